"""Visibility: which cells each photo shows, in which part of the photo, and at which depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.choices import Backend
from igsr.blocks.crops import Box, box_around
from igsr.capture.downscaling import reduced_size, resized_camera
from igsr.capture.types import Camera, Points, View
from igsr.evaluation.scores import BLACK
from igsr.rendering.renders import project, render
from igsr.rendering.splat_weights import splat_weights
from igsr.splats import Splats

Bool = npt.NDArray[np.bool_]
Float64 = npt.NDArray[np.float64]

#: Longest side of the renders that measure visibility, pixels.
THUMBNAIL_PX = 32


def _thumbnail(camera: Camera) -> Camera:
    return resized_camera(camera, *reduced_size(camera.width, camera.height, THUMBNAIL_PX))


def _without_sh(splats: Splats) -> Splats:
    """The splats with SH degree 0: visibility does not depend on their colors."""
    return replace(splats, sh=np.ascontiguousarray(splats.sh[:, :1]))


def splat_visibility(
    splats: Splats, cameras: Sequence[Camera], groups: Bool, backend: str
) -> Float64:
    """The fraction of each camera's picture that shows each group of splats, float64 [P, C].

    Args:
        splats: N splats; hidden ones do not count.
        cameras: P cameras.
        groups: bool [N, C], membership in C groups, which may overlap.
        backend: "cpu" or "gpu".
    """
    splats, members = _without_sh(splats), groups.astype(np.float64)
    visibility = np.zeros((len(cameras), groups.shape[1]))
    for row, camera in zip(visibility, cameras, strict=True):
        weights = splat_weights(splats, _thumbnail(camera), backend).astype(np.float64)
        # Weights come from gradients, which rounding may make negative.
        weights = np.maximum(weights, 0.0)
        seen = np.flatnonzero(weights)
        row[:] = weights[seen] @ members[seen] / max(float(weights[seen].sum()), 1e-9)
    return np.clip(visibility, 0.0, 1.0)


def track_visibility(points: Points | None, names: Sequence[str], groups: Bool) -> Float64:
    """The fraction of each photo's tracked points in each group, float64 [P, C].

    Args:
        points: M points with tracks, or None.
        names: names of P photos; those without tracks get 0.
        groups: bool [M, C], membership in C groups, which may overlap.
    """
    visibility = np.zeros((len(names), groups.shape[1]))
    if points is None or points.tracks is None:
        return visibility
    tracks = points.tracks
    number = {name: index for index, name in enumerate(names)}
    photo = np.array([number.get(name, -1) for name in tracks.names], np.int64)[tracks.view]
    known = photo >= 0
    photo, point = photo[known], tracks.point[known]
    total = np.maximum(np.bincount(photo, minlength=len(names)), 1)
    for index, group in enumerate(groups.T):
        shown = np.bincount(photo[group[point]], minlength=len(names))
        visibility[:, index] = shown / total
    return visibility


def visible_boxes(
    splats: Splats,
    cameras: Sequence[Camera],
    groups: Bool,
    wanted: Bool,
    background_groups: npt.NDArray[np.int64],
    backend: str,
) -> list[dict[int, Box]]:
    """Find the part of each photo that shows each group of splats.

    Args:
        splats: N splats.
        cameras: P cameras.
        groups: bool [N, C], membership in C groups, which may overlap.
        wanted: bool [P, C], the boxes to compute.
        background_groups: int64 [P], the group of each photo's empty pixels; -1 for none.
        backend: "cpu" or "gpu".

    Returns:
        For each photo, boxes by the index of the group.
    """
    splats = _without_sh(splats)
    boxes: list[dict[int, Box]] = []
    for photo, camera in enumerate(cameras):
        indices = np.flatnonzero(wanted[photo])
        small = _thumbnail(camera)
        projected = project(splats, small, backend) if len(indices) else {}
        boxes.append({})
        for first in range(0, len(indices), 3):  # one color channel per group
            chunk = indices[first : first + 3]
            colors = np.zeros_like(projected["colors"])
            colors[:, : len(chunk)] = groups[:, chunk]
            picture = _core.rasterize(
                {**projected, "colors": colors},
                width=small.width,
                height=small.height,
                background=np.zeros(3, colors.dtype),
                backend=backend,
            )
            for channel, group in enumerate(chunk):
                shown = picture["color"][..., channel].astype(np.float64)
                if group == background_groups[photo]:
                    shown = shown + (1.0 - picture["alpha"])
                boxes[-1][int(group)] = box_around(shown)
    return boxes


def in_any_view(splats: Splats, views: Sequence[View], backend: str) -> Bool:
    """Whether each splat [N] lies in the frame of any view, hidden or not."""
    shown = np.zeros(len(splats), np.bool_)
    splats = _without_sh(splats)
    for view in views:
        shown |= (project(splats, view.camera, backend)["radii"] > 0).any(axis=1)
    return shown


def scene_depths(views: Sequence[View], scene: Splats, backend: str) -> Float64:
    """The median depth of the scene in each view, float64 [V], world units; 0 if it is empty."""
    scene = _without_sh(scene)
    depths = []
    for view in views:
        picture = render(scene, _thumbnail(view.camera), BLACK, cast(Backend, backend))
        known = picture.expected_depth[picture.alpha > 0.5]
        depths.append(float(np.median(known)) if len(known) else 0.0)
    return np.array(depths)


def track_depths(views: Sequence[View], points: Points | None) -> Float64 | None:
    """The median depth of the points that each view tracks, float64 [V], world units.

    0 for a view without tracks; None if there are no tracks at all.
    """
    if points is None or points.tracks is None:
        return None
    tracks = points.tracks
    order = np.argsort(tracks.view, kind="stable")
    ends = np.searchsorted(tracks.view[order], np.arange(1, len(tracks.names)))
    seen = dict(zip(tracks.names, np.split(tracks.point[order], ends), strict=True))
    depths = np.zeros(len(views))
    for index, view in enumerate(views):
        if len(seen.get(view.name, ())):
            viewmat, xyz = view.camera.viewmat, points.xyz[seen[view.name]]
            depths[index] = np.median(xyz @ viewmat[2, :3] + viewmat[2, 3])
    return depths
