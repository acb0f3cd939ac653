"""The benchmark: which workloads run on which backends, and what did not run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from igsr import _core
from igsr._internal.atomic_write import check_writable
from igsr.capture import Capture, load_capture
from igsr.errors import IgsrError
from igsr_lab.bench.fit_rows import capture_rows, model_path
from igsr_lab.bench.growth import PAIR, POINT_SECONDS, SMALL_POINTS, growth_rows, pair_rows
from igsr_lab.bench.machine import describe_machine
from igsr_lab.bench.scenes import garden
from igsr_lab.bench.stage_rows import SECONDS, pipeline_rows, rasterize_rows

Row = dict[str, Any]
#: A workload's name, its number of splats where it runs with several, and what gives its rows.
Work = tuple[str, int | None, Callable[[], list[Row]]]

WORKLOADS = ("W1", "W2", "W3", "W4")
#: Splats of W3's two models.
MODEL_COUNTS = (20_000, 100_000)
#: What W4 is called where it is cut down to what a software driver does in minutes.
SMALL = "W4 small"
DOES_NOT_FIT = "the reference does not fit"
#: What every row has, whether it ran or not.
COLUMNS: dict[str, Any] = {
    "workload": None,
    "backend": None,
    "pass": None,
    "splats": None,
    "width": None,
    "height": None,
    "ms": None,
    "max_error": None,
    "mean_error": None,
}


@dataclass(frozen=True)
class Settings:
    """What to run.

    Attributes:
        backends: resolved names.
        workloads: some of ``WORKLOADS``.
        garden: gsplat's ``test_garden.npz``, for W2.
        capture: photos for W3.
        models: folder that keeps W3's fitted models.
        seed: of all that is drawn.
        seconds: how long a row is repeated.
        small: a few small points in place of W4, by the name of ``SMALL``.
    """

    backends: tuple[str, ...]
    workloads: tuple[str, ...] = WORKLOADS
    garden: Path | None = None
    capture: Path | None = None
    models: Path = Path("out/bench")
    seed: int = 0
    seconds: float = SECONDS
    small: bool = False


def not_run(workload: str, backend: str, reason: str, splats: int | None = None) -> Row:
    """A row that says why a workload has no figures."""
    row = {"workload": workload, "backend": backend, "splats": splats, "not_run": reason}
    return {**COLUMNS, **row}


def run_benchmark(
    settings: Settings, on_row: Callable[[str], object] = lambda doing: None
) -> dict[str, Any]:
    """Run the workloads; ``{"machine": ..., "rows": [...]}``.

    A workload that fails has a row that says why, and the others' rows are kept.

    Args:
        settings: what to run.
        on_row: told what is about to run.

    Raises:
        IgsrError: a file that was given cannot be used.
    """
    # A mistake in a path is found before the first minute of work.
    scene = None if settings.garden is None else garden(settings.garden, settings.seed)
    capture = None if settings.capture is None else load_capture(settings.capture)
    if capture is not None and "W3" in settings.workloads:
        for count in MODEL_COUNTS:
            path = model_path(capture, count, settings.models, settings.seed)
            if not path.is_file():
                check_writable(path)
    machine = describe_machine(list(settings.backends), settings.seed)
    rows: list[Row] = []
    for backend in settings.backends:
        for workload, splats, work in _work(settings, backend, scene, capture):
            on_row(f"{workload} on {backend}" + (f" with {splats} splats" if splats else ""))
            try:
                found = work()
            except (IgsrError, RuntimeError) as error:  # the renderer's RuntimeErrors are the GPU's
                # What was measured before, perhaps for minutes, is not thrown away.
                found = [not_run(workload, backend, str(error), splats)]
            rows.extend({**COLUMNS, **row} for row in found)
    peaks = [row["peak_gflops"] for row in rows if row.get("peak_gflops")]
    machine["peak_gflops"] = max([machine["peak_gflops"], *peaks])
    return {"machine": machine, "rows": rows}


def _work(settings: Settings, backend: str, scene: Any, capture: Capture | None) -> Iterator[Work]:
    """What is to run on one backend, named."""
    seed, seconds = settings.seed, settings.seconds
    if "W1" in settings.workloads:
        yield "W1", None, lambda: rasterize_rows(backend, seed, seconds)
    if "W2" in settings.workloads:
        if scene is None:
            reason = "it needs gsplat's test_garden.npz: --garden FILE"
            yield "W2", None, lambda: [not_run("W2", backend, reason)]
        else:
            yield "W2", None, lambda: pipeline_rows("W2", scene, backend, seed, seconds)
    if "W3" in settings.workloads:
        for count in MODEL_COUNTS:
            yield "W3", count, _capture_work(settings, backend, capture, count)
    if "W4" in settings.workloads:
        if backend == "reference":
            yield "W4", None, lambda: [not_run("W4", backend, DOES_NOT_FIT)]
        else:
            of_a_point = min(seconds, POINT_SECONDS)
            if settings.small:
                few = SMALL_POINTS
                yield SMALL, None, lambda: growth_rows(backend, seed, few, of_a_point, SMALL)
            else:
                yield "W4", None, lambda: growth_rows(backend, seed, seconds=of_a_point)
                yield "W4", PAIR[0], lambda: pair_rows(backend, seed, seconds)


def _capture_work(
    settings: Settings, backend: str, capture: Capture | None, count: int
) -> Callable[[], list[Row]]:
    if backend == "reference":
        return lambda: [not_run("W3", backend, DOES_NOT_FIT, count)]
    if capture is None:
        return lambda: [not_run("W3", backend, "it needs a capture: --capture DIR", count)]
    return lambda: capture_rows(
        capture, count, backend, settings.models, settings.seed, settings.seconds
    )


def resolved_backends(names: list[str]) -> tuple[str, ...]:
    """Backends by the names that run, each once.

    Args:
        names: "auto", "cpu", "gpu" or "reference", in any number.
    """
    return tuple(dict.fromkeys(_core.resolve_backend(name) for name in names))
