"""``igsr refine``: fit photos, and improve the fit with denoised novel views."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from igsr._internal.input_files import read_json
from igsr._internal.progress_bar import progress_bar
from igsr.cli.denoiser_option import DenoiserOption, chosen_denoiser
from igsr.cli.error_messages import error_messages
from igsr.cli.options import (
    FIT,
    AllowMissingOption,
    CheckpointOption,
    EstimatorOption,
    ExampleOption,
    ExposureOption,
    FitBackendOption,
    FitSizeOption,
    HoldoutOption,
    JsonOption,
    MatcherOption,
    PhotosArgument,
    QualityOption,
    ResumeOption,
    SeedOption,
    TransientsOption,
    estimator_options,
    option,
    photos_or_example,
)
from igsr.cli.output import fitted_line, output_console, parts_line, print_files, print_json

if TYPE_CHECKING:
    from igsr.refinement import Refined


def refine_command(
    photos: PhotosArgument = None,
    *,
    out: Annotated[Path, option("--out", help="Folder for the scene and its report.")],
    example: ExampleOption = False,
    rounds: Annotated[
        str,
        option(
            "--rounds",
            metavar="auto|N",
            help="Number of rounds; auto: 1, or 1 to 4 for photos with alpha.",
        ),
    ] = "auto",
    quality: QualityOption = "normal",
    max_size: FitSizeOption = None,
    holdout: HoldoutOption = None,
    backend: FitBackendOption = "auto",
    exposure: ExposureOption = "off",
    resume: ResumeOption = False,
    as_json: JsonOption = False,
    estimator: EstimatorOption = "auto",
    checkpoint: CheckpointOption = None,
    matcher: MatcherOption = None,
    allow_missing: AllowMissingOption = False,
    steps: Annotated[
        int | None, option("--steps", metavar="N", help="Optimizer steps of each fit.", panel=FIT)
    ] = None,
    transients: TransientsOption = "auto",
    denoiser: DenoiserOption = None,
    seed: SeedOption = 0,
) -> None:
    """Fit few PHOTOS; add denoised novel views and refit."""
    with error_messages(lambda: f"Interrupted; the same command with --resume continues in {out}."):
        from igsr.refinement import refine, round_denoiser

        # Before the example is written: it may need torch, or not exist.
        chosen = chosen_denoiser(denoiser, round_denoiser)
        path = photos_or_example(photos, example, out)
        with progress_bar(shown=not as_json) as show:
            refined = refine(
                path,
                rounds,
                out=out,
                steps=steps,
                quality=quality,
                exposure=exposure,
                transients=transients,
                denoiser=chosen,
                seed=seed,
                backend=backend,
                holdout=holdout,
                max_size=max_size,
                estimator=estimator,
                estimator_options=estimator_options(checkpoint, matcher),
                allow_missing=allow_missing,
                resume=resume,
                progress=show,
            )
    report = read_json(out / "report.json")
    if as_json:
        print_json(_summary(refined, report, out))
    else:
        _print_summary(refined, report, out)


def _summary(refined: Refined, report: dict[str, Any], out: Path) -> dict[str, Any]:
    """The object that --json prints."""
    assert refined.stop is not None
    return {
        "rounds": len(refined.rounds),
        "stop_reason": refined.stop.reason.value,
        "stopped": str(refined.stop),
        "test": _tests(refined) or None,
        "splats": len(refined.splats),
        "train": report["train"],
        "limit": report["limit"],
        "seconds": report["seconds"],
        "photos": report["photos"],
        "parts": report["parts"],
        "peak_memory_bytes": report["peak_memory_bytes"],
        "out": str(out),
    }


def _tests(refined: Refined) -> list[dict[str, float | None]]:
    """Scores of held-out photos after the first fit and after each round."""
    tests = [refined.first_test, *(done.test for done in refined.rounds)]
    return [test for test in tests if test]


def _print_summary(refined: Refined, report: dict[str, Any], out: Path) -> None:
    console = output_console()
    console.print(f"Rounds: {len(refined.rounds)}; stopped: {refined.stop}")
    by_round = " -> ".join(f"{test['psnr']:.2f}" for test in _tests(refined))
    if by_round:
        console.print(f"PSNR of held-out photos by round: {by_round} dB")
    console.print(fitted_line(report["train"]))
    console.print(report["limit"]["sentence"])
    console.print(parts_line(report["parts"]), style="dim")
    print_files(out, ["scene.ply", "scene.html", "report.html", "report.json", "views.png"])
