"""Novel views: new cameras near the photos' cameras, with the same targets.

Each known camera gives eight candidates at ``STEP`` degrees from it, on a circle around its target,
and the middle between it and each nearby camera. A candidate is novel if no known camera is close.
Views between known cameras come first. The views that a round adds are known cameras in the next
round, so each round reaches further out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igsr._internal.choices import Backend
from igsr.capture import Camera
from igsr.capture.downscaling import resized_camera
from igsr.rendering.renders import render
from igsr.splats import Splats

Float64 = npt.NDArray[np.float64]

#: Angle from a known camera to a novel view, seen from their target, degrees.
STEP = 12.0
#: A view closer to a known camera than this fraction of ``STEP`` is not novel.
MIN_STEP = 0.6
#: No view is placed between two cameras that are further apart than this, degrees.
GAP = 60.0
#: Candidates around each known camera.
DIRECTIONS = 8
#: A view is inside or behind an object if more than this fraction of its pixels is closer than
#: ``CLOSE`` times the distance to its target.
CLOSE_FRACTION, CLOSE = 0.1, 0.35
#: Minimum alpha of a pixel that shows a surface.
SURFACE_ALPHA = 0.5
#: Longer side of the renders whose depths are used, pixels.
DEPTH_SIDE_PX = 96


@dataclass(frozen=True, eq=False)
class NovelView:
    """A camera that no photo was taken from.

    Attributes:
        camera: pinhole camera with the size and focal length of the known camera that it was
            derived from.
        angle: degrees to the nearest known camera, seen from that camera's target.
        between: whether it is between known cameras, not beyond them.
    """

    camera: Camera
    angle: float
    between: bool


def novel_views(
    splats: Splats, known: Sequence[Camera], count: int, backend: Backend = "auto"
) -> list[NovelView]:
    """Place cameras near known ones, apart from each other and outside of objects.

    Args:
        splats: the scene so far.
        known: cameras of the photos, and of views that earlier rounds added.
        count: maximum number of views.
        backend: "auto", "cpu", "gpu" or "reference".

    Returns:
        First views between known cameras; in each group, those farthest from all others first.
        Fewer than ``count``, or none, if there is no more room.
    """
    distances = [_viewing_distance(splats, camera, backend) for camera in known]
    looking = [
        (camera, distance)
        for camera, distance in zip(known, distances, strict=True)
        if distance is not None
    ]
    centers = np.array([camera.center for camera, _ in looking]).reshape(-1, 3)
    targets = np.array([_target(*one) for one in looking]).reshape(-1, 3)
    found: list[tuple[NovelView, float]] = []
    for k, (camera, distance) in enumerate(looking):
        others = [one for i, (one, _) in enumerate(looking) if i != k]
        for candidate, reach, between in _neighborhood(camera, distance, others):
            angle = float(_angles(targets, centers, candidate.center).min())
            if angle >= MIN_STEP * STEP:
                found.append((NovelView(candidate, angle, between), reach))
    chosen: list[NovelView] = []
    for between in (True, False):
        group = [pair for pair in found if pair[0].between == between]
        _add_farthest(chosen, group, count, centers, splats, backend)
    return chosen


def _add_farthest(
    chosen: list[NovelView],
    group: Sequence[tuple[NovelView, float]],
    count: int,
    centers: Float64,
    splats: Splats,
    backend: Backend,
) -> None:
    """Append views of a group, farthest from known cameras and chosen views first.

    Args:
        chosen: views so far, at most ``count`` in the end.
        group: views, each with the distance to its target.
        count: maximum number of chosen views.
        centers: [N, 3] centers of the known cameras, world.
        splats: the scene.
        backend: of the renders.
    """
    new = np.array([view.camera.center for view in chosen]).reshape(-1, 3)
    around = np.concatenate([centers, new])
    apart = np.array(
        [_angles(_target(v.camera, d), v.camera.center, around).min() for v, d in group]
    )
    while len(chosen) < count and len(apart) and apart.max() >= MIN_STEP * STEP:
        # The first of equally far views: rounding, which depends on the unit, must not decide.
        best = int(np.argmax(np.round(apart, 2)))
        view, reach = group[best]
        apart[best] = 0.0
        if not _is_outside(splats, view.camera, reach, backend):
            continue
        chosen.append(view)
        for i, (other, its_reach) in enumerate(group):
            target = _target(other.camera, its_reach)
            away = _angles(target, other.camera.center, view.camera.center)
            apart[i] = min(apart[i], float(away))


def _neighborhood(
    camera: Camera, distance: float, others: Sequence[Camera]
) -> list[tuple[Camera, float, bool]]:
    """Candidates around a camera, with distance to the target and whether each is between."""
    out = []
    for other in others:
        gap = _angle(camera, other, distance)
        if STEP < gap <= GAP:
            out.append((*_towards(camera, other, distance, 0.5), True))
    for k in range(DIRECTIONS):
        turn = 2.0 * np.pi * k / DIRECTIONS
        out.append((_leaning(camera, distance, np.cos(turn), np.sin(turn)), distance, False))
    return out


def _target(camera: Camera, distance: float) -> Float64:
    """The point [3], world, on a camera's axis at a distance."""
    return np.asarray(camera.center + distance * camera.viewmat[2, :3])


def _leaning(camera: Camera, distance: float, right: float, down: float) -> Camera:
    """The camera rotated around its target by ``STEP``, towards a side of its image."""
    target = _target(camera, distance)
    rotation = camera.viewmat[:3, :3]
    away = -rotation[2]
    side = right * rotation[0] + down * rotation[1]
    angle = np.radians(STEP)
    moved = np.cos(angle) * away + np.sin(angle) * side
    return _looking(camera, target + distance * moved, target, rotation[1])


def _towards(camera: Camera, other: Camera, distance: float, part: float) -> tuple[Camera, float]:
    """A camera on the arc between two around the first one's target, and its distance to that."""
    target = _target(camera, distance)
    there = other.center - target
    far = float(np.linalg.norm(there))
    start, end = -camera.viewmat[2, :3], there / far
    angle = np.arccos(np.clip(start @ end, -1.0, 1.0))
    weights = np.sin((1.0 - part) * angle), np.sin(part * angle)
    direction = (weights[0] * start + weights[1] * end) / np.sin(angle)
    reach = (1.0 - part) * distance + part * far
    down = (1.0 - part) * camera.viewmat[1, :3] + part * other.viewmat[1, :3]
    return _looking(camera, target + reach * direction, target, down), reach


def _looking(camera: Camera, center: Float64, target: Float64, down: Float64) -> Camera:
    """A copy of a camera at ``center`` that looks at ``target``, with its y axis near ``down``."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(down, forward)
    if np.linalg.norm(right) < 1e-6:
        right = camera.viewmat[0, :3] - (camera.viewmat[0, :3] @ forward) * forward
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    return replace(camera, viewmat=viewmat)


def _angle(camera: Camera, other: Camera, distance: float) -> float:
    """Degrees between two camera centers, seen from the first camera's target."""
    return float(_angles(_target(camera, distance), camera.center, other.center))


def _angles(target: Float64, center: Float64, others: Float64) -> Float64:
    """Degrees between ``center`` and ``others``, seen from ``target``; [..., 3] broadcast."""
    here, there = center - target, others - target
    lengths = np.linalg.norm(here, axis=-1) * np.linalg.norm(there, axis=-1)
    cosine = np.sum(here * there, axis=-1) / np.where(lengths > 0.0, lengths, 1.0)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return np.where(lengths > 0.0, angle, 180.0)


def _small(camera: Camera) -> Camera:
    """The same camera with a small image."""
    scale = min(1.0, DEPTH_SIDE_PX / max(camera.width, camera.height))
    width, height = max(1, round(scale * camera.width)), max(1, round(scale * camera.height))
    return resized_camera(camera, width, height)


def _viewing_distance(splats: Splats, camera: Camera, backend: Backend) -> float | None:
    """Median depth of the surfaces that a camera sees; None if it sees none."""
    seen = render(splats, _small(camera), backend=backend)
    depths = seen.expected_depth[seen.alpha > SURFACE_ALPHA]
    return float(np.median(depths)) if len(depths) else None


def _is_outside(splats: Splats, camera: Camera, distance: float, backend: Backend) -> bool:
    """Whether few pixels of a camera are close and some show a surface."""
    seen = render(splats, _small(camera), backend=backend)
    near = (seen.alpha > SURFACE_ALPHA) & (seen.expected_depth < CLOSE * distance)
    return bool(near.mean() <= CLOSE_FRACTION and (seen.alpha > SURFACE_ALPHA).any())
