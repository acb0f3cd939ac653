"""Rigs: the pinhole views of a wide photo, which share one center.

The views are the sides of a cube around the camera, of 90 degrees each and with as many pixels per
degree in their middle as the photo has in its own. They are cropped to what the photo shows, and
nearly empty ones are dropped. So no direction is shown twice.

A pixel of a view is the mean of ``SAMPLES`` x ``SAMPLES`` places in the photo; a photo of more than
twice the resolution is first reduced by an area filter.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from igsr.capture.downscaling import reduced_size, resized_camera
from igsr.capture.types import Camera, intrinsic_matrix
from igsr.capture.undistort import Sampler
from igsr.capture.wide_photos import WideFisheye, WidePhoto, lit_circle
from igsr.errors import IgsrError

Float64 = npt.NDArray[np.float64]
UInt8 = npt.NDArray[np.uint8]
Bool = npt.NDArray[np.bool_]

#: Samples of the photo per axis and pixel of a view.
SAMPLES = 2
#: Maximum pixels of the decoded photo per axis and pixel of a view.
MAX_OVERSAMPLING = 2.0
#: Views that show less than this part of a cube's side are dropped.
MIN_SHOWN_PART = 0.02
#: Grid points per side of a cube that are tested for being inside the photo.
_TEST_POINTS = 128
#: Axes of the cube's sides, as (right, down, forward) in the photo's frame.
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
        name: its direction, a key of ``_SIDES``.
        camera: its camera, whose world is the frame of the photo's camera.
    """

    name: str
    camera: Camera

    def named(self, photo: str) -> str:
        """Return the view's name, given the photo's."""
        return f"{photo}/{self.name}.png"

    def in_world(self, viewmat: Float64) -> Camera:
        """Return its camera in the world, given the photo camera's viewmat [4, 4]."""
        return replace(self.camera, viewmat=self.camera.viewmat @ viewmat)


@dataclass(frozen=True, eq=False)
class Rig:
    """A wide photo at its full size, and its views."""

    photo: WidePhoto
    sides: tuple[Side, ...] = field(repr=False)


@functools.lru_cache(maxsize=64)
def rig_of(photo: WidePhoto) -> Rig:
    """Return the views of a wide photo; it is an IgsrError if it shows nothing."""
    focal = max(1.0, photo.pixels_per_radian)
    size = max(2, round(2.0 * focal))
    sides = []
    for name, axes in _SIDES.items():
        viewmat = np.eye(4)
        viewmat[:3, :3] = np.array(axes, dtype=np.float64)
        crop = _crop(photo, viewmat[:3, :3], size)
        if crop is None:
            continue
        left, top, right, bottom = crop
        # 90 degrees over ``size`` pixels.
        K = intrinsic_matrix(0.5 * size, 0.5 * size, 0.5 * size - left, 0.5 * size - top)
        sides.append(Side(name, Camera(viewmat, K, right - left, bottom - top)))
    if not sides:
        raise IgsrError("its lens shows nothing; correct its camera")
    return Rig(photo, tuple(sides))


def _crop(photo: WidePhoto, rotation: Float64, size: int) -> tuple[int, int, int, int] | None:
    """Left, top, right and bottom of the part of a cube's side that the photo shows, pixels."""
    count = min(size, _TEST_POINTS)
    at = (np.arange(count) + 0.5) * 2.0 / count - 1.0
    x, y = np.meshgrid(at, at)
    valid = photo.places(np.stack([x, y, np.ones_like(x)], axis=-1) @ rotation)[2]
    if valid.mean() < MIN_SHOWN_PART:
        return None
    spans = []
    for axis in (0, 1):
        shown = np.flatnonzero(valid.any(axis=axis))
        low, high = max(0, int(shown[0]) - 1), min(count, int(shown[-1]) + 2)
        spans.append((low * size // count, -(-high * size // count)))
    (left, right), (top, bottom) = spans
    return left, top, right, bottom


def _resized_cameras(rig: Rig, max_size: int | None) -> list[Camera]:
    """The cameras of all sides with at most ``max_size`` pixels on their longest side."""
    cameras = [side.camera for side in rig.sides]
    return [
        resized_camera(camera, *reduced_size(camera.width, camera.height, max_size))
        for camera in cameras
    ]


def decoded_size(rig: Rig, size: tuple[int, int], max_size: int | None) -> tuple[int, int]:
    """Return the width and height at which to decode a wide photo, whose file has ``size`` pixels.

    ``max_size`` is the longest side in pixels of a view; None keeps them as they are.
    """
    photo = rig.photo
    focal = max(camera.K[0, 0] for camera in _resized_cameras(rig, max_size))
    factor = min(1.0, MAX_OVERSAMPLING * focal / photo.pixels_per_radian)
    width, height = math.ceil(factor * photo.width), math.ceil(factor * photo.height)
    return min(size[0], width), min(size[1], height)


def sampled_views(
    rig: Rig, image: UInt8, mask: Bool | None, max_size: int | None
) -> dict[int, tuple[Camera, UInt8, Bool | None]]:
    """Sample the views of a wide photo.

    Args:
        rig: the views.
        image: uint8 [H, W, 3 or 4] of the photo, at its full size or that of ``decoded_size``.
        mask: bool [H, W] of it; without one, a fisheye photo is masked to its lit circle.
        max_size: as ``decoded_size``.

    Returns:
        Camera, photo and mask of each view that is not hidden, by its index in ``rig.sides``.
    """
    photo = rig.photo.resized(image.shape[1], image.shape[0])
    if mask is None and isinstance(photo, WideFisheye):
        mask = lit_circle(image, photo)
    views: dict[int, tuple[Camera, UInt8, Bool | None]] = {}
    for index, camera in enumerate(_resized_cameras(rig, max_size)):
        sampler = _SideSampler(photo, camera)
        shown = sampler.valid if mask is None else sampler.mask(mask)
        if shown.mean() < MIN_SHOWN_PART:
            continue
        pixels = sampler.image(image, mask)
        views[index] = camera, pixels, None if shown.all() else shown
    return views


class _SideSampler(Sampler):
    """Samples one view, ``camera`` in the photo's frame, from a wide photo of the size given."""

    def __init__(self, photo: WidePhoto, camera: Camera) -> None:
        super().__init__(camera.height, camera.width)
        self._photo, self._camera = photo, camera
        for band in self._bands():
            for _, _, valid in self._places(band):
                self.valid[band] &= valid

    def _places(self, band: slice) -> Iterator[tuple[Float64, Float64, Bool]]:
        """Places in the photo at which the pixels of a band are sampled."""
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
        width, height = self._photo.width, self._photo.height
        for u, v, valid in self._places(band):
            u, v = np.where(valid, u, 0.5) - 0.5, np.where(valid, v, 0.5) - 0.5
            if not self._photo.wraps:
                u = np.clip(u, 0.0, width - 1.0)
            v = np.clip(v, 0.0, height - 1.0)
            left, up = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
            across, below = (u - left).astype(np.float32), (v - up).astype(np.float32)
            right, lower = left + 1, np.minimum(up + 1, height - 1)
            if self._photo.wraps:
                left, right = left % width, right % width
            else:
                right = np.minimum(right, width - 1)
            part = np.float32(1.0 / SAMPLES**2)
            yield up * width + left, part * (1.0 - across) * (1.0 - below)
            yield up * width + right, part * across * (1.0 - below)
            yield lower * width + left, part * (1.0 - across) * below
            yield lower * width + right, part * across * below


def moved_to_side(
    xy: Float64, directions: Float64, photo: WidePhoto, camera: Camera
) -> tuple[Float64, Bool]:
    """Move observations of known points from a wide photo to one of its views.

    An observation moves with the projection of its point. Its reprojection error is mapped by the
    derivative of the view's projection with respect to the photo's, so it stays the same to first
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
    # Two tangents, built from the axis that is farthest from the direction.
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

    def derivatives(project: Callable[[Float64], Float64]) -> Float64:
        """Differences [M, 2, 2] of a projection along both tangents."""
        steps = (1e-5 * first, 1e-5 * second)
        return np.stack([project(unit + step) - project(unit - step) for step in steps], axis=2)

    of_photo, of_view = across_edge(derivatives(in_photo)), derivatives(in_view)
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
