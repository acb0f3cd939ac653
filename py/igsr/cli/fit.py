"""``igsr fit``: fit splats to photos."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from igsr._internal.event import Event
from igsr._internal.progress_bar import progress_bar
from igsr.capture.photo_folder import FRAMES
from igsr.cli.error_messages import error_messages
from igsr.cli.options import (
    ADVANCED,
    FIT,
    AllowMissingOption,
    BackgroundOption,
    CheckpointOption,
    EstimatorOption,
    ExampleOption,
    ExposureOption,
    FitBackendOption,
    FitSizeOption,
    FramesOption,
    HoldoutOption,
    JsonOption,
    MatcherOption,
    PhotosArgument,
    QualityOption,
    ResumeOption,
    SeedOption,
    TransientsOption,
    background_color,
    estimator_options,
    option,
    photos_or_example,
)
from igsr.cli.output import (
    fitted_line,
    masked_line,
    output_console,
    parts_line,
    print_files,
    print_json,
    protocol_line,
    removed_line,
    score_line,
)

Start = Literal["auto", "points", "depths", "hull", "rays", "random"]

StepsOption = Annotated[
    int | None, option("--steps", metavar="N", help="Optimizer steps.", panel=FIT)
]
MaxSplatsOption = Annotated[
    int | None,
    option("--max-splats", metavar="N", help="Maximum number of splats.", panel=FIT),
]
PosesOption = Annotated[
    Literal["fixed", "joint"],
    option("--poses", help="joint: also optimize camera poses.", panel=FIT),
]
FocalOption = Annotated[
    Literal["fixed", "shared", "per-camera"],
    option("--focal", help="Focal lengths to optimize.", panel=FIT),
]
KeepFloatersOption = Annotated[
    bool, option("--keep-floaters", help="Do not remove floaters.", panel=FIT)
]
DegreeOption = Annotated[
    int | None,
    option("--sh-degree", metavar="0..4", help="Spherical-harmonics degree.", panel=ADVANCED),
]
DensityOption = Annotated[
    Literal["mcmc", "original", "fixed"] | None,
    option("--density", help="Density control.", panel=ADVANCED),
]
StartOption = Annotated[
    Start,
    option(
        "--start",
        metavar="NAME",
        help="Initialization: auto, points, depths, hull, rays or random.",
        panel=ADVANCED,
    ),
]
BlocksOption = Annotated[
    str | None,
    option(
        "--blocks",
        metavar="auto|N",
        help="Split the scene into N blocks, for scenes larger than memory.",
        panel=ADVANCED,
    ),
]
RayOption = Annotated[
    str | None,
    option("--ray", metavar="ADDRESS", help="Fit blocks on this Ray cluster.", panel=ADVANCED),
]


def fit_command(
    photos: PhotosArgument = None,
    *,
    out: Annotated[Path, option("--out", help="Folder for the scene and its report.")],
    example: ExampleOption = False,
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
    frames: FramesOption = FRAMES,
    allow_missing: AllowMissingOption = False,
    steps: StepsOption = None,
    max_splats: MaxSplatsOption = None,
    poses: PosesOption = "fixed",
    focal: FocalOption = "fixed",
    transients: TransientsOption = "auto",
    keep_floaters: KeepFloatersOption = False,
    sh_degree: DegreeOption = None,
    density: DensityOption = None,
    start: StartOption = "auto",
    background: BackgroundOption = None,
    seed: SeedOption = 0,
    blocks: BlocksOption = None,
    ray: RayOption = None,
) -> None:
    """Fit splats to PHOTOS and score them.

    Estimates the cameras first if the photos have none.
    """
    last_step = 0

    def interrupted() -> str:
        if blocks is not None or ray is not None:
            return "Interrupted; the same command continues."
        if not last_step:
            return "Interrupted before the first step."
        return (
            f"Interrupted at step {last_step}; the checkpoint is saved, the same command with "
            "--resume continues."
        )

    with error_messages(interrupted):
        path = photos_or_example(photos, example, out)
        settings: dict[str, Any] = {
            "quality": quality,
            "steps": steps,
            "max_splats": max_splats,
            "sh_degree": sh_degree,
            "density": density,
            "start": start,
            "poses": poses,
            "focal": focal,
            "exposure": exposure,
            "transients": transients,
            "remove_floaters": not keep_floaters,
            "seed": seed,
        }
        shared: dict[str, Any] = {
            "holdout": holdout,
            "max_size": max_size,
            "backend": backend,
            "background": background_color(background),
        }
        if blocks is not None or ray is not None:
            from igsr.cli.fit_blocks import fit_blocks

            fit_blocks(path, out, blocks or "auto", ray, settings, **shared, as_json=as_json)
            return
        from igsr.fitting import fit

        with progress_bar(shown=not as_json) as show:

            def progress(event: Event) -> None:
                nonlocal last_step
                last_step = int(event.done) if event.stage == "fit" else last_step
                show(event)

            result = fit(
                path,
                out=out,
                estimator=estimator,
                estimator_options=estimator_options(checkpoint, matcher),
                frames=frames,
                allow_missing=allow_missing,
                resume=resume,
                progress=progress,
                **settings,
                **shared,
            )
    assert result.report is not None
    if as_json:
        print_json(result.report)
    else:
        _print_report(result.report, out)


def _print_report(report: dict[str, Any], out: Path) -> None:
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
    names = ["scene.ply", "scene.html", "report.html", "report.json", "views.png", "cameras.json"]
    print_files(out, names)
