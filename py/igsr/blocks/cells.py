"""Cells on the ground plane, with equally many cameras each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.capture.types import Camera
from igsr.errors import IgsrError

Float64 = npt.NDArray[np.float64]

#: Cells are widened by this part of their sides, half of it at either border (VastGaussian).
WIDENED = 0.2
#: Cameras tell the ground plane by their places where these spread up by less than this part of
#: their lesser spread along it.
FLAT = 0.5


@dataclass(frozen=True)
class Ground:
    """The ground plane.

    Attributes:
        axes: float64 [2, 3], two orthogonal unit vectors along it, world frame.
    """

    axes: Float64

    def places(self, points: Float64) -> Float64:
        """Points [N, 3] in the world frame as places on the plane, float64 [N, 2]."""
        return np.asarray(points, np.float64) @ self.axes.T


@dataclass(frozen=True)
class Cell:
    """A rectangle on the ground plane; it includes its low borders and not its high ones.

    Attributes:
        low, high: its corners in world units; infinite where no other cell lies beyond.
        side: lengths of the sides, of the part in which cameras stand.
    """

    low: tuple[float, float]
    high: tuple[float, float]
    side: tuple[float, float]

    def holds(self, places: Float64) -> npt.NDArray[np.bool_]:
        """Which of the places [N, 2] lie in it; every place lies in one cell of a plan."""
        inside = (places >= np.array(self.low)) & (places < np.array(self.high))
        return np.asarray(inside.all(axis=1))

    def widened(self, part: float = WIDENED) -> Cell:
        """The cell with sides longer by a part, half of it at either border."""
        by = 0.5 * part * np.array(self.side)
        low, high = np.array(self.low) - by, np.array(self.high) + by
        return Cell((low[0], low[1]), (high[0], high[1]), self.side)

    def near_border(self, places: Float64, part: float) -> npt.NDArray[np.bool_]:
        """Which places [N, 2] lie within a part of the sides of a border to another cell."""
        inner, outer = self.widened(-2.0 * part), self.widened(2.0 * part)
        return outer.holds(places) & ~inner.holds(places)

    def plain(self) -> dict[str, Any]:
        """As JSON has it: None for infinite borders."""

        def finite(corner: tuple[float, float]) -> list[float | None]:
            return [value if math.isfinite(value) else None for value in corner]

        return {"low": finite(self.low), "high": finite(self.high), "side": list(self.side)}


#: A cell that is the whole plane.
EVERYWHERE = Cell((-math.inf, -math.inf), (math.inf, math.inf), (0.0, 0.0))


def near_borders(cells: Sequence[Cell], places: Float64, part: float) -> npt.NDArray[np.bool_]:
    """Which places [N, 2] lie within a part of a cell's sides of its border to another cell."""
    near: npt.NDArray[np.bool_] = np.zeros(len(places), np.bool_)
    for cell in cells:
        near |= cell.near_border(places, part)
    return near


def ground_of(cameras: Sequence[Camera]) -> Ground:
    """The plane that cameras stand on.

    It is the plane that their places spread along. Where they stand in a line or all around, it is
    the one that is level for them.

    Args:
        cameras: at least one.
    """
    centers = np.stack([camera.center for camera in cameras])
    spread, axes = np.linalg.eigh(np.cov((centers - centers.mean(axis=0)).T, bias=True))
    axes = axes.T[::-1]  # the largest first
    largest, lesser, least = np.sqrt(np.maximum(spread[::-1], 0.0))
    if least < FLAT * lesser:
        return Ground(axes[:2])
    up = -np.mean([camera.viewmat[1, :3] for camera in cameras], axis=0)
    along = axes[0] if lesser < FLAT * largest else np.cross(up, axes[2])
    for candidate in (along, axes[0], axes[1]):
        first = candidate - up * (candidate @ up) / max(up @ up, 1e-12)
        if np.linalg.norm(first) > 1e-6 and np.linalg.norm(up) > 1e-6:
            first /= np.linalg.norm(first)
            return Ground(np.stack([first, np.cross(up / np.linalg.norm(up), first)]))
    return Ground(axes[:2])


def split_into_cells(places: Float64, count: int) -> list[Cell]:
    """Split the plane into cells with equally many cameras each, within one.

    The side along which cameras spread more is split first, in the ratio of the cells on either
    side of it.

    Args:
        places: float64 [N, 2], the cameras'.
        count: of cells.

    Raises:
        IgsrError: there are fewer cameras than cells, or too many stand at one place.
    """
    if not 1 <= count <= len(places):
        raise IgsrError(
            f"{count} blocks need at least as many photos to fit, not {len(places)}; give fewer "
            "--blocks."
        )
    bounds = np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
    return _split(np.asarray(places, np.float64), bounds, count)


def _split(places: Float64, bounds: Float64, count: int) -> list[Cell]:
    low, high = places.min(axis=0), places.max(axis=0)
    if count == 1:
        (x0, y0), (x1, y1) = bounds
        # Where no other cell lies beyond, the side ends with the cameras.
        known = np.where(np.isfinite(bounds), bounds, np.stack([low, high]))
        side = known[1] - known[0]
        return [Cell((x0, y0), (x1, y1), (float(side[0]), float(side[1])))]
    axis = int(np.argmax(high - low))
    first = count // 2
    order = np.argsort(places[:, axis], kind="stable")
    middle = round(len(places) * first / count)
    below, above = places[order[middle - 1], axis], places[order[middle], axis]
    if not below < above:
        # Cameras at one place (views of a panorama) stay together.
        values = np.unique(places[:, axis])
        cuts = 0.5 * (values[:-1] + values[1:])
        ranks = np.searchsorted(np.sort(places[:, axis]), cuts)
        allowed = (ranks >= first) & (ranks <= len(places) - (count - first))
        if not allowed.any():
            raise IgsrError(
                f"{len(places)} photos at {len(values)} places across cannot be split into {count} "
                "blocks; give fewer --blocks."
            )
        cuts, ranks = cuts[allowed], ranks[allowed]
        cut = float(cuts[np.argmin(np.abs(ranks - middle))])
    else:
        cut = float(0.5 * (below + above))
    is_below = places[:, axis] < cut
    lower, upper = bounds.copy(), bounds.copy()
    lower[1, axis] = upper[0, axis] = cut
    return [
        *_split(places[is_below], lower, first),
        *_split(places[~is_below], upper, count - first),
    ]
