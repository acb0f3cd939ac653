"""What a worker is told of the fit that it is to do, and how its result is kept."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr._internal.atomic_write import atomic_write
from igsr._internal.untrusted_npz import DAMAGE, stored_arrays
from igsr.blocks.cells import Cell, Ground, near_borders
from igsr.blocks.photo_parts import Box
from igsr.blocks.reach import reaching_out
from igsr.capture.exposure import Exposure
from igsr.capture.photos import Shot
from igsr.capture.types import Points
from igsr.errors import IgsrError
from igsr.splats import Splats

#: Files in the folder of a task.
SPLATS, CHECKPOINT, PROGRESS = "splats.npz", "checkpoint.npz", "progress.json"


@dataclass(frozen=True, eq=False)
class BlockPart:
    """Which part of a scene a task fits.

    Attributes:
        scene: the file of the splats that it goes on from: those within ``fitted`` are fitted, the
            others stay as they are.
        ground: the plane of the cells.
        cell: whose splats, once fitted, are the block's.
        fitted: the cell whose splats are fitted, which is wider; but not those that reach out into
            others.
        cells: all cells of the plan.
        across: names of photos that show a seam: the block scores those of them that it has.
        band: above 0, splats are fitted that lie as near to a border between cells, as a part of
            the cells' sides, and no others.
    """

    scene: Path
    ground: Ground
    cell: Cell
    fitted: Cell
    cells: tuple[Cell, ...]
    across: frozenset[str] = frozenset()
    band: float = 0.0

    def moving(self, scene: Splats) -> npt.NDArray[np.bool_]:
        """Which splats of the scene are fitted, bool [N]."""
        places = self.ground.places(scene.means.astype(np.float64) + scene.origin)
        if self.band > 0.0:
            return near_borders(self.cells, places, self.band)
        return self.fitted.holds(places) & ~reaching_out(scene, self.cells, self.ground)

    def kept(self, fitted: Splats) -> npt.NDArray[np.bool_]:
        """Which of the splats that were fitted are the block's, bool [N]."""
        if self.band > 0.0:
            return np.ones(len(fitted), np.bool_)
        places = self.ground.places(fitted.means.astype(np.float64) + fitted.origin)
        return self.cell.holds(places) & ~reaching_out(fitted, self.cells, self.ground)

    def plain(self) -> dict[str, Any]:
        """As JSON has it, without the scene."""
        return {
            "ground": self.ground.axes.tolist(),
            "cell": self.cell.plain(),
            "fitted": self.fitted.plain(),
            "across": sorted(self.across),
            "cells": [cell.plain() for cell in self.cells],
            "band": self.band,
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class FitTask:
    """One fit of a run in blocks.

    Attributes:
        name: of its folder, such as "coarse" or "block-003".
        capture: folder of the capture, for messages.
        folder: of its files.
        shots: the photos that it is fitted to.
        marks: of their files, as the manifest has them.
        max_size: longest side in pixels of the photos as loaded, or None.
        settings: keywords of ``igsr.fit``: preset, quality and what was given by hand.
        backend: "cpu" or "gpu".
        exposures: of photos, by name, that are taken out of them before the fit.
        boxes: of photos, by name, the part that is fitted; all of those that are not named.
        splats_part: part of the most splats there may be, where memory ran out before.
        points: the capture's, for the coarse fit; None for others, and where there are none.
        block: the part of the scene that is fitted; None for all of it, the coarse fit.
    """

    name: str
    capture: Path
    folder: Path
    shots: list[Shot]
    marks: list[str]
    max_size: int | None
    settings: dict[str, Any]
    backend: str
    exposures: Mapping[str, Exposure] = field(default_factory=dict)
    boxes: Mapping[str, Box] = field(default_factory=dict)
    splats_part: float = 1.0
    points: Points | None = None
    block: BlockPart | None = None


def key_of(task: FitTask, **more: Any) -> dict[str, Any]:
    """All that a task's result depends on, as JSON has it.

    Args:
        task: the task.
        more: what else it depends on, such as the hash of the scene that it goes on from.
    """
    digest = hashlib.sha256()
    for shot, mark in zip(task.shots, task.marks, strict=True):
        camera = shot.camera
        for part in (camera.viewmat, camera.K):
            digest.update(np.ascontiguousarray(part).data)
        exposure = task.exposures.get(shot.name)
        about = [shot.name, shot.split, camera.width, camera.height, mark, repr(shot.lens)]
        about += [str(shot.side), None if exposure is None else exposure.plain()]
        about += [task.boxes[shot.name].plain()] if shot.name in task.boxes else []
        digest.update(json.dumps(about).encode())
    return {
        "photos": digest.hexdigest(),
        "max_size": task.max_size,
        "settings": task.settings,
        "backend": task.backend,
        "block": None if task.block is None else task.block.plain(),
        **more,
    }


def save_splats(path: Path, splats: Splats) -> None:
    """Write splats as they are, bit for bit, whole or not at all.

    Raises:
        IgsrError: the file cannot be written.
    """
    names = ("means", "quats", "scales", "opacities", "sh", "origin")
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **{name: getattr(splats, name) for name in names})


def load_splats(path: Path) -> Splats:
    """What ``save_splats`` wrote.

    Raises:
        IgsrError: the file is missing or damaged.
    """
    try:
        arrays: dict[str, Any] = stored_arrays(path)
        return Splats(**arrays)
    except (*DAMAGE, IgsrError) as error:
        raise IgsrError(
            f"{path} cannot be read ({error}); delete its folder to fit it again."
        ) from error
