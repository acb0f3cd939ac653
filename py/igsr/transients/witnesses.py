"""What other photos show of the surface in each pixel of a photo.

The surface is not taken from the photo's own render: what stands before the others' surface in one
photo alone is soon made up for that photo, close to its camera. It is taken from the depths of the
other photos, where two of them have the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr._internal.choices import Backend
from igsr.capture import Camera, View
from igsr.capture.downscaling import plane_area_means, reduced_size, reduced_view
from igsr.evaluation.scores import over_background
from igsr.geometry.pixel_rays import pixel_rays
from igsr.rendering.renders import render
from igsr.splats import Splats

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
UInt8 = npt.NDArray[np.uint8]
Bool = npt.NDArray[np.bool_]

#: Pixels of a photo's longer side at which photos are compared.
LONGEST = 256
#: Below this alpha a render has no surface.
SURFACE_ALPHA = 0.5
#: Two depths are of one surface if they differ by no more than this part.
SAME_DEPTH = 0.03
#: Most photos that are asked about a pixel, the nearest by direction.
MOST_WITNESSES = 6
#: Half the side, in pixels, of the window in which a witness may have a color: what depths are off.
SLACK = 2
#: A color is among others if it is no further outside than this.
AGREE = 0.03
#: Depths tried, evenly spaced in inverse depth, and their range in units of the photo's median.
DEPTHS, NEAREST, FARTHEST = 64, 0.3, 8.0
#: Fewest pixels that a witness must share with a photo for its gain to be known.
LEAST_SHARED = 200
#: Gains are not told by colors darker than this.
DARK = 0.02
#: From this color on a pixel may have been cut to white.
WHITE = 0.98


@dataclass(frozen=True, eq=False)
class SmallPhoto:
    """A photo at the size at which photos are compared.

    Colors are bytes, 0 to 255: those of all photos of a fit are held at once.

    Attributes:
        camera: of the small photo.
        color: uint8 [H, W, 3], means of 3 x 3 pixels.
        low, high: uint8 [H, W, 3], least and most color within ``SLACK`` pixels.
        usable: bool [H, W], where its pixels count.
        trusted: bool [H, W], where they count as a witness, too.
        depth: float32 [H, W], of the render, world units; 0 where there is no surface.
    """

    camera: Camera
    color: UInt8
    low: UInt8
    high: UInt8
    usable: Bool
    trusted: Bool
    depth: Float32


@dataclass(frozen=True, eq=False)
class Testimony:
    """What K other photos say about the N pixels of a photo whose surface two of them have.

    Attributes:
        pixels: int64 [N], numbers of these pixels, row by row.
        agreed: bool [N], whether at least two of the photos see the surface, in one color.
        color: float32 [N, 3], that color, with the photo's gain.
        outside: float32 [N], by how much the photo's color lies outside of all colors that the
            photos that agree have within ``SLACK`` pixels, in the channel where most.
        explained: bool [N], whether the photo's color is shown at the depth of its own render, by
            half of the photos that see a surface there.
        others: the K photos.
        gains: float32 [K, 3], what their colors are multiplied by to be the photo's.
    """

    pixels: Int64
    agreed: Bool
    color: Float32
    outside: Float32
    explained: Bool
    others: list[SmallPhoto]
    gains: Float32


def small_photos(
    splats: Splats,
    views: Sequence[View],
    doubtful: Sequence[Bool | None],
    background: Sequence[float],
    backend: Backend = "auto",
) -> list[SmallPhoto]:
    """Photos as they are compared.

    Args:
        splats: the scene as fitted so far.
        views: V photos with the scene's colors.
        doubtful: for each, bool [H, W], pixels that are no witnesses, or None.
        background: RGB in [0, 1] behind photos with alpha.
        backend: "auto", "cpu", "gpu" or "reference".
    """
    photos = []
    for view, doubted in zip(views, doubtful, strict=True):
        size = reduced_size(view.camera.width, view.camera.height, LONGEST)
        small = reduced_view(view, *size)
        drawn = render(splats, small.camera, background, backend)
        depth = np.where(drawn.alpha > SURFACE_ALPHA, drawn.expected_depth, np.float32(0.0))
        color = over_background(small.image, background).astype(np.float32)
        usable = np.ones(depth.shape, np.bool_) if small.mask is None else small.mask
        trusted = usable
        if doubted is not None:
            # A small pixel is doubtful if any under it is.
            trusted = usable & (plane_area_means(doubted.astype(np.float64), *size) == 0.0)
        mean = np.rint(_windows(color, 1).mean(axis=(-2, -1))).astype(np.uint8)
        wide = _windows(mean, SLACK)
        low, high = wide.min(axis=(-2, -1)), wide.max(axis=(-2, -1))
        photos.append(SmallPhoto(small.camera, mean, low, high, usable, trusted, depth))
    return photos


def testimony(index: int, photos: Sequence[SmallPhoto]) -> Testimony | None:
    """What the others say about one photo; None where no two see a surface of it.

    Args:
        index: of the photo.
        photos: all.
    """
    photo = photos[index]
    others = _nearest(index, photos)
    if len(others) < 2:
        return None
    surface = _confirmed(np.stack([_depth_from(photo, other) for other in others])).reshape(-1)
    pixels = np.flatnonzero((surface > 0.0) & photo.usable.reshape(-1))
    if not len(pixels):
        return None
    rays = pixel_rays(photo.camera)[pixels]
    own = colors_at(photo.color, pixels)
    sights = [_sight(photo.camera, other, rays, surface[pixels]) for other in others]
    seen = np.stack([visible for _, visible in sights])
    colors = np.stack(
        [colors_at(other.color, at) for other, (at, _) in zip(others, sights, strict=True)]
    )
    gains = np.stack([_gain(own, *one) for one in zip(colors, seen, strict=True)])
    middle = _median(np.minimum(colors * gains[:, None], np.float32(1.0)), seen)
    # A photo agrees if the color is among those that it shows around there.
    same, outside = np.zeros_like(seen), np.full(len(pixels), np.inf, np.float32)
    for k, (other, (at, visible)) in enumerate(zip(others, sights, strict=True)):
        low, high = _range(other, at, gains[k])
        same[k] = visible & (_outside(middle, low, high) <= AGREE)
        outside = np.where(same[k], np.minimum(outside, _outside(own, low, high)), outside)
    count = same.sum(axis=0)
    agreed = (count >= 2) & (3 * count >= 2 * seen.sum(axis=0))
    looked, shown = np.zeros((2, len(pixels)), np.int64)
    depth = photo.depth.reshape(-1)[pixels]
    for other, gain in zip(others, gains, strict=True):
        at, visible = _sight(photo.camera, other, rays, depth)
        low, high = _range(other, at, gain)
        looked += visible
        shown += visible & (_outside(own, low, high) <= AGREE)
    explained = (shown > 0) & (2 * shown >= looked)
    outside = np.where(agreed, outside, np.float32(0.0))
    return Testimony(pixels, agreed, middle, outside, explained, others, gains)


def shown_at_any_depth(photo: SmallPhoto, pixels: Int64, said: Testimony) -> Bool:
    """At which of M pixels of a photo two others show its color at one depth, whichever it is.

    Where the scene has a wrong surface so far, they do so at the true one.

    Args:
        photo: the photo.
        pixels: int64 [M], numbers of pixels, row by row.
        said: of the photo.
    """
    surface = photo.depth[photo.depth > 0.0]
    found = np.zeros(len(pixels), np.bool_)
    if not len(pixels) or not len(surface):
        return found
    middle = float(np.median(surface))
    rays = pixel_rays(photo.camera)[pixels]
    own = colors_at(photo.color, pixels)
    for inverse in np.linspace(1.0 / NEAREST, 1.0 / FARTHEST, DEPTHS):
        depth = np.full(len(pixels), middle / inverse, np.float32)
        count = np.zeros(len(pixels), np.int64)
        for other, gain in zip(said.others, said.gains, strict=True):
            at, visible = _sight(photo.camera, other, rays, depth, through=True)
            low, high = _range(other, at, gain)
            count += visible & (_outside(own, low, high) <= AGREE)
        found |= count >= 2
    return found


def _windows(values: npt.NDArray[Any], half: int) -> npt.NDArray[Any]:
    """The square window around each pixel, [H, W, 3, 2 half + 1, 2 half + 1], edges repeated."""
    padded = np.pad(values, [(half, half), (half, half), (0, 0)], mode="edge")
    side = 2 * half + 1
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, (side, side), axis=(0, 1)))


def colors_at(picture: UInt8, at: Int64) -> Float32:
    """Colors [N, 3] in [0, 1] of a small photo's picture [H, W, 3] in pixels of these numbers."""
    return picture.reshape(-1, 3)[at].astype(np.float32) / np.float32(255.0)


def _range(other: SmallPhoto, at: Int64, gain: Float32) -> tuple[Float32, Float32]:
    """Least and most color [N, 3] around pixels of another photo, as the photo has them.

    A photo holds no more than white: what is brighter is white there, and what another has as white
    may be any color that is as bright or brighter.
    """
    low, high = colors_at(other.low, at), colors_at(other.high, at)
    most = np.where(high >= WHITE, np.float32(1.0), np.minimum(high * gain, np.float32(1.0)))
    return np.minimum(low * gain, np.float32(1.0)), most


def _outside(color: Float32, low: Float32, high: Float32) -> Float32:
    """How far colors [N, 3] are out of a range, in the channel where most."""
    return np.asarray(np.maximum(low - color, color - high).max(axis=-1).clip(0.0))


def _gain(own: Float32, color: Float32, seen: Bool) -> Float32:
    """What another photo's colors [N, 3] are multiplied by to be the photo's, [3]."""
    if seen.sum() < LEAST_SHARED:
        return np.ones(3, np.float32)
    ratio = np.log(np.maximum(own[seen], DARK) / np.maximum(color[seen], DARK))
    return np.asarray(np.exp(np.median(ratio, axis=0)), np.float32)


def _median(colors: Float32, seen: Bool) -> Float32:
    """The median [N, 3] of the colors [K, N, 3] of photos that see the surface; 0 where none does.

    Of an even number of photos it is the mean of the two in the middle.
    """
    ordered = np.sort(np.where(seen[..., None], colors, np.float32(np.inf)), axis=0)
    count = seen.sum(axis=0)
    each = np.arange(colors.shape[1])
    below, above = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, len(seen) - 1)
    middle = 0.5 * (ordered[below, each] + ordered[above, each])
    return np.where((count > 0)[:, None], middle, 0.0).astype(np.float32)


def _nearest(index: int, photos: Sequence[SmallPhoto]) -> list[SmallPhoto]:
    """The other photos that look at a photo's surface from the nearest directions."""
    photo = photos[index]
    is_surface = photo.depth > 0.0
    if not is_surface.any():
        return []
    forward = photo.camera.viewmat[2, :3]
    middle = photo.camera.center + forward * float(np.median(photo.depth[is_surface]))

    def direction(camera: Camera) -> Float64:
        away = middle - camera.center
        return np.asarray(away / max(float(np.linalg.norm(away)), 1e-30))

    here = direction(photo.camera)
    others = [k for k in range(len(photos)) if k != index]
    cosines = np.array([direction(photos[k].camera) @ here for k in others])
    order = np.argsort(-cosines, kind="stable")[:MOST_WITNESSES]
    return [photos[others[k]] for k in sorted(order)]


def _moved(
    start: Camera, end: Camera, rays: Float32, depth: Float32
) -> tuple[Float32, Float32, Float32]:
    """Columns, rows and depths [N] at ``end`` of surfaces on rays of ``start``."""
    # Points stay in a camera's axes: float32 has no room for a scene far from the world's origin.
    between = (end.viewmat @ np.linalg.inv(start.viewmat)).astype(np.float32)
    x, y, z = ((rays * depth[:, None]) @ between[:3, :3].T + between[:3, 3]).T
    inverse = np.float32(1.0) / np.where(z > 0.0, z, np.float32(np.inf))
    K = end.K.astype(np.float32)
    return K[0, 0] * x * inverse + K[0, 2], K[1, 1] * y * inverse + K[1, 2], z


def _sight(
    camera: Camera, other: SmallPhoto, rays: Float32, depth: Float32, through: bool = False
) -> tuple[Int64, Bool]:
    """The pixels [N] where another photo has surfaces on rays, and whether it sees them [N].

    With ``through`` it sees them whatever its own surface is.
    """
    x, y, z = _moved(camera, other.camera, rays, depth)
    width, height = other.camera.width, other.camera.height
    seen = (depth > 0.0) & (z > 0.0) & (x > 0.0) & (x < width) & (y > 0.0) & (y < height)
    at = np.where(seen, y, 0.0).astype(np.int64) * width + np.where(seen, x, 0.0).astype(np.int64)
    seen &= other.trusted.reshape(-1)[at]
    if not through:
        seen &= np.abs(other.depth.reshape(-1)[at] - z) <= SAME_DEPTH * z
    return at, seen


def _depth_from(photo: SmallPhoto, other: SmallPhoto) -> Float32:
    """The depth [H, W] in a photo's pixels of another's surface, infinite where it has none.

    Each of the other's pixels is seen in the four that are nearest to where it comes to lie.
    """
    height, width = photo.usable.shape
    x, y, z = _moved(other.camera, photo.camera, pixel_rays(other.camera), other.depth.reshape(-1))
    there = (other.depth.reshape(-1) > 0.0) & (z > 0.0)
    there &= (x > 0.0) & (x < width) & (y > 0.0) & (y < height)
    x, y, z = x[there] - 0.5, y[there] - 0.5, z[there]
    # One pixel around the picture takes what lies half outside.
    out = np.full((height + 2) * (width + 2), np.inf, np.float32)
    corner = (np.floor(y).astype(np.int64) + 1) * (width + 2) + np.floor(x).astype(np.int64) + 1
    for offset in (0, 1, width + 2, width + 3):
        np.minimum.at(out, corner + offset, z)
    return out.reshape(height + 2, width + 2)[1:-1, 1:-1]


def _confirmed(depths: Float32) -> Float32:
    """The nearest depth [H, W] that two of K [K, H, W] have, or 0."""
    ordered = np.sort(depths, axis=0)
    near, far = ordered[:-1], ordered[1:]
    with np.errstate(invalid="ignore"):
        same = far - near <= SAME_DEPTH * near
        first = same.argmax(axis=0)[None]
        mean = 0.5 * (np.take_along_axis(near, first, 0) + np.take_along_axis(far, first, 0))[0]
    return np.where(same.any(axis=0), mean, 0.0).astype(np.float32)
