"""``python -m igsr_lab study``: experiments of the literature and of ``docs/``.

A subcommand has the options of its study; those that are not given have the defaults of the
function in ``igsr_lab.study``.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from igsr.cli.error_messages import error_messages
from igsr.cli.options import FitBackendOption, JsonOption, option, resolved
from igsr.cli.output import error_console, print_json
from igsr.errors import IgsrError
from igsr_lab.commands.options import JobsOption, RayOption, TimeLeft

app = typer.Typer(
    help="Run the experiments of the literature and of docs/: the same photos, seeds and scores "
    "for every method.\n\nFinished runs are kept in --out; the same command continues from there.",
    no_args_is_help=True,
)

Row = dict[str, Any]

PRESET_HELP = "default, 3dgs or instantsplat"


def _names(flag: str, metavar: str, help: str) -> Any:
    """A repeatable option of names."""
    return Annotated[list[str] | None, option(flag, metavar=metavar, help=help)]


def _number(flag: str, help: str) -> Any:
    return Annotated[int | None, option(flag, metavar="N", help=help)]


def _file(flag: str, help: str, metavar: str = "FILE") -> Any:
    return Annotated[Path | None, option(flag, metavar=metavar, help=help)]


#: Options of studies by the name of the argument.
OPTIONS: dict[str, Any] = {
    "scenes": _names(
        "--scene", "NAME", "Folder in DATA; repeatable. Default: the scenes in docs/."
    ),
    "view_ids": _names(
        "--views",
        "75|76",
        "List of view ids, named after the one in which published code differs; repeatable. "
        "Default: both.",
    ),
    "counts": _names("--views", "N", "Number of photos; repeatable."),
    "counts_or_all": _names(
        "--views", "N|all", "Number of fitted photos; repeatable. Default: 3 and 6."
    ),
    "presets": _names("--preset", "NAME", f"{PRESET_HELP}; repeatable. Default: all."),
    "methods": _names(
        "--method",
        "NAME",
        "Refinement: ours, no-denoiser, no-trust, no-selection, no-outward, improvement, absolute "
        "or absolute-before; repeatable.",
    ),
    "kinds": _names(
        "--kind",
        "KIND",
        "Degraded fits: from 3, 6 or 9 photos, noise, or paper (its noise and steps); repeatable. "
        "Default: the first four.",
    ),
    "denoisers": _names("--denoiser", "NAME=FILE", "Another denoiser to compare; repeatable."),
    "preset": Annotated[
        str | None, option("--preset", metavar="NAME", help=f"{PRESET_HELP}. Default: default.")
    ],
    "compare": Annotated[
        str | None,
        option("--compare", metavar="NAME", help="Baseline preset; also reports differences."),
    ],
    "estimator": Annotated[
        str | None, option("--estimator", metavar="NAME", help="Camera estimator. Default: colmap.")
    ],
    "noise": Annotated[
        float | None,
        option("--noise", help="Standard deviation of camera-to-world's entries. Default: 0.01."),
    ],
    "raw_affine": Annotated[
        bool, option("--raw-affine", help="Also fit with noise whose shear is kept.")
    ],
    "holdout": _number("--holdout", "Hold out every Nth photo. Default: 8."),
    "steps": _number("--steps", "Steps of each fit. Default: the preset's."),
    "max_size": _number("--max-size", "Maximum side of photos, pixels. Default: as in fits."),
    "score_size": _number(
        "--score-size", "Maximum side of scored photos, pixels. Default: --max-size, or 1600."
    ),
    "known_cameras": Annotated[
        bool, option("--known-cameras", help="Use the cameras of scenes that have some.")
    ],
    "left_half": Annotated[
        bool,
        option(
            "--left-half",
            help="Also score right halves of held-out photos, with the exposure found on their "
            "left halves.",
        ),
    ],
    "weights": _file("--weights", "Denoiser weights. Default: igsr's."),
    "features": _file(
        "--features", "SqueezeNet 1.0 arrays (.npz), to score a perceptual distance (not LPIPS)."
    ),
    "lpips": Annotated[
        str | None,
        option(
            "--lpips",
            metavar="alex|vgg|squeeze",
            help="Also score LPIPS v0.1 with this backbone, which is downloaded.",
        ),
    ],
    "pairs": _file("--pairs", "Training pairs, to compare their artifacts with.", "PAIRS"),
}
#: Names in ``OPTIONS`` of arguments whose options differ between studies.
ARGUMENTS = {"view_ids": "views", "counts": "views", "counts_or_all": "views"}
REFINEMENT = ("weights", "steps", "features")


def _add(
    name: str,
    help: str,
    line: Callable[[Row], str],
    *options: str,
    seeds: int = 3,
    backend: bool = True,
    ray: bool = True,
) -> None:
    """Add a subcommand that runs the study ``name`` and prints ``line`` after each run.

    ``backend`` is whether the study fits, ``ray`` whether its runs may be on other machines, which
    do not measure time and memory.
    """
    kind = inspect.Parameter.KEYWORD_ONLY
    parameters = [
        inspect.Parameter(
            "data",
            kind,
            annotation=Annotated[
                Path, typer.Argument(metavar="DATA", help="Folder with the scenes.")
            ],
        ),
        inspect.Parameter(
            "out",
            kind,
            annotation=Annotated[
                Path, option("--out", help="Folder for study.json, study.md, study.png and runs/.")
            ],
        ),
    ]
    shared: list[tuple[str, Any, Any]] = [
        ("seeds", Annotated[int, option("--seeds", help="Number of seeds, from 0.")], seeds),
        *([("backend", FitBackendOption, "auto")] if backend else []),
        ("jobs", JobsOption, 1),
        *([("ray", RayOption, False)] if ray else []),
        ("as_json", JsonOption, False),
    ]
    own = [(ARGUMENTS.get(one, one), OPTIONS[one], None) for one in ("scenes", *options)]
    parameters += [
        inspect.Parameter(argument, kind, annotation=annotation, default=default)
        for argument, annotation, default in [*own, *shared]
    ]

    def command(**given: Any) -> None:
        _run(name, line, **given)

    command.__doc__ = help
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {one.name: one.annotation for one in parameters}
    app.command(name.replace("_", "-"))(command)


def _run(
    name: str,
    line: Callable[[Row], str],
    *,
    data: Path,
    out: Path,
    seeds: int,
    jobs: int,
    as_json: bool,
    backend: str = "cpu",
    ray: bool = False,
    denoisers: list[str] | None = None,
    **options: Any,
) -> None:
    """Run a function of ``igsr_lab.study`` with the given options, and print its table."""
    from igsr_lab import study

    with error_messages(
        lambda: "Interrupted; finished runs are kept, the same command continues from there."
    ):
        console = error_console()
        time_left = TimeLeft()

        def on_run(done: int, total: int, row: Row) -> None:
            nonlocal time_left
            text = f"{done} of {total}: {line(row)}"
            if "failed" in row:  # cameras, whose time says nothing about fits
                time_left = TimeLeft()
            else:
                text += f"; {time_left(done, total)}"
            console.print(text)

        given = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in options.items()
            if value is not None
        }
        if denoisers is not None:
            given["denoisers"] = _files_by_name(denoisers)
        settings = study.Study(data, out, seeds, resolved(backend), jobs, on_run, ray)
        report = getattr(study, name)(settings, **given)
    if as_json:
        print_json(report)
        return
    typer.echo((out / "study.md").read_text(encoding="utf-8"))


def _files_by_name(given: list[str]) -> dict[str, Path]:
    """NAME=FILE options as a dictionary."""
    files: dict[str, Path] = {}
    for text in given:
        name, _, file = text.partition("=")
        if not name or not file or name in files:
            raise IgsrError(f"--denoiser must be NAME=FILE, each name once, not {text!r}.")
        files[name] = Path(file)
    return files


def _fit_line(row: Row) -> str:
    return (
        f"{row['scene']} views {row['views']} {row['preset']} seed {row['seed']}: "
        f"{row['psnr']:.2f} dB in {row['seconds']:.0f} s"
    )


def _pose_noise_line(row: Row) -> str:
    return (
        f"{row['scene']} {row['noise']}, poses {row['poses']} seed {row['seed']}: "
        f"{row['refined']['psnr']:.2f} dB in {row['seconds']:.0f} s"
    )


def _poses_line(row: Row) -> str:
    return (
        f"{row['scene']} seed {row['seed']}: {row['registered']} of {row['photos']} registered in "
        f"{row['seconds']:.0f} s"
    )


def _depths_line(row: Row) -> str:
    right = "no depth" if row["right"] is None else f"{100 * row['right']:.1f} % right"
    return f"{row['scene']}: {right} in {row['seconds']:.0f} s"


def _own_photos_line(row: Row) -> str:
    seconds = sum(part["seconds"] for part in row["parts"].values())
    if "failed" in row:  # cameras
        result = row["failed"] or f"{row['placed']} of {row['photos']} photos placed"
        return f"{row['scene']}: {result} in {seconds:.0f} s"
    return (
        f"{row['scene']} {row['preset']} seed {row['seed']}: {row['psnr']:.2f} dB held out, "
        f"{row['train_psnr']:.2f} dB fitted, {row['splats']} splats in {seconds:.0f} s"
    )


def _denoiser_line(row: Row) -> str:
    return (
        f"{row['scene']} {row['kind']} seed {row['seed']}: {row['renders']} renders in "
        f"{row['seconds']:.0f} s"
    )


def _rounds_line(row: Row) -> str:
    rounds = {name: method["rounds"] for name, method in row["methods"].items()}
    first = next(iter(rounds.values()))[0]["psnr"]
    last = ", ".join(f"{name} {of_method[-1]['psnr']:.2f}" for name, of_method in rounds.items())
    return (
        f"{row['scene']} {row['layout']} {row['photos']} seed {row['seed']}: {first:.2f} dB, "
        f"then {last}"
    )


_add(
    "blender8",
    "Fit NeRF Synthetic from eight photos.",
    _fit_line,
    *("view_ids", "presets", "lpips"),
)
_add(
    "few_photos",
    "Fit real captures from 3, 6 and 9 photos, or 3, 6 and 12 of the tankard.",
    _fit_line,
    *("counts", "presets", "lpips"),
)
_add(
    "pose_noise",
    "Fit 20 views of NeRF Synthetic with noise on their poses, fixed or fitted jointly.",
    _pose_noise_line,
    *("noise", "raw_affine"),
)
_add(
    "poses",
    "Compare the cameras found in photos with the true ones.",
    _poses_line,
    "estimator",
    seeds=1,
    backend=False,
)
_add(
    "depths",
    "Compare depth maps by stereo with the true ones of synthetic captures.",
    _depths_line,
    backend=False,
    ray=False,
)
_add(
    "own_photos",
    "Run folders of plain photos: cameras, fit, held-out scores, seconds and memory.",
    _own_photos_line,
    *("preset", "compare", "holdout", "steps", "max_size", "score_size", "known_cameras"),
    *("features", "left_half"),
    ray=False,
)
_add(
    "denoiser_table",
    "Score renders of degraded reconstructions before and after denoising.",
    _denoiser_line,
    *("kinds", "denoisers", "features", "pairs"),
    seeds=1,
)
_add(
    "table2",
    "Refine from 10 photos, localized and scattered, as the paper's Table 2.",
    _rounds_line,
    *("methods", *REFINEMENT),
)
_add(
    "table3",
    "Refine from 4 localized photos of a real object, as the paper's Table 3.",
    _rounds_line,
    *("methods", *REFINEMENT),
)
_add(
    "sweep",
    "Refine from 4 to 15 photos with 1, 2 and 4 views a round, up to four rounds.",
    _rounds_line,
    *("counts", *REFINEMENT),
    seeds=1,
)
_add(
    "photographs",
    "Refine real captures from few photos by two rounds, and report the paired gain.",
    _rounds_line,
    *("counts_or_all", "max_size", *REFINEMENT),
)
_add(
    "refinement_ablation",
    "Refine by one round, with one part of the refinement left out at a time.",
    _rounds_line,
    *("methods", *REFINEMENT),
    seeds=1,
)
