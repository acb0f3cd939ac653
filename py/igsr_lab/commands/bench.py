"""``python -m igsr_lab bench``: speed and error of the backends."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated, Any

import typer

from igsr._internal.atomic_write import check_writable
from igsr._internal.json_file import write_json
from igsr.cli.error_messages import error_messages
from igsr.cli.options import option
from igsr.cli.output import error_console, output_console
from igsr.errors import IgsrError

GardenOption = Annotated[
    Path | None, option("--garden", metavar="FILE", help="For W2: gsplat's test_garden.npz.")
]
CaptureOption = Annotated[
    Path | None, option("--capture", metavar="CAPTURE", help="For W3: photos of 400x400 pixels.")
]
SecondsOption = Annotated[float, option("--seconds", help="Seconds that each row is repeated.")]
#: Longest time that a row is repeated.
MAX_SECONDS = 3600.0
#: Largest percentage of ``--fail-above``.
MAX_PERCENT = 1000.0


class BackendChoice(str, enum.Enum):
    """Backends; typer has no lists of literals."""

    auto = "auto"
    cpu = "cpu"
    gpu = "gpu"
    reference = "reference"


class WorkloadChoice(str, enum.Enum):
    """Workloads."""

    W1 = "W1"
    W2 = "W2"
    W3 = "W3"
    W4 = "W4"


BackendsOption = Annotated[
    list[BackendChoice] | None, option("--backend", help="Repeatable. Default: auto.")
]
WorkloadsOption = Annotated[
    list[WorkloadChoice] | None, option("--workload", help="Repeatable. Default: all.")
]
ModelsOption = Annotated[
    Path | None,
    option("--models", metavar="DIR", help="For W3: folder of fitted models. Default: out/bench."),
]
PlotOption = Annotated[
    Path | None, option("--plot", metavar="PNG", help="Plot time against error.")
]
JsonOption = Annotated[
    Path | None, option("--json", metavar="FILE", help="Write the machine and all rows.")
]
AccuracyOption = Annotated[
    Path | None,
    option(
        "--accuracy",
        metavar="FILE",
        help="Instead of workloads, measure every setting; write a page like "
        "docs/how-it-works/accuracy.md and its plot.",
    ),
]
ReportOption = Annotated[
    Path | None,
    option(
        "--report",
        metavar="HTML",
        help="Write a page about this GPU (driver, limits, all rows) and a JSON file, to "
        "attach to bug reports.",
    ),
]
CompareOption = Annotated[
    Path | None,
    option(
        "--compare",
        metavar="FILE",
        help="Time W1 and W4 in turns with another build: the compiled module "
        "(igsr/_core*.so) of another checkout.",
    ),
]
FailAboveOption = Annotated[
    float | None,
    option(
        "--fail-above",
        metavar="PERCENT",
        help="With --compare: exit with status 1 if this build takes that much longer.",
    ),
]


def bench_command(
    backends: BackendsOption = None,
    workloads: WorkloadsOption = None,
    garden: GardenOption = None,
    capture: CaptureOption = None,
    models: ModelsOption = None,
    seed: Annotated[int, option("--seed", help="Random seed of the workloads.")] = 0,
    seconds: SecondsOption = 2.0,
    plot: PlotOption = None,
    json_path: JsonOption = None,
    accuracy: AccuracyOption = None,
    report_path: ReportOption = None,
    compare: CompareOption = None,
    fail_above: FailAboveOption = None,
    profile: Annotated[
        bool,
        option("--profile", help="Instead of workloads, measure a fit step's kernels on the GPU."),
    ] = False,
) -> None:
    """Measure speed, and error against the float64 reference, of the backends.

    Workloads: W1 rasterization; W2 the garden scene, forward and backward; W3 a fit step on a
    capture; W4 growth of a fit step with splats and pixels.
    """
    from igsr_lab import bench as benchmark

    with error_messages():
        if seed < 0:
            raise IgsrError(f"--seed must be at least 0, not {seed}.")
        if not 0.0 <= seconds <= MAX_SECONDS:
            raise IgsrError(f"--seconds must be from 0 to {MAX_SECONDS:g}, not {seconds:g}.")
        names = benchmark.resolved_backends([one.value for one in backends or [BackendChoice.auto]])
        if fail_above is not None and compare is None:
            raise IgsrError("--fail-above compares two builds; give --compare FILE as well.")
        if fail_above is not None and not 0.0 <= fail_above <= MAX_PERCENT:
            raise IgsrError(f"--fail-above must be from 0 to {MAX_PERCENT:g}, not {fail_above:g}.")
        given: dict[str, Any] = {
            "--garden": garden,
            "--capture": capture,
            "--models": models,
            "--report": report_path,
        }
        if profile:
            _refuse(
                {
                    **given,
                    "--workload": workloads,
                    "--backend": backends,
                    "--compare": compare,
                    "--accuracy": accuracy,
                    "--plot": plot,
                },
                "--profile runs no workloads",
            )
        if compare is not None:
            only = "--compare runs W1 and W4 only"
            _refuse({**given, "--accuracy": accuracy, "--plot": plot}, only)
            if {WorkloadChoice.W2, WorkloadChoice.W3} & set(workloads or ()):
                raise IgsrError(f"{only}; leave W2 and W3 out.")
        elif accuracy is not None:
            _refuse({"--workload": workloads, **given}, "--accuracy runs no workloads")
        pages = [] if report_path is None else [report_path, benchmark.json_beside(report_path)]
        for path in (plot, json_path, accuracy, *pages):
            if path is not None:
                check_writable(path)
        console = error_console()
        if profile:
            tables = benchmark.kernel_tables(seed)
            if json_path is not None:
                write_json(json_path, {"kernels": tables})
            benchmark.print_kernels(output_console(), tables)
            return
        chosen = tuple(one.value for one in workloads or WorkloadChoice)
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
            on_row = status.update
            if compare is not None:
                both = tuple(name for name in chosen if name in ("W1", "W4"))
                report = benchmark.compare_builds(compare, names, both, seed, seconds, on_row)
            elif report_path is not None:
                report = benchmark.device_report(settings, on_row)
                benchmark.write_device_report(report_path, report)
            elif accuracy is None:
                report = benchmark.run_benchmark(settings, on_row)
            else:
                implementations = ("reference", *(name for name in names if name != "reference"))
                report = benchmark.measure_accuracy(implementations, seed, seconds, on_row)
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


def _refuse(options: dict[str, Any], reason: str) -> None:
    """Raise an error if one of the options is given."""
    for name, value in options.items():
        if value:
            raise IgsrError(f"{reason}; leave {name} out.")
