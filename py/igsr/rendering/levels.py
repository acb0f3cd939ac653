"""Scenes in levels of detail: write them, and read one level for the scene page."""

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
#: Maximum number of splats in a level for the page, about 10 MB.
MAX_PAGE_SPLATS = 300_000
#: Approximate maximum number of splats in a cell of the finest level.
SPLATS_PER_CELL = 16_384


@dataclass(frozen=True)
class LevelsWritten:
    """Result of ``write_levels``.

    Attributes:
        counts: number of splats in each level, the finest first.
        cells: number of cells.
        files: number of SOG folders.
        notes: messages about data that was left out.
    """

    counts: list[int]
    cells: int
    files: int
    notes: list[str]


def write_levels(
    scene: str | os.PathLike[str],
    out: str | os.PathLike[str],
    levels: int,
    per_cell: int = SPLATS_PER_CELL,
) -> LevelsWritten:
    """Write a scene in levels of detail as streamed SOG, which PlayCanvas's engine reads.

    The finest level has all splats, in cells of about equal count. Each coarser level has a quarter
    of the splats of the previous one: within a cell, neighbors are merged into one splat of their
    mean, spread, color and opacity. A ``.ply`` is streamed from the disk twice.

    Args:
        scene: a splat file.
        out: folder to write, new or empty. ``lod-meta.json`` lists the cells.
        levels: number of levels, 1 to 8.
        per_cell: approximate maximum number of splats in a cell of the finest level.

    Raises:
        IgsrError: an argument cannot be used, or a file cannot be read or written.
    """
    if not 1 <= levels <= 8:
        raise IgsrError(f"lod must be a number of levels from 1 to 8, not {levels}.")
    if per_cell < 1:
        raise IgsrError(f"per_cell must be at least 1 splat, not {per_cell}.")
    with atomic_folder(out) as folder:
        try:
            written = _core.write_levels(os.fspath(scene), str(folder), levels, per_cell)
        except (OSError, ValueError) as error:
            # The message names the temporary folder.
            message = str(error).replace(str(folder), str(Path(out)))
            raise IgsrError(f"{message}.") from error
    return LevelsWritten(**written)


def level_within(path: str | os.PathLike[str], max_splats: int = MAX_PAGE_SPLATS) -> Splats:
    """Read the finest level of a ``lod-meta.json`` with at most ``max_splats`` splats."""
    try:
        read = _core.read_level(os.fspath(path), max_splats)
    except (OSError, ValueError) as error:
        raise IgsrError(f"{error}.") from error
    return Splats(**{part.name: read[part.name] for part in fields(Splats)})
