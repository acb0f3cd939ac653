"""Rigs: the pinhole views that a wide photo becomes, which share one center.

The views are the sides of a cube around the camera, of 90 degrees each and as many pixels per
degree in their middle as the photo has in its own. What the photo does not show is cut off; views
that would be nearly empty are left out. So no direction is shown twice.

A pixel of a view is the mean of what it covers in the photo, by ``SAMPLES`` x ``SAMPLES`` places
within it; a photo that has more than twice the resolution is reduced by an area filter before.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from igsr.capture.downscaling import reduced_size, resized_camera
from igsr.capture.types import Camera, intrinsic_matrix
from igsr.capture.wide_photos import WideFisheye, WidePhoto, lit_circle
from igsr.errors import IgsrError

Float64 = npt.NDArray[np.float64]
UInt8 = npt.NDArray[np.uint8]
Bool = npt.NDArray[np.bool_]

#: Places within a pixel, per axis, at which the photo is sampled.
SAMPLES = 2
#: The most pixels of a photo for one of a view, per axis, that are sampled.
OVERSAMPLED = 2.0
#: A view of which the photo shows less than this part of a cube's side is left out.
LEAST_SHOWN = 0.02
#: Pixels of a view mapped at a time: bounds memory.
_BAND_PIXELS = 1 << 16
#: Places per side of a cube at which it is looked whether the photo shows it.
_LOOKED_AT = 128
#: Where the sides of the cube look, as (right, down, forward) in the photo's frame.
_SIDES = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}


@dataclass(frozen=True, eq=False)
class Side:
    """One pinhole view of a wide photo.

    Attributes:
        name: where it looks: "front", "right", "back", "left", "up" or "down".
        camera: in the frame of the photo's camera, which is its world.
    """

    name: str
    camera: Camera

    def named(self, photo: str) -> str:
        """The view's name, by the photo's."""
        return f"{photo}/{self.name}.png"

    def in_world(self, viewmat: Float64) -> Camera:
        """Its camera in the world.

        Args:
            viewmat: [4, 4], world to the photo's camera.
        """
        camera = self.camera
        return Camera(camera.viewmat @ viewmat, camera.K, camera.width, camera.height)


@dataclass(frozen=True, eq=False)
class Rig:
    """The views of a wide photo.

    Attributes:
        photo: the wide photo, at its full size.
        sides: its views, at theirs.
    """

    photo: WidePhoto
    sides: tuple[Side, ...] = field(repr=False)


@functools.lru_cache(maxsize=64)
def rig_of(photo: WidePhoto) -> Rig:
    """The views that a wide photo becomes.

    Raises:
        IgsrError: it shows nothing.
    """
    focal = max(1.0, photo.pixels_per_radian)
    size = max(2, round(2.0 * focal))
    sides = []
    for name, axes in _SIDES.items():
        rotation = np.array(axes, dtype=np.float64)
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation
        shown = _shown_part(photo, rotation, size)
        if shown is None:
            continue
        left, top, right, bottom = shown
        # 90 degrees over ``size`` pixels.
        K = intrinsic_matrix(0.5 * size, 0.5 * size, 0.5 * size - left, 0.5 * size - top)
        sides.append(Side(name, Camera(viewmat, K, right - left, bottom - top)))
    if not sides:
        raise IgsrError("its lens shows nothing; correct its camera")
    return Rig(photo, tuple(sides))


def _shown_part(photo: WidePhoto, rotation: Float64, size: int) -> tuple[int, int, int, int] | None:
    """Left, top, right and bottom, in pixels, of what a side of the cube has of the photo."""
    count = min(size, _LOOKED_AT)
    at = (np.arange(count) + 0.5) * 2.0 / count - 1.0
    x, y = np.meshgrid(at, at)
    valid = photo.places(np.stack([x, y, np.ones_like(x)], axis=-1) @ rotation)[2]
    if valid.mean() < LEAST_SHOWN:
        return None
    spans = []
    for axis in (0, 1):
        seen = np.flatnonzero(valid.any(axis=axis))
        low, high = max(0, int(seen[0]) - 1), min(count, int(seen[-1]) + 2)
        spans.append((low * size // count, -(-high * size // count)))
    (left, right), (top, bottom) = spans
    return left, top, right, bottom


def sides_at(rig: Rig, max_size: int | None) -> tuple[list[Camera], tuple[int, int]]:
    """The views at the size that they are loaded at, and the photo's size that suffices for them.

    Args:
        rig: the views.
        max_size: longest side in pixels of a view; None keeps them as they are.

    Returns:
        Cameras in the frame of the photo's, and width and height of the photo, pixels.
    """
    cameras = [
        resized_camera(one.camera, *reduced_size(one.camera.width, one.camera.height, max_size))
        for one in rig.sides
    ]
    photo = rig.photo
    focal = max(camera.K[0, 0] for camera in cameras)
    factor = min(1.0, OVERSAMPLED * focal / photo.pixels_per_radian)
    return cameras, (math.ceil(factor * photo.width), math.ceil(factor * photo.height))


def shown_part(rig: Rig, image: UInt8, mask: Bool | None) -> Bool | None:
    """The mask of a wide photo; of a fisheye without one, the circle that has light."""
    if mask is not None or not isinstance(rig.photo, WideFisheye):
        return mask
    return lit_circle(image, rig.photo.resized(image.shape[1], image.shape[0]))


def sampled_views(
    rig: Rig, image: UInt8, mask: Bool | None, max_size: int | None
) -> list[tuple[Camera, UInt8, Bool | None]]:
    """Camera, photo and mask of each view.

    Args:
        rig: the views.
        image: uint8 [H, W, 3 or 4] of the wide photo, at its full size or that of ``sides_at``.
        mask: bool [H, W] of it, or None.
        max_size: as ``sides_at``.
    """
    photo = rig.photo.resized(image.shape[1], image.shape[0])
    views: list[tuple[Camera, UInt8, Bool | None]] = []
    for camera in sides_at(rig, max_size)[0]:
        sampler = SideSampler(photo, camera)
        pixels = sampler.image(image, mask)
        shown = sampler.valid if mask is None else sampler.mask(mask)
        views.append((camera, pixels, None if shown.all() else shown))
    return views


class SideSampler:
    """Samples one view from photos.

    Args:
        photo: the wide photo, at the size that is sampled.
        camera: the view, in the frame of the photo's camera.

    Attributes:
        valid: bool [H, W], True where the photo shows the whole pixel.
    """

    def __init__(self, photo: WidePhoto, camera: Camera) -> None:
        """Find what the photo shows of the view."""
        self._photo, self._camera = photo, camera
        self.valid = np.ones((camera.height, camera.width), dtype=bool)
        for band in self._bands():
            for _, _, valid in self._places(band):
                self.valid[band] &= valid

    def _bands(self) -> Iterator[slice]:
        rows = max(1, _BAND_PIXELS // self._camera.width)
        height = self._camera.height
        return (slice(top, min(top + rows, height)) for top in range(0, height, rows))

    def _places(self, band: slice) -> Iterator[tuple[Float64, Float64, Bool]]:
        """Places in the photo that the pixels of a band are sampled at."""
        camera = self._camera
        for down in range(SAMPLES):
            for right in range(SAMPLES):
                x = np.arange(camera.width) + (right + 0.5) / SAMPLES
                y = np.arange(band.start, band.stop) + (down + 0.5) / SAMPLES
                x, y = np.meshgrid(
                    (x - camera.K[0, 2]) / camera.K[0, 0], (y - camera.K[1, 2]) / camera.K[1, 1]
                )
                rays = np.stack([x, y, np.ones_like(x)], axis=-1)
                yield self._photo.places(rays @ camera.viewmat[:3, :3])

    def _taps(self, band: slice) -> Iterator[tuple[npt.NDArray[np.int64], npt.NDArray[np.float32]]]:
        """The photo's pixels that a band mixes, and their weights."""
        width, height = self._photo.width, self._photo.height
        for u, v, valid in self._places(band):
            u, v = np.where(valid, u, 0.5) - 0.5, np.where(valid, v, 0.5) - 0.5
            if not self._photo.wraps:
                u = np.clip(u, 0.0, width - 1.0)
            v = np.clip(v, 0.0, height - 1.0)
            left, up = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
            across, below = (u - left).astype(np.float32), (v - up).astype(np.float32)
            further, lower = left + 1, np.minimum(up + 1, height - 1)
            if self._photo.wraps:
                left, further = left % width, further % width
            else:
                further = np.minimum(further, width - 1)
            part = np.float32(1.0 / SAMPLES**2)
            yield up * width + left, part * (1.0 - across) * (1.0 - below)
            yield up * width + further, part * across * (1.0 - below)
            yield lower * width + left, part * (1.0 - across) * below
            yield lower * width + further, part * across * below

    def image(self, image: UInt8, mask: Bool | None = None) -> UInt8:
        """The view of a photo.

        Args:
            image: uint8 [H, W, 3 or 4] of the photo, alpha straight.
            mask: bool [H, W]; masked pixels lend no color where others can.

        Returns:
            uint8 [h, w, 3 or 4]; pixels that are not valid are 0.
        """
        channels = image.shape[2]
        # As in ``Undistorter``: a pixel is fetched as one word.
        padded = np.zeros((*image.shape[:2], 4), dtype=np.uint8)
        padded[..., :channels] = image
        words = padded.view(np.uint32).ravel()
        counted = None if mask is None else mask.ravel()
        out = np.zeros((*self.valid.shape, channels), dtype=np.uint8)
        for band in self._bands():
            mixed = np.zeros((*self.valid[band].shape, channels), dtype=np.float32)
            weights = np.zeros(self.valid[band].shape, dtype=np.float32)
            for index, weight in self._taps(band):
                pixels = words[index].view(np.uint8).reshape(*index.shape, 4)
                if counted is not None:
                    weight = weight * np.maximum(counted[index], np.float32(1e-6))
                weights += weight
                if channels == 4:
                    weight = weight * pixels[..., 3]
                    mixed[..., 3] += weight
                mixed[..., :3] += weight[..., None] * pixels[..., :3]
            if channels == 4:
                mixed[..., :3] /= np.maximum(mixed[..., 3:], 1e-9)
                mixed[..., 3] /= np.maximum(weights, 1e-9)
            else:
                mixed /= np.maximum(weights, 1e-9)[..., None]
            mixed[~self.valid[band]] = 0.0
            out[band] = np.clip(np.rint(mixed), 0.0, 255.0)
        return out

    def mask(self, mask: Bool) -> Bool:
        """The view of a mask, bool [H, W]: True where valid and sampled from unmasked pixels."""
        flat = mask.ravel()
        out = self.valid.copy()
        for band in self._bands():
            for index, weight in self._taps(band):
                # Less than a thousandth of a pixel is rounding.
                out[band] &= flat[index] | (weight < 1e-3)
        return out


def moved_to_side(
    xy: Float64, directions: Float64, photo: WidePhoto, camera: Camera
) -> tuple[Float64, Bool]:
    """Where observations of known points in a wide photo are in one of its views.

    As with lenses, a place moves with the projection of its point; what it is off that is turned
    and scaled as the view is against the photo there, so that errors stay what they are to first
    order.

    Args:
        xy: [M, 2], places in the photo, pixels.
        directions: [M, 3], of the points in the frame of the photo's camera.
        photo: the wide photo.
        camera: of the view, in that frame.

    Returns:
        Places [M, 2] in the view, and whether [M] the view shows them.
    """
    norms = np.linalg.norm(directions, axis=1, keepdims=True)
    unit = directions / np.where(norms > 0.0, norms, 1.0)
    # Two tangents, from the axis that is least along the direction.
    least = np.eye(3)[np.abs(unit).argmin(axis=1)]
    first = np.cross(unit, least)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    second = np.cross(unit, first)

    def in_photo(rays: Float64) -> Float64:
        u, v, _ = photo.places(rays)
        return np.stack([u, v], axis=1)

    def in_view(rays: Float64) -> Float64:
        local = rays @ camera.viewmat[:3, :3].T
        with np.errstate(all="ignore"):
            flat = local[:, :2] / local[:, 2:]
        return np.asarray(flat * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2])

    def across_edge(difference: Float64) -> Float64:
        if photo.wraps:
            difference[:, 0] -= photo.width * np.round(difference[:, 0] / photo.width)
        return difference

    step = 1e-5
    of_photo = np.stack(
        [
            across_edge(in_photo(unit + step * t) - in_photo(unit - step * t))
            for t in (first, second)
        ],
        axis=2,
    )
    of_view = np.stack(
        [in_view(unit + step * t) - in_view(unit - step * t) for t in (first, second)], axis=2
    )
    ahead = (unit @ camera.viewmat[2, :3]) > 1e-6
    determinant = of_photo[:, 0, 0] * of_photo[:, 1, 1] - of_photo[:, 0, 1] * of_photo[:, 1, 0]
    usable = ahead & np.isfinite(of_view).all(axis=(1, 2)) & (np.abs(determinant) > 1e-30)
    places = np.full((len(xy), 2), np.nan)
    off = across_edge(xy - in_photo(unit))
    turned = np.linalg.solve(of_photo[usable], off[usable, :, None])
    places[usable] = in_view(unit[usable]) + (of_view[usable] @ turned)[..., 0]
    with np.errstate(invalid="ignore"):
        inside = (places >= 0.0).all(axis=1) & (places <= (camera.width, camera.height)).all(axis=1)
    return places, usable & inside
