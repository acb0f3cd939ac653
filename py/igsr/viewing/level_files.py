"""Scenes in levels of detail: written, and read for the page, which does not draw by distance."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields
from pathlib import Path

from igsr import _core
from igsr._internal.atomic_write import atomic_folder
from igsr.errors import IgsrError
from igsr.splats import Splats

#: The file that lists cells and levels, in PlayCanvas's layout of streamed SOG.
INDEX = _core.LEVELS_INDEX
#: Most splats that the page is given of such a scene: about 10 MB.
MOST = 300_000
#: Most splats that a cell of the finest level has, about.
PER_CELL = 16_384


@dataclass(frozen=True)
class LevelsWritten:
    """What ``write_levels`` wrote.

    Attributes:
        counts: splats of each level, the finest first.
        cells: number of cells.
        files: number of SOGs, folders of images each.
        notes: messages about what was left out.
    """

    counts: list[int]
    cells: int
    files: int
    notes: list[str]


def write_levels(
    scene: str | os.PathLike[str],
    out: str | os.PathLike[str],
    levels: int,
    per_cell: int = PER_CELL,
) -> LevelsWritten:
    """Write a scene in levels of detail: streamed SOG, as PlayCanvas's engine reads it, too.

    The finest level has all splats, in cells of about equally many. Each other one has a quarter of
    the splats of the next finer one: in each cell neighbours are merged into one of their mean,
    spread, color and opacity. A ``.ply`` is read from the disk twice, and never whole.

    Args:
        scene: a splat file.
        out: folder to write; it must be new or empty. ``lod-meta.json`` lists the cells.
        levels: how many, 1 to 8.
        per_cell: most splats that a cell has at the finest level, about.

    Raises:
        IgsrError: an argument cannot be used, or a file cannot be read or written.
    """
    if not 1 <= levels <= 8:
        raise IgsrError(f"lod must be a number of levels from 1 to 8, not {levels}.")
    if per_cell < 1:
        raise IgsrError(f"per_cell must be at least 1 splat, not {per_cell}.")
    with atomic_folder(out) as folder:
        try:
            done = _core.write_levels(os.fspath(scene), str(folder), levels, per_cell)
        except (OSError, ValueError) as error:
            # The folder's own name is a temporary one.
            message = str(error).replace(str(folder), str(Path(out)))
            raise IgsrError(f"{message}.") from error
    return LevelsWritten(**done)


def level_within(path: str | os.PathLike[str], most: int = MOST) -> Splats:
    """The finest level of a scene that has at most so many splats.

    Args:
        path: a ``lod-meta.json``.
        most: the largest number of splats.

    Raises:
        IgsrError: a file cannot be read, or the coarsest level has more.
    """
    try:
        read = _core.read_level(os.fspath(path), most)
    except (OSError, ValueError) as error:
        raise IgsrError(f"{error}.") from error
    return Splats(**{part.name: read[part.name] for part in fields(Splats)})
