"""Depth maps by PatchMatch stereo, and points of them.

A few wrong points hurt an initialization more than missing ones, so a pixel has a depth only if the
depth maps of two other photos have the same surface, or one depth map if no more photos see the
place (as in COLMAP's fusion, Schoenberger et al. 2016, section 4.5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.capture import View
from igsr.fitting.initialization.photo_pixels import (
    at_most,
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

#: Photos are compared if they look at the scene from within this angle. Those about
#: ``BEST_ANGLE_DEG`` apart are preferred, with these deviations: nearer ones have little parallax,
#: farther ones see surfaces differently.
MAX_ANGLE_DEG = 60.0
BEST_ANGLE_DEG = 15.0
NEARER_DEG = 6.0
FARTHER_DEG = 20.0
#: Fits start from depth maps if photos have another one within this angle: further apart, depth
#: maps leave too much open (strecha_fountain, 3 photos).
NEIGHBOR_DEG = 40.0
#: Number of photos to compare with, and the fraction of the scene that they must see.
COMPARED_PHOTOS = 5
MIN_OVERLAP = 0.1
#: Longer side of photos for depth maps, pixels; bounds the time.
MAX_SIDE_PX = 512
#: Maximum number of photos with depth maps, evenly spaced.
MAX_DEPTH_MAPS = 24
#: Range of depths, in units of the distance to the target.
MIN_DEPTH = 0.25
MAX_DEPTH = 8.0
#: The range by the depths of known points, if a photo shows enough of them. Points are on texture:
#: the scene extends in front of and behind them. It begins in front of the nearest points by this
#: factor times their distance from the median, both in inverse depths, between these fractions of
#: their depth. Wrong surfaces close to a camera would hide the scene.
IN_FRONT = 1.5
NEAREST_FRACTIONS = (0.6, 0.9)
MAX_POINT_DEPTH = 4.0
MIN_KNOWN_POINTS = 20


@dataclass(eq=False)
class DepthMap:
    """Depths of a photo's pixels.

    Attributes:
        view: the photo, reduced to at most ``MAX_SIDE_PX``.
        depth: float32 [H, W], z-depth in world units; 0 if no other photo confirms it.
        normal: float32 [H, W, 3], unit normals towards the camera, in its frame; 0 without depth.
        confidence: float32 [H, W] in 0..1, by correlation and by how many photos confirm it.
    """

    view: View
    depth: Float32
    normal: Float32
    confidence: Float32

    def points(self) -> tuple[Float64, Float64]:
        """World points [P, 3] of the pixels with depth, row by row, and their colors in 0..1."""
        rows, columns = np.nonzero(self.depth)
        rays = pixel_rays(self.view.camera, columns, rows)
        depth = self.depth[rows, columns, None].astype(np.float64)
        colors = self.view.image[rows, columns, :3] / 255.0
        return to_world(self.view.camera, rays * depth), colors


def viewed_target(views: list[View], known: Float64 | None) -> Float64:
    """The point [3] that photos look at: the median of known points [P, 3] or the focus point."""
    if known is not None and len(known) >= MIN_KNOWN_POINTS:
        return np.asarray(np.median(known, axis=0))
    return focus_point([view.camera for view in views])


def have_neighbors(
    views: list[View], target: Float64, angle_deg: float = NEIGHBOR_DEG, fraction: float = 1.0
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
        known: [P, 3], points of the scene, to start from and for the range of depths, or None.
    """
    chosen = np.linspace(0, len(views) - 1, min(len(views), MAX_DEPTH_MAPS)).round()
    small = [reduced(views[int(k)], MAX_SIDE_PX) for k in np.unique(chosen)]
    target = viewed_target(views, known)
    angles = _angles_deg(small, target)
    searches = []
    for k, view in enumerate(small):
        distance = max(float(np.linalg.norm(target - view.camera.center)), 1e-9)
        seeds = _seeds(view, known)
        others = _compared_photos(small, k, angles, seeds, distance)
        if others:
            nearest, farthest = _depth_range(seeds, distance)
            seeds[:, 2] = 1.0 / seeds[:, 2]
            searches.append((k, others, (1.0 / nearest, 1.0 / farthest), seeds.astype(np.float32)))
    usable = [usable_pixels(view) for view in small]
    results = _core.depth_maps(
        [_luma(view, mask) for view, mask in zip(small, usable, strict=True)],
        [mask.astype(np.uint8) for mask in usable],
        np.stack([view.camera.viewmat for view in small]),
        np.stack([view.camera.K[[0, 1, 0, 1], [0, 1, 2, 2]] for view in small]),
        searches,
    )
    return [
        DepthMap(small[search[0]], arrays["depth"], arrays["normal"], arrays["confidence"])
        for search, arrays in zip(searches, results, strict=True)
    ]


def depth_points(
    views: list[View], known: Float64 | None, count: int, random: np.random.Generator
) -> tuple[Float64, Float64]:
    """Return points of the confirmed pixels of depth maps.

    Args:
        views: the photos; masked and transparent pixels have no points.
        known: [P, 3], points of the scene, or None; see ``depth_maps``.
        count: maximum number of points.
        random: chooses points.

    Returns:
        Points [P, 3] in the world frame and their colors [P, 3] in 0..1.
    """
    nothing = np.zeros((0, 3))
    both = [(nothing, nothing), *(one.points() for one in depth_maps(views, known))]
    points, colors = (np.concatenate(arrays) for arrays in zip(*both, strict=True))
    xyz, rgb = at_most(count, (points, colors), random)
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


def _seeds(view: View, known: Float64 | None) -> Float64:
    """Column, row and depth [P, 3] of the known points that a photo shows."""
    if known is None:
        return np.zeros((0, 3))
    row, column, depth, inside = project(view.camera, known)
    return np.stack([column, row, depth], axis=1)[inside]


def _depth_range(seeds: Float64, distance: float) -> tuple[float, float]:
    """The nearest and farthest depth to try, by known points or the target's distance."""
    if len(seeds) >= MIN_KNOWN_POINTS:
        low, median, high = (float(d) for d in np.percentile(seeds[:, 2], [1.0, 50.0, 99.0]))
        fraction = 1.0 / (1.0 + IN_FRONT * (1.0 - low / median))
        return low * float(np.clip(fraction, *NEAREST_FRACTIONS)), MAX_POINT_DEPTH * high
    return MIN_DEPTH * distance, MAX_DEPTH * distance


def _compared_photos(
    views: list[View], k: int, angles_deg: Float64, seeds: Float64, distance: float
) -> list[int]:
    """The photos that photo ``k`` is compared with, the best first."""
    camera = views[k].camera
    if len(seeds) < MIN_KNOWN_POINTS:
        # A wall at the target's distance.
        rows, columns = np.indices((5, 5)).reshape(2, -1) + 0.5
        places = [columns * camera.width / 5.0, rows * camera.height / 5.0]
        seeds = np.stack([*places, np.full(25, distance)], axis=1).astype(np.float64)
    rays = pixel_rays(camera, seeds[:, 0].astype(np.int64), seeds[:, 1].astype(np.int64))
    world = to_world(camera, rays * seeds[:, 2:])
    worth = {}
    for i, view in enumerate(views):
        angle = float(angles_deg[k, i])
        overlap = float(project(view.camera, world)[3].mean())
        is_apart = (view.camera.center != camera.center).any()
        if i != k and is_apart and angle < MAX_ANGLE_DEG and overlap > MIN_OVERLAP:
            error = angle - BEST_ANGLE_DEG
            error /= NEARER_DEG if error < 0.0 else FARTHER_DEG
            worth[i] = overlap * float(np.exp(-0.5 * error**2))
    return sorted(worth, key=lambda i: -worth[i])[:COMPARED_PHOTOS]
