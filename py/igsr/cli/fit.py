"""``igsr fit``: fit splats to a capture."""

from __future__ import annotations

import contextlib
import enum
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar

from igsr import _core
from igsr._internal.json_file import write_json
from igsr.capture import Capture
from igsr.capture.photo_folder import FRAMES
from igsr.capture.write_cameras import write_cameras
from igsr.cli.pose import (
    CameraFinder,
    CheckpointOption,
    EstimatorOption,
    FramesOption,
    GraphOption,
    capture_to_fit,
)
from igsr.cli.shared import (
    BackendChoice,
    BackendOption,
    BackgroundOption,
    CaptureArgument,
    HoldoutOption,
    JsonOption,
    PresetChoice,
    background_color,
    error_console,
    one_sentence,
    output_console,
    print_json,
    protocol_line,
    resolved,
    score_line,
    scored,
    stopped,
    warnings_as_sentences,
)
from igsr.evaluation.contact_sheet import contact_sheet, save_sheet
from igsr.evaluation.scores import METRICS, default_background, default_split
from igsr.fitting.pose_refinement import refine_cameras
from igsr.fitting.presets import preset_settings
from igsr.fitting.run import Progress, fit_with_cameras
from igsr.pose import AUTO
from igsr.splats import Splats


class DensityChoice(str, enum.Enum):
    """How splats are added and removed."""

    mcmc = "mcmc"
    original = "original"
    fixed = "fixed"


class StartChoice(str, enum.Enum):
    """What the first splats are made from."""

    auto = "auto"
    points = "points"
    hull = "hull"
    sift = "sift"
    rays = "rays"
    random = "random"


class PosesChoice(str, enum.Enum):
    """Whether cameras are fitted with the splats."""

    fixed = "fixed"
    joint = "joint"


class FocalChoice(str, enum.Enum):
    """Which focal lengths are fitted."""

    fixed = "fixed"
    shared = "shared"
    per_camera = "per-camera"


def fit_command(
    capture_path: CaptureArgument,
    out: Annotated[
        Path,
        typer.Option("--out", help="Folder for scene.ply, report.json, views.png, checkpoint.npz."),
    ],
    holdout: HoldoutOption = None,
    preset: Annotated[
        PresetChoice,
        typer.Option(
            "--preset",
            help="Settings where none is given below: default (for few photos or for many, by "
            "their number), 3dgs and instantsplat (baselines).",
        ),
    ] = PresetChoice.default,
    steps: Annotated[int | None, typer.Option("--steps", help="Optimiser steps.")] = None,
    backend: BackendOption = BackendChoice.auto,
    seed: Annotated[int, typer.Option("--seed", help="Same seed, same bits.")] = 0,
    max_splats: Annotated[
        int | None, typer.Option("--max-splats", help="Most splats there may be.")
    ] = None,
    sh_degree: Annotated[
        int | None, typer.Option("--sh-degree", help="Degree of view-dependent colour, 0 to 4.")
    ] = None,
    density: Annotated[
        DensityChoice | None,
        typer.Option(
            "--density",
            help="How splats are added and removed: mcmc (relocation under a cap), original "
            "(clone, split, prune), fixed.",
        ),
    ] = None,
    dropout: Annotated[
        float | None,
        typer.Option("--dropout", help="Part of the splats that steps leave out at random."),
    ] = None,
    hull: Annotated[
        bool | None,
        typer.Option("--hull/--no-hull", help="Remove splats that a photo with alpha shows empty."),
    ] = None,
    start: Annotated[
        StartChoice | None,
        typer.Option("--start", help="What the first splats are made from."),
    ] = None,
    poses: Annotated[
        PosesChoice | None,
        typer.Option(
            "--poses",
            help="joint: the photos' cameras are fitted too.",
        ),
    ] = None,
    focal: Annotated[
        FocalChoice | None,
        typer.Option("--focal", help="Focal lengths that are fitted: one factor for all, or each."),
    ] = None,
    estimator: EstimatorOption = AUTO,
    network: CheckpointOption = None,
    graph: GraphOption = None,
    frames: FramesOption = FRAMES,
    background: BackgroundOption = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue from the checkpoint in --out.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Fit splats to the photos of CAPTURE and score them.

    Where CAPTURE is a plain folder of photos, or a video, its cameras are found first.
    """
    last: list[Progress] = []

    def interrupted() -> str:
        if not last or last[-1].step == 0:
            return "Interrupted before the first step."
        return (
            f"Interrupted at step {last[-1].step}; the checkpoint is saved, "
            "the same command with --resume continues."
        )

    with one_sentence(interrupted):
        name = resolved(backend)
        with warnings_as_sentences():
            capture, found = capture_to_fit(
                capture_path,
                out,
                holdout,
                CameraFinder(estimator, network, graph, frames, seed),
                resume=resume,
                shown=not as_json,
            )
        color = background_color(background) or default_background(capture)
        # Photos with alpha are fitted over random colours, so that no background is learnt.
        has_alpha = any(view.image.shape[2] == 4 for view in capture.train_views)
        settings = preset_settings(
            preset.value,
            len(capture.train_views),
            steps=steps,
            max_splats=max_splats,
            sh_degree=sh_degree,
            density=None if density is None else density.value,
            dropout=dropout,
            hull=hull,
            start=None if start is None else start.value,
            poses=None if poses is None else poses.value,
            focal=None if focal is None else focal.value,
        )
        with _fit_bar(settings["steps"], shown=not as_json) as show, warnings_as_sentences():

            def progress(now: Progress) -> None:
                last[:] = [now]
                show(now)

            splats, fitted = fit_with_cameras(
                capture,
                progress=progress,
                backend=name,
                seed=seed,
                **settings,
                background=None if has_alpha else color,
                checkpoint=out / "checkpoint.npz",
                resume=resume,
            )
        splats.save(out / "scene.ply")
        info = _core.backend_info(name)
        split = default_split(fitted)
        scores, sheet = scored(splats, fitted, split, color, name, shown=not as_json)
        scores["protocol"]["holdout"] = holdout
        moved = fitted is not capture
        write_cameras(out / "cameras.json", fitted.train_views)
        if last:
            seconds, started = last[-1].seconds, last[-1].started
        else:
            seconds, started = _finished_before(out)
        report = {
            **{metric: scores[metric] for metric in METRICS},
            "splats": len(splats),
            "preset": preset.value,
            **settings,
            "start": started[0],
            "start_splats": started[1],
            "seconds": round(seconds, 3),
            **info,
            "seed": seed,
            "version": _core.__version__,
            "capture": str(capture_path),
            "protocol": scores["protocol"],
            "views": scores["views"],
        }
        save_sheet(out / "views.png", contact_sheet(sheet))
        write_json(out / "report.json", report)
        if (moved or found) and split == "test":
            # Photos that were not fitted have the cameras they were given, which may be as wrong
            # as those that were found or moved; these are their best.
            report["refined"] = _refined_scores(splats, fitted, color, name, shown=not as_json)
            write_json(out / "report.json", report)
    if as_json:
        print_json(report)
        return
    console = output_console()
    console.print(
        f"{report['splats']} splats in {report['seconds']:.1f} s on {name} "
        f"({info['instruction_set']}), seed {seed}"
    )
    console.print(f"start: {report['start']}, {report['start_splats']} points", style="dim")
    console.print(score_line(report))
    if "refined" in report:
        console.print(f"with refined cameras: {score_line(report['refined'])}")
    console.print(protocol_line(report["protocol"]), style="dim")
    names = ["scene.ply", "report.json", "views.png", "cameras.json"]
    console.print("  ".join(str(out / name) for name in names), style="dim")


def _refined_scores(
    splats: Splats,
    capture: Capture,
    background: tuple[float, float, float],
    backend: str,
    shown: bool,
) -> dict[str, Any]:
    """Scores of the test views, each with its camera fitted to its photo."""
    bar = ProgressBar(
        TextColumn("refine cameras {task.completed}/{task.total}"),
        BarColumn(bar_width=30),
        TimeRemainingColumn(compact=True),
        console=error_console(),
        disable=not shown,
        transient=True,
    )
    task = bar.add_task("refine")
    with stopped(bar):

        def progress(done: int, total: int) -> None:
            bar.start()
            bar.update(task, completed=done, total=total)

        views = refine_cameras(
            splats, capture.test_views, background, backend=backend, progress=progress
        )
    refined = Capture(capture.path, views, capture.points)
    scores, _ = scored(splats, refined, "test", background, backend, shown)
    return {metric: scores[metric] for metric in METRICS}


def _finished_before(out: Path) -> tuple[float, tuple[str, int]]:
    """Seconds of fitting and first splats (see ``Progress``) of a fit that was already complete."""
    from igsr.fitting.checkpoint import load_checkpoint

    _, settings = load_checkpoint(out / "checkpoint.npz")
    return settings["seconds"], tuple(settings["started"])


@contextlib.contextmanager
def _fit_bar(steps: int, shown: bool) -> Iterator[Callable[[Progress], None]]:
    """A progress bar on stderr with loss, splat count, steps/s and time left."""
    bar = ProgressBar(
        TextColumn("fit {task.completed}/{task.total}"),
        BarColumn(bar_width=30),
        TextColumn("loss {task.fields[loss]}  {task.fields[splats]} splats"),
        TextColumn("{task.fields[speed]} steps/s"),
        TimeRemainingColumn(compact=True),
        console=error_console(),
        disable=not shown,
    )
    task = bar.add_task("fit", total=steps, loss="-", splats=0, speed="-")
    with stopped(bar):

        def show(now: Progress) -> None:
            bar.start()
            bar.update(
                task,
                completed=now.step,
                loss=f"{now.loss:.4f}",
                splats=now.splats,
                speed=f"{now.steps_per_second:.0f}",
            )

        yield show
