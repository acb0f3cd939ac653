"""Errors against the f64 reference: of a picture, and of gradients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr_lab.bench.scenes import Arrays

#: Error beyond which a pixel of the band is left out (bounds: docs/how-it-works/numerics.md):
#: for 2D splats handed over as they are, and for pictures from splats.
BOUND_2D = {"reference": 0.0, "cpu": 2e-6, "gpu": 2e-5}
BOUND_3D = {"reference": 0.0, "cpu": 1e-4, "gpu": 1e-4}
#: A pair that is blended in one picture and not in the other changes the transmittance by 1/255 of
#: itself at least, and rounding by far less. Behind something nearly opaque the colour hardly shows
#: it; the gradients of the splats there do.
FLIP = 1e-3


@dataclass(frozen=True)
class Error:
    """How far something is from the reference.

    Attributes:
        max, mean: largest and mean absolute difference; of gradients, as parts of the largest of
            their kind, for the kind where each is worst.
        where: the kind with the largest maximum, such as "v_means".
    """

    max: float
    mean: float
    where: str


@dataclass(frozen=True)
class Band:
    """Pixels at which an f32 implementation may rightly differ.

    Attributes:
        pixels: how many there are, of ``of``.
        left_out: bool [H, W], those that differ by more than the bound, or that blended other
            pairs (``FLIP``); only they do not count.
    """

    pixels: int
    of: int
    left_out: npt.NDArray[np.bool_]


def picture_error(
    got: Arrays, expected: Arrays, band: npt.NDArray[np.bool_], bound: float
) -> tuple[Error, Band]:
    """Error of colour and alpha over the pixels that ``expected`` has (NaN elsewhere)."""
    known = np.isfinite(expected["alpha"])
    difference = np.maximum(
        np.abs(got["color"] - expected["color"]).max(axis=2),
        np.abs(got["alpha"] - expected["alpha"]),
    )
    # What is not finite counts as infinitely wrong: a maximum would pass over NaN.
    difference = np.where(np.isfinite(difference), difference, np.inf)
    through = got["transmittance"] / expected["transmittance"]
    flipped = ~(np.abs(through - 1.0) <= FLIP)
    left_out = known & band & ((difference > bound) | flipped)
    counted = known & ~left_out
    values = difference[counted]
    error = Error(float(values.max()), float(values.mean()), "picture")
    return error, Band(int((band & known).sum()), int(known.sum()), left_out)


def gradient_error(got: Arrays, expected: Arrays) -> Error:
    """Error of all gradients that both have, each kind in parts of its largest."""
    worst, worst_mean, where = -1.0, 0.0, ""
    for name in sorted(got.keys() & expected.keys()):
        largest = np.abs(expected[name]).max(initial=0.0)
        if largest == 0.0:
            largest = 1.0
        difference = np.abs(np.asarray(got[name], dtype=np.float64) - expected[name]) / largest
        difference = np.where(np.isfinite(difference), difference, np.inf)
        most = float(difference.max(initial=0.0))
        if most > worst:
            worst, where = most, name
        worst_mean = max(worst_mean, float(difference.mean()) if difference.size else 0.0)
    return Error(worst, worst_mean, where)


def errors_row(of: str, error: Error, band: Band, other: Error | None = None) -> dict[str, Any]:
    """The error columns of a row; ``other`` is the picture's where ``error`` is the gradients'."""
    row: dict[str, Any] = {
        "error_of": of,
        "max_error": error.max,
        "mean_error": error.mean,
        "worst": error.where,
    }
    if other is not None:
        row |= {"picture_max_error": other.max, "picture_mean_error": other.mean}
    return row | {
        "compared_pixels": band.of,
        "band_pixels": band.pixels,
        "left_out_pixels": int(band.left_out.sum()),
    }
