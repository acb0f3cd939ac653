"""Novel views: cameras near the photos' cameras, which look at what these look at.

Around each known camera, candidates are eight ways to lean out by ``STEP`` degrees about the point
that it looks at, and the middle between it and each other camera nearby. A candidate is novel if it
is not close to a known camera. Views between known cameras come first, then those beyond them. The
cameras of views that a round adds are known in the next round, which so reaches further out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igsr._internal.choices import Backend
from igsr.capture import Camera
from igsr.rendering.renders import render
from igsr.splats import Splats

Float64 = npt.NDArray[np.float64]

#: Degrees from a known camera to a novel view, about what they look at.
STEP = 12.0
#: A view nearer to a known camera than this part of a step is not novel.
LEAST_STEP = 0.6
#: Two cameras further apart than this, degrees, have nothing known between them.
GAP = 60.0
#: Directions to lean out in.
DIRECTIONS = 8
#: A view is inside the scene, or behind something, where more than this share of its pixels is
#: nearer than ``CLOSE`` times the distance to what it looks at.
CLOSE_SHARE, CLOSE = 0.1, 0.35
#: A pixel of less alpha than this shows no surface.
SURFACE_ALPHA = 0.5
#: Longer side, in pixels, of the small renders that tell where surfaces are.
DEPTH_RENDER_SIDE = 96


@dataclass(frozen=True, eq=False)
class NovelView:
    """A camera that no photo was taken from.

    Attributes:
        camera: pinhole camera with the size and focal length of the known camera that it was
            derived from.
        angle: degrees to the nearest known camera, about what that looks at.
        between: whether it lies between known cameras, not beyond them.
    """

    camera: Camera
    angle: float
    between: bool


def novel_views(
    splats: Splats, known: Sequence[Camera], count: int, backend: Backend = "auto"
) -> list[NovelView]:
    """Cameras near known ones but not at them, spread out, and never inside the scene.

    Args:
        splats: the scene so far.
        known: cameras of the photos, and of views that earlier rounds added.
        count: most views that are returned.
        backend: "auto", "cpu", "gpu" or "reference".

    Returns:
        Those between known cameras first; in each group the ones farthest from all others first.
        Fewer than ``count``, or none, where there is no more room for them.
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
        for candidate, reach, between in _neighbourhood(camera, distance, others):
            angle = float(_angles(targets, centers, candidate.center).min())
            if angle >= LEAST_STEP * STEP:
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
        group: views, each with its distance to what it looks at.
        count: most views that are chosen.
        centers: [N, 3] centers of the known cameras, world.
        splats: the scene, which no view may stand inside of.
        backend: what renders.
    """
    new = np.array([view.camera.center for view in chosen]).reshape(-1, 3)
    around = np.concatenate([centers, new])
    apart = np.array(
        [_angles(_target(v.camera, d), v.camera.center, around).min() for v, d in group]
    )
    while len(chosen) < count and len(apart) and apart.max() >= LEAST_STEP * STEP:
        best = int(np.argmax(apart))
        view, reach = group[best]
        apart[best] = 0.0
        if not _is_outside(splats, view.camera, reach, backend):
            continue
        chosen.append(view)
        for i, (other, its_reach) in enumerate(group):
            target = _target(other.camera, its_reach)
            away = _angles(target, other.camera.center, view.camera.center)
            apart[i] = min(apart[i], float(away))


def _neighbourhood(
    camera: Camera, distance: float, others: Sequence[Camera]
) -> list[tuple[Camera, float, bool]]:
    """Cameras around one, each one's distance to what it looks at, and whether it is between."""
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
    """The camera turned by a step about what it looks at, towards a side of its own picture."""
    target = _target(camera, distance)
    rotation = camera.viewmat[:3, :3]
    away = -rotation[2]
    side = right * rotation[0] + down * rotation[1]
    angle = np.radians(STEP)
    moved = np.cos(angle) * away + np.sin(angle) * side
    return _looking(camera, target + distance * moved, target, rotation[1])


def _towards(camera: Camera, other: Camera, distance: float, part: float) -> tuple[Camera, float]:
    """A camera on the arc between two, about what the first looks at, and its distance to that."""
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
    """A camera like another, at a place, looking at a target, its y axis nearest to a given one."""
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
    """Degrees between where two cameras stand, seen from what the first looks at."""
    return float(_angles(_target(camera, distance), camera.center, other.center))


def _angles(target: Float64, center: Float64, others: Float64) -> Float64:
    """Degrees between ``center`` and ``others``, seen from ``target``; [..., 3] broadcast."""
    here, there = center - target, others - target
    lengths = np.linalg.norm(here, axis=-1) * np.linalg.norm(there, axis=-1)
    cosine = np.sum(here * there, axis=-1) / np.where(lengths > 0.0, lengths, 1.0)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return np.where(lengths > 0.0, angle, 180.0)


def _small(camera: Camera) -> Camera:
    """The same camera with a small picture."""
    scale = min(1.0, DEPTH_RENDER_SIDE / max(camera.width, camera.height))
    width, height = max(1, round(scale * camera.width)), max(1, round(scale * camera.height))
    K = camera.K.copy()
    K[0] *= width / camera.width
    K[1] *= height / camera.height
    return replace(camera, K=K, width=width, height=height)


def _viewing_distance(splats: Splats, camera: Camera, backend: Backend) -> float | None:
    """Median depth of what a camera sees; None where it sees nothing."""
    seen = render(splats, _small(camera), backend=backend)
    depths = seen.expected_depth[seen.alpha > SURFACE_ALPHA]
    return float(np.median(depths)) if len(depths) else None


def _is_outside(splats: Splats, camera: Camera, distance: float, backend: Backend) -> bool:
    """Whether a camera stands in front of the scene: few pixels are close, some show a surface."""
    seen = render(splats, _small(camera), backend=backend)
    near = (seen.alpha > SURFACE_ALPHA) & (seen.expected_depth < CLOSE * distance)
    return bool(near.mean() <= CLOSE_SHARE and (seen.alpha > SURFACE_ALPHA).any())
