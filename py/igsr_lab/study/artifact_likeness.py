"""How alike the errors of two sets of renders are: real captures' and the training pairs'.

An error is a render less the true picture. What tells artifacts apart is how coarse they are: the
part of the error's power in each octave of spatial frequency, and how much of it few pixels hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr._internal.atomic_write import atomic_write
from igsr.denoiser.inputs import COLOR
from igsr_lab.denoiser.pair_files import Pairs

Float64 = npt.NDArray[np.float64]

#: Upper edges of the octaves, cycles per pixel along a row or column.
OCTAVES = 0.5 / 2.0 ** np.arange(6)[::-1]
#: The part of the pixels, those with the largest errors, whose share of the power is taken.
WORST = 0.1
NAMES = (*(f"power up to {edge:.3g} cycles per pixel" for edge in OCTAVES), "power in worst tenth")


@dataclass(frozen=True)
class Likeness:
    """How far real renders' errors are from synthetic ones', beside what that can be.

    Attributes:
        distance: octaves between the two sets; None where one has no render, here and below.
        within: octaves between two halves of the synthetic files: what chance makes of it.
        noise: octaves between the real set and white noise: what a recipe unlike it would have.
        real: median signature of the real set, by ``NAMES``; empty without renders.
        synthetic: median signature of the synthetic set.
        renders: how many each set has, by "real" and "synthetic".
    """

    distance: float | None
    within: float | None
    noise: float | None
    real: dict[str, float]
    synthetic: dict[str, float]
    renders: dict[str, int]


def signatures(pairs: Sequence[Pairs]) -> Float64:
    """One row per render: shares of the error's power by octave, and in the worst pixels.

    Renders without an error, or with pixels whose truth is unknown, are left out: edges of masks
    have spectra of their own.
    """
    rows = []
    for one in pairs:
        for seen, truth, mask in zip(one.inputs[:, :COLOR], one.truth, one.masks, strict=True):
            error = (seen.astype(np.float64) - truth).mean(axis=0)
            if mask.all() and error.any():
                rows.append(_signature(error))
    return np.array(rows).reshape(len(rows), len(NAMES))


def _signature(error: Float64) -> Float64:
    height, width = error.shape
    # Without a window the picture's own border would count as an error of all frequencies.
    window = np.hanning(height + 2)[1:-1, None] * np.hanning(width + 2)[None, 1:-1]
    power = np.abs(np.fft.fft2(error * window)) ** 2
    frequency = np.maximum(
        np.abs(np.fft.fftfreq(height))[:, None], np.abs(np.fft.fftfreq(width))[None]
    )
    octave = np.searchsorted(OCTAVES, frequency.ravel() - 1e-12)
    shares = np.bincount(octave, power.ravel(), minlength=len(OCTAVES))[: len(OCTAVES)]
    squares = np.sort(np.square(error).ravel())
    worst = squares[int((1.0 - WORST) * len(squares)) :].sum() / squares.sum()
    return np.append(shares / max(float(shares.sum()), 1e-300), worst)


def distance(first: Float64, second: Float64) -> float:
    """Mean over the entries of a signature of how far two sets' medians are apart, in octaves."""
    medians = [np.log2(np.maximum(np.median(rows, axis=0), 1e-6)) for rows in (first, second)]
    return float(np.mean(np.abs(medians[0] - medians[1])))


def likeness(real: Sequence[Pairs], synthetic: Sequence[Pairs], seed: int = 0) -> Likeness:
    """How far real renders' errors are from synthetic ones'; ``seed`` draws the white noise."""
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
    """Plot a real artifact beside a synthetic one, render and error, and both sets' spectra.

    Raises:
        IgsrError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    axes = figure.subplot_mosaic(
        [["real", "real error", "spectra"], ["synthetic", "synthetic error", "spectra"]],
        width_ratios=[1, 1, 1.6],
    )
    for name, pairs, medians in (
        ("real", real, found.real),
        ("synthetic", synthetic, found.synthetic),
    ):
        if pairs:
            one = pairs[0]
            seen, truth = (np.moveaxis(x[0], 0, -1) for x in (one.inputs[:, :COLOR], one.truth))
            axes[name].imshow(seen)
            error = np.abs(seen.astype(np.float64) - truth).mean(axis=-1)
            axes[f"{name} error"].imshow(error, vmin=0.0, vmax=96.0, cmap="magma")
        for shown in (name, f"{name} error"):
            axes[shown].set_title(shown, fontsize=9)
            axes[shown].set_axis_off()
        shares = list(medians.values())[: len(OCTAVES)]
        if shares:
            axes["spectra"].loglog(OCTAVES, shares, "o-", label=name)
    axes["spectra"].set_xticks(OCTAVES, [f"{edge:.3g}" for edge in OCTAVES])
    axes["spectra"].set_xticks([], minor=True)
    axes["spectra"].set_xlabel("upper edge of the octave, cycles per pixel")
    axes["spectra"].set_ylabel("share of the error's power")
    axes["spectra"].grid(alpha=0.3, which="both")
    axes["spectra"].legend()
    if found.distance is not None:
        axes["spectra"].set_title(f"{found.distance:.2f} octaves apart", fontsize=9)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
