"""Errors of pictures and gradients against the f64 reference."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr_lab.bench.scenes import Arrays

#: Error above which a pixel of the band is left out (bounds: docs/how-it-works/numerics.md), for
#: pictures of given 2D splats and of splats.
BOUND_2D = {"reference": 0.0, "cpu": 2e-6, "gpu": 2e-5}
BOUND_3D = {"reference": 0.0, "cpu": 1e-4, "gpu": 1e-4}
#: Minimum relative change of the transmittance that is a flip: a pair that is blended in one of two
#: pictures changes it by at least 1/255, rounding by far less. Behind nearly opaque splats, the
#: color hardly changes, but gradients do.
MIN_FLIP = 1e-3


@dataclass(frozen=True)
class Error:
    """Difference from the reference."""

    #: Largest absolute difference; for gradients relative to the largest of their kind, of the
    #: worst kind.
    max: float
    mean: float  # the same for the mean
    where: str  # the kind with the largest maximum, such as "v_means"


@dataclass(frozen=True)
class Band:
    """Pixels at which an f32 implementation may differ."""

    pixels: int  # their number, out of ``of``
    of: int
    #: bool [H, W], pixels that are not compared, as they differ by more than the bound or are
    #: flipped.
    left_out: npt.NDArray[np.bool_]


def picture_error(
    got: Arrays, expected: Arrays, band: npt.NDArray[np.bool_], bound: float
) -> tuple[Error, Band]:
    """Error of color and alpha over the pixels of ``expected`` (NaN elsewhere)."""
    known = np.isfinite(expected["alpha"])
    difference = np.maximum(
        np.abs(got["color"] - expected["color"]).max(axis=2),
        np.abs(got["alpha"] - expected["alpha"]),
    )
    # A maximum would ignore NaN.
    difference = np.where(np.isfinite(difference), difference, np.inf)
    through = got["transmittance"] / expected["transmittance"]
    flipped = ~(np.abs(through - 1.0) <= MIN_FLIP)
    left_out = known & band & ((difference > bound) | flipped)
    values = difference[known & ~left_out]
    error = Error(float(values.max()), float(values.mean()), "picture")
    return error, Band(int((band & known).sum()), int(known.sum()), left_out)


def gradient_error(got: Arrays, expected: Arrays) -> Error:
    """Error of all gradients that both have, each kind relative to its largest."""
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


def size_row(workload: str, backend: str, splats: int, width: int, height: int) -> dict[str, Any]:
    """The columns of a row for its workload."""
    return {
        "workload": workload,
        "backend": backend,
        "splats": splats,
        "width": width,
        "height": height,
    }


def errors_row(of: str, error: Error, band: Band, picture: Error | None = None) -> dict[str, Any]:
    """The error columns of a row; ``picture`` is the picture's error if ``error`` is another."""
    row: dict[str, Any] = {
        "error_of": of,
        "max_error": error.max,
        "mean_error": error.mean,
        "worst": error.where,
    }
    if picture is not None:
        row |= {"picture_max_error": picture.max, "picture_mean_error": picture.mean}
    return row | {
        "compared_pixels": band.of,
        "band_pixels": band.pixels,
        "left_out_pixels": int(band.left_out.sum()),
    }
