"""Points on the rays of photo pixels, at the depth where the other photos look most alike.

A plane sweep (Collins 1996) with small patches, for photos that look from similar directions. What
makes an initialization good is less where most points are than that few are wrong: twice as many
rays are tried as points are asked for, and those are taken whose depth stands out most from all
others of its ray.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera, View

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Int64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

#: Patches are compared unwarped: photos must look at the scene from within so many degrees.
MAX_ANGLE = 40.0
#: Depths tried per ray, and their range in units of the distance to what the cameras look at.
DEPTHS = 96
NEAREST, FARTHEST = 0.25, 8.0
#: Photos compared with per ray, the nearest: more cost time and look from further apart.
COMPARED = 4
#: A patch is 3 x 3 averages over squares; so many of these squares fit in a photo's longer side.
SQUARES = 85
#: Rays tried per point taken.
TRIES = 2
#: A depth's doubt is its difference minus this part of the least difference elsewhere on the ray.
UNIQUENESS = 0.7
#: Depths this near to the best one do not speak against it.
NEIGHBOURS = 4
#: Rays compared at once; bounds memory.
CHUNK = 1024


def can_sweep(views: list[View], target: Float64, angle: float = MAX_ANGLE) -> bool:
    """Whether every photo has another that sees the target [3] from within ``angle`` degrees."""
    rays = np.stack([view.camera.centre - target for view in views])
    lengths = np.linalg.norm(rays, axis=1, keepdims=True)
    rays = rays / np.maximum(lengths, np.finfo(np.float64).tiny)
    cosines = rays @ rays.T
    np.fill_diagonal(cosines, -1.0)
    return bool((cosines.max(axis=1) > np.cos(np.radians(angle))).all())


def swept_points(
    views: list[View], target: Float64, count: int, random: np.random.Generator
) -> tuple[Float64, Float64]:
    """Points where photos look alike. Rays that no other photo sees are taken last, at any depth.

    Args:
        views: the photos; masked pixels have no rays and are not compared.
        target: [3], the point that the cameras look at.
        count: number of points.
        random: what draws the rays.

    Returns:
        Points [count, 3] in the world frame and their photos' colors [count, 3] in 0..1.
    """
    photos = [_averaged(view) for view in views]
    centres = np.stack([view.camera.centre for view in views])
    per_view = np.bincount(random.integers(len(views), size=TRIES * count), minlength=len(views))
    points, colors, doubts = [], [], []
    for v, (view, rays) in enumerate(zip(views, per_view, strict=True)):
        camera = view.camera
        usable = np.arange(camera.width * camera.height)
        if view.mask is not None:
            usable = np.flatnonzero(view.mask)
        reach = float(np.linalg.norm(target - camera.centre))
        near = np.argsort(np.linalg.norm(centres - centres[v], axis=1), kind="stable")
        others = [int(other) for other in near if other != v][:COMPARED]
        pixels = random.choice(usable, size=rays)
        for pixel in np.split(pixels, range(CHUNK, rays, CHUNK)):
            row, column = np.divmod(pixel, camera.width)
            world = _on_rays(camera, row, column, reach, random)
            own = _patches(photos[v], _side(view), row, column)[:, None]
            differences = np.full((max(1, len(others)), *world.shape[:2]), np.inf)
            for k, other in enumerate(others):
                at_row, at_column, seen = _projected(views[other], world)
                patches = _patches(photos[other], _side(views[other]), at_row, at_column)
                differences[k] = np.where(seen, _difference(patches, own), np.inf)
            best, doubt = _most_alike(differences, random)
            points.append(world[np.arange(len(pixel)), best])
            colors.append(view.image[row, column, :3] / 255.0)
            doubts.append(doubt)
    taken = np.sort(np.argsort(np.concatenate(doubts), kind="stable")[:count])
    return np.concatenate(points)[taken], np.concatenate(colors)[taken]


def _on_rays(
    camera: Camera, row: Int64, column: Int64, reach: float, random: np.random.Generator
) -> Float64:
    """World points [rays, DEPTHS, 3] on the rays of pixels, from near to far."""
    directions = np.stack(
        [
            (column + 0.5 - camera.K[0, 2]) / camera.K[0, 0],
            (row + 0.5 - camera.K[1, 2]) / camera.K[1, 1],
            np.ones(len(row)),
        ],
        axis=1,
    )
    depths = np.geomspace(NEAREST, FARTHEST, DEPTHS)
    # Jitter each ray's depths, or all points would lie on a few shells.
    jitter = np.exp(random.uniform(-0.5, 0.5, size=len(row)) * np.log(depths[1] / depths[0]))
    z = reach * depths[None, :] * jitter[:, None]
    local = directions[:, None, :] * z[..., None] - camera.viewmat[:3, 3]
    world: Float64 = local @ camera.viewmat[:3, :3]
    return world


def _projected(view: View, world: Float64) -> tuple[Int64, Int64, Bool]:
    """Row and column of the pixels that world points [..., 3] fall on, and which the view sees."""
    camera = view.camera
    local = world @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    z = np.maximum(local[..., 2], 1e-9)
    x = np.floor(camera.K[0, 0] * local[..., 0] / z + camera.K[0, 2])
    y = np.floor(camera.K[1, 1] * local[..., 1] / z + camera.K[1, 2])
    seen = (local[..., 2] > 1e-9) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    row, column = np.where(seen, y, 0).astype(np.int64), np.where(seen, x, 0).astype(np.int64)
    if view.mask is not None:
        seen &= view.mask[row, column]
    return row, column, seen


def _patches(photo: Float32, side: int, row: Int64, column: Int64) -> Float32:
    """The patches [..., 9, 4] around pixels of an averaged photo, continued at its border."""
    height, width = photo.shape[:2]
    down, right = side * (np.indices((3, 3)).reshape(2, 9) - 1)
    rows = np.clip(row[..., None] + down, 0, height - 1)
    columns = np.clip(column[..., None] + right, 0, width - 1)
    return photo[rows, columns]


def _difference(a: Float32, b: Float32) -> Float32:
    """Mean absolute difference [...] of patches [..., 9, 4] where both have unmasked pixels."""
    both = a[..., 3] * b[..., 3]
    apart = np.abs(a[..., :3] - b[..., :3]).mean(axis=-1)
    difference: Float32 = (apart * both).sum(axis=-1) / np.maximum(both.sum(axis=-1), 1e-6)
    return difference


def _most_alike(differences: Float64, random: np.random.Generator) -> tuple[Int64, Float64]:
    """Per ray the depth that photos agree on best, and how doubtful it is, infinite if unseen.

    Args:
        differences: [views, rays, depths], infinite where a view does not see the point.
        random: decides between equals.
    """
    seen = np.isfinite(differences).sum(axis=0)
    # The lower median over those that see it: the rest may be hidden behind something.
    middle = np.maximum(seen - 1, 0) // 2
    cost = np.take_along_axis(np.sort(differences, axis=0), middle[None], axis=0)[0]
    # Ties (flat color, nothing seen) must not all fall to the nearest depth.
    tie = random.uniform(size=cost.shape)
    best = np.where(seen > 0, cost + 1e-4 * tie, 1e9 + tie).argmin(axis=1)
    least = np.take_along_axis(cost, best[:, None], axis=1)[:, 0]
    apart = np.abs(np.arange(cost.shape[1]) - best[:, None]) > NEIGHBOURS
    elsewhere = np.where(apart, cost, np.inf).min(axis=1)
    # Where no other depth is seen, nothing stands out.
    elsewhere = np.where(np.isfinite(elsewhere), elsewhere, least)
    doubt = np.full(len(least), np.inf)
    matched = np.isfinite(least)
    doubt[matched] = least[matched] - UNIQUENESS * elsewhere[matched]
    return np.asarray(best), doubt


def _side(view: View) -> int:
    """Side of a patch's squares in pixels, odd."""
    squares = max(view.camera.width, view.camera.height) / SQUARES
    return 1 + 2 * max(0, round((squares - 1.0) / 2.0))


def _averaged(view: View) -> Float32:
    """Colors in 0..1 and a weight, [H, W, 4], averaged over the square around each pixel.

    Masked pixels have no part in the colors; the weight is the part of the square that is not
    masked.
    """
    height, width = view.image.shape[:2]
    side, margin = _side(view), _side(view) // 2
    used = np.ones((height, width)) if view.mask is None else view.mask.astype(np.float64)
    sums = np.concatenate([view.image[..., :3] / 255.0 * used[..., None], used[..., None]], axis=2)
    for axis in (0, 1):
        pad = [(margin + 1, margin) if axis == k else (0, 0) for k in range(3)]
        total = np.cumsum(np.pad(sums, pad), axis=axis)
        length = sums.shape[axis]
        first, last = (np.take(total, range(i, i + length), axis) for i in (0, side))
        sums = last - first
    part = sums[..., 3:]
    averages = np.concatenate([sums[..., :3] / np.maximum(part, 1e-6), part / side**2], axis=2)
    return averages.astype(np.float32)
