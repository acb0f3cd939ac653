"""``igsr refine``: fit photos, and improve the fit with denoised novel views."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from igsr._internal.progress_bar import progress_bar
from igsr.capture.photo_folder import FRAMES
from igsr.cli.denoiser_option import DenoiserOption, chosen_denoiser
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
from igsr.cli.settings_options import ConfigOption, settings_options
from igsr.cli.shared import (
    ExampleOption,
    FitSizeOption,
    HoldoutOption,
    JsonOption,
    fitted_line,
    output_console,
    parts_line,
    photos_or_example,
    print_json,
)
from igsr.errors import IgsrError
from igsr.fitting.presets import default_max_size
from igsr.refinement.settings import AUTO, RefineSettings

# What imports torch is imported by the command, so that --help answers at once.
if TYPE_CHECKING:
    from igsr.capture import Capture
    from igsr.capture.load import Overview
    from igsr.denoiser import Denoiser
    from igsr.refinement.results import Refined


@settings_options(RefineSettings)
def refine_command(
    *,
    photos: Annotated[
        Path | None,
        typer.Argument(
            metavar="PHOTOS", help="A folder of photos, or a capture.", show_default=False
        ),
    ] = None,
    out: Annotated[
        Path,
        typer.Option("--out", help="Folder for scene.ply, scene.html, report.html and rounds/."),
    ],
    given: dict[str, Any],
    example: ExampleOption = False,
    holdout: HoldoutOption = None,
    max_size: FitSizeOption = None,
    photo_count: Annotated[
        int | None,
        typer.Option("--photos", metavar="N", help="Fit N of the train photos, evenly spaced."),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option("--weights", metavar="FILE", help="The denoiser. Default: igsr's own."),
    ] = None,
    denoiser_name: DenoiserOption = None,
    estimator: EstimatorOption = AUTO,
    network: CheckpointOption = None,
    graph: GraphOption = None,
    matcher: MatcherOption = None,
    frames: FramesOption = FRAMES,
    allow_missing: AllowMissingOption = False,
    config: ConfigOption = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from the checkpoints in --out.")
    ] = False,
    html: HtmlOption = True,
    as_json: JsonOption = False,
) -> None:
    """Fit few photos, then add denoised novel views and refit, while cross-validation improves."""
    with error_messages(
        lambda: f"Interrupted; what is done is in {out}, the same command with --resume goes on."
    ):
        settings = RefineSettings(**given)
        if photo_count is not None and photos is not None:
            _check_photo_count(photos, holdout, frames, photo_count)

        from igsr._core import resolve_backend
        from igsr.fitting.followed_run import FollowedRun
        from igsr.refinement.loop import refine, round_denoiser
        from igsr.refinement.run import bar_state

        path = photos_or_example(photos, example, out, "PHOTOS")
        # A missing GPU is found before cameras are looked for.
        backend = resolve_backend(settings.backend)
        if max_size is None:
            max_size = default_max_size(backend, settings.quality)

        def announced(seen: Overview, kept: bool) -> None:
            from igsr.cli.announcement import announce

            announce(
                seen,
                holdout=holdout,
                photos=photo_count,
                max_size=max_size,
                preset="default",
                quality=settings.quality,
                given={"steps": settings.steps},
                backend=backend,
                cameras_kept=kept,
                rounds=settings.most_rounds,
            )

        if denoiser_name is not None:
            denoiser: Denoiser = chosen_denoiser(denoiser_name, weights)
        else:
            denoiser = round_denoiser(weights)
        with warning_messages(), closing(FollowedRun(out)) as followed:
            capture, _ = capture_to_fit(
                path,
                out,
                holdout,
                CameraFinder(estimator, network, graph, matcher, frames, settings.seed),
                max_size=max_size,
                allow_missing=allow_missing,
                resume=resume,
                shown=not as_json,
                announced=None if as_json else announced,
                followed=followed,
            )
        if photo_count is not None:
            capture = _some_photos(capture, photo_count)
        with progress_bar("refine", shown=not as_json) as show, warning_messages():
            refined = refine(
                capture,
                progress=lambda now: show(bar_state(now)),
                denoiser=denoiser,
                out=out,
                resume=resume,
                **vars(settings),
            )
        with warning_messages():
            has_page = html and write_page(out, refined.models(), refined.capture)
    if as_json:
        print_json(_summary(refined, out))
    else:
        _print_summary(refined, out, [PAGE] if has_page else [])


def _check_photo_count(photos: Path, holdout: int | None, frames: int, count: int) -> None:
    """Find a --photos that a path cannot have, before photos are decoded or cameras looked for.

    Raises:
        IgsrError: there are fewer train photos, even if the cameras of all are found.
    """
    from igsr.capture.load import look_at

    _check_count(count, look_at(photos, frames).train_photos(holdout), photos)


def _some_photos(capture: Capture, count: int) -> Capture:
    """The capture with ``count`` of its train views, evenly spaced, and its test views."""
    from igsr.capture import Capture

    train = capture.train_views
    _check_count(count, len(train), capture.path)
    ids = [(2 * k + 1) * len(train) // (2 * count) for k in range(count)]
    return Capture(capture.path, [train[i] for i in ids] + capture.test_views, capture.points)


def _check_count(count: int, most: int, path: Path) -> None:
    if not 1 <= count <= most:
        raise IgsrError(
            f"--photos must be from 1 to {most}, the train photos of {path}, not {count}."
        )


def _report(out: Path) -> dict[str, Any]:
    """The report that the refinement has just written."""
    report: dict[str, Any] = json.loads((out / "report.json").read_text(encoding="utf-8"))
    return report


def _summary(refined: Refined, out: Path) -> dict[str, Any]:
    """What --json prints."""
    report = _report(out)
    assert refined.stop is not None
    accepted = [done for done in refined.rounds if done.accepted]
    tests = [refined.first_test, *(done.test for done in accepted)]
    return {
        "accepted": len(accepted),
        "tried": len(refined.rounds),
        "stop_reason": refined.stop.reason.value,
        "stopped": str(refined.stop),
        "test": tests if refined.first_test else None,
        "splats": len(refined.splats),
        "train": report["train"],
        "limit": report["limit"],
        "seconds": {stage: round(seconds, 2) for stage, seconds in refined.seconds.items()},
        "parts": report["parts"],
        "peak_memory_bytes": report["peak_memory_bytes"],
        "out": str(out),
    }


def _print_summary(refined: Refined, out: Path, pages: list[str]) -> None:
    accepted = [done for done in refined.rounds if done.accepted]
    console = output_console()
    console.print(
        f"{len(accepted)} of {len(refined.rounds)} rounds accepted; stopped: {refined.stop}",
        markup=False,
    )
    for number, done in enumerate(refined.rounds, 1):
        if done.gain is not None:
            console.print(f"Round {number}: {done.verdict}", markup=False)
    if refined.first_test:
        tests = [refined.first_test, *(done.test for done in accepted)]
        by_round = " -> ".join(f"{scores['psnr']:.2f}" for scores in tests if scores)
        console.print(f"PSNR of the test views by round: {by_round} dB")
    report = _report(out)
    console.print(fitted_line(report["train"]))
    console.print(report["limit"]["sentence"])
    console.print(parts_line(report["parts"]), style="dim")
    names = ["scene.ply", *pages, "report.html", "report.json", "views.png"]
    console.print("  ".join(str(out / file) for file in names), style="dim", markup=False)
