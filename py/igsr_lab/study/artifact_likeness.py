"""Similarity of the errors in renders of real captures and in training pairs.

An error is a render minus the photo. Artifacts differ by scale: the share of the error's power in
each octave of spatial frequency, and the share in the few worst pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr.denoiser.inputs import COLOR
from igsr_lab.denoiser.pair_files import Pairs
from igsr_lab.report_parts import new_figure, save_figure

Float64 = npt.NDArray[np.float64]

#: Upper edges of the octaves, cycles per pixel along a row or column.
OCTAVES = 0.5 / 2.0 ** np.arange(6)[::-1]
#: Fraction of the pixels that counts as worst.
WORST_FRACTION = 0.1
NAMES = (*(f"power up to {edge:.3g} cycles per pixel" for edge in OCTAVES), "power in worst tenth")
#: Absolute error, of 255, that is drawn brightest.
BRIGHTEST_ERROR = 96.0


@dataclass(frozen=True)
class Likeness:
    """Distance between the errors of real and synthetic renders."""

    #: Octaves between the two sets; None if one has no render, here and below.
    distance: float | None
    #: Octaves between two halves of the synthetic files, the distance by chance.
    within: float | None
    #: Octaves between the real set and white noise, the distance of a wrong recipe.
    noise: float | None
    real: dict[str, float]  # median signature of the real set, by ``NAMES``; empty without renders
    synthetic: dict[str, float]  # median signature of the synthetic set
    renders: dict[str, int]  # number of renders of "real" and "synthetic"


def signatures(pairs: Sequence[Pairs]) -> Float64:
    """One row per render: shares of the error's power by octave, and in the worst pixels.

    Renders without errors are left out, and masked renders, whose edges would add frequencies.
    """
    rows = []
    for one in pairs:
        for render, truth, mask in zip(one.inputs[:, :COLOR], one.truth, one.masks, strict=True):
            error = (render.astype(np.float64) - truth).mean(axis=0)
            if mask.all() and error.any():
                rows.append(_signature(error))
    return np.array(rows).reshape(len(rows), len(NAMES))


def _signature(error: Float64) -> Float64:
    height, width = error.shape
    # Without a window, the picture's border would count as an error of all frequencies.
    window = np.hanning(height + 2)[1:-1, None] * np.hanning(width + 2)[None, 1:-1]
    power = np.abs(np.fft.fft2(error * window)) ** 2
    frequency = np.maximum(
        np.abs(np.fft.fftfreq(height))[:, None], np.abs(np.fft.fftfreq(width))[None]
    )
    octave = np.searchsorted(OCTAVES, frequency.ravel() - 1e-12)
    shares = np.bincount(octave, power.ravel(), minlength=len(OCTAVES))[: len(OCTAVES)]
    squares = np.sort(np.square(error).ravel())
    worst = squares[int((1.0 - WORST_FRACTION) * len(squares)) :].sum() / squares.sum()
    return np.append(shares / max(float(shares.sum()), 1e-300), worst)


def distance(first: Float64, second: Float64) -> float:
    """Mean difference of two sets' median signatures, in octaves."""
    medians = [np.log2(np.maximum(np.median(rows, axis=0), 1e-6)) for rows in (first, second)]
    return float(np.mean(np.abs(medians[0] - medians[1])))


def likeness(real: Sequence[Pairs], synthetic: Sequence[Pairs], seed: int = 0) -> Likeness:
    """Compare the errors of real and synthetic renders; ``seed`` draws the white noise."""
    sets = {"real": signatures(real), "synthetic": signatures(synthetic)}
    halves = [signatures(synthetic[start::2]) for start in (0, 1)]
    random = np.random.default_rng(seed)
    noise = np.stack([_signature(random.normal(size=(128, 128))) for _ in range(16)])

    def between(first: Float64, second: Float64) -> float | None:
        return distance(first, second) if len(first) and len(second) else None

    return Likeness(
        distance=between(sets["real"], sets["synthetic"]),
        within=between(*halves),
        noise=between(sets["real"], noise),
        real=_medians(sets["real"]),
        synthetic=_medians(sets["synthetic"]),
        renders={name: len(rows) for name, rows in sets.items()},
    )


def _medians(rows: Float64) -> dict[str, float]:
    if not len(rows):
        return {}
    return dict(zip(NAMES, np.median(rows, axis=0).tolist(), strict=True))


def plot_likeness(
    path: Path, found: Likeness, real: Sequence[Pairs], synthetic: Sequence[Pairs]
) -> None:
    """Plot a real and a synthetic render with their errors, and both sets' spectra."""
    figure = new_figure(11.0, 4.6)
    axes = figure.subplot_mosaic(
        [["real", "real error", "spectra"], ["synthetic", "synthetic error", "spectra"]],
        width_ratios=[1, 1, 1.6],
    )
    spectra = axes["spectra"]
    for name, pairs, medians in (
        ("real", real, found.real),
        ("synthetic", synthetic, found.synthetic),
    ):
        if pairs:
            render, truth = (
                np.moveaxis(pictures[0], 0, -1)
                for pictures in (pairs[0].inputs[:, :COLOR], pairs[0].truth)
            )
            axes[name].imshow(render)
            error = np.abs(render.astype(np.float64) - truth).mean(axis=-1)
            axes[f"{name} error"].imshow(error, vmin=0.0, vmax=BRIGHTEST_ERROR, cmap="magma")
        for shown in (name, f"{name} error"):
            axes[shown].set_title(shown, fontsize=9)
            axes[shown].set_axis_off()
        shares = list(medians.values())[: len(OCTAVES)]
        if shares:
            spectra.loglog(OCTAVES, shares, "o-", label=name)
    spectra.set_xticks(OCTAVES, [f"{edge:.3g}" for edge in OCTAVES])
    spectra.set_xticks([], minor=True)
    spectra.set_xlabel("upper edge of the octave, cycles per pixel")
    spectra.set_ylabel("share of the error's power")
    spectra.grid(alpha=0.3, which="both")
    spectra.legend()
    if found.distance is not None:
        spectra.set_title(f"{found.distance:.2f} octaves apart", fontsize=9)
    save_figure(figure, path, dpi=110)
