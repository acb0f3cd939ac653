"""``python -m igsr_lab bench``: speed and error of the backends."""

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
    """What ``python -m igsr_lab bench`` measures."""

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
    report_path: Annotated[
        Path | None,
        typer.Option(
            "--report",
            metavar="HTML",
            help="Write a page of this computer's GPU (driver, limits, all rows) and a JSON file "
            "beside it: what to attach to a report of a problem.",
        ),
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(
            "--compare",
            metavar="FILE",
            help="Time W1 and W4 in turns with another build: the compiled module "
            "(igsr/_core*.so) of another checkout.",
        ),
    ] = None,
    fail_above: Annotated[
        float | None,
        typer.Option(
            "--fail-above",
            metavar="PERCENT",
            help="With --compare: end with status 1 where this build takes so much longer.",
        ),
    ] = None,
) -> None:
    """Measure speed, and error against the float64 reference, of the backends.

    Workloads: W1 rasterize only; W2 the garden scene, forward and backward; W3 a fit step on a
    capture; W4 how a fit step grows with splats and pixels.
    """
    from igsr_lab import bench as benchmark

    given: dict[str, object]
    with error_messages():
        if seed < 0:
            raise IgsrError(f"--seed must be at least 0, not {seed}.")
        if not 0.0 <= seconds <= 3600.0:
            raise IgsrError(f"--seconds must be from 0 to 3600, not {seconds:g}.")
        names = benchmark.resolved_backends([b.value for b in backends or [BackendChoice.auto]])
        if fail_above is not None and compare is None:
            raise IgsrError("--fail-above compares two builds; give --compare FILE as well.")
        if fail_above is not None and not 0.0 <= fail_above <= 1000.0:
            raise IgsrError(f"--fail-above must be from 0 to 1000, not {fail_above:g}.")
        if compare is not None:
            given = {
                "--accuracy": accuracy,
                "--garden": garden,
                "--capture": capture,
                "--models": models,
                "--plot": plot,
                "--report": report_path,
            }
            for name, value in given.items():
                if value:
                    raise IgsrError(f"--compare runs W1 and W4 only; leave {name} out.")
            if {WorkloadChoice.W2, WorkloadChoice.W3} & set(workloads or ()):
                raise IgsrError("--compare runs W1 and W4 only; leave W2 and W3 out.")
        elif accuracy is not None:
            given = {
                "--workload": workloads,
                "--garden": garden,
                "--capture": capture,
                "--models": models,
                "--report": report_path,
            }
            for name, value in given.items():
                if value:
                    raise IgsrError(f"--accuracy runs no workloads; leave {name} out.")
        pages = [] if report_path is None else [report_path, benchmark.json_beside(report_path)]
        for path in (plot, json_path, accuracy, *pages):
            if path is not None:
                check_writable(path)
        console = error_console()
        chosen = tuple(w.value for w in workloads or WorkloadChoice)
        settings = benchmark.Settings(
            backends=names,
            workloads=chosen,
            garden=garden,
            capture=capture,
            models=models or benchmark.Settings.models,
            seed=seed,
            seconds=seconds,
        )
        with console.status("starting") as status:
            if compare is not None:
                report = benchmark.compare_builds(
                    compare,
                    names,
                    tuple(name for name in chosen if name in ("W1", "W4")),
                    seed,
                    seconds,
                    status.update,
                )
            elif report_path is not None:
                report = benchmark.device_report(settings, status.update)
                benchmark.write_device_report(report_path, report)
            elif accuracy is None:
                report = benchmark.run_benchmark(settings, status.update)
            else:
                implementations = ("reference", *(name for name in names if name != "reference"))
                report = benchmark.measure_accuracy(implementations, seed, seconds, status.update)
                benchmark.write_accuracy(accuracy, report)
        if plot is not None:
            benchmark.plot_speed_vs_error(plot, report)
        if json_path is not None:
            write_json(json_path, report)
    if compare is None:
        benchmark.print_report(output_console(), report)
        return
    benchmark.print_pairs(output_console(), report)
    slower = [] if fail_above is None else benchmark.slower_rows(report["rows"], fail_above)
    for line in slower:
        console.print(line)
    if slower:
        raise typer.Exit(1)
