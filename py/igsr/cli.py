"""The ``igsr`` command: pose, fit, render, eval, info, export, compact, study, synth, bench."""

from __future__ import annotations

import contextlib
import enum
import inspect
import json
import math
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar
from rich.table import Table

from . import _core
from .atomic_write import atomic_write, check_folder, check_writable
from .capture import Camera, Capture, load_capture
from .capture.folder import holds_cameras
from .capture.photo_folder import FRAMES, has_photos
from .capture.write_colmap import write_colmap
from .capture.write_files import relative_name
from .capture.write_transforms import write_transforms
from .compaction import DEFAULT_STEPS, CompactProgress, compact, write_plot
from .errors import IgsrError
from .evaluation import METRICS, ScoredView, default_background, default_split, evaluate
from .fitting import Progress, fit_with_cameras
from .orbit import orbit
from .pose import AUTO, capture_of, estimate, photos_of
from .pose.registry import ESTIMATORS
from .poses import refine_cameras
from .presets import preset_settings
from .rendering import render
from .report import sheet_names, write_cameras, write_contact_sheet, write_report
from .splats import Splats

app = typer.Typer(
    help="Fit a Gaussian-splat scene from photos, with known cameras or without.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

#: Exit status after Ctrl-C: 128 + SIGINT, as shells report it.
INTERRUPTED = 130

NAMED_COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "grey": (0.5, 0.5, 0.5)}


class BackendChoice(str, enum.Enum):
    """What computes."""

    auto = "auto"
    cpu = "cpu"
    gpu = "gpu"
    reference = "reference"


class DensityChoice(str, enum.Enum):
    """How splats are added and removed."""

    mcmc = "mcmc"
    original = "original"
    fixed = "fixed"


class PresetChoice(str, enum.Enum):
    """Sets of fit settings."""

    default = "default"
    baseline_3dgs = "3dgs"
    instantsplat = "instantsplat"


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


class FormatChoice(str, enum.Enum):
    """Files that describe cameras."""

    colmap = "colmap"
    colmap_text = "colmap-text"
    transforms = "transforms"


class StudyChoice(str, enum.Enum):
    """Protocols of ``igsr study``."""

    blender8 = "blender8"
    few_photos = "few-photos"
    pose_noise = "pose-noise"
    poses = "poses"


class WorkloadChoice(str, enum.Enum):
    """What ``igsr bench`` measures."""

    W1 = "W1"
    W2 = "W2"
    W3 = "W3"
    W4 = "W4"


class SplitChoice(str, enum.Enum):
    """Which views of a capture."""

    train = "train"
    test = "test"


BackendOption = Annotated[
    BackendChoice,
    typer.Option("--backend", help="auto: a real GPU if one answers, else the CPU."),
]
BackgroundOption = Annotated[
    str | None,
    typer.Option(
        "--background",
        metavar="COLOR",
        help="white, black, grey or R,G,B in 0..1, behind renders and photos with alpha. "
        "Default: white where photos have alpha, else black.",
    ),
]
HoldoutOption = Annotated[
    int | None,
    typer.Option("--holdout", help="Every how many views one is held out and scored, such as 8."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object, for machines.")]
CaptureArgument = Annotated[
    Path, typer.Argument(metavar="CAPTURE", help="Folder or file that holds photos and cameras.")
]
FramesOption = Annotated[
    int, typer.Option("--frames", help="How many frames are taken of each video.")
]
EstimatorOption = Annotated[
    str,
    typer.Option(
        "--estimator",
        metavar="NAME",
        help=f"What finds cameras: {', '.join(ESTIMATORS)}, or auto, the first of them that can "
        "run here.",
    ),
]
CheckpointOption = Annotated[
    Path | None, typer.Option("--checkpoint", metavar="FILE", help="dust3r: the network's weights.")
]
GraphOption = Annotated[
    str | None,
    typer.Option(
        "--graph",
        metavar="KIND",
        help="dust3r: which pairs of photos it sees: complete, swin-K, logwin-K or oneref-K.",
    ),
]
SceneArgument = Annotated[Path, typer.Argument(metavar="SCENE", help="A splat .ply file.")]


def main() -> None:
    """Run the ``igsr`` command."""
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        # Mesa's layer that asks the desktop for its GPU prints an error where there is no desktop.
        os.environ.setdefault("NODEVICE_SELECT", "1")
    app()


@contextlib.contextmanager
def one_sentence(interrupted: Callable[[], str] = lambda: "Interrupted.") -> Iterator[None]:
    """Turn what a user can mend into one sentence on stderr and a non-zero exit."""
    try:
        yield
    except KeyboardInterrupt:
        _complain(interrupted())
        raise typer.Exit(INTERRUPTED) from None
    except (IgsrError, RuntimeError) as error:  # the renderer's RuntimeErrors are the GPU's
        _complain(str(error))
        raise typer.Exit(1) from None
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _complain(f"{where}{error.strerror or error}")
        raise typer.Exit(1) from None
    except MemoryError:
        _complain("There is not enough memory for this; use fewer or smaller photos or splats")
        raise typer.Exit(1) from None


@contextlib.contextmanager
def _warnings_as_sentences() -> Iterator[None]:
    """Print the warnings of igsr itself as the command prints its errors, as they come."""
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *rest: _complain(str(message))
        yield


def _complain(sentence: str) -> None:
    sentence = " ".join(sentence.split())
    print(sentence if sentence.endswith((".", "!", "?")) else sentence + ".", file=sys.stderr)


def _resolved(backend: BackendChoice) -> str:
    """The backend that runs; a missing adapter is found before any work."""
    return _core.resolve_backend(backend.value)


def _color(text: str | None) -> tuple[float, float, float] | None:
    if text is None:
        return None
    if text in NAMED_COLORS:
        return NAMED_COLORS[text]
    try:
        red, green, blue = (float(part) for part in text.split(","))
        if all(0.0 <= channel <= 1.0 for channel in (red, green, blue)):
            return red, green, blue
    except ValueError:
        pass
    raise IgsrError(
        f"--background must be {', '.join(NAMED_COLORS)} or three numbers in 0..1 such as "
        f"0.2,0.2,0.2, not {text!r}."
    )


def _load(path: Path, holdout: int | None) -> Capture:
    capture = load_capture(path)
    return capture if holdout is None else capture.with_holdout(holdout)


@dataclass(frozen=True)
class CameraFinder:
    """What was said of how cameras are to be found."""

    estimator: str
    checkpoint: Path | None
    graph: str | None
    frames: int
    seed: int

    @property
    def options(self) -> dict[str, Any]:
        """What goes to the estimator itself."""
        given = {"checkpoint": self.checkpoint, "graph": self.graph}
        return {name: value for name, value in given.items() if value is not None}


def _fit_capture(
    path: Path,
    out: Path,
    holdout: int | None,
    finder: CameraFinder,
    *,
    resume: bool,
    shown: bool,
) -> Capture:
    """The capture at a path; photos without cameras get them, kept in ``out/capture``."""
    if holds_cameras(path) or not has_photos(path):
        if finder.options or finder.estimator != AUTO:
            raise IgsrError(
                f"{path} has cameras, or no photos; leave --estimator, --checkpoint and --graph out"
            )
        return _load(path, holdout)
    kept = out / "capture"
    if kept.resolve() in (path.resolve(), *path.resolve().parents):
        raise IgsrError(f"{path} lies where the fit would write {kept}; name another --out")
    if resume and holds_cameras(kept):
        _complain(f"The cameras found before are used, from {kept}")
    else:
        report = _posed(path, kept, finder, plot=False, shown=shown, replace=True)
        _complain(
            f"Cameras of {len(report['cameras'])} of {report['photos']} photos were found by "
            f"{report['estimator']} and are kept in {kept}"
        )
    return _load(kept, holdout)


def _console() -> Console:
    # Paths stay whole: a terminal breaks long lines by itself.
    return Console(file=sys.stdout, highlight=False, soft_wrap=True)


def _print_json(value: dict[str, Any]) -> None:
    print(json.dumps(value, indent=2, allow_nan=False))


def _score_line(scores: dict[str, Any]) -> str:
    parts = [
        f"PSNR {scores['psnr']:.2f} dB",
        f"SSIM {scores['ssim']:.4f}",
        "MS-SSIM " + (f"{scores['ms_ssim']:.4f}" if scores["ms_ssim"] is not None else "-"),
        f"FLIP {scores['flip']:.4f}",
    ]
    return "   ".join(parts)


def _protocol_line(protocol: dict[str, Any]) -> str:
    background = tuple(protocol["background"])
    names = {color: name for name, color in NAMED_COLORS.items()}
    behind = names.get(background) or ",".join(f"{channel:g}" for channel in background)
    return (
        f"scored on {protocol['views']} {protocol['split']} view"
        f"{'' if protocol['views'] == 1 else 's'} over {behind}, {protocol['pixels']}"
    )


@app.command("pose")
def pose_command(
    photos: Annotated[
        list[Path],
        typer.Argument(metavar="PHOTOS", help="A folder of photos, or photos and videos."),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="Folder for the capture; it must be new or empty.")
    ],
    estimator: EstimatorOption = AUTO,
    checkpoint: CheckpointOption = None,
    graph: GraphOption = None,
    plot: Annotated[
        bool, typer.Option("--plot", help="Draw cameras and points to poses.png in --out.")
    ] = False,
    frames: FramesOption = FRAMES,
    seed: Annotated[int, typer.Option("--seed", help="Same seed, same bits.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Find the cameras of PHOTOS and write both as a COLMAP capture."""
    with one_sentence(lambda: "Interrupted; nothing is written."), _warnings_as_sentences():
        check_folder(out)
        started = time.monotonic()
        given = photos[0] if len(photos) == 1 else photos
        if estimator == AUTO and isinstance(given, Path) and holds_cameras(given):
            raise IgsrError(
                f"{given} has cameras already; fit it as it is, or name an --estimator to find "
                "them anew"
            )
        finder = CameraFinder(estimator, checkpoint, graph, frames, seed)
        report = _posed(given, out, finder, plot=plot, shown=not as_json)
        report["seconds"] = round(time.monotonic() - started, 3)
    if as_json:
        _print_json(report)
        return
    console = _console()
    console.print(
        f"{len(report['cameras'])} of {report['photos']} photos placed by {report['estimator']} in "
        f"{report['seconds']:.1f} s, {report['points']} points, seed {seed}"
    )
    console.print("  ".join([str(out), *([str(out / "poses.png")] if plot else [])]), style="dim")


def _posed(
    photos: Path | list[Path],
    out: Path,
    finder: CameraFinder,
    *,
    plot: bool,
    shown: bool,
    replace: bool = False,
) -> dict[str, Any]:
    """Find cameras and write the capture; what ``igsr pose`` reports."""
    from .pose.plot import plot_poses

    loaded = photos_of(photos, finder.frames)
    with _pose_bar(shown) as show:
        name, found = estimate(
            loaded, finder.estimator, seed=finder.seed, progress=show, **finder.options
        )
    for sentence in found.warnings:
        _complain(sentence)
    capture = capture_of(photos if isinstance(photos, Path) else Path("photos"), loaded, found)
    trusted = [
        mask
        for mask, camera in zip(found.trusted, found.cameras, strict=True)
        if camera is not None
    ]
    write_colmap(capture, out, replace=replace, further_masks={"trusted": trusted})
    if plot:
        plot_poses(out / "poses.png", capture)
    return {
        "estimator": name,
        "photos": len(loaded),
        "cameras": [
            {
                "name": view.name,
                "centre": view.camera.centre.tolist(),
                "focal": [float(view.camera.K[0, 0]), float(view.camera.K[1, 1])],
            }
            for view in capture.views
        ],
        "not_placed": [
            photo.name
            for photo, camera in zip(loaded, found.cameras, strict=True)
            if camera is None
        ],
        "points": 0 if capture.points is None else len(capture.points.xyz),
        "warnings": found.warnings,
        "seed": finder.seed,
        "version": _core.__version__,
        "out": str(out),
    }


@contextlib.contextmanager
def _pose_bar(shown: bool) -> Iterator[Callable[[str, int, int], None]]:
    """A progress bar on stderr, one line for each stage of finding cameras."""
    bar = ProgressBar(
        TextColumn("{task.description} {task.completed}/{task.total}"),
        BarColumn(bar_width=30),
        TimeRemainingColumn(compact=True),
        console=Console(file=sys.stderr, highlight=False),
        disable=not shown,
        transient=True,
    )
    tasks: dict[str, Any] = {}
    with _stopped(bar):

        def show(stage: str, done: int, total: int) -> None:
            bar.start()
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total)
            bar.update(tasks[stage], completed=done, total=total)

        yield show


@app.command("export")
def export_command(
    capture_path: CaptureArgument,
    out: Annotated[Path, typer.Option("--out", help="Folder; it must be new or empty.")],
    form: Annotated[
        FormatChoice,
        typer.Option("--format", help="colmap (binary), colmap-text, or nerfstudio's transforms."),
    ] = FormatChoice.colmap,
    as_json: JsonOption = False,
) -> None:
    """Write CAPTURE in another format: photos undistorted, at full resolution, masks as masks."""
    with one_sentence(lambda: "Interrupted; nothing is written."):
        check_folder(out)
        capture = load_capture(capture_path)
        if form is FormatChoice.transforms:
            write_transforms(capture, out)
        else:
            write_colmap(capture, out, text=form is FormatChoice.colmap_text)
    if as_json:
        _print_json({"out": str(out), "format": form.value, "views": len(capture.views)})
    else:
        _console().print(f"{len(capture.views)} views in {out}")


@app.command("fit")
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
            help="joint: the photos' cameras are fitted too and written to cameras.json.",
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
        name = _resolved(backend)
        with _warnings_as_sentences():
            capture = _fit_capture(
                capture_path,
                out,
                holdout,
                CameraFinder(estimator, network, graph, frames, seed),
                resume=resume,
                shown=not as_json,
            )
        color = _color(background) or default_background(capture)
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
        with _fit_bar(settings["steps"], shown=not as_json) as show, _warnings_as_sentences():

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
        scores, sheet = _scored(splats, fitted, split, color, name, shown=not as_json)
        scores["protocol"]["holdout"] = holdout
        moved = fitted is not capture
        if moved:
            write_cameras(out / "cameras.json", fitted.train_views)
        else:  # another fit's would not belong to this scene
            (out / "cameras.json").unlink(missing_ok=True)
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
        write_contact_sheet(out / "views.png", sheet)
        write_report(out / "report.json", report)
        if moved and split == "test":
            # Photos that were not fitted have the cameras they were given; these are their best.
            report["refined"] = _refined_scores(splats, fitted, color, name, shown=not as_json)
            write_report(out / "report.json", report)
    if as_json:
        _print_json(report)
        return
    console = _console()
    console.print(
        f"{report['splats']} splats in {report['seconds']:.1f} s on {name} "
        f"({info['instruction_set']}), seed {seed}"
    )
    console.print(f"start: {report['start']}, {report['start_splats']} points", style="dim")
    console.print(_score_line(report))
    if "refined" in report:
        console.print(f"with refined cameras: {_score_line(report['refined'])}")
    console.print(_protocol_line(report["protocol"]), style="dim")
    names = ["scene.ply", "report.json", "views.png", *(["cameras.json"] if moved else [])]
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
        console=Console(file=sys.stderr, highlight=False),
        disable=not shown,
        transient=True,
    )
    task = bar.add_task("refine")
    with _stopped(bar):

        def progress(done: int, total: int) -> None:
            bar.start()
            bar.update(task, completed=done, total=total)

        views = refine_cameras(
            splats, capture.test_views, background, backend=backend, progress=progress
        )
    refined = Capture(capture.path, views, capture.points)
    scores, _ = _scored(splats, refined, "test", background, backend, shown)
    return {metric: scores[metric] for metric in METRICS}


def _finished_before(out: Path) -> tuple[float, tuple[str, int]]:
    """Seconds of fitting and first splats (see ``Progress``) of a fit that was already complete."""
    from .checkpoint import load_checkpoint

    _, settings = load_checkpoint(out / "checkpoint.npz")
    return settings["seconds"], tuple(settings["started"])


@contextlib.contextmanager
def _stopped(bar: ProgressBar) -> Iterator[None]:
    """Stop a bar at the end. It starts with the first progress: a mistake before is one line."""
    try:
        yield
    finally:
        if bar.live.is_started:
            bar.stop()


@contextlib.contextmanager
def _fit_bar(steps: int, shown: bool) -> Iterator[Callable[[Progress], None]]:
    """A progress bar on stderr with loss, splat count, steps/s and time left."""
    bar = ProgressBar(
        TextColumn("fit {task.completed}/{task.total}"),
        BarColumn(bar_width=30),
        TextColumn("loss {task.fields[loss]}  {task.fields[splats]} splats"),
        TextColumn("{task.fields[speed]} steps/s"),
        TimeRemainingColumn(compact=True),
        console=Console(file=sys.stderr, highlight=False),
        disable=not shown,
    )
    task = bar.add_task("fit", total=steps, loss="-", splats=0, speed="-")
    with _stopped(bar):

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


def _scored(
    splats: Splats,
    capture: Capture,
    split: str,
    background: tuple[float, float, float],
    backend: str,
    shown: bool,
) -> tuple[dict[str, Any], list[ScoredView]]:
    """The scores, and the views that go on a contact sheet."""
    views = capture.test_views if split == "test" else capture.train_views
    wanted = sheet_names([view.name for view in views])
    sheet: list[ScoredView] = []
    bar = ProgressBar(
        TextColumn("score {task.completed}/{task.total}"),
        BarColumn(bar_width=30),
        console=Console(file=sys.stderr, highlight=False),
        disable=not shown,
        transient=True,
    )
    task = bar.add_task("score", total=len(views))
    with _stopped(bar):

        def on_view(scored: ScoredView) -> None:
            bar.start()
            bar.advance(task)
            if scored.name in wanted:
                sheet.append(scored)

        scores = evaluate(splats, capture, split, background, backend, on_view)
    return scores, sheet


@app.command("eval")
def eval_command(
    scene: SceneArgument,
    capture_path: CaptureArgument,
    holdout: HoldoutOption = None,
    split: Annotated[
        SplitChoice | None, typer.Option("--split", help="Default: test views if there are any.")
    ] = None,
    background: BackgroundOption = None,
    backend: BackendOption = BackendChoice.auto,
    as_json: JsonOption = False,
) -> None:
    """Score SCENE against the photos of CAPTURE."""
    with one_sentence():
        name = _resolved(backend)
        splats = Splats.load(scene)
        capture = _load(capture_path, holdout)
        color = _color(background) or default_background(capture)
        chosen = split.value if split is not None else default_split(capture)
        scores, _ = _scored(splats, capture, chosen, color, name, shown=not as_json)
        scores["protocol"]["holdout"] = holdout
    report = {**scores, "splats": len(splats), **_core.backend_info(name)}
    if as_json:
        _print_json(report)
        return
    table = Table(box=None, pad_edge=False)
    for heading in ("view", "PSNR", "SSIM", "MS-SSIM", "FLIP"):
        table.add_column(heading, justify="left" if heading == "view" else "right")
    for row in scores["views"]:
        table.add_row(
            row["name"],
            f"{row['psnr']:.2f}",
            f"{row['ssim']:.4f}",
            "-" if row["ms_ssim"] is None else f"{row['ms_ssim']:.4f}",
            f"{row['flip']:.4f}",
        )
    console = _console()
    console.print(table)
    console.print(_score_line(scores))
    console.print(_protocol_line(scores["protocol"]), style="dim")


@app.command("compact")
def compact_command(
    scene: SceneArgument,
    max_loss: Annotated[
        str, typer.Option("--max-loss", metavar="DB", help="PSNR that may be lost, such as 0.1dB.")
    ] = "0.1dB",
    capture_path: Annotated[
        Path | None,
        typer.Option(
            "--capture",
            metavar="CAPTURE",
            help="The photos of the scene: refine to them and measure the loss on held-out ones. "
            "Without it, both by pictures of SCENE from around it.",
        ),
    ] = None,
    holdout: HoldoutOption = None,
    psnr: Annotated[
        float | None,
        typer.Option(
            "--psnr",
            help="Without --capture: how good SCENE is, dB, for a change of it to be worth dB. "
            "Default: what the report.json beside SCENE says, else 30.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="PLY",
            help="The smaller scene; the curve goes beside it as .json and .png. "
            "Default: SCENE's name with .compact.ply.",
        ),
    ] = None,
    sh_degree: Annotated[
        int | None,
        typer.Option(
            "--sh-degree",
            help="Degree of view-dependent colour of the smaller scene: a higher one needs fewer "
            "splats, but more bytes for each. Default: SCENE's, or lower where that loses little.",
        ),
    ] = None,
    steps: Annotated[
        int, typer.Option("--steps", help="Refinement steps of a model that may be the result.")
    ] = DEFAULT_STEPS,
    seed: Annotated[int, typer.Option("--seed", help="Same seed, same bits.")] = 0,
    background: BackgroundOption = None,
    backend: BackendOption = BackendChoice.auto,
    as_json: JsonOption = False,
) -> None:
    """Make SCENE smaller: the fewest splats that lose no more than --max-loss."""
    with one_sentence(lambda: "Interrupted; nothing is written."):
        name = _resolved(backend)
        limit = _decibels("--max-loss", max_loss)
        target = scene.with_suffix(".compact.ply") if out is None else out
        if target.suffix.lower() != ".ply":
            raise IgsrError(f"--out {target} must be a .ply file.")
        splats = Splats.load(scene)
        capture = None
        if capture_path is not None:
            capture = _load(capture_path, holdout)
        elif holdout is not None:
            raise IgsrError("--holdout chooses among photos; give --capture or leave it out.")
        elif psnr is None:
            psnr = _reported_psnr(scene.parent / "report.json")
        curve, plot = target.with_suffix(".json"), target.with_suffix(".png")
        for path in (target, curve, plot):
            check_writable(path)
        with _compact_bar(shown=not as_json) as show:
            compaction = compact(
                splats,
                limit,
                capture,
                psnr=psnr,
                sh_degree=sh_degree,
                steps=steps,
                seed=seed,
                background=_color(background),
                backend=name,
                progress=show,
            )
        report = {"scene": str(scene), "out": str(target), **compaction.report}
        report["protocol"]["holdout"] = holdout
        compaction.splats.save(target)
        write_report(curve, report)
        write_plot(plot, report)
    if as_json:
        _print_json(report)
        return
    whole, result = report["whole"], report["result"]
    console = _console()
    console.print(
        f"{result['splats']} splats of SH degree {result['sh_degree']}, {result['bytes']} bytes; "
        f"before {whole['splats']}, {whole['sh_degree']}, {whole['bytes']}"
    )
    console.print(f"loses {result['loss']:.3f} dB of at most {limit:g}")
    console.print(
        f"{report['protocol']['judge_views']} views that were not refined to, against "
        f"{report['protocol']['against']}",
        style="dim",
    )
    console.print(f"{target}  {curve}  {plot}", style="dim")


def _decibels(option: str, text: str) -> float:
    try:
        value = float(text.strip().lower().removesuffix("db"))
    except ValueError:
        value = math.nan
    if not 0.0 < value < 100.0:
        raise IgsrError(f"{option} must be dB above 0 and below 100 such as 0.1dB, not {text!r}.")
    return value


def _reported_psnr(path: Path) -> float | None:
    """What the report of a fit says of its scene, or None where there is none to be read."""
    try:
        psnr = json.loads(path.read_text(encoding="utf-8"))["psnr"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return psnr if isinstance(psnr, float) and 0.0 < psnr < 100.0 else None


@contextlib.contextmanager
def _compact_bar(shown: bool) -> Iterator[Callable[[CompactProgress], None]]:
    """A progress bar on stderr for the size that is tried, with its time left."""
    bar = ProgressBar(
        TextColumn("size {task.fields[trial]}: {task.fields[what]}"),
        BarColumn(bar_width=30),
        TextColumn("step {task.completed}/{task.total}"),
        TimeRemainingColumn(compact=True),
        console=Console(file=sys.stderr, highlight=False),
        disable=not shown,
    )
    tasks: dict[int, Any] = {}
    with _stopped(bar):

        def show(now: CompactProgress) -> None:
            bar.start()
            if now.trial not in tasks:
                what = f"{now.splats} splats, SH {now.sh_degree}"
                tasks[now.trial] = bar.add_task(
                    "compact", total=now.steps, trial=now.trial, what=what
                )
            bar.update(tasks[now.trial], completed=now.step)

        yield show


@app.command("render")
def render_command(
    scene: SceneArgument,
    out: Annotated[
        Path, typer.Option("--out", help="Folder for pictures, or .mp4 file with --orbit.")
    ],
    cameras: Annotated[
        Path | None,
        typer.Option("--cameras", metavar="CAPTURE", help="Render from the cameras of a capture."),
    ] = None,
    orbit_frames: Annotated[
        int | None,
        typer.Option(
            "--orbit",
            metavar="FRAMES",
            help="Write a video once around the scene; with --cameras, at their distance.",
        ),
    ] = None,
    exr: Annotated[
        bool,
        typer.Option(
            "--exr", help="EXR in 32-bit float: R, G, B, A and Z (expected depth) instead of PNG."
        ),
    ] = False,
    background: BackgroundOption = None,
    backend: BackendOption = BackendChoice.auto,
    as_json: JsonOption = False,
) -> None:
    """Render SCENE to PNG or EXR pictures, or to a video around it."""
    with one_sentence():
        name = _resolved(backend)
        splats = Splats.load(scene)
        capture = None if cameras is None else load_capture(cameras)
        color = _color(background) or (
            NAMED_COLORS["black"] if capture is None else default_background(capture)
        )
        if orbit_frames is not None:
            if exr:
                raise IgsrError("--exr writes pictures and --orbit a video; leave one out.")
            if out.suffix.lower() not in (".mp4", ".mkv", ".mov"):
                raise IgsrError(f"--out {out} must be a video file such as orbit.mp4 with --orbit.")
            files = [_write_orbit(splats, orbit(splats, capture, orbit_frames), out, color, name)]
        elif capture is not None:
            files = _write_pictures(splats, capture, out, color, name, exr)
        else:
            raise IgsrError("Say where from: --cameras CAPTURE, --orbit FRAMES, or both.")
    if as_json:
        _print_json({"files": [str(file) for file in files], **_core.backend_info(name)})
    else:
        _console().print(str(files[0]) if len(files) == 1 else f"{len(files)} pictures in {out}")


def _write_orbit(
    splats: Splats,
    path_cameras: list[Camera],
    out: Path,
    background: tuple[float, float, float],
    backend: str,
) -> Path:
    from .video import write_video

    frames = (render(splats, camera, background, backend).to_uint8() for camera in path_cameras)
    write_video(out, frames)
    return out


def _write_pictures(
    splats: Splats,
    capture: Capture,
    out: Path,
    background: tuple[float, float, float],
    backend: str,
    exr: bool,
) -> list[Path]:
    from PIL import Image

    suffix = ".exr" if exr else ".png"
    files: list[Path] = []
    for view in capture.views:
        path = out / _picture_name(view.name, suffix)
        if path in files:
            path = out / _picture_name(view.name + suffix, suffix)
        picture = render(splats, view.camera, background, backend)
        with atomic_write(path) as temporary:
            if exr:
                _core.write_exr(
                    str(temporary), picture.color, picture.alpha, picture.expected_depth
                )
            else:
                Image.fromarray(picture.to_uint8()).save(temporary, format="PNG")
        files.append(path)
    return files


def _picture_name(view_name: str, suffix: str) -> Path:
    """A view's name as a relative path that cannot leave the folder it is joined to."""
    return Path(relative_name(view_name)).with_suffix(suffix)


@app.command("info")
def info_command(
    path: Annotated[Path, typer.Argument(metavar="SCENE|CAPTURE", help="What to describe.")],
    as_json: JsonOption = False,
) -> None:
    """Describe a scene or a capture, and the backends of this machine."""
    with one_sentence():
        report = _scene_info(path) if path.suffix.lower() == ".ply" else _capture_info(path)
        report["backends"] = _backends()
    if as_json:
        _print_json(report)
        return
    console = _console()
    for key, value in report.items():
        if key == "backends":
            for name, what in value.items():
                console.print(f"backend {name}: {what}")
        else:
            console.print(f"{key.replace('_', ' ')}: {_plain(value)}")


@app.command("study")
def study_command(
    protocol: Annotated[
        StudyChoice,
        typer.Argument(
            help="blender8: NeRF Synthetic from eight photos. few-photos: real captures from 3, 6 "
            "and 9 photos, or 3, 6 and 12 of the tankard. pose-noise: 20 views of NeRF Synthetic "
            "with noise on their poses, which are kept or fitted. poses: cameras found in photos "
            "against the true ones."
        ),
    ],
    data: Annotated[Path, typer.Argument(metavar="DATA", help="Folder that holds the scenes.")],
    out: Annotated[
        Path, typer.Option("--out", help="Folder for study.json, study.md, study.png and runs/.")
    ],
    scenes: Annotated[
        list[str] | None,
        typer.Option(
            "--scene",
            help="A folder in DATA; repeat it for several. Default: chair and lego; fern, "
            "dtu_scan24 and tankard; for poses the sets of docs/pose_colmap.md.",
        ),
    ] = None,
    views: Annotated[
        list[str] | None,
        typer.Option(
            "--views",
            help="Repeat it for several. blender8: 75 or 76, the view that codes differ in; "
            "few-photos: a number of photos. Default: all.",
        ),
    ] = None,
    presets: Annotated[
        list[PresetChoice] | None,
        typer.Option("--preset", help="Repeat it for several. Default: all."),
    ] = None,
    noise: Annotated[
        float | None,
        typer.Option(
            "--noise", help="pose-noise: standard deviation of camera-to-world's numbers. [0.01]"
        ),
    ] = None,
    raw_affine: Annotated[
        bool,
        typer.Option("--raw-affine", help="pose-noise: also keep the shear that noise brings."),
    ] = False,
    estimator: Annotated[
        str | None,
        typer.Option("--estimator", metavar="NAME", help="poses: what finds cameras. [colmap]"),
    ] = None,
    seeds: Annotated[
        int | None, typer.Option("--seeds", help="Fits of each kind. [3; poses: 1]")
    ] = None,
    jobs: Annotated[int, typer.Option("--jobs", help="Fits at a time; they share the cores.")] = 1,
    ray: Annotated[
        bool,
        typer.Option("--ray", help="Fits go over a Ray cluster (pip install 'igsr[ray]')."),
    ] = False,
    backend: BackendOption = BackendChoice.auto,
    as_json: JsonOption = False,
) -> None:
    """Run a protocol of the literature: the same photos, seeds and scores for every preset.

    What is finished is kept in --out, and the same command goes on from there.
    """
    from . import study

    with one_sentence(
        lambda: "Interrupted; finished fits are kept, the same command goes on from there."
    ):
        console = Console(file=sys.stderr, highlight=False)
        started = time.monotonic()
        first: list[int] = []

        def on_run(done: int, total: int, row: dict[str, Any]) -> None:
            first[:] = first or [done - 1]
            left = (time.monotonic() - started) / (done - first[0]) * (total - done)
            if protocol is StudyChoice.poses:
                console.print(
                    f"{done} of {total}: {row['scene']} seed {row['seed']}: {row['registered']} of "
                    f"{row['photos']} placed in {row['seconds']:.0f} s; about {left / 60.0:.0f} "
                    "min left"
                )
                return
            if protocol is StudyChoice.pose_noise:
                kind = f"{row['noise']}, poses {row['poses']}"
                psnr = row["refined"]["psnr"]
            else:
                kind, psnr = f"views {row['views']} {row['preset']}", row["psnr"]
            console.print(
                f"{done} of {total}: {row['scene']} {kind} seed {row['seed']}: "
                f"{psnr:.2f} dB in {row['seconds']:.0f} s; about {left / 60.0:.0f} min left"
            )

        studies: dict[StudyChoice, Callable[..., dict[str, Any]]] = {
            StudyChoice.blender8: study.blender8,
            StudyChoice.few_photos: study.few_photos,
            StudyChoice.pose_noise: study.pose_noise,
            StudyChoice.poses: study.poses,
        }
        run = studies[protocol]
        given: dict[str, Any] = {
            "scenes": scenes and tuple(scenes),
            "views": views and tuple(views),
            "presets": presets and tuple(choice.value for choice in presets),
            "noise": noise,
            "raw_affine": raw_affine or None,
            "estimator": estimator,
            "seeds": seeds,
            "backend": None if backend is BackendChoice.auto else backend,
        }
        given = {name: value for name, value in given.items() if value is not None}
        foreign = [name for name in given if name not in inspect.signature(run).parameters]
        if foreign:
            option = {"scenes": "scene", "presets": "preset"}.get(foreign[0], foreign[0])
            raise IgsrError(
                f"--{option.replace('_', '-')} says nothing to {protocol.value}; leave it out."
            )
        if "backend" in inspect.signature(run).parameters:
            given["backend"] = _resolved(backend)
        report = run(data, out, **given, jobs=jobs, on_run=on_run, ray=ray)
    if as_json:
        _print_json(report)
        return
    _console().print((out / "study.md").read_text(encoding="utf-8"), markup=False)


@app.command("synth")
def synth_command(
    scenes: Annotated[int, typer.Option("--scenes", metavar="N", help="How many.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder of the captures.")],
    seed: Annotated[int, typer.Option("--seed", help="Same seed, same scenes.")] = 0,
    first: Annotated[int, typer.Option("--first", help="Number of the first scene.")] = 0,
    size: Annotated[int, typer.Option("--size", help="Pixels of the photos' longer side.")] = 256,
    views: Annotated[int, typer.Option("--views", help="Photos to fit, per scene.")] = 24,
    test_views: Annotated[
        int, typer.Option("--test-views", help="Photos to score, per scene.")
    ] = 8,
    spp: Annotated[int, typer.Option("--spp", help="Light paths per pixel, a square.")] = 36,
    jobs: Annotated[
        int | None,
        typer.Option("--jobs", help="Scenes at a time, a core each. Default: all cores."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Make procedural captures: random scenes rendered with exact cameras, depth and masks.

    Needs Mitsuba 3 (pip install 'igsr[synth]'). What is finished is kept in --out, and the same
    command goes on from there.
    """
    from . import synth

    with one_sentence(
        lambda: "Interrupted; finished scenes are kept, the same command goes on from there."
    ):
        console = Console(file=sys.stderr, highlight=False)

        def on_scene(done: int, total: int, row: dict[str, Any]) -> None:
            where = "" if row["kind"] == "none" else f", {row['kind']}"
            console.print(
                f"{done} of {total}: {row['name']} ({', '.join(row['contents'])}{where}) "
                f"in {row['seconds']:.0f} s"
            )

        report = synth.synthesize(
            out,
            scenes,
            seed=seed,
            first=first,
            settings=synth.CaptureSettings(size, views, test_views, spp),
            jobs=(os.cpu_count() or 1) if jobs is None else jobs,
            on_scene=on_scene,
        )
    if as_json:
        _print_json(report)
        return
    made = sum(row["seconds"] is not None for row in report["scenes"])
    _console().print(f"{made} made, {scenes - made} there already: {out}", markup=False)


@app.command("bench")
def bench_command(
    backends: Annotated[
        list[BackendChoice] | None,
        typer.Option("--backend", help="Repeat it for several. Default: what auto stands for."),
    ] = None,
    workloads: Annotated[
        list[WorkloadChoice] | None,
        typer.Option("--workload", help="Repeat it for several. Default: all."),
    ] = None,
    garden: Annotated[
        Path | None,
        typer.Option("--garden", metavar="FILE", help="gsplat's test_garden.npz, for W2."),
    ] = None,
    capture: Annotated[
        Path | None,
        typer.Option("--capture", metavar="CAPTURE", help="Photos of 400x400 for W3."),
    ] = None,
    models: Annotated[
        Path | None,
        typer.Option(
            "--models",
            metavar="DIR",
            help="Folder that keeps the models fitted for W3. Default: out/bench.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", help="Same seed, same workloads.")] = 0,
    seconds: Annotated[
        float, typer.Option("--seconds", help="How long each row is repeated.")
    ] = 2.0,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="PNG", help="Draw time against error.")
    ] = None,
    json_path: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the machine and all rows.")
    ] = None,
    accuracy: Annotated[
        Path | None,
        typer.Option(
            "--accuracy",
            metavar="FILE",
            help="Instead of workloads, measure every setting and write a page like "
            "docs/accuracy.md, its plot beside it.",
        ),
    ] = None,
) -> None:
    """Measure speed and error together, against the f64 reference.

    W1: rasterize only. W2: the garden, forward and backward. W3: a fit step on a capture. W4: how a
    fit step grows with splats and pixels.
    """
    from . import benchmark

    with one_sentence():
        if seed < 0:
            raise IgsrError(f"--seed must be at least 0, not {seed}.")
        if not 0.0 <= seconds <= 3600.0:
            raise IgsrError(f"--seconds must be from 0 to 3600, not {seconds:g}.")
        names = benchmark.resolved_backends([b.value for b in backends or [BackendChoice.auto]])
        if accuracy is not None:
            given = {
                "--workload": workloads,
                "--garden": garden,
                "--capture": capture,
                "--models": models,
            }
            for name, value in given.items():
                if value:
                    raise IgsrError(f"--accuracy runs no workloads; leave {name} out.")
        for path in (plot, json_path, accuracy):
            if path is not None:
                check_writable(path)
        console = Console(file=sys.stderr, highlight=False)
        settings = benchmark.Settings(
            backends=names,
            workloads=tuple(w.value for w in workloads or WorkloadChoice),
            garden=garden,
            capture=capture,
            models=models or benchmark.Settings.models,
            seed=seed,
            seconds=seconds,
        )
        with console.status("starting") as status:
            if accuracy is None:
                report = benchmark.run_benchmark(settings, status.update)
            else:
                implementations = ("reference", *(name for name in names if name != "reference"))
                report = benchmark.measure_accuracy(implementations, seed, seconds, status.update)
                benchmark.write_accuracy(accuracy, report)
        if plot is not None:
            benchmark.plot_speed_vs_error(plot, report)
        if json_path is not None:
            write_report(json_path, report)
    benchmark.print_report(_console(), report)


def _plain(value: object) -> str:
    if isinstance(value, list):
        return "  ".join(_plain(item) for item in value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _opacity(logit: float) -> float:
    # tanh does not overflow for any logit, as exp does.
    return 0.5 + 0.5 * math.tanh(0.5 * logit)


def _scene_info(path: Path) -> dict[str, Any]:
    splats = Splats.load(path)
    bounds = splats.bounds()
    finite = splats.finite
    logit = float(np.median(splats.opacities[finite])) if finite.any() else None
    return {
        "kind": "scene",
        "path": str(path),
        "splats": len(splats),
        "not_finite": int((~finite).sum()),
        "sh_degree": splats.sh_degree,
        "lowest_corner": None if bounds is None else bounds[0].tolist(),
        "highest_corner": None if bounds is None else bounds[1].tolist(),
        "origin": splats.origin.tolist(),
        "median_opacity": None if logit is None else _opacity(logit),
        "bytes": path.stat().st_size,
    }


def _known(number: float) -> float | None:
    """None where poses so far out that their mean overflows leave no number; JSON has none."""
    return float(number) if math.isfinite(number) else None


def _capture_info(path: Path) -> dict[str, Any]:
    capture = load_capture(path)
    sizes = sorted({f"{view.camera.width}x{view.camera.height}" for view in capture.views})
    points = None if capture.points is None else len(capture.points.xyz)
    return {
        "kind": "capture",
        "path": str(path),
        "views": len(capture.views),
        "train_views": len(capture.train_views),
        "test_views": len(capture.test_views),
        "sizes": sizes,
        "views_with_alpha": sum(view.image.shape[2] == 4 for view in capture.views),
        "views_with_mask": sum(view.mask is not None for view in capture.views),
        "points": points,
        "scene_centre": [_known(x) for x in capture.scene_centre],
        "scene_extent": _known(capture.scene_extent),
    }


def _backends() -> dict[str, str]:
    """Each backend with what it runs on, or why it does not."""
    found = {}
    for name in ("cpu", "gpu", "reference"):
        try:
            info = _core.backend_info(_core.resolve_backend(name))
            found[name] = f"{info['device']}, {info['instruction_set']}"
        except RuntimeError as error:
            found[name] = f"not available: {error}"
    found["auto"] = _core.resolve_backend("auto")
    return found


if __name__ == "__main__":
    main()
