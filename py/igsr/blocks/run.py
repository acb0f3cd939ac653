"""``fit_in_blocks``: from a capture larger than memory to one scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.event import Listener
from igsr._internal.folder_lock import folder_lock
from igsr._internal.json_file import write_json
from igsr._internal.part_usage import Parts
from igsr.blocks.cells import grid_of
from igsr.blocks.manifest import read_manifest
from igsr.blocks.plan import BlockPlan, blocks_for_memory, plan_blocks
from igsr.blocks.report import block_report, score_photos, write_block_page
from igsr.blocks.runner import remove_checkpoints, run_tasks
from igsr.blocks.seams import seam_scores, seam_task, with_seam_fit
from igsr.blocks.tasks import (
    SPLATS_FILE,
    BlockOptions,
    Context,
    FitTask,
    block_name,
    block_tasks,
    coarse_task,
    load_splats,
)
from igsr.capture.exposure import Exposure
from igsr.errors import IgsrError
from igsr.splats import Splats, joined, subset


def fit_in_blocks(
    path: Path, out: Path, options: BlockOptions, progress: Listener | None = None
) -> tuple[Splats, dict[str, Any]]:
    """Fit a capture in blocks.

    Blocks that are finished in ``out``, with the same settings, are not fitted again. A block that
    was interrupted continues from its checkpoint.

    Args:
        path: the capture, as ``igsr.load_capture`` takes it.
        out: folder for ``scene.ply``, ``report.json``, ``report.html``, ``manifest.json`` and the
            workers' files in ``blocks/``.
        options: number of blocks, cluster and settings.
        progress: called about once a second, from another thread, with an ``igsr.Event``: done and
            total count blocks, and values are the finished fraction of each block, by its name. An
            exception that it raises ends the run after the block under way.

    Returns:
        The joined scene, and the content of ``report.json``.

    Raises:
        IgsrError: the capture cannot be used, a block cannot be fitted, a file cannot be written,
            or another run writes into ``out``; the message names the block.
        UserWarning: a block has no photos or no splats, a block is fitted again after its process
            was lost, or machines of the cluster differ.
    """
    _check(options)
    with folder_lock(out):
        return _fit_in_blocks(path, out, options, progress)


def _fit_in_blocks(
    path: Path, out: Path, options: BlockOptions, progress: Listener | None
) -> tuple[Splats, dict[str, Any]]:
    parts = Parts()
    with parts.measured("plan"):
        manifest = read_manifest(path, options.max_size, options.holdout)
        train = manifest.of_split("train")
        if not train:
            raise IgsrError(f"{path} has no photos to fit.")
        points = manifest.points()
        max_splats = options.settings.get("max_splats")
        count = options.blocks or blocks_for_memory(manifest, options.max_size, max_splats)
        grid = grid_of([manifest.shots[index].camera for index in train], count)
        write_json(out / "manifest.json", {"photos": manifest.plain()})
    if options.background is not None and not manifest.has_alpha(train):
        # As in igsr.fit: photos with alpha are fitted over a new color in each step.
        background = {"background": list(options.background)}
        options = replace(options, settings={**options.settings, **background})
    context = Context(out, options, manifest)

    with parts.measured("coarse fit"):
        tasks = [coarse_task(context, points, count)]
        (coarse_row,) = run_tasks("coarse fit", tasks, options.ray, progress)
        coarse = load_splats(tasks[0].folder / SPLATS_FILE)
    exposures = {name: Exposure(**values) for name, values in coarse_row["exposures"].items()}
    context = replace(context, exposures=exposures)
    with parts.measured("assign photos"):
        plan = plan_blocks(manifest, grid, coarse, points, options.backend)
        blocks = block_tasks(context, plan, coarse)
        tasks += blocks
    with parts.measured("fit blocks"):
        rows = run_tasks("fit blocks", blocks, options.ray, progress)
    with parts.measured("join"):
        splats = _joined(plan, coarse, blocks)
    with parts.measured("score seams"):
        seams = seam_scores(context, splats, blocks, rows)
    if seams is not None and seams["visible"]:
        with parts.measured("fit seams"):
            task = seam_task(context, plan, splats)
            if task is not None:
                tasks.append(task)
                run_tasks("fit seams", [task], options.ray, progress)
                refitted = with_seam_fit(splats, task)
                after = seam_scores(context, refitted, blocks, rows)
                if after is not None and after["loss_db"] < seams["loss_db"]:
                    splats, seams = refitted, {**after, "before_seam_fit": seams}
    with parts.measured("score"):
        splats.save(out / "scene.ply")
        scores, page_views = score_photos(context, plan, splats)
    report = block_report(context, plan, coarse_row, rows, splats)
    report |= {"seams": seams, **scores, "parts": parts.plain()}
    write_json(out / "report.json", report)
    write_block_page(out / "report.html", report, manifest, splats, page_views)
    remove_checkpoints(tasks)
    return splats, report


def _check(options: BlockOptions) -> None:
    if options.blocks is not None and options.blocks < 1:
        raise IgsrError(f"blocks must be auto or a number of at least 1, not {options.blocks}.")
    for name in ("poses", "focal"):
        if options.settings.get(name) not in (None, "fixed"):
            raise IgsrError(
                f"Blocks are fitted with fixed cameras; leave {name} out, or find better cameras "
                "first (igsr pose)."
            )


def _joined(plan: BlockPlan, coarse: Splats, tasks: Sequence[FitTask]) -> Splats:
    """The splats of all blocks, with spanning splats and unfitted cells from the coarse fit."""
    folders = {task.name: task.folder for task in tasks}
    positions, spanning = plan.grid.splat_positions(coarse), plan.grid.spanning(coarse)
    parts = []
    for index, cell in enumerate(plan.grid.cells):
        folder, inside = folders.get(block_name(index)), cell.contains(positions)
        if folder is None:
            parts.append(subset(coarse, inside))
        else:
            parts += [load_splats(folder / SPLATS_FILE), subset(coarse, spanning & inside)]
    degree = max(part.sh_degree for part in parts)
    return joined([_with_sh_degree(part, degree) for part in parts])


def _with_sh_degree(splats: Splats, degree: int) -> Splats:
    rows = (degree + 1) ** 2 - splats.sh.shape[1]
    return replace(splats, sh=np.pad(splats.sh, ((0, 0), (0, rows), (0, 0)))) if rows else splats
