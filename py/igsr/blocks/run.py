"""``fit_in_blocks``: a capture past one machine's memory, from its photos' headers to one scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from igsr._internal.choices import Backend
from igsr._internal.json_file import write_json
from igsr._internal.part_usage import Parts
from igsr.blocks.manifest import Manifest, read_manifest
from igsr.blocks.mending import mending_task, near_seams
from igsr.blocks.options import BlockOptions
from igsr.blocks.page import write_block_page
from igsr.blocks.photo_parts import Box
from igsr.blocks.plan import BlockPlan, blocks_for_memory, cells_of, memory_of, plan_blocks
from igsr.blocks.progress import Standing
from igsr.blocks.reach import reaching_out
from igsr.blocks.report import block_report, held_out_scores
from igsr.blocks.runner import Runner
from igsr.blocks.seams import loaded_in_parts, psnr_of_parts, seam_scores
from igsr.blocks.task_making import block_tasks, coarse_task, name_of
from igsr.blocks.tasks import SPLATS, FitTask, key_of, load_splats
from igsr.capture.exposure import Exposure
from igsr.errors import IgsrError
from igsr.evaluation.scores import BLACK, WHITE
from igsr.fitting.fingerprint import hash_of
from igsr.fitting.fitter import splat_arrays
from igsr.splats import Splats, joined, subset


def fit_in_blocks(
    path: Path,
    out: Path,
    options: BlockOptions,
    told: Callable[[list[Standing]], None] | None = None,
) -> tuple[Splats, dict[str, Any]]:
    """Fit a capture in blocks.

    What is done already in ``out``, by the same settings, is not done again: a run that was killed
    goes on where it was.

    Args:
        path: the capture, as ``igsr.load_capture`` takes it.
        out: folder for ``scene.ply``, ``report.json``, ``report.html``, ``manifest.json`` and, in
            ``blocks/``, what workers leave.
        options: what is asked for.
        told: called now and then with where all blocks stand.

    Returns:
        The joined scene, and what ``report.json`` holds.

    Raises:
        IgsrError: the capture cannot be used, a block cannot be fitted, or a file not be written;
            the message names the block.
        UserWarning: a block has no photos or no splats and stays as coarse as it is; machines of
            the cluster differ.
    """
    parts = Parts()
    _check(options)
    with parts.measured("plan"):
        manifest = read_manifest(path, options.max_size, options.holdout)
        train = manifest.of_split("train")
        if not train:
            raise IgsrError(f"{path} has no photos to fit.")
        points = manifest.points()
        given = options.settings.get("max_splats")
        count = options.blocks or blocks_for_memory(manifest, options.max_size, given)
        ground, cells = cells_of(manifest, count)
        write_json(out / "manifest.json", {"photos": manifest.plain()})
    has_alpha = any(manifest.headers[index].channels == 4 for index in train)
    if options.background is not None and not has_alpha:
        # As igsr fit: what is behind photos with alpha is a new color in each step.
        background = {"background": list(options.background)}
        options = replace(options, settings={**options.settings, **background})
    runner = Runner(out, str(path), options.backend, options.ray, told)

    first = coarse_task(manifest, points, out, options, count)
    with parts.measured("coarse fit"):
        coarse_row = runner.rows([first], [key_of(first)])[0]
        coarse = load_splats(first.folder / SPLATS)
    exposures = {
        name: Exposure(tuple(one["gain"]), tuple(one["offset"]))
        for name, one in coarse_row["exposures"].items()
    }

    with parts.measured("assign photos"):
        backend = cast(Backend, options.backend)
        plan = plan_blocks(manifest, ground, cells, coarse, points, backend)
        scene = {"scene": hash_of(splat_arrays(coarse).values())}
    tasks = block_tasks(manifest, plan, coarse, exposures, out, options)
    with parts.measured("fit blocks"):
        keys = [key_of(task, **scene) for task in tasks]
        number = {shot.name: index for index, shot in enumerate(manifest.shots)}
        memory = [
            memory_of(
                manifest,
                [number[shot.name] for shot in task.shots],
                options.max_size,
                boxes=[task.boxes[shot.name] for shot in task.shots],
            )
            for task in tasks
        ]
        rows = runner.rows(tasks, keys, memory)

    with parts.measured("join"):
        splats = _joined(plan, coarse, tasks)
    with parts.measured("score seams"):
        own = [row["across"] for row in rows]
        boxes = [
            {name: task.boxes[name] for name in scores}
            for task, scores in zip(tasks, own, strict=True)
        ]
        seams = _seams(manifest, own, boxes, splats, exposures, options)
    if seams is not None and seams["visible"]:
        with parts.measured("mend seams"):
            mended = _mended(manifest, plan, splats, exposures, out, options, runner)
            after = _seams(manifest, own, boxes, mended, exposures, options)
        if after is not None and after["loss_db"] < seams["loss_db"]:
            splats, seams = mended, {**after, "before_mending": seams}
    with parts.measured("score"):
        splats.save(out / "scene.ply")
        scores = held_out_scores(manifest, plan, splats, exposures, options)
    report = block_report(
        path, options, plan, coarse_row, {row["name"]: row for row in rows}, splats
    )
    report["background_splats"] = len(splats) - sum(row["splats"] for row in rows)
    report |= {"seams": seams, **scores, "parts": parts.plain()}
    write_json(out / "report.json", report)
    write_block_page(out / "report.html", report, manifest, splats, exposures, options)
    runner.forget_checkpoints()
    return splats, report


def _check(options: BlockOptions) -> None:
    if options.blocks is not None and options.blocks < 1:
        raise IgsrError(f"blocks must be auto or a number of at least 1, not {options.blocks}.")
    for name in ("poses", "focal"):
        if options.settings.get(name) not in (None, "fixed"):
            raise IgsrError(
                f"Blocks are fitted with cameras as they are; leave {name} out, or find better "
                "cameras first (igsr pose)."
            )


def _joined(plan: BlockPlan, coarse: Splats, tasks: Sequence[FitTask]) -> Splats:
    """The splats of all blocks, in the order of the cells.

    Coarse ones where none was fitted, and those that reach out into other cells.
    """
    fitted = {task.name: task for task in tasks}
    places = plan.ground.places(coarse.means.astype(np.float64) + coarse.origin)
    shared = reaching_out(coarse, plan.cells, plan.ground)
    kept = []
    for index, cell in enumerate(plan.cells):
        task = fitted.get(name_of(index))
        if task is None:
            kept.append(subset(coarse, cell.holds(places)))
        else:
            kept.append(load_splats(task.folder / SPLATS))
            kept.append(subset(coarse, shared & cell.holds(places)))
    degree = max(part.sh_degree for part in kept)
    return joined([_with_degree(part, degree) for part in kept])


def _with_degree(splats: Splats, degree: int) -> Splats:
    """The same splats, with room for spherical harmonics of a degree."""
    rows = (degree + 1) ** 2 - splats.sh.shape[1]
    return replace(splats, sh=np.pad(splats.sh, ((0, 0), (0, rows), (0, 0)))) if rows else splats


def _mended(
    manifest: Manifest,
    plan: BlockPlan,
    splats: Splats,
    exposures: Mapping[str, Exposure],
    out: Path,
    options: BlockOptions,
    runner: Runner,
) -> Splats:
    """The scene with splats near seams fitted together."""
    made = mending_task(manifest, plan, splats, exposures, out, options)
    if made is None:
        return splats
    task, key = made
    runner.rows([task], [key])
    near = near_seams(plan, splats)
    return joined([subset(splats, ~near), load_splats(task.folder / SPLATS)])


def _seams(
    manifest: Manifest,
    own: Sequence[Mapping[str, float]],
    boxes: Sequence[Mapping[str, Box]],
    splats: Splats,
    exposures: Mapping[str, Exposure],
    options: BlockOptions,
) -> dict[str, Any] | None:
    """What parts of photos across seams lose by joining; see ``seam_scores``."""
    names = {name for scores in own for name in scores}
    photos = [i for i, shot in enumerate(manifest.shots) if shot.name in names]
    parts = loaded_in_parts(manifest, photos, options.max_size, exposures)
    has_alpha = any(manifest.headers[index].channels == 4 for index in photos)
    color = options.background or (WHITE if has_alpha else BLACK)
    by_joined = psnr_of_parts(splats, parts, boxes, color, cast(Backend, options.backend))
    return seam_scores(own, by_joined)
