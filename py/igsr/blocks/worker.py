"""The work of a task: load its photos, fit them, and save the splats in its folder."""

from __future__ import annotations

import contextlib
import math
import os
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.event import Event
from igsr._internal.input_files import read_json
from igsr._internal.json_file import write_json
from igsr._internal.part_usage import Meter
from igsr.blocks.crops import WHOLE, cropped
from igsr.blocks.manifest import loaded_batches, shot_mark
from igsr.blocks.tasks import (
    CHECKPOINT_FILE,
    PROGRESS_FILE,
    SPLATS_FILE,
    FitTask,
    Region,
    load_splats,
    save_splats,
)
from igsr.blocks.visibility import in_any_view, scene_depths, track_depths
from igsr.capture import Capture, View, photos_among
from igsr.errors import IgsrError
from igsr.evaluation.scores import default_background, score_views
from igsr.fitting.checkpoint import load_checkpoint
from igsr.fitting.fit_capture import fit_capture
from igsr.fitting.fitter import without_exposures
from igsr.fitting.photo_statistics import photo_statistics
from igsr.fitting.presets import settings_for
from igsr.fitting.result import FitResult
from igsr.splats import Splats, joined, subset

#: Seconds between two updates of the progress file.
PROGRESS_INTERVAL_S = 1.0


def run_task(task: FitTask) -> dict[str, Any]:
    """Run a task and return its row of the report.

    Raises:
        IgsrError: the photos cannot be loaded or fitted, or a file cannot be written.
    """
    meter = Meter()
    try:
        views = _load_views(task)
        row = _coarse_fit(task, views) if task.region is None else _block_fit(task, views)
    except IgsrError as error:
        raise IgsrError(f"{task.name} on {socket.gethostname()}: {error}") from error
    return {
        "name": task.name,
        **row,
        "photos": len(views),
        "pixels": sum(view.camera.width * view.camera.height for view in views),
        **meter.lap().plain(),
        "host": socket.gethostname(),
        "process": os.getpid(),
        **_core.backend_info(task.backend),
    }


def _load_views(task: FitTask) -> list[View]:
    """The task's crops, with known exposures removed."""
    for shot, mark in zip(task.shots, task.marks, strict=True):
        if shot_mark(shot) != mark:
            raise IgsrError(f"{shot.path} was changed since the run began; start it again.")
    views = [
        cropped(view, task.boxes.get(view.name, WHOLE))
        for batch in loaded_batches(task.capture, task.shots, task.max_size)
        for view in batch
    ]
    return without_exposures(views, [task.exposures.get(view.name) for view in views])


def _coarse_fit(task: FitTask, views: list[View]) -> dict[str, Any]:
    capture = Capture(task.capture, views, task.points)
    result, row = _fit(task, capture, track_depths(views, task.points))
    save_splats(task.folder / SPLATS_FILE, result.splats)
    exposures = {name: exposure.plain() for name, exposure in result.exposures.items()}
    return {"splats": len(result.splats), "exposures": exposures, **row}


def _block_fit(task: FitTask, views: list[View]) -> dict[str, Any]:
    region = cast(Region, task.region)
    scene = load_splats(region.scene)
    trainable = region.trainable(scene)
    # Splats outside all photos would only take memory.
    background = ~trainable & in_any_view(scene, views, task.backend)
    frozen = subset(scene, background) if background.any() else None
    capture = Capture(task.capture, views)
    result, row = _fit(
        task,
        capture,
        scene_depths(views, scene, task.backend),
        start=subset(scene, trainable),
        frozen=frozen,
        whole_schedule=region.block is not None,
    )
    fitted = result.splats
    kept = subset(fitted, region.kept(fitted))
    save_splats(task.folder / SPLATS_FILE, kept)
    scored = score_views(
        fitted if frozen is None else joined([fitted, frozen]),
        [view for view in views if view.name in region.across],
        task.settings.get("background") or default_background(capture),
        task.backend,
        ("psnr",),
    )
    return {
        "splats": len(kept),
        "fitted_splats": len(fitted),
        "frozen_splats": 0 if frozen is None else len(frozen),
        "start_splats": int(trainable.sum()),
        "across": {view.name: view.scores["psnr"] for view in scored},
        **row,
    }


def _fit(
    task: FitTask,
    capture: Capture,
    depths: npt.NDArray[np.float64] | None,
    start: Splats | None = None,
    **keywords: Any,
) -> tuple[FitResult, dict[str, Any]]:
    """Fit a capture, from the task's checkpoint if it can be used; return the report, too."""
    # Large scenes have no point that all photos look at; the depths replace it.
    statistics = photo_statistics(photos_among(capture.train_views), depths)
    given = {name: value for name, value in task.settings.items() if name != "start"}
    quality = given.pop("quality", "normal")
    preset = settings_for(statistics, quality, **given)
    chosen: dict[str, Any] = {"dropout": preset.dropout, "density": preset.density}
    max_splats = round(task.splats_part * preset.max_splats)
    if start is None:
        chosen["sh_degree"] = preset.sh_degree
        start = task.settings.get("start")
    else:
        max_splats = max(max_splats, len(start))
    # The joined scene would have the backdrops of all blocks.
    chosen |= {**given, "max_splats": max(1, max_splats), "backdrop": False, **keywords}
    checkpoint = task.folder / CHECKPOINT_FILE
    attempt = 1 + read_progress(task.folder).get("attempt", 0)
    report = _progress_writer(task.folder / PROGRESS_FILE, attempt)

    def run(resume: bool) -> FitResult:
        return fit_capture(
            capture,
            start=start,
            checkpoint=checkpoint,
            resume=resume,
            report=report,
            backend=task.backend,
            quality=quality,
            **chosen,
        )

    resumed_from = _checkpoint_step(checkpoint)
    try:
        result = run(resume=resumed_from is not None)
    except IgsrError:
        if resumed_from is None:
            raise
        # The checkpoint belongs to other settings or another instruction set.
        resumed_from = None
        result = run(resume=False)
    return result, {
        "max_splats": chosen["max_splats"],
        "splats_part": task.splats_part,
        "steps": result.settings.steps,
        "dropout": result.settings.dropout,
        "density": result.settings.density,
        "loss": result.loss if np.isfinite(result.loss) else None,
        "start": result.started[0],
        "removed": dict(result.removed),
        "masked": {name: round(part, 5) for name, part in result.masked.items()},
        "resumed_from": resumed_from,
        "attempts": attempt,
    }


def _checkpoint_step(checkpoint: Path) -> int | None:
    """The step of a checkpoint; None if it is missing or damaged."""
    try:
        return int(load_checkpoint(checkpoint)[0]["step"][0])
    except (IgsrError, KeyError):
        return None


def read_progress(folder: Path) -> dict[str, Any]:
    """The content of a task's progress file; empty before the first attempt."""
    try:
        progress: dict[str, Any] = read_json(folder / PROGRESS_FILE)
        return progress
    except (OSError, ValueError):
        return {}


def _progress_writer(path: Path, attempt: int) -> Callable[[Event], None]:
    """A listener that writes a fit's progress to a file; errors are ignored."""
    about = {"attempt": attempt, "process": os.getpid()}
    written_at = -math.inf

    def report(event: Event) -> None:
        nonlocal written_at
        if time.monotonic() - written_at < PROGRESS_INTERVAL_S:
            return
        written_at = time.monotonic()
        progress = {"step": int(event.done), "steps": int(event.total), "work": event.part}
        with contextlib.suppress(IgsrError):
            write_json(path, {**progress, **about})

    report(Event("fit", part=0.0))
    return report
