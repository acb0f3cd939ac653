"""Plot of cameras and points from three sides, to check poses by eye."""

from __future__ import annotations

import os

import numpy as np
import numpy.typing as npt

from igsr._internal.atomic_write import atomic_write
from igsr.capture import Capture

Float64 = npt.NDArray[np.float64]

#: Points drawn at most; more only cover each other.
MOST_POINTS = 20_000
#: Length of a drawn camera, of the largest distance between cameras.
LENGTH = 0.08


def plot_poses(path: str | os.PathLike[str], capture: Capture) -> None:
    """Draw a capture's cameras, as frusta with their views' numbers, and its points, as PNG.

    The scene is turned so that the cameras' mean up is up: seen from above, from the front and
    from the side.

    Raises:
        IgsrError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    centers = np.stack([view.camera.center for view in capture.views])
    turn = _upright([view.camera.viewmat[:3, :3] for view in capture.views])
    middle = centers.mean(axis=0)
    spread = float(np.linalg.norm(centers[:, None] - centers[None], axis=-1).max())
    size = LENGTH * spread if spread > 0.0 else 1.0
    points, colors = _points(capture)
    points = (points - middle) @ turn.T
    frusta = [
        (
            _frustum(
                view.camera.viewmat, view.camera.K, view.camera.width, view.camera.height, size
            )
            - middle
        )
        @ turn.T
        for view in capture.views
    ]
    # Very distant points would make the cameras tiny.
    corners = np.concatenate(frusta)
    near = (
        np.concatenate([corners, np.quantile(points, (0.05, 0.95), axis=0)])
        if len(points)
        else corners
    )
    low, high = near.min(axis=0), near.max(axis=0)
    half = 0.55 * float((high - low).max())
    figure = Figure(figsize=(15.0, 5.4), layout="constrained")
    views = (
        ("from above", 0, 2, True),
        ("from the front", 0, 1, False),
        ("from the side", 2, 1, False),
    )
    for axis, (title, across, up, above) in zip(figure.subplots(1, 3), views, strict=True):
        sign = 1.0 if above else -1.0
        axis.scatter(points[:, across], sign * points[:, up], s=1.0, c=colors, linewidths=0.0)
        for number, corners in enumerate(frusta):
            outline = corners[[0, 1, 2, 0, 3, 4, 0, 2, 3, 4, 1]]
            axis.plot(
                outline[:, across], sign * outline[:, up], color=f"C{number % 10}", linewidth=1.0
            )
            axis.annotate(str(number), (corners[0, across], sign * corners[0, up]), fontsize=8)
        center = 0.5 * (low + high)
        axis.set_xlim(center[across] - half, center[across] + half)
        axis.set_ylim(sign * center[up] - half, sign * center[up] + half)
        axis.set_aspect("equal")
        axis.set_title(title, fontsize=10)
        axis.grid(alpha=0.3)
    figure.suptitle(
        f"{len(capture.views)} cameras, {len(points)} points drawn, units of the world", fontsize=10
    )
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=100)


def _upright(rotations: list[Float64]) -> Float64:
    """The rotation [3, 3] to axes right, down and forward, down the cameras' mean down."""
    down = np.mean([rotation[1] for rotation in rotations], axis=0)
    if np.linalg.norm(down) < 1e-6:
        return np.eye(3)
    down /= np.linalg.norm(down)
    # Cameras that look in all directions have no mean: use the axis that is most horizontal.
    forward = np.mean([rotation[2] for rotation in rotations], axis=0)
    forward -= (forward @ down) * down
    if np.linalg.norm(forward) < 1e-3:
        forward = np.eye(3)[int(np.abs(down).argmin())]
        forward -= (forward @ down) * down
    forward /= np.linalg.norm(forward)
    return np.stack([np.cross(down, forward), down, forward])


def _frustum(viewmat: Float64, K: Float64, width: int, height: int, size: float) -> Float64:
    """Center and corners [5, 3] of a camera in the world."""
    pixels = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float64)
    rays = np.ones((4, 3))
    rays[:, :2] = (pixels - K[:2, 2]) / K[[0, 1], [0, 1]]
    local = np.concatenate([np.zeros((1, 3)), size * rays])
    world: Float64 = (local - viewmat[:3, 3]) @ viewmat[:3, :3]
    return world


def _points(capture: Capture) -> tuple[Float64, Float64]:
    if capture.points is None:
        return np.zeros((0, 3)), np.zeros((0, 3))
    step = -(-len(capture.points.xyz) // MOST_POINTS)
    return capture.points.xyz[::step], capture.points.rgb[::step] / 255.0
