"""Cells of a scene: rectangles on the ground plane with equal numbers of cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr._internal.rotations import rotations_of
from igsr.capture.types import Camera
from igsr.errors import IgsrError
from igsr.splats import Splats

Bool = npt.NDArray[np.bool_]
Float64 = npt.NDArray[np.float64]

#: A block is fitted in its cell, expanded by this fraction of the cell's sides (VastGaussian).
OVERLAP_FRACTION = 0.2
#: A direction is flat if the cameras spread less along it than this fraction of the next one.
FLAT_FRACTION = 0.5
#: A splat is spanning if it extends beyond its cell by more than this fraction of the cell's sides.
SPANNING_FRACTION = 0.25
#: Extent of a splat from its center, standard deviations.
EXTENT_SIGMAS = 2.0


@dataclass(frozen=True)
class Cell:
    """A rectangle on the ground plane; it includes its low borders and excludes its high ones.

    Attributes:
        low, high: corners in world units; infinite at the outer border of the scene.
        side: lengths of the sides in world units, up to the outermost cameras.
    """

    low: tuple[float, float]
    high: tuple[float, float]
    side: tuple[float, float]

    def contains(self, positions: Float64) -> Bool:
        """Whether positions [N, 2] lie in the cell; each lies in exactly one cell of a plan."""
        inside = (positions >= np.array(self.low)) & (positions < np.array(self.high))
        return np.asarray(inside.all(axis=1))

    def expanded(self, fraction: float = OVERLAP_FRACTION) -> Cell:
        """The cell with sides longer by a fraction, half of it at each border."""
        margin = 0.5 * fraction * np.array(self.side)
        low, high = np.array(self.low) - margin, np.array(self.high) + margin
        return Cell((low[0], low[1]), (high[0], high[1]), self.side)

    def plain(self) -> dict[str, Any]:
        """The cell for JSON, with None for infinity."""

        def finite(corner: tuple[float, float]) -> list[float | None]:
            return [value if math.isfinite(value) else None for value in corner]

        return {"low": finite(self.low), "high": finite(self.high), "side": list(self.side)}


@dataclass(frozen=True, eq=False)
class Grid:
    """Cells on the ground plane.

    Attributes:
        axes: float64 [2, 3], two orthogonal unit vectors in the plane, world frame.
        cells: C cells without overlap; together they cover the plane.
    """

    axes: Float64
    cells: tuple[Cell, ...]

    def positions(self, points: Float64) -> Float64:
        """Project points [N, 3] in the world frame onto the plane, float64 [N, 2]."""
        return np.asarray(points, np.float64) @ self.axes.T

    def splat_positions(self, splats: Splats) -> Float64:
        """Positions of the splats' centers on the plane, float64 [N, 2]."""
        return self.positions(splats.means.astype(np.float64) + splats.origin)

    def inside(self, positions: Float64, *, expanded: bool = False) -> Bool:
        """Whether each position [N, 2] lies in each cell, bool [N, C]."""
        cells = [cell.expanded() for cell in self.cells] if expanded else self.cells
        return np.stack([cell.contains(positions) for cell in cells], axis=1)

    def near_borders(self, splats: Splats, fraction: float) -> Bool:
        """Whether each splat lies within a fraction of a cell's sides of a border, bool [N]."""
        positions = self.splat_positions(splats)
        near: Bool = np.zeros(len(positions), np.bool_)
        for cell in self.cells:
            inner, outer = cell.expanded(-2.0 * fraction), cell.expanded(2.0 * fraction)
            near |= outer.contains(positions) & ~inner.contains(positions)
        return near

    def spanning(self, splats: Splats) -> Bool:
        """Whether each splat extends far into other cells than its own, bool [N].

        Such splats, as in haze and sky, stay as the coarse fit has them: a single block would fit
        them to its own photos only.
        """
        positions = self.splat_positions(splats)
        norms = np.linalg.norm(splats.quats.astype(np.float64), axis=1, keepdims=True)
        quats = np.asarray(splats.quats / np.where(norms > 0.0, norms, 1.0))
        axes = np.einsum("gk,nkj->ngj", self.axes, rotations_of(quats))
        axes = axes * np.exp(splats.scales.astype(np.float64))[:, None, :]
        extent = EXTENT_SIGMAS * np.sqrt((axes**2).sum(axis=2))
        spanning: Bool = np.zeros(len(splats), np.bool_)
        for cell in self.cells:
            margin = SPANNING_FRACTION * np.array(cell.side)
            below = positions - extent < np.array(cell.low) - margin
            above = positions + extent > np.array(cell.high) + margin
            spanning |= cell.contains(positions) & (below | above).any(axis=1)
        return spanning


def grid_of(cameras: Sequence[Camera], count: int) -> Grid:
    """Split the ground plane into cells with equal numbers of cameras.

    Raises:
        IgsrError: there are fewer cameras than cells, or too many cameras at one position.
    """
    axes = ground_axes(cameras)
    return Grid(axes, split_into_cells(centers_of(cameras) @ axes.T, count))


def centers_of(cameras: Sequence[Camera]) -> Float64:
    """Centers of cameras, float64 [N, 3], world frame."""
    return np.stack([camera.center for camera in cameras])


def ground_axes(cameras: Sequence[Camera]) -> Float64:
    """Estimate two orthogonal unit vectors in the ground plane, float64 [2, 3].

    It is the plane along which the cameras spread. If they lie on a line or all around, it is
    perpendicular to their mean up direction.
    """
    centers = centers_of(cameras)
    spread, axes = np.linalg.eigh(np.cov((centers - centers.mean(axis=0)).T, bias=True))
    axes = axes.T[::-1]  # by decreasing spread
    first, second, third = np.sqrt(np.maximum(spread[::-1], 0.0))
    up = -np.mean([camera.viewmat[1, :3] for camera in cameras], axis=0)
    if third < FLAT_FRACTION * second or np.linalg.norm(up) <= 1e-6:
        return np.asarray(axes[:2])
    along = axes[0] if second < FLAT_FRACTION * first else np.cross(up, axes[2])
    for candidate in (along, axes[0], axes[1]):
        level = candidate - up * (candidate @ up) / max(up @ up, 1e-12)
        if np.linalg.norm(level) > 1e-6:
            break
    level /= np.linalg.norm(level)
    return np.stack([level, np.cross(up / np.linalg.norm(up), level)])


def split_into_cells(positions: Float64, count: int) -> tuple[Cell, ...]:
    """Split the plane into cells with equal numbers of cameras, by the cameras' positions [N, 2].

    Each split is across the axis along which the cameras spread more. Cameras at one position, such
    as the views of a panorama, stay together.

    Raises:
        IgsrError: there are fewer cameras than cells, or too many cameras at one position.
    """
    if not 1 <= count <= len(positions):
        raise IgsrError(
            f"{count} blocks need at least as many photos to fit, not {len(positions)}; give fewer "
            "--blocks."
        )
    bounds = np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
    return tuple(_split(np.asarray(positions, np.float64), bounds, count))


def _split(positions: Float64, bounds: Float64, count: int) -> list[Cell]:
    low, high = positions.min(axis=0), positions.max(axis=0)
    if count == 1:
        (x0, y0), (x1, y1) = bounds
        inner = np.where(np.isfinite(bounds), bounds, np.stack([low, high]))
        side = inner[1] - inner[0]
        return [Cell((x0, y0), (x1, y1), (float(side[0]), float(side[1])))]
    axis = int(np.argmax(high - low))
    ordered = np.sort(positions[:, axis])
    below_count = count // 2
    values = np.unique(ordered)
    cuts = 0.5 * (values[:-1] + values[1:])
    ranks = np.searchsorted(ordered, cuts)
    allowed = (ranks >= below_count) & (ranks <= len(ordered) - (count - below_count))
    if not allowed.any():
        raise IgsrError(
            f"{len(positions)} photos at {len(values)} places across cannot be split into {count} "
            "blocks; give fewer --blocks."
        )
    middle = round(len(positions) * below_count / count)
    cut = float(cuts[allowed][np.argmin(np.abs(ranks[allowed] - middle))])
    is_below = positions[:, axis] < cut
    lower, upper = bounds.copy(), bounds.copy()
    lower[1, axis] = upper[0, axis] = cut
    return [
        *_split(positions[is_below], lower, below_count),
        *_split(positions[~is_below], upper, count - below_count),
    ]
