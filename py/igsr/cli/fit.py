"""``igsr fit``: fit splats to a capture."""

from __future__ import annotations

from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from igsr._internal.choices import FitBackend
from igsr._internal.part_usage import Parts
from igsr._internal.progress_bar import BarState, progress_bar
from igsr._internal.settings import checked_given, settings_of
from igsr.capture.photo_folder import FRAMES
from igsr.cli.error_messages import error_messages, warning_messages
from igsr.cli.pose import (
    AllowMissingOption,
    CameraFinder,
    CheckpointOption,
    EstimatorOption,
    FramesOption,
    GraphOption,
    MatcherOption,
    capture_to_fit,
)
from igsr.cli.scene_page_option import PAGE, HtmlOption, write_page
from igsr.cli.settings_options import ConfigOption, given_by_hand, settings_options
from igsr.cli.shared import (
    BackgroundOption,
    ExampleOption,
    FitBackendChoice,
    FitBackendOption,
    FitSizeOption,
    HoldoutOption,
    JsonOption,
    PresetChoice,
    QualityChoice,
    QualityOption,
    background_color,
    fitted_line,
    masked_line,
    output_console,
    parts_line,
    photos_or_example,
    print_json,
    protocol_line,
    removed_line,
    resolved,
    score_line,
    scored,
)
from igsr.errors import IgsrError
from igsr.fitting.photo_support import support_of
from igsr.fitting.presets import default_max_size, settings_for
from igsr.fitting.settings import FitSettings
from igsr.pose import AUTO, not_placed

# What computes takes long to import: the help of the command does without.
if TYPE_CHECKING:
    from igsr.capture import Capture
    from igsr.capture.load import Overview
    from igsr.fitting import Progress
    from igsr.fitting.fit_report import FitScores
    from igsr.fitting.followed_run import FollowedRun
    from igsr.splats import Splats


@settings_options(FitSettings, leave_out=("background",))
def fit_command(
    ctx: typer.Context,
    *,
    capture: Annotated[
        Path | None,
        typer.Argument(
            metavar="CAPTURE",
            help="Folder or file with photos, with cameras or without.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path,
        typer.Option("--out", help="Folder for scene.ply, scene.html, report.html, report.json."),
    ],
    example: ExampleOption = False,
    holdout: HoldoutOption = None,
    max_size: FitSizeOption = None,
    quality: QualityOption = QualityChoice.normal,
    preset: Annotated[
        PresetChoice,
        typer.Option(
            "--preset",
            help="Settings where none is given: default (for few photos or for many, by their "
            "number), or the baselines 3dgs and instantsplat.",
        ),
    ] = PresetChoice.default,
    given: dict[str, Any],
    backend: FitBackendOption = FitBackendChoice.auto,
    estimator: EstimatorOption = AUTO,
    network: CheckpointOption = None,
    graph: GraphOption = None,
    matcher: MatcherOption = None,
    frames: FramesOption = FRAMES,
    allow_missing: AllowMissingOption = False,
    background: BackgroundOption = None,
    config: ConfigOption = None,
    blocks: Annotated[
        str | None,
        typer.Option(
            "--blocks",
            metavar="auto|N",
            help="Fit in N blocks on the ground, one after another or over --ray: for scenes that "
            "do not fit into memory. CAPTURE needs cameras.",
        ),
    ] = None,
    ray: Annotated[
        str | None,
        typer.Option(
            "--ray",
            metavar="ADDRESS",
            help="Fit blocks on the Ray cluster at this address, or that this machine is part of "
            "(auto); needs igsr\\[ray] and a disk that all machines mount.",
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue from the checkpoint in --out.")
    ] = False,
    html: HtmlOption = True,
    as_json: JsonOption = False,
) -> None:
    """Fit splats to the photos of CAPTURE and score them.

    Where CAPTURE is a plain folder of photos, or a video, its cameras are found first.
    """
    last: list[Progress] = []
    parts = Parts()

    def interrupted() -> str:
        if not last or last[-1].step == 0:
            return "Interrupted before the first step."
        return (
            f"Interrupted at step {last[-1].step}; the checkpoint is saved, "
            "the same command with --resume continues."
        )

    with error_messages(interrupted), warning_messages(), ExitStack() as ending:
        # Check the options, find the cameras, and take what was not given from the preset.
        checked_given(FitSettings, given)
        if config is not None and given_by_hand(ctx, "preset") and _is_complete(given):
            raise IgsrError(
                f"--preset changes nothing: {config} names every setting. Leave one of them out."
            )
        name = resolved(backend)
        photos = photos_or_example(capture, example, out, "CAPTURE")
        if max_size is None:
            max_size = default_max_size(name, quality.value)

        if blocks is not None or ray is not None:
            from igsr.cli.fit_blocks import fit_blocks

            fit_blocks(
                photos,
                out,
                blocks=blocks or "auto",
                ray=ray,
                holdout=holdout,
                max_size=max_size,
                backend=name,
                settings={"preset": preset.value, "quality": quality.value, **given},
                background=background_color(background),
                as_json=as_json,
            )
            return

        def announced(seen: Overview, kept: bool) -> None:
            from igsr.cli.announcement import announce

            if given.get("start") == "hull" and seen.channels < 4:
                raise IgsrError(f"{photos} has photos without alpha; --start hull needs it in all")
            if as_json:
                return
            announce(
                seen,
                holdout=holdout,
                max_size=max_size,
                preset=preset.value,
                quality=quality.value,
                given=given,
                backend=name,
                cameras_kept=kept,
            )

        from igsr.fitting.followed_run import FollowedRun

        followed = ending.enter_context(closing(FollowedRun(out)))
        finder = CameraFinder(estimator, network, graph, matcher, frames, given["seed"])
        loaded, found = capture_to_fit(
            photos,
            out,
            holdout,
            finder,
            max_size=max_size,
            allow_missing=allow_missing,
            resume=resume,
            shown=not as_json,
            parts=parts,
            announced=announced,
            followed=followed,
        )
        color = _background(background, loaded)
        # Photos with alpha are fitted over random colors, so that no background is learned.
        has_alpha = any(view.image.shape[2] == 4 for view in loaded.train_views)
        settings = settings_for(
            preset.value,
            support_of(loaded.train_views),
            quality.value,
            **given,
            background=None if has_alpha else color,
        )

        from igsr.fitting.fit_report import FinishedFit, fit_report, write_fit_report, write_scene

        followed.show(loaded, color)
        with parts.measured("fit"):
            splats, fitted = _fitted(
                loaded, settings, name, out, resume, last, followed, shown=not as_json
            )

        # Write the scene, its scores and everything that it takes to fit it again.
        asked = {
            "capture": str(photos),
            "holdout": holdout,
            "max_size": max_size,
            "preset": preset.value,
            "quality": quality.value,
            **settings.plain(),
            "backend": name,
            "estimator": estimator,
            "network": None if network is None else str(network),
            "graph": graph,
            "matcher": matcher,
            "frames": frames,
            "allow_missing": allow_missing,
            "background": background,
        }
        write_scene(out, splats, fitted)
        has_page = html and write_page(out, splats, fitted, color)
        followed.tell("score photos", 1.0, at_once=True)
        with parts.measured("score"):
            is_refined = bool(fitted.test_views) and (settings.moves_cameras or found)
            scores = _scored(splats, fitted, color, name, is_refined=is_refined, shown=not as_json)
        scores.scores.protocol["holdout"] = holdout
        done = FinishedFit(splats, fitted, settings, asked, last[-1], not_placed(fitted))
        report = fit_report(done, scores, parts)
        write_fit_report(out, report, done, scores)
    if as_json:
        print_json(report)
    else:
        _print_report(report, out, [PAGE] if has_page else [])


def _is_complete(given: dict[str, Any]) -> bool:
    """Whether every setting that presets have is given."""
    return not set(settings_of(FitSettings)) - set(given) - {"seed", "background"}


def _background(text: str | None, capture: Capture) -> tuple[float, float, float]:
    from igsr.evaluation.scores import default_background

    return background_color(text) or default_background(capture)


def _fitted(
    capture: Capture,
    settings: FitSettings,
    backend: str,
    out: Path,
    resume: bool,
    last: list[Progress],
    followed: FollowedRun,
    *,
    shown: bool,
) -> tuple[Splats, Capture]:
    """Fit with a progress bar; ``last`` holds the last progress in the end."""
    from igsr.fitting import fit_with_cameras
    from igsr.fitting.run import bar_state

    with progress_bar("fit", shown=shown) as show:

        def progress(now: Progress) -> None:
            last[:] = [now]
            state = bar_state(now)
            show(state)
            followed.tell(f"fit: step {now.step} of {now.steps}, {state.text}", now.work)

        keywords: dict[str, Any] = {**settings.plain(), "backend": backend}
        return fit_with_cameras(
            capture,
            progress=progress,
            checkpoint=out / "checkpoint.npz",
            resume=resume,
            **keywords,
        )


def _scored(
    splats: Splats,
    capture: Capture,
    color: tuple[float, float, float],
    backend: FitBackend,
    *,
    is_refined: bool,
    shown: bool,
) -> FitScores:
    """Score held-out and fitted photos; with ``is_refined`` held-out ones also with other cameras.

    Held-out photos have the cameras that they were given, which may be as wrong as those that were
    found or optimized; with cameras fitted to them they score what the splats are worth.
    """
    from igsr.capture import Capture
    from igsr.evaluation.quick_scores import train_photos, train_scores
    from igsr.evaluation.scores import METRICS, default_split
    from igsr.fitting import refine_cameras
    from igsr.fitting.fit_report import FitScores

    split = default_split(capture)
    if split == "train":
        some = Capture(capture.path, train_photos(capture))
        scores, sheet = scored(splats, some, split, color, backend, shown=shown)
        count = len(capture.train_views)
        if len(some.views) < count:
            scores.protocol["of"] = count
        train = {"psnr": scores.psnr, "ssim": scores.ssim, "views": len(some.views), "of": count}
        return FitScores(scores, sheet, train)
    scores, sheet = scored(splats, capture, split, color, backend, shown=shown)
    train = train_scores(splats, capture, color, backend)
    if not is_refined:
        return FitScores(scores, sheet, train)
    with progress_bar("refine cameras", shown=shown, transient=True) as show:
        views = refine_cameras(
            splats,
            capture.test_views,
            color,
            backend=backend,
            progress=lambda done, total: show(BarState(done, total)),
        )
    refined = Capture(capture.path, views, capture.points)
    again, _ = scored(splats, refined, "test", color, backend, shown)
    return FitScores(scores, sheet, train, {metric: again[metric] for metric in METRICS})


def _print_report(report: dict[str, Any], out: Path, pages: list[str]) -> None:
    console = output_console()
    console.print(
        f"{report['splats']} splats in {report['seconds']:.1f} s on {report['backend']} "
        f"({report['instruction_set']}), seed {report['seed']}"
    )
    console.print(
        f"initialization: {report['start']}, {report['start_splats']} points", style="dim"
    )
    if report["removed"]:
        console.print(removed_line(report["removed"]), style="dim")
    if report["masked"]:
        console.print(masked_line(report["masked"], report["photos"]["train"]), style="dim")
    console.print(score_line(report))
    if "refined" in report:
        console.print(f"with refined cameras: {score_line(report['refined'])}")
    if report["protocol"]["split"] == "test":
        console.print(fitted_line(report["train"]))
    console.print(report["limit"]["sentence"])
    console.print(protocol_line(report["protocol"]), style="dim")
    console.print(parts_line(report["parts"]), style="dim")
    names = ["scene.ply", *pages, "report.html", "report.json", "views.png", "cameras.json"]
    console.print("  ".join(str(out / name) for name in names), style="dim")
