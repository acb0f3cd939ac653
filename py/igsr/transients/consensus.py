"""The color that other photos agree on, in each pixel of a photo.

The surface in a pixel comes from depths that two other photos confirm, and not from the photo's
own render: the fit soon reproduces a transient object by splats close to the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr._internal.choices import Backend
from igsr.capture import Camera, View
from igsr.capture.downscaling import plane_area_means, reduced_size, reduced_view
from igsr.evaluation.scores import over_background
from igsr.geometry.pixel_rays import pixel_rays
from igsr.rendering.renders import render
from igsr.splats import Splats
from igsr.transients.regions import window_max, window_min

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
UInt8 = npt.NDArray[np.uint8]
Bool = npt.NDArray[np.bool_]

#: Longest side of the photos that are compared, pixels.
THUMBNAIL_PX = 256
#: Renders have a surface above this alpha.
MIN_ALPHA = 0.5
#: Relative difference of depths of the same surface.
DEPTH_TOLERANCE = 0.03
#: Maximum number of photos that a photo is compared with, the nearest by viewing direction.
MAX_NEIGHBORS = 6
#: Errors of depths, as pixels of another photo: it shows a color if it does so within this radius.
RADIUS_PX = 2
#: Tolerance of a color comparison, in [0, 1].
COLOR_TOLERANCE = 0.03
#: Depths along a ray, evenly spaced in inverse depth, and their range in units of the photo's
#: median depth.
DEPTH_COUNT = 64
MIN_DEPTH = 0.3
MAX_DEPTH = 8.0
#: Minimum number of common pixels for the gain between two photos.
MIN_GAIN_PIXELS = 200
#: Darkest color that gains are computed with, in [0, 1].
MIN_GAIN_COLOR = 0.02
#: Brighter pixels may be overexposed, in [0, 1].
OVEREXPOSED = 0.98


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """A reduced photo, with colors in 0..255 since all photos of a fit are in memory at once.

    Attributes:
        camera: of the thumbnail.
        color: uint8 [H, W, 3], means of 3 x 3 pixels.
        low, high: uint8 [H, W, 3], extreme colors within ``RADIUS_PX``.
        usable: bool [H, W], pixels that are compared with other photos.
        trusted: bool [H, W], pixels that other photos are compared with.
        depth: float32 [H, W], rendered, world units; 0 without a surface.
    """

    camera: Camera
    color: UInt8
    low: UInt8
    high: UInt8
    usable: Bool
    trusted: Bool
    depth: Float32


@dataclass(frozen=True, eq=False)
class Consensus:
    """Colors of N pixels of a photo in K neighboring photos.

    Attributes:
        pixels: int64 [N], flat indices of the pixels whose surface two neighbors confirm.
        agreed: bool [N], whether the neighbors that see the surface agree on its color.
        color: float32 [N, 3], this color, with the photo's gain.
        distance: float32 [N], distance of the photo's color from the range that the agreeing
            neighbors show, in the channel with the largest one.
        explained: bool [N], whether half of the neighbors show the photo's color at the depth of
            its own render.
        neighbors: the neighboring photos.
        gains: float32 [K, 3], factors from their colors to the photo's.
    """

    pixels: Int64
    agreed: Bool
    color: Float32
    distance: Float32
    explained: Bool
    neighbors: list[Thumbnail]
    gains: Float32


def thumbnails(
    splats: Splats,
    views: Sequence[View],
    masks: Sequence[Bool | None],
    background: Sequence[float],
    backend: Backend,
) -> list[Thumbnail]:
    """Reduce photos and render their depth; pixels [H, W] in the masks are not trusted."""
    photos = []
    for view, mask in zip(views, masks, strict=True):
        size = reduced_size(view.camera.width, view.camera.height, THUMBNAIL_PX)
        small = reduced_view(view, *size)
        picture = render(splats, small.camera, background, backend)
        depth = np.where(picture.alpha > MIN_ALPHA, picture.expected_depth, np.float32(0.0))
        usable = np.ones(depth.shape, np.bool_) if small.mask is None else small.mask
        trusted = usable
        if mask is not None:
            trusted = usable & (plane_area_means(mask.astype(np.float64), *size) == 0.0)
        image = over_background(small.image, background).astype(np.float32)
        padded = np.pad(image, [(1, 1), (1, 1), (0, 0)], mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(0, 1))
        color = np.rint(windows.mean(axis=(-2, -1))).astype(np.uint8)
        low, high = window_min(color, RADIUS_PX), window_max(color, RADIUS_PX)
        photos.append(Thumbnail(small.camera, color, low, high, usable, trusted, depth))
    return photos


def consensus_of(index: int, photos: Sequence[Thumbnail]) -> Consensus | None:
    """Compare one of the photos with its neighbors; None if no two see a common surface."""
    photo = photos[index]
    neighbors = _neighbors(index, photos)
    if len(neighbors) < 2:
        return None
    depths = np.stack([_warped_depth(photo, neighbor) for neighbor in neighbors])
    surface = _confirmed_depth(depths).reshape(-1)
    pixels = np.flatnonzero((surface > 0.0) & photo.usable.reshape(-1))
    if not len(pixels):
        return None
    rays = pixel_rays(photo.camera)[pixels]
    own = colors_at(photo.color, pixels)
    at, seen = _sights(photo.camera, rays, surface[pixels], neighbors)
    colors = np.stack([colors_at(n.color, at_n) for n, at_n in zip(neighbors, at, strict=True)])
    gains = np.stack([_gain(own, *pair) for pair in zip(colors, seen, strict=True)])
    median = _median(np.minimum(colors * gains[:, None], np.float32(1.0)), seen)
    ranges = _color_ranges(neighbors, at, gains)
    agreeing = seen & (_distance(median, *ranges) <= COLOR_TOLERANCE)
    count = agreeing.sum(axis=0)
    agreed = (count >= 2) & (3 * count >= 2 * seen.sum(axis=0))
    distance = np.where(agreeing, _distance(own, *ranges), np.float32(np.inf)).min(axis=0)
    at, seen = _sights(photo.camera, rays, photo.depth.reshape(-1)[pixels], neighbors)
    ranges = _color_ranges(neighbors, at, gains)
    showing = (seen & (_distance(own, *ranges) <= COLOR_TOLERANCE)).sum(axis=0)
    explained = (showing > 0) & (2 * showing >= seen.sum(axis=0))
    distance = np.where(agreed, distance, np.float32(0.0))
    return Consensus(pixels, agreed, median, distance, explained, neighbors, gains)


def shown_at_any_depth(photo: Thumbnail, pixels: Int64, consensus: Consensus) -> Bool:
    """Whether two neighbors show the color of each of M pixels at any common depth, bool [M]."""
    surface = photo.depth[photo.depth > 0.0]
    shown = np.zeros(len(pixels), np.bool_)
    if not len(pixels) or not len(surface):
        return shown
    median = float(np.median(surface))
    rays = pixel_rays(photo.camera)[pixels]
    own = colors_at(photo.color, pixels)
    for inverse in np.linspace(1.0 / MIN_DEPTH, 1.0 / MAX_DEPTH, DEPTH_COUNT):
        depth = np.full(len(pixels), median / inverse, np.float32)
        at, seen = _sights(photo.camera, rays, depth, consensus.neighbors, occluded=False)
        ranges = _color_ranges(consensus.neighbors, at, consensus.gains)
        shown |= (seen & (_distance(own, *ranges) <= COLOR_TOLERANCE)).sum(axis=0) >= 2
    return shown


def colors_at(picture: UInt8, at: Int64) -> Float32:
    """Colors in [0, 1] of a picture uint8 [H, W, 3] at flat indices [N], float32 [N, 3]."""
    return picture.reshape(-1, 3)[at].astype(np.float32) / np.float32(255.0)


def _color_ranges(
    neighbors: Sequence[Thumbnail], at: Int64, gains: Float32
) -> tuple[Float32, Float32]:
    """Extreme colors [K, N, 3] around pixels [K, N] of neighbors, with the photo's gain."""
    pairs = list(zip(neighbors, at, strict=True))
    low = np.stack([colors_at(neighbor.low, at_n) for neighbor, at_n in pairs])
    high = np.stack([colors_at(neighbor.high, at_n) for neighbor, at_n in pairs])
    one = np.float32(1.0)
    # Overexposed pixels may have any brighter color.
    brightest = np.where(high >= OVEREXPOSED, one, np.minimum(high * gains[:, None], one))
    return np.minimum(low * gains[:, None], one), brightest


def _distance(color: Float32, low: Float32, high: Float32) -> Float32:
    """Distance of colors [N, 3] from ranges [K, N, 3], the largest of all channels, [K, N]."""
    return np.asarray(np.maximum(low - color, color - high).max(axis=-1).clip(0.0))


def _gain(own: Float32, color: Float32, seen: Bool) -> Float32:
    """The factor [3] from a neighbor's colors [N, 3] to the photo's."""
    if seen.sum() < MIN_GAIN_PIXELS:
        return np.ones(3, np.float32)
    ratio = np.log(np.maximum(own[seen], MIN_GAIN_COLOR) / np.maximum(color[seen], MIN_GAIN_COLOR))
    return np.asarray(np.exp(np.median(ratio, axis=0)), np.float32)


def _median(colors: Float32, seen: Bool) -> Float32:
    """The median [N, 3] of colors [K, N, 3] of the neighbors that see the surface; 0 if none do."""
    ordered = np.sort(np.where(seen[..., None], colors, np.float32(np.inf)), axis=0)
    count = seen.sum(axis=0)
    each = np.arange(colors.shape[1])
    below, above = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, len(seen) - 1)
    median = 0.5 * (ordered[below, each] + ordered[above, each])
    return np.where((count > 0)[:, None], median, 0.0).astype(np.float32)


def _neighbors(index: int, photos: Sequence[Thumbnail]) -> list[Thumbnail]:
    """The photos that look at a photo's surface from the nearest directions."""
    photo = photos[index]
    surface = photo.depth[photo.depth > 0.0]
    if not len(surface):
        return []
    forward = photo.camera.viewmat[2, :3]
    target = photo.camera.center + forward * float(np.median(surface))

    def direction(camera: Camera) -> Float64:
        away = target - camera.center
        return np.asarray(away / max(float(np.linalg.norm(away)), 1e-30))

    own = direction(photo.camera)
    others = [k for k in range(len(photos)) if k != index]
    cosines = np.array([direction(photos[k].camera) @ own for k in others])
    order = np.argsort(-cosines, kind="stable")[:MAX_NEIGHBORS]
    return [photos[others[k]] for k in sorted(order)]


def _projected(
    start: Camera, end: Camera, rays: Float32, depth: Float32
) -> tuple[Float32, Float32, Float32]:
    """Columns, rows and depths [N] in ``end`` of points on rays of ``start``."""
    # In the axes of a camera: float32 is too coarse for a scene far from the world's origin.
    between = (end.viewmat @ np.linalg.inv(start.viewmat)).astype(np.float32)
    x, y, z = ((rays * depth[:, None]) @ between[:3, :3].T + between[:3, 3]).T
    inverse = np.float32(1.0) / np.where(z > 0.0, z, np.float32(np.inf))
    K = end.K.astype(np.float32)
    return K[0, 0] * x * inverse + K[0, 2], K[1, 1] * y * inverse + K[1, 2], z


def _sights(
    camera: Camera,
    rays: Float32,
    depth: Float32,
    neighbors: Sequence[Thumbnail],
    occluded: bool = True,
) -> tuple[Int64, Bool]:
    """Flat indices [K, N] of the neighbors' pixels that points on rays lie in, and visibility."""
    at, visible = np.zeros((2, len(neighbors), len(depth)), np.int64)
    for k, neighbor in enumerate(neighbors):
        x, y, z = _projected(camera, neighbor.camera, rays, depth)
        inside = (depth > 0.0) & _in_frame(neighbor.camera, x, y, z)
        column, row = (np.where(inside, value, 0.0).astype(np.int64) for value in (x, y))
        at[k] = row * neighbor.camera.width + column
        visible[k] = inside & neighbor.trusted.reshape(-1)[at[k]]
        if occluded:
            visible[k] &= np.abs(neighbor.depth.reshape(-1)[at[k]] - z) <= DEPTH_TOLERANCE * z
    return at, visible > 0


def _in_frame(camera: Camera, x: Float32, y: Float32, z: Float32) -> Bool:
    return (z > 0.0) & (x > 0.0) & (x < camera.width) & (y > 0.0) & (y < camera.height)


def _warped_depth(photo: Thumbnail, neighbor: Thumbnail) -> Float32:
    """The depth [H, W] of a neighbor's surface in a photo, infinite if it has none."""
    height, width = photo.usable.shape
    depth = neighbor.depth.reshape(-1)
    x, y, z = _projected(neighbor.camera, photo.camera, pixel_rays(neighbor.camera), depth)
    inside = (depth > 0.0) & _in_frame(photo.camera, x, y, z)
    x, y, z = x[inside] - 0.5, y[inside] - 0.5, z[inside]
    # Each pixel covers the four nearest ones, which may lie one pixel outside of the photo.
    warped = np.full((height + 2) * (width + 2), np.inf, np.float32)
    corner = (np.floor(y).astype(np.int64) + 1) * (width + 2) + np.floor(x).astype(np.int64) + 1
    for offset in (0, 1, width + 2, width + 3):
        np.minimum.at(warped, corner + offset, z)
    return warped.reshape(height + 2, width + 2)[1:-1, 1:-1]


def _confirmed_depth(depths: Float32) -> Float32:
    """The nearest depth [H, W] that two of K depths [K, H, W] share; 0 if there is none."""
    ordered = np.sort(depths, axis=0)
    near, far = ordered[:-1], ordered[1:]
    with np.errstate(invalid="ignore"):
        same = far - near <= DEPTH_TOLERANCE * near
        first = same.argmax(axis=0)[None]
        mean = 0.5 * (np.take_along_axis(near, first, 0) + np.take_along_axis(far, first, 0))[0]
    return np.where(same.any(axis=0), mean, 0.0).astype(np.float32)
