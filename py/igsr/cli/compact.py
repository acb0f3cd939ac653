"""``igsr compact``: the smallest scene within a limit on PSNR."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

from igsr._internal.atomic_write import check_writable
from igsr._internal.input_files import read_json
from igsr._internal.json_file import write_json
from igsr._internal.progress_bar import progress_bar
from igsr.cli.error_messages import error_messages, nothing_written
from igsr.cli.options import (
    BackgroundOption,
    FitBackendOption,
    HoldoutOption,
    JsonOption,
    SceneArgument,
    SeedOption,
    background_color,
    load,
    option,
    resolved,
)
from igsr.cli.output import output_console, print_json
from igsr.compaction import DEFAULT_STEPS, compact, write_plot
from igsr.errors import IgsrError
from igsr.splats import Splats


def compact_command(
    scene: SceneArgument,
    max_loss: Annotated[
        str,
        option("--max-loss", metavar="DB", help="PSNR that may be lost, such as 0.1dB."),
    ] = "0.1dB",
    capture_path: Annotated[
        Path | None,
        option(
            "--capture",
            metavar="CAPTURE",
            help="Photos of the scene, to fine-tune on and to measure the loss on held-out ones. "
            "Without it, renders of SCENE are used.",
        ),
    ] = None,
    holdout: HoldoutOption = None,
    psnr: Annotated[
        float | None,
        option(
            "--psnr",
            help="Without --capture: PSNR of SCENE on its photos, from which the loss counts. "
            "Default: that in report.json in SCENE's folder, or 30.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        option(
            "--out",
            metavar="PLY",
            help="Smaller scene; its curve of size and PSNR is written as .json and .png. "
            "Default: SCENE's name with .compact.ply.",
        ),
    ] = None,
    sh_degree: Annotated[
        int | None,
        option(
            "--sh-degree",
            help="Spherical-harmonics degree of the smaller scene. A higher degree needs fewer "
            "splats with more bytes each. Default: SCENE's, or a lower one that loses little.",
        ),
    ] = None,
    steps: Annotated[
        int, option("--steps", help="Fine-tuning steps of each candidate.")
    ] = DEFAULT_STEPS,
    seed: SeedOption = 0,
    background: BackgroundOption = None,
    backend: FitBackendOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Reduce SCENE to the fewest splats that lose at most --max-loss of PSNR."""
    target = scene.with_suffix(".compact.ply") if out is None else out
    with error_messages(nothing_written(target)):
        name = resolved(backend)
        limit = _decibels("--max-loss", max_loss)
        if target.suffix.lower() != ".ply":
            raise IgsrError(f"--out {target} must be a .ply file.")
        splats = Splats.load(scene)
        capture = None
        if capture_path is not None:
            capture = load(capture_path, holdout)
        elif holdout is not None:
            raise IgsrError("--holdout needs photos; give --capture, or leave --holdout out.")
        elif psnr is None:
            psnr = _reported_psnr(scene.parent / "report.json")
        curve, plot = target.with_suffix(".json"), target.with_suffix(".png")
        for path in (target, curve, plot):
            check_writable(path)
        with progress_bar(shown=not as_json) as show:
            compaction = compact(
                splats,
                limit,
                capture,
                psnr=psnr,
                sh_degree=sh_degree,
                steps=steps,
                seed=seed,
                background=background_color(background),
                backend=name,
                progress=show,
            )
        report = {"scene": str(scene), "out": str(target), **compaction.report}
        report["protocol"]["holdout"] = holdout
        compaction.splats.save(target)
        write_json(curve, report)
        write_plot(plot, report)
    if as_json:
        print_json(report)
        return
    whole, result = report["whole"], report["result"]
    console = output_console()
    console.print(
        f"{result['splats']} splats of SH degree {result['sh_degree']}, {result['bytes']} bytes; "
        f"before: {whole['splats']}, {whole['sh_degree']}, {whole['bytes']}"
    )
    console.print(f"loss: {result['loss']:.3f} dB of at most {limit:g}")
    console.print(
        f"measured on {report['protocol']['validation_views']} held-out views, compared with "
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
        raise IgsrError(f"{option} must be above 0 and below 100 dB, such as 0.1dB, not {text!r}.")
    return value


def _reported_psnr(path: Path) -> float | None:
    """PSNR in the report of a fit; None if there is no report."""
    try:
        psnr = read_json(path)["psnr"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return psnr if isinstance(psnr, float) and 0.0 < psnr < 100.0 else None
