"""The tasks of a run in blocks: the coarse fit, and a fit for each block."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from igsr.blocks.cells import WIDENED
from igsr.blocks.manifest import Manifest
from igsr.blocks.options import BlockOptions
from igsr.blocks.plan import BlockPlan, memory_of
from igsr.blocks.reach import reaching_out
from igsr.blocks.tasks import SPLATS, BlockPart, FitTask
from igsr.capture.downscaling import reduced_size, resized_tracks
from igsr.capture.exposure import Exposure
from igsr.capture.memory_check import SPLAT_BYTES
from igsr.capture.types import Points
from igsr.errors import IgsrError
from igsr.splats import Splats

#: The coarse fit has photos of this part of their size, and no smaller or larger ones than these
#: (longest side, pixels).
COARSE, COARSE_SIZES = 1 / 3, (96, 400)
#: Pixels of all photos of the coarse fit together, at most.
COARSE_PIXELS = 600_000_000
#: So many splats it may have in any case: blocks that begin with few of them fall behind.
COARSE_SPLATS = 100_000


def name_of(block: int) -> str:
    """The name of a block by its number, from 0."""
    return f"block-{block:03d}"


def coarse_task(
    manifest: Manifest, points: Points | None, out: Path, options: BlockOptions, blocks: int
) -> FitTask:
    """The fit of everything, at low resolution, so that it takes no more memory than a block."""
    train = manifest.of_split("train")
    size = _coarse_size(manifest, train, options.max_size, blocks)
    settings = {**options.settings, "transients": "off"}
    if settings.get("max_splats") is not None:
        most = _coarse_splats(manifest, train, size, options.max_size, blocks, settings)
        settings["max_splats"] = most
    shots = [manifest.shots[index] for index in train]
    before = {shot.name: shot.camera for shot in shots}
    after = {
        name: _Size(*reduced_size(camera.width, camera.height, size))
        for name, camera in before.items()
    }
    return FitTask(
        name="coarse",
        capture=manifest.path,
        folder=out / "blocks" / "coarse",
        shots=shots,
        marks=[manifest.marks[index] for index in train],
        max_size=size,
        # Transient things are looked for by the blocks: the search holds all photos of a fit.
        settings=settings,
        backend=options.backend,
        points=resized_tracks(points, before, cast(Any, after)),
    )


@dataclass(frozen=True)
class _Size:
    width: int
    height: int


def _coarse_size(
    manifest: Manifest, photos: Sequence[int], max_size: int | None, blocks: int
) -> int:
    """Longest side in pixels of the coarse fit's photos, which have no more than a block's."""
    longest = max(max(manifest.headers[index].size) for index in photos)
    longest = min(longest, max_size or longest)
    least, most = COARSE_SIZES
    of_a_block = 0.75 * longest**2 * len(photos) * (1.0 + WIDENED) / blocks
    fitting = int((min(COARSE_PIXELS, of_a_block) / (0.75 * len(photos))) ** 0.5)
    return min(longest, max(least, min(most, fitting, round(COARSE * longest))))


def _coarse_splats(
    manifest: Manifest,
    photos: Sequence[int],
    size: int,
    max_size: int | None,
    blocks: int,
    settings: Mapping[str, Any],
) -> int:
    """Most splats of the coarse fit: those of the scene, or as many as a block's memory holds."""
    of_scene: int = settings["max_splats"]
    of_block = max(1, round((1.0 + WIDENED) * of_scene / blocks))
    some = list(photos)[: max(1, round((1.0 + WIDENED) * len(photos) / blocks))]
    left = memory_of(manifest, some, max_size, of_block)
    left -= memory_of(manifest, list(photos), size, 0)
    return min(of_scene, max(of_block, COARSE_SPLATS, left // SPLAT_BYTES))


def block_tasks(
    manifest: Manifest,
    plan: BlockPlan,
    coarse: Splats,
    exposures: Mapping[str, Exposure],
    out: Path,
    options: BlockOptions,
) -> list[FitTask]:
    """The tasks of the blocks that have photos and splats.

    Raises:
        IgsrError: there is none.
        UserWarning: a block has no photos or no splats.
    """
    given = dict(options.settings)
    given.pop("start", None)
    given["exposure"] = "off"
    if given.get("max_splats") is not None:
        # Those of the widened cell, of which the block keeps the part in the cell proper.
        most = given["max_splats"] / len(plan.cells)
        given["max_splats"] = max(1, round(most * (1.0 + WIDENED)))
    places = plan.ground.places(coarse.means.astype(np.float64) + coarse.origin)
    fits = ~reaching_out(coarse, plan.cells, plan.ground)
    tasks = []
    for index, cell in enumerate(plan.cells):
        photos = np.flatnonzero(plan.photos[:, index])
        name = name_of(index)
        inside = int((fits & cell.widened().holds(places)).sum())
        if not len(photos) or not inside:
            what = "photos" if not len(photos) else "splats of the coarse fit"
            warnings.warn(f"{name} has no {what}; it stays as coarse as it is.", stacklevel=3)
            continue
        shots = [manifest.shots[photo] for photo in photos]
        tasks.append(
            FitTask(
                name=name,
                capture=manifest.path,
                folder=out / "blocks" / name,
                shots=shots,
                marks=[manifest.marks[photo] for photo in photos],
                max_size=options.max_size,
                settings=given,
                backend=options.backend,
                exposures={
                    shot.name: exposures[shot.name] for shot in shots if shot.name in exposures
                },
                boxes={manifest.shots[photo].name: plan.box(int(photo), index) for photo in photos},
                block=BlockPart(
                    scene=out / "blocks" / "coarse" / SPLATS,
                    ground=plan.ground,
                    cell=cell,
                    fitted=cell.widened(),
                    cells=tuple(plan.cells),
                    across=frozenset(manifest.shots[i].name for i in photos if plan.across[i]),
                ),
            )
        )
    if not tasks:
        raise IgsrError(f"No block of {manifest.path} has photos and splats; give fewer --blocks.")
    return tasks
