"""``igsr study``: protocols of the literature."""

from __future__ import annotations

import enum
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from igsr.cli.shared import (
    BackendChoice,
    BackendOption,
    JobsOption,
    JsonOption,
    PresetChoice,
    RayOption,
    TimeLeft,
    error_console,
    one_sentence,
    output_console,
    print_json,
    resolved,
)
from igsr.errors import IgsrError


class StudyChoice(str, enum.Enum):
    """Protocols of ``igsr study``."""

    blender8 = "blender8"
    few_photos = "few-photos"
    pose_noise = "pose-noise"
    poses = "poses"
    denoiser_table = "denoiser-table"
    table2 = "table2"
    table3 = "table3"
    sweep = "sweep"
    refinement_ablation = "refinement-ablation"


#: Studies of the loop, whose runs have rounds.
LOOPS = (
    StudyChoice.table2,
    StudyChoice.table3,
    StudyChoice.sweep,
    StudyChoice.refinement_ablation,
)


def study_command(
    protocol: Annotated[
        StudyChoice,
        typer.Argument(
            help="blender8: NeRF Synthetic from eight photos. few-photos: real captures from 3, 6 "
            "and 9 photos, or 3, 6 and 12 of the tankard. pose-noise: 20 views of NeRF Synthetic "
            "with noise on their poses, which are kept or fitted. poses: cameras found in photos "
            "against the true ones. denoiser-table: renders of poor fits before and after. table2, "
            "table3, sweep: rounds of igsr refine beside those of the paper. refinement-ablation: "
            "one round with parts of it taken out."
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
            "dtu_scan24 and tankard; for poses the sets of docs/research/finding-cameras.md; for "
            "denoiser-table all that have cameras; chair, or tankard for table3, and fern too for "
            "refinement-ablation.",
        ),
    ] = None,
    views: Annotated[
        list[str] | None,
        typer.Option(
            "--views",
            help="Repeat it for several. blender8: 75 or 76, the view that codes differ in; "
            "few-photos and sweep: a number of photos. Default: all.",
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
    kinds: Annotated[
        list[str] | None,
        typer.Option(
            "--kind",
            help="denoiser-table: 3, 6, 9 (photos), noise, paper (its noise and steps); repeat "
            "it for several. Default: the first four.",
        ),
    ] = None,
    denoisers: Annotated[
        list[str] | None,
        typer.Option(
            "--denoiser",
            metavar="NAME=FILE",
            help="denoiser-table: a further one beside igsr's; repeat it for several.",
        ),
    ] = None,
    methods: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            help="table2, table3 and refinement-ablation: what goes on from a fit; repeat it for "
            "several. ours, no-denoiser, no-trust, no-selection, no-outward, improvement, absolute "
            "or absolute-before.",
        ),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(
            "--weights", metavar="FILE", help="Studies of the loop: the denoiser. Default: igsr's."
        ),
    ] = None,
    steps: Annotated[
        int | None, typer.Option("--steps", help="Studies of the loop: of each fit.")
    ] = None,
    features: Annotated[
        Path | None,
        typer.Option(
            "--features",
            metavar="FILE",
            help="denoiser-table and studies of the loop: SqueezeNet 1.0's arrays (.npz), to score "
            "a perceptual distance that is not LPIPS.",
        ),
    ] = None,
    pairs: Annotated[
        Path | None,
        typer.Option(
            "--pairs",
            metavar="PAIRS",
            help="denoiser-table: training pairs, to say how alike their errors are.",
        ),
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(
            "--seeds",
            help="Fits of each kind. [3; poses, denoiser-table, sweep, refinement-ablation: 1]",
        ),
    ] = None,
    jobs: JobsOption = 1,
    ray: RayOption = False,
    backend: BackendOption = BackendChoice.auto,
    as_json: JsonOption = False,
) -> None:
    """Run a protocol of the literature: the same photos, seeds and scores for every preset.

    What is finished is kept in --out, and the same command goes on from there.
    """
    from igsr import study

    with one_sentence(
        lambda: "Interrupted; finished fits are kept, the same command goes on from there."
    ):
        console = error_console()
        time_left = TimeLeft()

        def on_run(done: int, total: int, row: dict[str, Any]) -> None:
            left = time_left(done, total)
            if protocol is StudyChoice.poses:
                console.print(
                    f"{done} of {total}: {row['scene']} seed {row['seed']}: {row['registered']} of "
                    f"{row['photos']} placed in {row['seconds']:.0f} s; {left}"
                )
                return
            if protocol in LOOPS:
                last = {
                    name: f"{method['rounds'][-1]['psnr']:.2f}"
                    for name, method in row["methods"].items()
                }
                first = next(iter(row["methods"].values()))["rounds"][0]["psnr"]
                told = ", ".join(f"{name} {psnr}" for name, psnr in last.items())
                console.print(
                    f"{done} of {total}: {row['scene']} {row['layout']} {row['photos']} seed "
                    f"{row['seed']}: {first:.2f} dB, then {told}; {left}"
                )
                return
            if protocol is StudyChoice.denoiser_table:
                console.print(
                    f"{done} of {total}: {row['scene']} {row['kind']} seed {row['seed']}: "
                    f"{row['renders']} renders in {row['seconds']:.0f} s; {left}"
                )
                return
            if protocol is StudyChoice.pose_noise:
                kind = f"{row['noise']}, poses {row['poses']}"
                psnr = row["refined"]["psnr"]
            else:
                kind, psnr = f"views {row['views']} {row['preset']}", row["psnr"]
            console.print(
                f"{done} of {total}: {row['scene']} {kind} seed {row['seed']}: "
                f"{psnr:.2f} dB in {row['seconds']:.0f} s; {left}"
            )

        studies: dict[StudyChoice, Callable[..., dict[str, Any]]] = {
            StudyChoice.blender8: study.blender8,
            StudyChoice.few_photos: study.few_photos,
            StudyChoice.pose_noise: study.pose_noise,
            StudyChoice.poses: study.poses,
            StudyChoice.denoiser_table: study.denoiser_table,
            StudyChoice.table2: study.table2,
            StudyChoice.table3: study.table3,
            StudyChoice.sweep: study.sweep,
            StudyChoice.refinement_ablation: study.refinement_ablation,
        }
        run = studies[protocol]
        given: dict[str, Any] = {
            "scenes": scenes and tuple(scenes),
            "views": views and tuple(views),
            "presets": presets and tuple(choice.value for choice in presets),
            "noise": noise,
            "raw_affine": raw_affine or None,
            "estimator": estimator,
            "kinds": kinds and tuple(kinds),
            "denoisers": denoisers and _files_by_name(denoisers),
            "features": features,
            "pairs": pairs,
            "methods": methods and tuple(methods),
            "weights": weights,
            "steps": steps,
            "seeds": seeds,
            "backend": None if backend is BackendChoice.auto else backend,
        }
        given = {name: value for name, value in given.items() if value is not None}
        foreign = [name for name in given if name not in inspect.signature(run).parameters]
        if foreign:
            singular = ("scenes", "presets", "kinds", "denoisers", "methods")
            option = foreign[0].removesuffix("s") if foreign[0] in singular else foreign[0]
            raise IgsrError(
                f"--{option.replace('_', '-')} says nothing to {protocol.value}; leave it out."
            )
        if "backend" in inspect.signature(run).parameters:
            given["backend"] = resolved(backend)
        report = run(data, out, **given, jobs=jobs, on_run=on_run, ray=ray)
    if as_json:
        print_json(report)
        return
    output_console().print((out / "study.md").read_text(encoding="utf-8"), markup=False)


def _files_by_name(given: list[str]) -> dict[str, Path]:
    """NAME=FILE options as a dictionary.

    Raises:
        IgsrError: one is of another form, or a name is given twice.
    """
    out: dict[str, Path] = {}
    for text in given:
        name, _, file = text.partition("=")
        if not name or not file or name in out:
            raise IgsrError(f"--denoiser must be NAME=FILE, each name once, not {text!r}.")
        out[name] = Path(file)
    return out
