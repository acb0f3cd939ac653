"""``python -m igsr_lab study``: experiments of the literature and of ``docs/``, a subcommand each.

Every subcommand has the options of its own experiment only. Where an option is not given, the
default is that of the function in ``igsr_lab.study``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from igsr.cli.error_messages import error_messages
from igsr.cli.shared import (
    FitBackendChoice,
    FitBackendOption,
    JsonOption,
    PresetChoice,
    error_console,
    output_console,
    print_json,
    resolved,
)
from igsr.errors import IgsrError
from igsr_lab.commands.options import JobsOption, RayOption, TimeLeft

app = typer.Typer(
    help="Run the experiments of the literature and of docs/: the same photos, seeds and scores "
    "for every method.\n\nFinished runs are kept in --out; the same command continues from there.",
    no_args_is_help=True,
)

DataArgument = Annotated[Path, typer.Argument(metavar="DATA", help="Folder with the scenes.")]
OutOption = Annotated[
    Path, typer.Option("--out", help="Folder for study.json, study.md, study.png and runs/.")
]
ScenesOption = Annotated[
    list[str] | None,
    typer.Option(
        "--scene",
        metavar="NAME",
        help="A folder in DATA. Repeat it for several. Default: the scenes in docs/.",
    ),
]
PresetsOption = Annotated[
    list[PresetChoice] | None,
    typer.Option("--preset", help="Repeat it for several. Default: all."),
]
MethodsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--method",
        metavar="NAME",
        help="What continues from a fit. Repeat it for several: ours, no-denoiser, no-trust, "
        "no-selection, no-outward, improvement, absolute or absolute-before.",
    ),
]
SweptPhotosOption = Annotated[
    list[str] | None,
    typer.Option("--views", metavar="N", help="Number of photos. Repeat it for several."),
]
PhotographsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--views",
        metavar="N",
        help="Number of photos that are fitted, or all. Repeat it for several. Default: 3 and 6.",
    ),
]
PhotographsSizeOption = Annotated[
    int | None,
    typer.Option(
        "--max-size", metavar="N", help="Longest side of the photos, pixels. Default: a fit's."
    ),
]
WeightsOption = Annotated[
    Path | None,
    typer.Option("--weights", metavar="FILE", help="Weights of a denoiser. Default: igsr's."),
]
StepsOption = Annotated[
    int | None, typer.Option("--steps", help="Steps of each fit. Default: the preset's.")
]
FeaturesOption = Annotated[
    Path | None,
    typer.Option(
        "--features",
        metavar="FILE",
        help="SqueezeNet 1.0's arrays (.npz), to score a perceptual distance (which is not LPIPS).",
    ),
]
SeedsOption = Annotated[
    int | None, typer.Option("--seeds", help="Number of seeds, from 0. Default: 3.")
]
OneSeedOption = Annotated[
    int | None, typer.Option("--seeds", help="Number of seeds, from 0. Default: 1.")
]


@app.command("blender8")
def blender8_command(
    data: DataArgument,
    out: OutOption,
    scenes: ScenesOption = None,
    views: Annotated[
        list[str] | None,
        typer.Option(
            "--views",
            metavar="75|76",
            help="The list of view ids, named after the one id in which published code differs. "
            "Repeat it for both. Default: both.",
        ),
    ] = None,
    presets: PresetsOption = None,
    seeds: SeedsOption = None,
    backend: FitBackendOption = FitBackendChoice.auto,
    jobs: JobsOption = 1,
    ray: RayOption = False,
    as_json: JsonOption = False,
) -> None:
    """Fit NeRF Synthetic from eight photos."""
    _run(
        "blender8", _fit_line, data, out, jobs, ray, as_json,
        scenes=scenes, views=views, presets=presets, seeds=seeds, backend=backend,
    )  # fmt: skip


@app.command("few-photos")
def few_photos_command(
    data: DataArgument,
    out: OutOption,
    scenes: ScenesOption = None,
    views: SweptPhotosOption = None,
    presets: PresetsOption = None,
    seeds: SeedsOption = None,
    backend: FitBackendOption = FitBackendChoice.auto,
    jobs: JobsOption = 1,
    ray: RayOption = False,
    as_json: JsonOption = False,
) -> None:
    """Fit real captures from 3, 6 and 9 photos, or 3, 6 and 12 of the tankard."""
    _run(
        "few_photos", _fit_line, data, out, jobs, ray, as_json,
        scenes=scenes, views=views, presets=presets, seeds=seeds, backend=backend,
    )  # fmt: skip


@app.command("pose-noise")
def pose_noise_command(
    data: DataArgument,
    out: OutOption,
    scenes: ScenesOption = None,
    noise: Annotated[
        float | None,
        typer.Option(
            "--noise",
            help="Standard deviation of the noise on the entries of camera-to-world. Default: "
            "0.01.",
        ),
    ] = None,
    raw_affine: Annotated[
        bool, typer.Option("--raw-affine", help="Also keep the shear that the noise brings.")
    ] = False,
    seeds: SeedsOption = None,
    backend: FitBackendOption = FitBackendChoice.auto,
    jobs: JobsOption = 1,
    ray: RayOption = False,
    as_json: JsonOption = False,
) -> None:
    """Fit 20 views of NeRF Synthetic with noise on their poses, fixed or fitted jointly."""
    _run(
        "pose_noise", _pose_noise_line, data, out, jobs, ray, as_json,
        scenes=scenes, noise=noise, raw_affine=raw_affine, seeds=seeds, backend=backend,
    )  # fmt: skip


@app.command("poses")
def poses_command(
    data: DataArgument,
    out: OutOption,
    scenes: ScenesOption = None,
    estimator: Annotated[
        str | None,
        typer.Option("--estimator", metavar="NAME", help="What finds cameras. Default: colmap."),
    ] = None,
    seeds: OneSeedOption = None,
    jobs: JobsOption = 1,
    ray: RayOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compare the cameras found in photos with the true ones."""
    _run(
        "poses", _poses_line, data, out, jobs, ray, as_json,
        scenes=scenes, estimator=estimator, seeds=seeds,
    )  # fmt: skip


@app.command("own-photos")
def own_photos_command(
    data: Annotated[
        Path,
        typer.Argument(metavar="DATA", help="A folder of photos, or a folder of such folders."),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            help="Folder for study.json, study.md, study.png, sheets/, splats/, cameras/, runs/.",
        ),
    ],
    scenes: Annotated[
        list[str] | None,
        typer.Option(
            "--scene",
            metavar="NAME",
            help="A folder of photos in DATA. Repeat it for several. Default: all.",
        ),
    ] = None,
    preset: Annotated[
        str, typer.Option("--preset", metavar="PRESET", help="Settings of the fits.")
    ] = "default",
    compare: Annotated[
        str | None,
        typer.Option(
            "--compare",
            metavar="PRESET",
            help="Fit with these settings, too, and tell the differences to them.",
        ),
    ] = None,
    seeds: SeedsOption = None,
    holdout: Annotated[
        int | None,
        typer.Option("--holdout", metavar="N", help="Hold out every Nth photo. Default: 8."),
    ] = None,
    steps: StepsOption = None,
    max_size: Annotated[
        int | None,
        typer.Option(
            "--max-size", metavar="N", help="Longest side of the photos that are fitted, pixels."
        ),
    ] = None,
    score_size: Annotated[
        int | None,
        typer.Option(
            "--score-size",
            metavar="N",
            help="Longest side of the scored photos, pixels. Default: --max-size, or 1600.",
        ),
    ] = None,
    known_cameras: Annotated[
        bool,
        typer.Option("--known-cameras", help="Use cameras that lie beside the photos."),
    ] = False,
    features: FeaturesOption = None,
    left_half: Annotated[
        bool,
        typer.Option(
            "--left-half",
            help="Score the right halves of held-out photos, too, with the exposure that is found "
            "on their left halves.",
        ),
    ] = False,
    backend: FitBackendOption = FitBackendChoice.auto,
    jobs: JobsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Run folders of plain photos end to end: cameras, fit, held-out scores, seconds and memory."""
    _run(
        "own_photos", _own_photos_line, data, out, jobs, None, as_json,
        scenes=scenes, preset=preset, compare=compare, seeds=seeds, holdout=holdout, steps=steps,
        max_size=max_size, score_size=score_size, known_cameras=known_cameras, features=features,
        left_half=left_half, backend=backend,
    )  # fmt: skip


@app.command("denoiser-table")
def denoiser_table_command(
    data: DataArgument,
    out: OutOption,
    scenes: ScenesOption = None,
    kinds: Annotated[
        list[str] | None,
        typer.Option(
            "--kind",
            metavar="KIND",
            help="Degraded reconstructions: from 3, 6 or 9 photos, noise, or paper (its noise and "
            "steps). Repeat it for several. Default: the first four.",
        ),
    ] = None,
    denoisers: Annotated[
        list[str] | None,
        typer.Option(
            "--denoiser",
            metavar="NAME=FILE",
            help="Another denoiser to compare with igsr's. Repeat it for several.",
        ),
    ] = None,
    features: FeaturesOption = None,
    pairs: Annotated[
        Path | None,
        typer.Option(
            "--pairs", metavar="PAIRS", help="Training pairs, to compare their artifacts with."
        ),
    ] = None,
    seeds: OneSeedOption = None,
    backend: FitBackendOption = FitBackendChoice.auto,
    jobs: JobsOption = 1,
    ray: RayOption = False,
    as_json: JsonOption = False,
) -> None:
    """Score renders of degraded reconstructions before and after denoising."""
    with error_messages():
        files = None if denoisers is None else _files_by_name(denoisers)
    _run(
        "denoiser_table", _denoiser_line, data, out, jobs, ray, as_json,
        scenes=scenes, kinds=kinds, denoisers=files, features=features, pairs=pairs, seeds=seeds,
        backend=backend,
    )  # fmt: skip


@app.command("table2")
def table2_command(
    data: DataArgument,
    out: OutOption,
    scenes: ScenesOption = None,
    methods: MethodsOption = None,
    weights: WeightsOption = None,
    steps: StepsOption = None,
    features: FeaturesOption = None,
    seeds: SeedsOption = None,
    backend: FitBackendOption = FitBackendChoice.auto,
    jobs: JobsOption = 1,
    ray: RayOption = False,
    as_json: JsonOption = False,
) -> None:
    """Refine from 10 photos, localized and scattered, beside the paper's Table 2."""
    _run(
        "table2", _rounds_line, data, out, jobs, ray, as_json,
        scenes=scenes, methods=methods, weights=weights, steps=steps, features=features,
        seeds=seeds, backend=backend,
    )  # fmt: skip


@app.command("table3")
def table3_command(
    data: DataArgument,
    out: OutOption,
    scenes: ScenesOption = None,
    methods: MethodsOption = None,
    weights: WeightsOption = None,
    steps: StepsOption = None,
    features: FeaturesOption = None,
    seeds: SeedsOption = None,
    backend: FitBackendOption = FitBackendChoice.auto,
    jobs: JobsOption = 1,
    ray: RayOption = False,
    as_json: JsonOption = False,
) -> None:
    """Refine from 4 localized photos of a real object, beside the paper's Table 3."""
    _run(
        "table3", _rounds_line, data, out, jobs, ray, as_json,
        scenes=scenes, methods=methods, weights=weights, steps=steps, features=features,
        seeds=seeds, backend=backend,
    )  # fmt: skip


@app.command("sweep")
def sweep_command(
    data: DataArgument,
    out: OutOption,
    scenes: ScenesOption = None,
    views: SweptPhotosOption = None,
    weights: WeightsOption = None,
    steps: StepsOption = None,
    features: FeaturesOption = None,
    seeds: OneSeedOption = None,
    backend: FitBackendOption = FitBackendChoice.auto,
    jobs: JobsOption = 1,
    ray: RayOption = False,
    as_json: JsonOption = False,
) -> None:
    """Refine from 4 to 15 photos with 1, 2 and 4 views a round, up to four rounds."""
    _run(
        "sweep", _rounds_line, data, out, jobs, ray, as_json,
        scenes=scenes, views=views, weights=weights, steps=steps, features=features,
        seeds=seeds, backend=backend,
    )  # fmt: skip


@app.command("photographs")
def photographs_command(
    data: DataArgument,
    out: OutOption,
    scenes: ScenesOption = None,
    views: PhotographsOption = None,
    max_size: PhotographsSizeOption = None,
    weights: WeightsOption = None,
    steps: StepsOption = None,
    features: FeaturesOption = None,
    seeds: SeedsOption = None,
    backend: FitBackendOption = FitBackendChoice.auto,
    jobs: JobsOption = 1,
    ray: RayOption = False,
    as_json: JsonOption = False,
) -> None:
    """Refine by two rounds from few photos of real captures, and tell the paired gain."""
    _run(
        "photographs", _rounds_line, data, out, jobs, ray, as_json,
        scenes=scenes, views=views, max_size=max_size, weights=weights, steps=steps,
        features=features, seeds=seeds, backend=backend,
    )  # fmt: skip


@app.command("refinement-ablation")
def refinement_ablation_command(
    data: DataArgument,
    out: OutOption,
    scenes: ScenesOption = None,
    methods: MethodsOption = None,
    weights: WeightsOption = None,
    steps: StepsOption = None,
    features: FeaturesOption = None,
    seeds: OneSeedOption = None,
    backend: FitBackendOption = FitBackendChoice.auto,
    jobs: JobsOption = 1,
    ray: RayOption = False,
    as_json: JsonOption = False,
) -> None:
    """Refine by one round, with one part of the loop taken out at a time."""
    _run(
        "refinement_ablation", _rounds_line, data, out, jobs, ray, as_json,
        scenes=scenes, methods=methods, weights=weights, steps=steps, features=features,
        seeds=seeds, backend=backend,
    )  # fmt: skip


def _run(
    name: str,
    line: Callable[[dict[str, Any]], str],
    data: Path,
    out: Path,
    jobs: int,
    ray: bool | None,
    as_json: bool,
    **options: Any,
) -> None:
    """Run a function of ``igsr_lab.study`` with the options that were given, and print its table.

    ``ray`` is None for one that measures time and memory, and so stays on this machine.
    """
    from igsr_lab import study

    with error_messages(
        lambda: "Interrupted; finished runs are kept, the same command continues from there."
    ):
        console = error_console()
        time_left = TimeLeft()

        def on_run(done: int, total: int, row: dict[str, Any]) -> None:
            nonlocal time_left
            text = f"{done} of {total}: {line(row)}"
            if "failed" in row:  # a scene's cameras, which say nothing of how long fits take
                time_left = TimeLeft()
            else:
                text += f"; {time_left(done, total)}"
            console.print(text, markup=False)

        given = {name: _plain(value) for name, value in options.items() if value is not None}
        if ray is not None:
            given["ray"] = ray
        report = getattr(study, name)(data, out, **given, jobs=jobs, on_run=on_run)
    if as_json:
        print_json(report)
        return
    output_console().print((out / "study.md").read_text(encoding="utf-8"), markup=False)


def _plain(value: Any) -> Any:
    """An option's value as the functions of ``igsr_lab.study`` take it."""
    if isinstance(value, FitBackendChoice):
        return resolved(value)
    if isinstance(value, list):
        return tuple(one.value if isinstance(one, PresetChoice) else one for one in value)
    return value


def _fit_line(row: dict[str, Any]) -> str:
    return (
        f"{row['scene']} views {row['views']} {row['preset']} seed {row['seed']}: "
        f"{row['psnr']:.2f} dB in {row['seconds']:.0f} s"
    )


def _own_photos_line(row: dict[str, Any]) -> str:
    if "failed" in row:  # a scene's cameras
        seconds = sum(part["seconds"] for part in row["parts"].values())
        what = row["failed"] or f"{row['placed']} of {row['photos']} photos placed"
        return f"{row['scene']}: {what} in {seconds:.0f} s"
    seconds = sum(part["seconds"] for part in row["parts"].values())
    return (
        f"{row['scene']} {row['preset']} seed {row['seed']}: {row['psnr']:.2f} dB held out, "
        f"{row['train_psnr']:.2f} dB fitted, {row['splats']} splats in {seconds:.0f} s"
    )


def _pose_noise_line(row: dict[str, Any]) -> str:
    return (
        f"{row['scene']} {row['noise']}, poses {row['poses']} seed {row['seed']}: "
        f"{row['refined']['psnr']:.2f} dB in {row['seconds']:.0f} s"
    )


def _poses_line(row: dict[str, Any]) -> str:
    return (
        f"{row['scene']} seed {row['seed']}: {row['registered']} of {row['photos']} registered in "
        f"{row['seconds']:.0f} s"
    )


def _denoiser_line(row: dict[str, Any]) -> str:
    return (
        f"{row['scene']} {row['kind']} seed {row['seed']}: {row['renders']} renders in "
        f"{row['seconds']:.0f} s"
    )


def _rounds_line(row: dict[str, Any]) -> str:
    rounds = {name: method["rounds"] for name, method in row["methods"].items()}
    first = next(iter(rounds.values()))[0]["psnr"]
    last = ", ".join(f"{name} {of_method[-1]['psnr']:.2f}" for name, of_method in rounds.items())
    return (
        f"{row['scene']} {row['layout']} {row['photos']} seed {row['seed']}: {first:.2f} dB, "
        f"then {last}"
    )


def _files_by_name(given: list[str]) -> dict[str, Path]:
    """NAME=FILE options as a dictionary.

    Raises:
        IgsrError: one has another form, or a name is given twice.
    """
    files: dict[str, Path] = {}
    for text in given:
        name, _, file = text.partition("=")
        if not name or not file or name in files:
            raise IgsrError(f"--denoiser must be NAME=FILE, each name once, not {text!r}.")
        files[name] = Path(file)
    return files
