"""What workers do: the coarse fit, and the fit of a block. Each loads the photos that it needs."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.choices import Backend
from igsr._internal.event import Event
from igsr._internal.json_file import write_json
from igsr._internal.part_usage import Meter
from igsr._internal.worker_processes import in_a_process
from igsr.blocks.manifest import shot_mark
from igsr.blocks.photo_parts import ALL, ASKED_SIZE, cut_out
from igsr.blocks.tasks import (
    CHECKPOINT,
    PROGRESS,
    SPLATS,
    BlockPart,
    FitTask,
    load_splats,
    save_splats,
)
from igsr.capture import Capture, View, photos_among
from igsr.capture.described import DescribedCapture
from igsr.capture.downscaling import reduced_size, resized_camera
from igsr.capture.types import Points
from igsr.errors import IgsrError
from igsr.evaluation.scores import BLACK, default_background, score_views
from igsr.fitting.checkpoint import load_checkpoint
from igsr.fitting.fit_capture import fit_capture
from igsr.fitting.fitter import without_exposures
from igsr.fitting.photo_statistics import PhotoStatistics, photo_statistics
from igsr.fitting.presets import settings_for
from igsr.fitting.result import FitResult
from igsr.fitting.settings import FitSettings
from igsr.rendering.renders import project, render
from igsr.splats import Splats, joined, subset

Bool = npt.NDArray[np.bool_]
Float64 = npt.NDArray[np.float64]

#: Photos that are held whole at a time while parts of them are cut out.
AT_A_TIME = 8
#: Seconds between two reports of progress.
WRITE_EVERY_S = 1.0


def in_own_process(capture: str, task: FitTask) -> dict[str, Any]:
    """Do a task in a process of its own, which gives its memory back when it ends."""
    return in_a_process(do_task, capture, task)


def do_task(capture: str, task: FitTask) -> dict[str, Any]:
    """Do a task, and leave its splats in its folder.

    Args:
        capture: the capture, for messages.
        task: what to do.

    Returns:
        A row for the report: what the fit took, where, and what it left.

    Raises:
        IgsrError: the photos cannot be loaded or fitted, or a file not be written; the message
            names the task.
    """
    meter = Meter()
    try:
        views = _loaded(task)
        row = _coarse(task, views) if task.block is None else _block(task, task.block, views)
    except IgsrError as error:
        raise IgsrError(f"{task.name} on {socket.gethostname()}: {error}") from error
    used = meter.lap()
    return {
        "name": task.name,
        **row,
        "photos": len(views),
        "pixels": sum(view.camera.width * view.camera.height for view in views),
        **used.plain(),
        "host": socket.gethostname(),
        "process": os.getpid(),
        **_core.backend_info(task.backend),
    }


def _loaded(task: FitTask) -> list[View]:
    """The task's photos, without their exposures; those, and no others, are decoded here."""
    for shot, mark in zip(task.shots, task.marks, strict=True):
        if shot_mark(shot) != mark:
            raise IgsrError(f"{shot.path} was changed since the run began; start it again.")
    views = []
    for first in range(0, len(task.shots), AT_A_TIME):
        shots = task.shots[first : first + AT_A_TIME]
        described = DescribedCapture(task.capture, shots, lambda: None)
        views += [
            cut_out(view, task.boxes.get(view.name, ALL))
            for view in described.loaded(task.max_size).views
        ]
    return without_exposures(views, [task.exposures.get(view.name) for view in views])


def _coarse(task: FitTask, views: list[View]) -> dict[str, Any]:
    capture = Capture(task.capture, views, task.points)
    splats, fitted, last = _fit(task, capture, {}, depths_of_points(views, task.points))
    exposures = {
        view.name: view.exposure.plain() for view in fitted.views if view.exposure is not None
    }
    save_splats(task.folder / SPLATS, splats)
    return {"splats": len(splats), "exposures": exposures, **last}


def _block(task: FitTask, block: BlockPart, views: list[View]) -> dict[str, Any]:
    scene = load_splats(block.scene)
    moving = block.moving(scene)
    # What none of the photos shows takes memory and does nothing.
    background = ~moving & shown_by(scene, views, task.backend)
    still = subset(scene, background) if background.any() else None
    settings = {
        "start": subset(scene, moving),
        "frozen": still,
        "whole_schedule": block.band == 0.0,
    }
    depths = depths_of_scene(views, scene, task.backend)
    splats, _, last = _fit(task, Capture(task.capture, views), settings, depths)
    whole = splats if still is None else joined([splats, still])
    color = task.settings.get("background") or default_background(Capture(task.capture, views))
    across = [view for view in views if view.name in block.across]
    scored = (
        score_views(whole, across, color, cast(Backend, task.backend), ("psnr",)) if across else ()
    )
    psnr = {one.name: one.scores["psnr"] for one in scored}
    kept = subset(splats, block.kept(splats))
    save_splats(task.folder / SPLATS, kept)
    return {
        "splats": len(kept),
        "fitted_splats": len(splats),
        "frozen_splats": 0 if still is None else len(still),
        "start_splats": int(moving.sum()),
        "across": psnr,
        **last,
    }


def _fit(
    task: FitTask, capture: Capture, more: dict[str, Any], depths: Float64 | None
) -> tuple[Splats, Capture, dict[str, Any]]:
    """Fit, from the task's checkpoint where that can be used.

    Args:
        task: the task.
        capture: its photos.
        more: keywords of ``igsr.fit`` beside the task's.
        depths: of what photos show, by which presets tell how many see the same place. (A fit of
            one thing knows it by the place that all photos look at; here there is none.)
    """
    checkpoint = task.folder / CHECKPOINT
    has_begun = False
    attempt = 1 + attempts(task.folder)
    write_progress = _progress_writer(task.folder / PROGRESS, attempt)

    def report(event: Event) -> None:
        nonlocal has_begun
        has_begun = True
        write_progress(event)

    def run(resume: bool) -> FitResult:
        keywords = {**chosen, **task.settings, **more, "max_splats": most}
        keywords["backdrop"] = False  # blocks are joined, and each would have its own
        return fit_capture(
            capture,
            report=report,
            backend=task.backend,
            checkpoint=checkpoint,
            resume=resume,
            **keywords,
        )

    support = photo_statistics(photos_among(capture.train_views), depths)
    usual = _usual_settings(task, support)
    start = more.get("start")
    chosen: dict[str, Any] = {"dropout": usual.dropout, "density": usual.density}
    if start is None:
        chosen["sh_degree"] = usual.sh_degree
    # The task's part of the most splats there may be, but no fewer than there are at first.
    most = max(1 if start is None else len(start), round(task.splats_part * usual.max_splats))
    resumed_from = _step_of(checkpoint)
    try:
        result = run(resume=resumed_from is not None)
    except IgsrError:
        if resumed_from is None or has_begun:
            raise
        resumed_from = None  # the checkpoint was of another fit, or another instruction set
        result = run(resume=False)
    about = {
        "max_splats": most,
        "splats_part": task.splats_part,
        "steps": result.settings.steps,
        "dropout": task.settings.get("dropout", chosen["dropout"]),
        "density": task.settings.get("density", chosen["density"]),
        "loss": result.loss if np.isfinite(result.loss) else None,
        "start": result.started[0],
        "removed": dict(result.removed),
        "masked": {name: round(part, 5) for name, part in result.masked.items()},
        "resumed_from": resumed_from,
        "attempts": attempt,
    }
    return result.splats, result.capture, about


def _usual_settings(task: FitTask, support: PhotoStatistics) -> FitSettings:
    """The settings of the task, and of its preset for photos that tell this."""
    given = {k: v for k, v in task.settings.items() if k not in ("quality", "start")}
    return settings_for(support, task.settings.get("quality", "normal"), **given)


def depths_of_scene(views: Sequence[View], scene: Splats, backend: str) -> Float64:
    """How far what photos show is, by a scene: the median over each picture, world units, [V]."""
    plain = replace(scene, sh=np.ascontiguousarray(scene.sh[:, :1]))
    depths = []
    for view in views:
        camera = view.camera
        small = resized_camera(camera, *reduced_size(camera.width, camera.height, ASKED_SIZE))
        drawn = render(plain, small, BLACK, cast(Backend, backend))
        known = drawn.expected_depth[drawn.alpha > 0.5]
        depths.append(float(np.median(known)) if len(known) else 0.0)
    return np.array(depths)


def depths_of_points(views: Sequence[View], points: Points | None) -> Float64 | None:
    """How far what photos show is, by the points that they see, [V]; None without tracks."""
    if points is None or points.tracks is None:
        return None
    tracks = points.tracks
    number = {name: index for index, name in enumerate(tracks.names)}
    order = np.argsort(tracks.view, kind="stable")
    ends = np.searchsorted(tracks.view[order], np.arange(len(tracks.names) + 1))
    depths = np.zeros(len(views))
    for index, view in enumerate(views):
        known = number.get(view.name)
        if known is None or ends[known] == ends[known + 1]:
            continue
        seen = points.xyz[tracks.point[order[ends[known] : ends[known + 1]]]]
        viewmat = view.camera.viewmat
        depths[index] = np.median(seen @ viewmat[2, :3] + viewmat[2, 3])
    return depths


def _step_of(checkpoint: Path) -> int | None:
    """The step that a checkpoint was saved at; None where there is none that can be read."""
    if not checkpoint.is_file():
        return None
    try:
        state, _ = load_checkpoint(checkpoint)
        return int(state["step"][0])
    except (IgsrError, KeyError, IndexError, ValueError):
        return None


def attempts(folder: Path) -> int:
    """How often a task has been begun and not ended, by what that left in its folder."""
    try:
        return int(json.loads((folder / PROGRESS).read_text(encoding="utf-8"))["attempt"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0


def _progress_writer(path: Path, attempt: int) -> Callable[[Event], None]:
    """A listener that writes a fit's progress, for the view of all blocks; errors are ignored."""
    about = {"attempt": attempt, "host": socket.gethostname(), "process": os.getpid()}
    written_at = time.monotonic()

    def write(progress: dict[str, Any]) -> None:
        with contextlib.suppress(OSError, IgsrError):
            write_json(path, {**progress, **about})

    def report(event: Event) -> None:
        nonlocal written_at
        if time.monotonic() - written_at < WRITE_EVERY_S:
            return
        written_at = time.monotonic()
        write(
            {
                "step": int(event.done),
                "steps": int(event.total),
                "splats": int(event.values["splats"]),
                "work": event.part,
            }
        )

    write({"step": 0, "steps": 0, "splats": 0, "work": 0.0})
    return report


def shown_by(splats: Splats, views: list[View], backend: str) -> Bool:
    """Which splats some photo has in its picture, hidden or not."""
    shown = np.zeros(len(splats), np.bool_)
    plain = replace(splats, sh=np.ascontiguousarray(splats.sh[:, :1]))
    for view in views:
        shown |= (project(plain, view.camera, backend)["radii"] > 0).any(axis=1)
    return shown
