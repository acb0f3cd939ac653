"""``igsr bench``: speed and error of the backends."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

from igsr._internal.atomic_write import check_writable
from igsr._internal.json_file import write_json
from igsr.cli.error_messages import error_messages
from igsr.cli.shared import (
    BackendChoice,
    error_console,
    output_console,
)
from igsr.errors import IgsrError


class WorkloadChoice(str, enum.Enum):
    """What ``igsr bench`` measures."""

    W1 = "W1"
    W2 = "W2"
    W3 = "W3"
    W4 = "W4"


def bench_command(
    backends: Annotated[
        list[BackendChoice] | None,
        typer.Option("--backend", help="Repeat it for several. Default: as auto."),
    ] = None,
    workloads: Annotated[
        list[WorkloadChoice] | None,
        typer.Option("--workload", help="Repeat it for several. Default: all."),
    ] = None,
    garden: Annotated[
        Path | None,
        typer.Option("--garden", metavar="FILE", help="For W2: gsplat's test_garden.npz."),
    ] = None,
    capture: Annotated[
        Path | None,
        typer.Option("--capture", metavar="CAPTURE", help="For W3: photos of 400x400 pixels."),
    ] = None,
    models: Annotated[
        Path | None,
        typer.Option(
            "--models",
            metavar="DIR",
            help="For W3: folder that keeps the fitted models. Default: out/bench.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", help="Random seed of the workloads.")] = 0,
    seconds: Annotated[
        float, typer.Option("--seconds", help="How long each row is repeated, in seconds.")
    ] = 2.0,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="PNG", help="Plot time against error.")
    ] = None,
    json_path: Annotated[
        Path | None,
        typer.Option("--json", metavar="FILE", help="Write the machine and all rows."),
    ] = None,
    accuracy: Annotated[
        Path | None,
        typer.Option(
            "--accuracy",
            metavar="FILE",
            help="Instead of workloads, measure every setting and write a page like "
            "docs/how-it-works/accuracy.md, its plot beside it.",
        ),
    ] = None,
) -> None:
    """Measure speed, and error against the float64 reference, of the backends.

    Workloads: W1 rasterize only; W2 the garden scene, forward and backward; W3 a fit step on a
    capture; W4 how a fit step grows with splats and pixels.
    """
    from igsr import benchmark

    with error_messages():
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
        console = error_console()
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
            write_json(json_path, report)
    benchmark.print_report(output_console(), report)
