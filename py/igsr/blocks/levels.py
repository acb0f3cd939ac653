"""A scene in levels of detail, by cells: what a viewer loads from coarse to fine."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from igsr import _core
from igsr._internal.atomic_write import atomic_folder
from igsr._internal.json_file import write_json
from igsr.blocks.cells import Ground, split_into_cells
from igsr.blocks.merging import merged
from igsr.blocks.worker import subset
from igsr.errors import IgsrError
from igsr.splats import Splats

#: Splats of a level are this part of the next finer one's.
PART = 0.25
#: Splats that a cell of the finest level has, about.
PER_CELL = 100_000
#: The file that lists levels and cells.
INDEX = "lod.json"


def write_levels(
    splats: Splats, out: str | os.PathLike[str], levels: int, cells: int | None = None
) -> dict[str, Any]:
    """Write a scene in levels of detail: a file for each cell of each level.

    A level has a quarter of the splats of the next finer one, and as many times fewer cells, down
    to one. The finest has all splats as they are, each in one cell.

    Args:
        splats: the scene.
        out: folder to write; it must be new or empty. ``lod.json`` lists, for each level from
            coarse to fine, the cells: file, number of splats, and the box around their centres in
            the world frame.
        levels: how many, 1 to 8.
        cells: of the finest level; None: as many as have 100 000 splats each.

    Returns:
        What ``lod.json`` holds.

    Raises:
        IgsrError: an argument cannot be used, or a file cannot be written.
    """
    if not 1 <= levels <= 8:
        raise IgsrError(f"lod must be a number of levels from 1 to 8, not {levels}.")
    if len(splats) == 0:
        raise IgsrError("The scene has no splats to make levels of.")
    finest = max(1, -(-len(splats) // PER_CELL)) if cells is None else cells
    if not 1 <= finest <= len(splats):
        raise IgsrError(f"cells must be from 1 to {len(splats)}, the splats there are.")
    ground = _ground(splats)
    index: dict[str, Any] = {
        "format": 1,
        "igsr": _core.__version__,
        "splats": len(splats),
        "levels": [],
    }
    with atomic_folder(out) as folder:
        for level in range(levels):
            finer = levels - 1 - level
            count = max(1, round(len(splats) * PART**finer))
            part = splats if finer == 0 else merged(splats, count)
            wanted = max(1, min(len(part), round(finest * PART**finer)))
            rows = _written(part, ground, folder, level, wanted)
            index["levels"].append({"splats": len(part), "cells": rows})
        write_json(folder / INDEX, index)
    return index


def _ground(splats: Splats) -> Ground:
    """The plane that splats spread along most."""
    means = splats.means[splats.finite].astype(np.float64)
    if len(means) == 0:
        raise IgsrError("The scene has no finite splats to make levels of.")
    _, axes = np.linalg.eigh(np.cov(means.T, bias=True))
    return Ground(axes.T[::-1][:2])


def _written(
    splats: Splats, ground: Ground, folder: Path, level: int, count: int
) -> list[dict[str, Any]]:
    places = np.nan_to_num(ground.places(splats.means.astype(np.float64) + splats.origin))
    try:
        cells = split_into_cells(places, count)
    except IgsrError:  # too many splats at one place
        cells = split_into_cells(places, 1)
    rows = []
    for number, cell in enumerate(cells):
        part = subset(splats, cell.holds(places))
        bounds = part.bounds()
        if bounds is None:
            continue
        name = f"level-{level}/cell-{number:04d}.ply"
        part.save(folder / name)
        low, high = (corner.tolist() for corner in bounds)
        rows.append({"file": name, "splats": len(part), "low": low, "high": high})
    return rows
