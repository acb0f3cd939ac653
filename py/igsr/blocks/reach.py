"""Splats that reach far beyond the cell of their center: no one block can fit them for all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from igsr._internal.rotations import rotations_of
from igsr.blocks.cells import Cell, Ground
from igsr.splats import Splats

#: A splat reaches out if it goes on beyond a border to another cell by more than this part of the
#: cell's side, within so many of its standard deviations.
BEYOND, DEVIATIONS = 0.25, 2.0


def reaching_out(splats: Splats, cells: Sequence[Cell], ground: Ground) -> npt.NDArray[np.bool_]:
    """Which splats reach far into cells beside the one that they are in, bool [N].

    Such are haze, sky, and what photos of one block let grow that those of others would not. As the
    coarse fit has them, they are the background of all blocks.

    Args:
        splats: N splats.
        cells: all cells of a plan.
        ground: the plane of the cells.
    """
    places = ground.places(splats.means.astype(np.float64) + splats.origin)
    turned = np.einsum("gk,nkj->ngj", ground.axes, rotations_of(_unit(splats.quats)))
    along = turned * np.exp(splats.scales.astype(np.float64))[:, None, :]
    half = DEVIATIONS * np.sqrt((along**2).sum(axis=2))
    out: npt.NDArray[np.bool_] = np.zeros(len(splats), np.bool_)
    for cell in cells:
        by = BEYOND * np.array(cell.side)
        beyond = (places - half < np.array(cell.low) - by) | (
            places + half > np.array(cell.high) + by
        )
        out |= cell.holds(places) & beyond.any(axis=1)
    return out


def _unit(quats: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Unit quaternions; zero stays zero."""
    norm = np.linalg.norm(quats.astype(np.float64), axis=1, keepdims=True)
    return np.asarray(quats / np.where(norm > 0.0, norm, 1.0))
