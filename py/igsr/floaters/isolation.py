"""Which splats stand alone: few others are near, by their own size."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from igsr.splats import Splats

#: A splat stands alone if fewer others than this are within so many standard deviations of its
#: longest axis. Far away splats are large, so those of a background do not.
NEIGHBOURS, REACH = 6, 5.0
#: Cells per axis that can be told apart: three such numbers make one of 63 bits.
_CELLS = 2**21


def alone(splats: Splats) -> npt.NDArray[np.bool_]:
    """Which splats stand alone.

    Centers are counted in a cube of three cells a side around the splat's, a cell being its reach
    or up to twice as long.

    Args:
        splats: the scene; all its parameters must be finite.

    Returns:
        bool [N].
    """
    means = splats.means.astype(np.float64)
    # Beyond float64's exponents a splat has no size to compare with; such are rounded to the last.
    reach = np.clip(np.log2(REACH) + splats.scales.max(axis=1) / np.log(2.0), -1000.0, 1000.0)
    levels = np.ceil(reach).astype(int)
    result = np.zeros(len(means), np.bool_)
    for level in np.unique(levels):
        mine = np.flatnonzero(levels == level)
        with np.errstate(over="ignore"):
            cells = np.floor(np.clip(means * 2.0**-level, -_CELLS / 2 + 2, _CELLS / 2 - 2))
        cells = cells.astype(np.int64) + _CELLS // 2
        occupied, count = np.unique(_key(cells), return_counts=True)
        near = np.zeros(len(mine), np.int64)
        for offset in np.ndindex(3, 3, 3):
            keys = _key(cells[mine] + np.array(offset) - 1)
            at = np.minimum(np.searchsorted(occupied, keys), len(occupied) - 1)
            near += np.where(occupied[at] == keys, count[at], 0)
        result[mine] = near - 1 < NEIGHBOURS
    return result


def _key(cells: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """One number for each cell, [M]."""
    key: npt.NDArray[np.int64] = (cells[:, 0] * _CELLS + cells[:, 1]) * _CELLS + cells[:, 2]
    return key
