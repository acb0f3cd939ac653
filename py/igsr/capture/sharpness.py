"""How blurred photos are, whatever they show, and which stand out among the others.

A photo is compared with itself under a further blur: what is blurred already changes little (Crete
et al., "The Blur Effect: Perception and Estimation with a New No-reference Perceptual Blur Metric",
2007).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]
UInt8 = npt.NDArray[np.uint8]
Bool = npt.NDArray[np.bool_]

#: Pixels of the longer side, about, at which photos are compared: less blur harms few fits, and
#: noise is averaged.
LONGEST = 480
#: A photo stands out where it is blurred by more than this, and by so much more than the others in
#: the median. Photos of eleven captures have 0.2 to 0.46; a blur by 0.4 percent of the width, 0.65.
BLURRED, MORE_THAN_OTHERS = 0.6, 0.2
#: Pixels of the further blur.
_BLUR = 9


def blur(image: UInt8, mask: Bool | None = None) -> float:
    """How blurred a photo is: 0 for noise, 1 for what shows no detail.

    Args:
        image: uint8 [H, W, 3 or 4].
        mask: bool [H, W] of the pixels that count, or None.
    """
    factor = max(1, round(max(image.shape[:2]) / LONGEST))
    gray = _reduced(image[..., :3].mean(axis=2), factor)
    counted = np.ones(gray.shape, dtype=bool) if mask is None else _reduced(mask, factor) > 0.999
    if image.shape[2] == 4:
        counted &= _reduced(image[..., 3], factor) > 254.0
    ratios = []
    for axis in (0, 1):
        plane = gray if axis == 0 else gray.T
        used = counted if axis == 0 else counted.T
        if len(plane) <= _BLUR:
            return 0.0
        blurred = _means(plane)
        both = used[1:] & used[:-1]
        before = np.abs(np.diff(plane, axis=0))[both]
        after = np.abs(np.diff(blurred, axis=0))[both]
        total = float(before.sum())
        if total <= 1e-9 * max(1, before.size):
            return 1.0
        ratios.append(1.0 - float(np.maximum(before - after, 0.0).sum()) / total)
    return max(ratios)


def blurred_photos(photos: Iterable[tuple[str, UInt8, Bool | None]]) -> set[str]:
    """Names of photos that are blurred where the others are not.

    Of a panorama, the sharpest view counts.

    Args:
        photos: name, image and mask of each; views of one panorama have one name.
    """
    found: dict[str, float] = {}
    for name, image, mask in photos:
        found[name] = min(found.get(name, 1.0), blur(image, mask))
    usual = float(np.median(list(found.values()))) if found else 0.0
    limit = max(BLURRED, usual + MORE_THAN_OTHERS)
    # What shows nothing at all has no detail to be blurred; it is told apart elsewhere.
    return {name for name, value in found.items() if limit < value < 1.0}


def _reduced(plane: np.ndarray, factor: int) -> Float64:
    """Means of squares; what is left over at the right and below does not count."""
    height, width = (max(1, length // factor) for length in plane.shape)
    whole = plane[: height * factor, : width * factor].astype(np.float64)
    parts = whole.reshape(height, whole.shape[0] // height, width, whole.shape[1] // width)
    return np.asarray(parts.mean(axis=(1, 3)))


def _means(plane: Float64) -> Float64:
    half = _BLUR // 2
    padded = np.pad(plane, ((half + 1, half), (0, 0)), mode="edge").cumsum(axis=0)
    return np.asarray((padded[_BLUR:] - padded[:-_BLUR]) / _BLUR)
