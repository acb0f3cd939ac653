"""Cameras around a scene: on a circle for turntable videos, or on a sphere for all its sides."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera
from igsr.errors import IgsrError
from igsr.geometry.focus_point import focus_point
from igsr.splats import Splats

Vector = npt.NDArray[np.float64]

#: Image size, vertical field of view and elevation above the horizon without cameras of photos.
DEFAULT_SIZE = (800, 600)
DEFAULT_FOV_DEG = 45.0
DEFAULT_ELEVATION_DEG = 20.0


def orbit(splats: Splats, cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """Return cameras on a circle around the scene.

    The circle is fitted to the given cameras: around their focus point, at their median distance
    and height, with their mean up direction and the first one's lens. Without cameras it is around
    the middle of the splats, z up.

    Args:
        splats: the scene.
        cameras: of photos of the scene; may be empty.
        frames: number of cameras, at least 1.

    Raises:
        IgsrError: ``frames`` is below 1, or there are no finite splats.
    """
    if frames < 1:
        raise IgsrError(f"orbit must have at least 1 frame, not {frames}.")
    if not cameras:
        target, distance = _framed(splats)
        up = np.array([0.0, 0.0, 1.0])
        start = np.array([0.0, -1.0, 0.0])
        elevation = np.radians(DEFAULT_ELEVATION_DEG)
        radius, height = distance * np.cos(elevation), distance * np.sin(elevation)
        columns, rows = DEFAULT_SIZE
        K = _default_lens(columns, rows)
    else:
        centers = np.stack([camera.center for camera in cameras])
        target = focus_point(list(cameras))
        up = _unit(-np.mean([camera.viewmat[1, :3] for camera in cameras], axis=0))
        offsets = centers - target
        heights = offsets @ up
        flat = offsets - heights[:, None] * up
        radius = float(np.median(np.linalg.norm(flat, axis=1)))
        height = float(np.median(heights))
        start = flat[0] if np.linalg.norm(flat[0]) > 1e-9 else np.cross(up, [1.0, 0.3, 0.2])
        K, columns, rows = cameras[0].K, cameras[0].width, cameras[0].height

    forward = _unit(start - (start @ up) * up)
    side = np.cross(up, forward)
    result = []
    for angle in np.linspace(0.0, 2.0 * np.pi, frames, endpoint=False):
        ring = radius * (np.cos(angle) * forward + np.sin(angle) * side)
        viewmat = look_at(target + ring + height * up, target, up)
        result.append(Camera(viewmat, K, columns, rows))
    return result


def cameras_around(splats: Splats, count: int, side: int) -> list[Camera]:
    """``count`` cameras spread evenly on a sphere, looking at the middle of the splats.

    Neighbors in the list stand far from each other, so every so many of them are spread as well.
    Pictures are ``side`` pixels wide and high.

    Args:
        splats: the scene.
        count: number of cameras.
        side: width and height of the pictures, pixels.

    Raises:
        IgsrError: there are no finite splats to look at.
    """
    target, distance = _framed(splats)
    # No direction is vertical, so z is never along the view.
    up = np.array([0.0, 0.0, 1.0])
    K = _default_lens(side, side)
    return [
        Camera(look_at(target + distance * direction, target, up), K, side, side)
        for direction in even_directions(count)
    ]


def even_directions(count: int) -> npt.NDArray[np.float64]:
    """Unit vectors [count, 3] spread evenly over all directions, none of them along z.

    A Fibonacci lattice: equal areas by height, the golden angle apart.
    """
    heights = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angles = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    flat = np.sqrt(1.0 - heights**2)
    return np.stack([flat * np.cos(angles), flat * np.sin(angles), heights], axis=1)


def _framed(splats: Splats) -> tuple[Vector, float]:
    """The middle of the splats and how far away a camera of the default lens frames them."""
    splats = splats.without_backdrop()
    finite = splats.finite
    if not finite.any():
        raise IgsrError("The scene has no finite splats to look at.")
    points = splats.means[finite].astype(np.float64) + splats.origin
    logits = splats.opacities[finite]
    solid = points[logits >= np.median(logits)]
    target = np.median(solid, axis=0)
    reach = np.quantile(np.linalg.norm(solid - target, axis=1), 0.9)
    distance = max(float(reach), 1e-6) / np.tan(np.radians(DEFAULT_FOV_DEG / 2)) * 1.2
    return target, float(distance)


def _default_lens(columns: int, rows: int) -> npt.NDArray[np.float64]:
    focal = rows / 2 / np.tan(np.radians(DEFAULT_FOV_DEG / 2))
    return np.array([[focal, 0.0, columns / 2], [0.0, focal, rows / 2], [0.0, 0.0, 1.0]])


def look_at(position: Vector, target: Vector, up: Vector) -> Vector:
    """World-to-camera [4, 4], OpenCV axes, at ``position`` looking at ``target``."""
    z = _unit(target - position)
    x = _unit(np.cross(z, up))
    y = np.cross(z, x)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([x, y, z])
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    return viewmat


def _unit(vector: Vector) -> Vector:
    length = float(np.linalg.norm(vector))
    return np.asarray(vector / length) if length > 1e-12 else np.array([0.0, 0.0, 1.0])
