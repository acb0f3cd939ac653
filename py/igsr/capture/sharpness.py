"""Measure the blur of photos, and find photos that are blurrier than the rest.

A photo is compared with itself after another blur, which changes a blurred photo little (Crete et
al., "The Blur Effect: Perception and Estimation with a New No-reference Perceptual Blur Metric",
2007).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]
UInt8 = npt.NDArray[np.uint8]
Bool = npt.NDArray[np.bool_]

#: Longer side of the reduced photos that are compared: less blur harms few fits, and reduction
#: averages noise.
_REDUCED_SIDE_PX = 480
#: Minimum blur of a photo that is reported, and its minimum excess over the median. Photos of
#: eleven captures have 0.2 to 0.46; after a blur by 0.4 percent of the width, 0.65.
_MIN_BLUR = 0.6
_MIN_BLUR_OVER_MEDIAN = 0.2
#: Width of the second blur.
_BLUR_PX = 9


def blur(image: UInt8, mask: Bool | None = None) -> float:
    """Measure the blur of a photo: 0 for noise, 1 without any detail.

    Args:
        image: uint8 [H, W, 3 or 4].
        mask: bool [H, W] of the pixels that count, or None.
    """
    factor = max(1, round(max(image.shape[:2]) / _REDUCED_SIDE_PX))
    gray = _reduced(image[..., :3].mean(axis=2), factor)
    counted = np.ones(gray.shape, dtype=bool) if mask is None else _reduced(mask, factor) > 0.999
    if image.shape[2] == 4:
        counted &= _reduced(image[..., 3], factor) > 254.0
    ratios = []
    for plane, used in ((gray, counted), (gray.T, counted.T)):
        if len(plane) <= _BLUR_PX:
            return 0.0
        both = used[1:] & used[:-1]
        before = np.abs(np.diff(plane, axis=0))[both]
        after = np.abs(np.diff(row_means(plane, _BLUR_PX), axis=0))[both]
        total = float(before.sum())
        if total <= 1e-9 * max(1, before.size):
            return 1.0
        ratios.append(1.0 - float(np.maximum(before - after, 0.0).sum()) / total)
    return max(ratios)


def blurred_photos(photos: Iterable[tuple[str, UInt8, Bool | None]]) -> set[str]:
    """Return the names of photos that are much blurrier than the rest.

    The sharpest view of a panorama counts. Photos without any detail are not reported as blurred.

    Args:
        photos: name, image and mask of each; views of one panorama share one name.
    """
    blurs: dict[str, float] = {}
    for name, image, mask in photos:
        blurs[name] = min(blurs.get(name, 1.0), blur(image, mask))
    median = float(np.median(list(blurs.values()))) if blurs else 0.0
    limit = max(_MIN_BLUR, median + _MIN_BLUR_OVER_MEDIAN)
    return {name for name, value in blurs.items() if limit < value < 1.0}


def _reduced(plane: np.ndarray, factor: int) -> Float64:
    """Means of squares; incomplete squares at the right and bottom are dropped."""
    height, width = (max(1, length // factor) for length in plane.shape)
    cropped = plane[: height * factor, : width * factor].astype(np.float64)
    squares = cropped.reshape(height, cropped.shape[0] // height, width, cropped.shape[1] // width)
    return np.asarray(squares.mean(axis=(1, 3)))


def row_means(plane: Float64, rows: int) -> Float64:
    """Return the mean of an odd number of rows around each pixel, float64 [H, W]."""
    half = rows // 2
    padded = np.pad(plane, ((half + 1, half), (0, 0)), mode="edge").cumsum(axis=0)
    return np.asarray((padded[rows:] - padded[:-rows]) / rows)
