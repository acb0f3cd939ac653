"""Depth maps by plane sweep, and their points that depth maps of other photos confirm.

A plane sweep (Collins 1996) with small patches, for photos from similar directions. A few wrong
points hurt an initialization more than missing ones, so a point is kept only if the depth map of
another photo has the same surface (as in COLMAP's fusion, Schoenberger et al. 2016, section 4.5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.capture import View
from igsr.fitting.initialization.photo_pixels import (
    at_most,
    by_distance,
    camera_centers,
    pixel_rays,
    project,
    reduced,
    to_world,
    usable_pixels,
)
from igsr.geometry.focus_point import focus_point

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]

#: Patches are compared unwarped, so photos must look at the scene from within this angle.
MAX_ANGLE_DEG = 40.0
#: Photos from within this angle have little parallax; they are compared with last.
MIN_ANGLE_DEG = 2.0
#: Longer side of photos for the sweep, pixels; bounds the time.
MAX_SIDE_PX = 320
#: Depths tried per pixel, evenly spaced in inverse depth.
DEPTHS = 96
#: Maximum number of photos with depth maps, evenly spaced.
MAX_DEPTH_MAPS = 24
#: Number of nearest photos to compare with.
COMPARED_PHOTOS = 4
#: Range of depths, in units of the distance to the target.
MIN_DEPTH = 0.25
MAX_DEPTH = 8.0
#: The range in units of the depths of known points, if a photo shows enough of them. Points are on
#: texture: the scene extends in front of and behind them.
MIN_POINT_DEPTH = 0.6
MAX_POINT_DEPTH = 4.0
MIN_KNOWN_POINTS = 20
#: Minimum correlation of patches for a point.
MIN_SCORE = 0.5
#: Number of nearest depth maps that may confirm a point.
CONFIRMING_MAPS = 8
#: Depths agree within this many of the depths tried, or this fraction of the depth.
TOLERANCE_PLANES = 1.5
TOLERANCE_FRACTION = 0.01


@dataclass(eq=False)
class DepthMap:
    """Depths of a photo's pixels.

    Attributes:
        view: the photo, reduced to at most ``MAX_SIDE_PX``.
        inverse_depth: float32 [H, W], 1 / z-depth in world units.
        score: float32 [H, W], correlation of patches in -1..1; -1 where no photo could be compared.
        spacing: between two of the inverse depths tried.
    """

    view: View
    inverse_depth: Float32
    score: Float32
    spacing: float

    def points(self) -> Float64:
        """World points [H * W, 3] of all pixels, row by row."""
        camera = self.view.camera
        rows, columns = np.indices(self.score.shape).reshape(2, -1)
        rays = pixel_rays(camera, columns, rows)
        return to_world(camera, rays / self.inverse_depth.reshape(-1, 1).astype(np.float64))


def sweep_target(views: list[View], known: Float64 | None) -> Float64:
    """The point [3] that photos look at: the median of known points [P, 3] or the focus point."""
    if known is not None and len(known) >= MIN_KNOWN_POINTS:
        return np.asarray(np.median(known, axis=0))
    return focus_point([view.camera for view in views])


def can_sweep(
    views: list[View], target: Float64, angle_deg: float = MAX_ANGLE_DEG, fraction: float = 1.0
) -> bool:
    """Whether photos have another one that sees the target from within an angle.

    Args:
        views: the photos.
        target: [3], world frame.
        angle_deg: maximum angle.
        fraction: of the photos that must have another one.
    """
    angles = _angles_deg(views, target)
    np.fill_diagonal(angles, 180.0)
    return bool(np.mean(angles.min(axis=1) < angle_deg) >= fraction)


def depth_maps(views: list[View], known: Float64 | None = None) -> list[DepthMap]:
    """Return depth maps of at most ``MAX_DEPTH_MAPS`` photos; deterministic.

    Args:
        views: the photos; masked and transparent pixels are not compared. Photos without another
            one to compare with have no depth map.
        known: [P, 3], points of the scene, for the range of depths, or None.
    """
    small = [reduced(view, MAX_SIDE_PX) for view in views]
    target = sweep_target(views, known)
    angles, centers = _angles_deg(views, target), camera_centers(views)
    sweeps: list[tuple[int, list[int], tuple[float, float], int]] = []
    swept = np.linspace(0, len(views) - 1, min(len(views), MAX_DEPTH_MAPS)).round()
    for k in (int(k) for k in np.unique(swept)):
        others = _compared_photos(centers, k, angles)
        if others:
            nearest, farthest = _depth_range(small[k], target, known)
            sweeps.append((k, others, (1.0 / nearest, 1.0 / farthest), DEPTHS))
    usable = [usable_pixels(view) for view in small]
    results = _core.plane_sweep(
        [_luma(view, mask) for view, mask in zip(small, usable, strict=True)],
        [None if mask.all() else mask.astype(np.uint8) for mask in usable],
        np.stack([view.camera.viewmat for view in small]),
        np.stack([view.camera.K[[0, 1, 0, 1], [0, 1, 2, 2]] for view in small]),
        sweeps,
    )
    maps = []
    for (k, _, (near, far), _), arrays in zip(sweeps, results, strict=True):
        score = np.where(usable[k], arrays["score"], np.float32(-1.0))
        spacing = (near - far) / (DEPTHS - 1)
        maps.append(DepthMap(small[k], arrays["inverse_depth"], score, spacing))
    return maps


def swept_points(
    views: list[View], known: Float64 | None, count: int, random: np.random.Generator
) -> tuple[Float64, Float64]:
    """Return points of depth maps that the depth map of another photo confirms.

    Args:
        views: the photos; masked and transparent pixels have no points.
        known: [P, 3], points of the scene, or None; see ``depth_maps``.
        count: maximum number of points.
        random: chooses points.

    Returns:
        Points [P, 3] in the world frame and their colors [P, 3] in 0..1.
    """
    maps = depth_maps(views, known)
    centers = camera_centers([depth_map.view for depth_map in maps])
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for k, depth_map in enumerate(maps):
        world = depth_map.points()
        others = [maps[i] for i in by_distance(centers, k)[:CONFIRMING_MAPS]]
        kept = (depth_map.score.reshape(-1) > MIN_SCORE) & _is_confirmed(world, others)
        points.append(world[kept])
        colors.append(depth_map.view.image[..., :3].reshape(-1, 3)[kept] / 255.0)
    xyz, rgb = at_most(count, (np.concatenate(points), np.concatenate(colors)), random)
    return xyz, rgb


def _luma(view: View, usable: Bool) -> Float32:
    """Luma in 0..1 (BT.601); pixels that are not usable are gray."""
    luma = view.image[..., :3] @ np.array([0.299, 0.587, 0.114]) / 255.0
    luma = np.where(usable, luma, 0.5)
    return np.ascontiguousarray(np.clip(luma, 0.0, 1.0), dtype=np.float32)


def _angles_deg(views: list[View], target: Float64) -> Float64:
    """Angles [V, V] between the directions from which photos see the target."""
    rays = np.stack([view.camera.center - target for view in views])
    lengths = np.linalg.norm(rays, axis=1, keepdims=True)
    rays = rays / np.maximum(lengths, np.finfo(np.float64).tiny)
    angles: Float64 = np.degrees(np.arccos(np.clip(rays @ rays.T, -1.0, 1.0)))
    return angles


def _compared_photos(centers: Float64, k: int, angles_deg: Float64) -> list[int]:
    """The photos that photo ``k`` is compared with, those with little parallax last."""
    near = [
        i
        for i in by_distance(centers, k)
        if angles_deg[k, i] < MAX_ANGLE_DEG and (centers[i] != centers[k]).any()
    ]
    return sorted(near, key=lambda i: angles_deg[k, i] < MIN_ANGLE_DEG)[:COMPARED_PHOTOS]


def _depth_range(view: View, target: Float64, known: Float64 | None) -> tuple[float, float]:
    """The nearest and farthest depth to try."""
    if known is not None:
        _, _, depth, inside = project(view.camera, known)
        if inside.sum() >= MIN_KNOWN_POINTS:
            low, high = np.percentile(depth[inside], [1.0, 99.0])
            return MIN_POINT_DEPTH * float(low), MAX_POINT_DEPTH * float(high)
    distance = max(float(np.linalg.norm(target - view.camera.center)), 1e-9)
    return MIN_DEPTH * distance, MAX_DEPTH * distance


def _is_confirmed(world: Float64, others: list[DepthMap]) -> Bool:
    """World points [P, 3] that are on the surface of another depth map."""
    confirmed = np.zeros(len(world), dtype=np.bool_)
    for other in others:
        row, column, depth, inside = project(other.view.camera, world)
        surface = 1.0 / other.inverse_depth[row, column].astype(np.float64)
        tolerance = np.maximum(TOLERANCE_PLANES * other.spacing * depth, TOLERANCE_FRACTION)
        known = other.score[row, column] > -1.0
        confirmed |= inside & known & (np.abs(1.0 - depth / surface) < tolerance)
    return confirmed
