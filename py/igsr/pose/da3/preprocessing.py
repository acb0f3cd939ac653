"""Photos as Depth Anything 3 was trained to see them, and the way back to their pixels.

The filters are OpenCV's, which the models were trained with: areas where a photo shrinks, cubic
convolution without antialiasing where it grows. Each is two matrices, one for rows and one for
columns, in float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igsr.errors import IgsrError
from igsr.pose.da3.config import PATCH, RESOLUTION
from igsr.pose.grid import Grid

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
UInt8 = npt.NDArray[np.uint8]

#: The side that is brought to the resolution, and how both become multiples of a patch.
METHODS = ("upper_bound_resize", "upper_bound_crop", "lower_bound_resize", "lower_bound_crop")
#: Mean and deviation of the training photos' channels.
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
#: Of the cubic convolution.
CUBIC = -0.75


@dataclass(frozen=True)
class Resampling:
    """How a photo comes to the size that the network sees.

    Attributes:
        photo_width, photo_height: pixels of the photo.
        scaled_width, scaled_height: pixels that it is scaled to, its aspect kept.
        resized_width, resized_height: pixels that it is then resized to.
        left, top: pixels that are then cut off on these sides.
        width, height: pixels of what is left, multiples of 14.
    """

    photo_width: int
    photo_height: int
    scaled_width: int
    scaled_height: int
    resized_width: int
    resized_height: int
    left: int
    top: int
    width: int
    height: int

    def grid(self) -> Grid:
        """How the network's pixels lie in the photo."""
        scale_x = self.photo_width / self.resized_width
        scale_y = self.photo_height / self.resized_height
        return Grid(
            self.height, self.width, scale_x, scale_y, self.left * scale_x, self.top * scale_y
        )

    def intrinsics(self, K: Float64) -> Float64:
        """Intrinsics [3, 3] in the network's pixels of those in the photo's."""
        scale_x = self.resized_width / self.photo_width
        scale_y = self.resized_height / self.photo_height
        scaled: Float64 = np.diag([scale_x, scale_y, 1.0]) @ K
        scaled[:2, 2] -= self.left, self.top
        return scaled

    def resized(self, width: int, height: int) -> Resampling:
        """The same, resized to another size; nothing may be cut."""
        sizes = {"resized_width": width, "resized_height": height}
        return replace(self, **sizes, width=width, height=height)

    def cut(self, width: int, height: int) -> Resampling:
        """The same, cut about the middle to a smaller size."""
        left = self.left + (self.width - width) // 2
        top = self.top + (self.height - height) // 2
        return replace(self, left=left, top=top, width=width, height=height)


def resampling_of(
    width: int, height: int, resolution: int = RESOLUTION, method: str = METHODS[0]
) -> Resampling:
    """How a photo of a size is brought to the network's.

    Args:
        width, height: of the photo, pixels.
        resolution: pixels of the longer side ("upper") or the shorter ("lower").
        method: one of ``METHODS``; "resize" changes the aspect so that both sides become the
            nearest multiples of 14, "crop" cuts about the middle.

    Raises:
        IgsrError: the method is unknown, the resolution is no whole number of at least 14, or the
            photo is so narrow that nothing is left of a side.
    """
    if method not in METHODS:
        raise IgsrError(f"method is {method!r}; give one of {', '.join(METHODS)}")
    if type(resolution) is not int or resolution < PATCH:
        raise IgsrError(f"resolution is {resolution!r}; give a whole number of at least {PATCH}")
    side = (max if method.startswith("upper") else min)(width, height)
    scale = resolution / side
    scaled_width, scaled_height = width, height
    if side != resolution:
        scaled_width, scaled_height = (max(1, round(n * scale)) for n in (width, height))
    if method.endswith("resize"):
        kept_width, kept_height = (
            (n + PATCH // 2) // PATCH * PATCH for n in (scaled_width, scaled_height)
        )
        resized_width, resized_height = kept_width, kept_height
    else:
        kept_width, kept_height = (n // PATCH * PATCH for n in (scaled_width, scaled_height))
        resized_width, resized_height = scaled_width, scaled_height
    if min(kept_width, kept_height) < PATCH:
        raise IgsrError(
            f"a photo of {width}x{height} pixels is too narrow for Depth Anything 3; crop it or "
            "leave it out"
        )
    return Resampling(
        photo_width=width,
        photo_height=height,
        scaled_width=scaled_width,
        scaled_height=scaled_height,
        resized_width=resized_width,
        resized_height=resized_height,
        left=(resized_width - kept_width) // 2,
        top=(resized_height - kept_height) // 2,
        width=kept_width,
        height=kept_height,
    )


def network_inputs(
    images: Sequence[UInt8],
    resolution: int = RESOLUTION,
    method: str = METHODS[0],
    intrinsics: Sequence[npt.ArrayLike] | None = None,
) -> tuple[Float32, Float64 | None]:
    """Photos of one pass at one size; those of other sizes are cut about the middle to the least.

    Args:
        images: uint8 [H, W, 3] each, RGB.
        resolution, method: as ``resampling_of``.
        intrinsics: float [3, 3] each, pixels of the images, or None.

    Returns:
        float32 [S, 3, h, w], normalised, and the intrinsics float64 [S, 3, 3] in its pixels.

    Raises:
        IgsrError: as ``resampling_of``; there is no image, one is no uint8 [H, W, 3], or there are
            not as many intrinsics.
    """
    if len(images) == 0:
        raise IgsrError("images is empty; give at least one")
    if intrinsics is not None and len(intrinsics) != len(images):
        raise IgsrError(
            f"intrinsics are {len(intrinsics)} and images {len(images)}; give one for each"
        )
    for n, image in enumerate(images):
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise IgsrError(f"image {n} is {image.dtype} {list(image.shape)}; give uint8 [H, W, 3]")
    resamplings = [
        resampling_of(image.shape[1], image.shape[0], resolution, method) for image in images
    ]
    width, height = (
        min(resampling.width for resampling in resamplings),
        min(resampling.height for resampling in resamplings),
    )
    resamplings = [resampling.cut(width, height) for resampling in resamplings]
    pixels = np.stack(
        [
            network_input(image, resampling)
            for image, resampling in zip(images, resamplings, strict=True)
        ]
    )
    if intrinsics is None:
        return pixels, None
    pairs = zip(intrinsics, resamplings, strict=True)
    return pixels, np.stack(
        [resampling.intrinsics(np.asarray(K, np.float64)) for K, resampling in pairs]
    )


def network_input(image: UInt8, resampling: Resampling) -> Float32:
    """A photo as the network sees it, float32 [3, h, w].

    Args:
        image: uint8 [H, W, 3].
        resampling: of ``resampling_of`` for its size.
    """
    levels = grey_levels(image, resampling).astype(np.float32) / np.float32(255.0)
    normalised = (levels - np.array(MEAN, np.float32)) / np.array(DEVIATION, np.float32)
    return np.ascontiguousarray(normalised.transpose(2, 0, 1))


def grey_levels(image: UInt8, resampling: Resampling) -> UInt8:
    """A photo's pixels uint8 [h, w, 3] at the network's size, as ``network_input``."""
    image = _resampled(image, resampling.scaled_width, resampling.scaled_height)
    image = _resampled(image, resampling.resized_width, resampling.resized_height)
    return image[
        resampling.top : resampling.top + resampling.height,
        resampling.left : resampling.left + resampling.width,
    ]


def _resampled(image: UInt8, width: int, height: int) -> UInt8:
    before = image.shape[:2]
    if before == (height, width):
        return image
    matrix = cubic_matrix if height > before[0] or width > before[1] else area_matrix
    down, across = matrix(before[0], height), matrix(before[1], width)
    channels = [down @ image[..., c].astype(np.float64) @ across.T for c in range(3)]
    # As float32, so that what the last places of float64 say does not decide which way a half goes.
    levels = np.stack(channels, axis=-1).astype(np.float32)
    return np.clip(np.rint(levels), 0.0, 255.0).astype(np.uint8)


def area_matrix(size: int, wanted: int) -> Float64:
    """[wanted, size]: each of ``wanted`` pixels as the mean of the pixels that it covers."""
    edges = np.arange(wanted + 1)[:, None] * (size / wanted)
    covered = np.clip(edges - np.arange(size), 0.0, 1.0)
    weights: Float64 = np.diff(covered, axis=0) * (wanted / size)
    return weights


def cubic_matrix(size: int, wanted: int) -> Float64:
    """[wanted, size]: each of ``wanted`` pixels from its four nearest by cubic convolution."""
    place = (np.arange(wanted) + 0.5) * (size / wanted) - 0.5
    first = np.floor(place).astype(np.int64)
    matrix = np.zeros((wanted, size))
    for tap in range(-1, 3):
        at = np.clip(first + tap, 0, size - 1)
        np.add.at(matrix, (np.arange(wanted), at), _cubic(np.abs(place - first - tap)))
    return matrix


def _cubic(distance: Float64) -> Float64:
    near = ((CUBIC + 2.0) * distance - (CUBIC + 3.0)) * distance**2 + 1.0
    far = CUBIC * (((distance - 5.0) * distance + 8.0) * distance - 4.0)
    return np.where(distance <= 1.0, near, np.where(distance < 2.0, far, 0.0))
