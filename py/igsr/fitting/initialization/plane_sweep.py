"""Depth maps of photos by plane sweep, and the points of them that other photos confirm.

A plane sweep (Collins 1996) with small patches, for photos that look from similar directions. What
makes an initialization good is less where most points are than that few are wrong: a pixel's point
is taken only where the depth map of another photo has the same surface (as in COLMAP's fusion,
Schoenberger et al. 2016, section 4.5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.capture import View
from igsr.capture.downscaling import reduced_size, reduced_view
from igsr.fitting.initialization.photo_pixels import pixels_of, usable_pixels
from igsr.geometry.focus_point import focus_point

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]

#: Patches are compared unwarped: photos must look at the scene from within so many degrees.
MAX_ANGLE = 40.0
#: Photos that look from nearer than this tell little of depth; they are compared with last.
MIN_ANGLE = 2.0
#: Pixels of a photo's longer side at which depths are found; bounds time.
LONGEST = 320
#: Depths tried per pixel, evenly spaced in inverse depth.
DEPTHS = 96
#: Photos that have depth maps, evenly spaced: of many photos, each shows what its neighbours do.
MOST_SWEPT = 24
#: Photos compared with, the nearest: more cost time and look from further apart.
COMPARED = 4
#: Range of depths, in units of the distance to what the cameras look at.
NEAREST, FARTHEST = 0.25, 8.0
#: The same, in units of the depths of the points that a photo sees, where it sees so many. Points
#: are on what has texture: the scene goes on before and behind them.
POINTS_NEAREST, POINTS_FARTHEST = 0.6, 4.0
POINTS_SEEN = 20
#: Correlation of patches that a point has at least.
LEAST_SCORE = 0.5
#: Depth maps of the nearest photos that may confirm a point.
CONFIRMING = 8
#: Depth maps agree where they differ by so many of the depths tried, or by this part of the depth.
SAME_PLANES, SAME_DEPTH = 1.5, 0.01


@dataclass(eq=False)
class DepthMap:
    """Depths of a photo's pixels.

    Attributes:
        view: the photo, reduced to at most ``LONGEST`` pixels.
        inverse_depth: float32 [H, W], 1 / z-depth in world units.
        score: float32 [H, W], correlation of patches in -1..1; -1 where no photo tells.
        gap: between two of the inverse depths tried.
    """

    view: View
    inverse_depth: Float32
    score: Float32
    gap: float

    def points(self) -> Float64:
        """The world points [H * W, 3] of all pixels, row by row."""
        camera = self.view.camera
        v, u = np.indices(self.score.shape).reshape(2, -1) + 0.5
        rays = np.stack(
            [
                (u - camera.K[0, 2]) / camera.K[0, 0],
                (v - camera.K[1, 2]) / camera.K[1, 1],
                np.ones(len(u)),
            ],
            axis=1,
        )
        local = rays / self.inverse_depth.reshape(-1, 1).astype(np.float64)
        world: Float64 = (local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
        return world


def looked_at(views: list[View], known: Float64 | None) -> Float64:
    """The place [3] that photos look at: amid the known points [P, 3], or where the axes meet."""
    if known is not None and len(known) >= POINTS_SEEN:
        return np.asarray(np.median(known, axis=0))
    return focus_point([view.camera for view in views])


def can_sweep(
    views: list[View], target: Float64, angle: float = MAX_ANGLE, part: float = 1.0
) -> bool:
    """Whether photos have another that sees the target [3] from within ``angle`` degrees.

    Args:
        views: the photos.
        target: what they look at.
        angle: degrees.
        part: of all photos, that must have another.
    """
    angles = _angles(views, target)
    np.fill_diagonal(angles, 180.0)
    return bool(np.mean(angles.min(axis=1) < angle) >= part)


def depth_maps(views: list[View], known: Float64 | None = None) -> list[DepthMap]:
    """Depth maps of at most ``MOST_SWEPT`` photos that have another to compare with.

    Nothing is random.

    Args:
        views: the photos; masked and transparent pixels are not compared.
        known: [P, 3], points of the scene, which tell the range of depths, or None.
    """
    small = [_reduced(view) for view in views]
    target = looked_at(views, known)
    angles = _angles(views, target)
    centres = np.stack([view.camera.center for view in views])
    sweeps: list[tuple[int, list[int], tuple[float, float], int]] = []
    for k in np.unique(np.linspace(0, len(views) - 1, min(len(views), MOST_SWEPT)).round()):
        k, view = int(k), small[int(k)]
        others = _compared(k, angles, np.linalg.norm(centres - centres[k], axis=1))
        nearest, farthest = _depth_range(view, target, known)
        sweeps.append((k, others, (1.0 / nearest, 1.0 / farthest), DEPTHS))
    sweeps = [sweep for sweep in sweeps if sweep[1]]
    usable = [usable_pixels(view) for view in small]
    found = _core.plane_sweep(
        [_grey(view, mask) for view, mask in zip(small, usable, strict=True)],
        [None if mask.all() else mask.astype(np.uint8) for mask in usable],
        np.stack([view.camera.viewmat for view in small]),
        np.stack([view.camera.K[[0, 1, 0, 1], [0, 1, 2, 2]] for view in small]),
        sweeps,
    )
    maps = []
    for (k, _, (near, far), _), arrays in zip(sweeps, found, strict=True):
        score = np.where(usable[k], arrays["score"], np.float32(-1.0))
        gap = (near - far) / (DEPTHS - 1)
        maps.append(DepthMap(small[k], arrays["inverse_depth"], score, gap))
    return maps


def swept_points(
    views: list[View], known: Float64 | None, count: int, random: np.random.Generator
) -> tuple[Float64, Float64]:
    """Points of photos' depth maps that the depth map of another photo confirms.

    Args:
        views: the photos; masked and transparent pixels have no points.
        known: [P, 3], points of the scene, or None; see ``depth_maps``.
        count: number of points, at most.
        random: what chooses among them.

    Returns:
        Points [P, 3] in the world frame and their photos' colors [P, 3] in 0..1.
    """
    maps = depth_maps(views, known)
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3))]
    centres = np.stack([one.view.camera.center for one in maps]) if maps else np.zeros((0, 3))
    for k, one in enumerate(maps):
        world = one.points()
        near = np.argsort(np.linalg.norm(centres - centres[k], axis=1), kind="stable")
        others = [maps[int(i)] for i in near if i != k][:CONFIRMING]
        agreed = (one.score.reshape(-1) > LEAST_SCORE) & _is_confirmed(world, others)
        points.append(world[agreed])
        colors.append(one.view.image[..., :3].reshape(-1, 3)[agreed] / 255.0)
    xyz, rgb = np.concatenate(points), np.concatenate(colors)
    if len(xyz) > count:
        chosen = np.sort(random.choice(len(xyz), size=count, replace=False))
        xyz, rgb = xyz[chosen], rgb[chosen]
    return xyz, rgb


def _reduced(view: View) -> View:
    camera = view.camera
    return reduced_view(view, *reduced_size(camera.width, camera.height, LONGEST))


def _grey(view: View, usable: Bool) -> Float32:
    """Luma in 0..1 (BT.601); what must not count is grey, whatever it shows."""
    grey = view.image[..., :3] @ np.array([0.299, 0.587, 0.114]) / 255.0
    grey = np.where(usable, grey, 0.5)
    return np.ascontiguousarray(np.clip(grey, 0.0, 1.0), dtype=np.float32)


def _angles(views: list[View], target: Float64) -> Float64:
    """Degrees [V, V] between the directions that photos see the target from."""
    rays = np.stack([view.camera.center - target for view in views])
    lengths = np.linalg.norm(rays, axis=1, keepdims=True)
    rays = rays / np.maximum(lengths, np.finfo(np.float64).tiny)
    angles: Float64 = np.degrees(np.arccos(np.clip(rays @ rays.T, -1.0, 1.0)))
    return angles


def _compared(k: int, angles: Float64, distances: Float64) -> list[int]:
    """The photos that photo ``k`` is compared with; those that tell little of depth last."""
    near = [int(i) for i in np.argsort(distances, kind="stable")]
    near = [i for i in near if i != k and distances[i] > 0.0 and angles[k, i] < MAX_ANGLE]
    return sorted(near, key=lambda i: angles[k, i] < MIN_ANGLE)[:COMPARED]


def _depth_range(view: View, target: Float64, known: Float64 | None) -> tuple[float, float]:
    """The nearest and farthest depth to try."""
    if known is not None:
        _, _, depth, inside = pixels_of(view, known)
        if inside.sum() >= POINTS_SEEN:
            low, high = np.percentile(depth[inside], [1.0, 99.0])
            return POINTS_NEAREST * float(low), POINTS_FARTHEST * float(high)
    reach = max(float(np.linalg.norm(target - view.camera.center)), 1e-9)
    return NEAREST * reach, FARTHEST * reach


def _is_confirmed(world: Float64, others: list[DepthMap]) -> Bool:
    """Which world points [P, 3] lie on the surface of another depth map."""
    confirmed = np.zeros(len(world), dtype=np.bool_)
    for other in others:
        row, column, depth, inside = pixels_of(other.view, world)
        surface = 1.0 / other.inverse_depth[row, column].astype(np.float64)
        same = np.maximum(SAME_PLANES * other.gap * depth, SAME_DEPTH)
        seen = other.score[row, column] > -1.0
        confirmed |= inside & seen & (np.abs(1.0 - depth / surface) < same)
    return confirmed
