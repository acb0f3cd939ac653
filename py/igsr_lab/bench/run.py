"""``run_benchmark``: the workloads on the backends."""

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
from igsr_lab.bench.scenes import garden
from igsr_lab.bench.stage_rows import SECONDS, pipeline_rows, rasterize_rows
from igsr_lab.bench.table import describe_machine

Row = dict[str, Any]
#: A workload's name, its number of splats if it runs with several, and the function of its rows.
Work = tuple[str, int | None, Callable[[], list[Row]]]

WORKLOADS = ("W1", "W2", "W3", "W4")
#: Splats of W3's two models.
MODEL_COUNTS = (20_000, 100_000)
#: Name of W4 with few points, for software drivers.
SMALL = "W4 small"
DOES_NOT_FIT = "the reference does not fit"
#: Keys of every row, also of workloads that did not run.
COLUMNS: dict[str, Any] = dict.fromkeys(
    (
        *("workload", "backend", "pass", "splats", "width", "height"),
        *("ms", "max_error", "mean_error"),
    )
)


@dataclass(frozen=True)
class Settings:
    """What to run."""

    backends: tuple[str, ...]  # resolved names
    workloads: tuple[str, ...] = WORKLOADS  # some of ``WORKLOADS``
    garden: Path | None = None  # gsplat's ``test_garden.npz``, for W2
    capture: Path | None = None  # photos for W3
    models: Path = Path("out/bench")  # folder of W3's fitted models
    seed: int = 0  # random seed of the workloads
    seconds: float = SECONDS  # time that each row is repeated
    small: bool = False  # whether W4 has a few small points only


def not_run(workload: str, backend: str, reason: str, splats: int | None = None) -> Row:
    """A row of a workload that did not run, with the reason."""
    row = {"workload": workload, "backend": backend, "splats": splats, "not_run": reason}
    return {**COLUMNS, **row}


def run_benchmark(
    settings: Settings, on_row: Callable[[str], object] = lambda doing: None
) -> dict[str, Any]:
    """Run the workloads; return ``{"machine": ..., "rows": [...]}``.

    A workload that fails has a row with the reason. ``on_row`` gets a description of each.
    """
    # Check files before the first minute of work.
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
            rows += rows_or_reason(workload, backend, work, splats)
    peaks = [row["peak_gflops"] for row in rows if row.get("peak_gflops")]
    machine["peak_gflops"] = max([machine["peak_gflops"], *peaks])
    return {"machine": machine, "rows": rows}


def rows_or_reason(
    workload: str, backend: str, work: Callable[[], list[Row]], splats: int | None = None
) -> list[Row]:
    """Rows of a workload; a single row with the reason if it fails."""
    try:
        rows = work()
    except (IgsrError, RuntimeError) as error:  # the GPU raises RuntimeError
        rows = [not_run(workload, backend, str(error), splats)]
    return [{**COLUMNS, **row} for row in rows]


def _work(settings: Settings, backend: str, scene: Any, capture: Capture | None) -> Iterator[Work]:
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
        point_seconds = min(seconds, POINT_SECONDS)
        if backend == "reference":
            yield "W4", None, lambda: [not_run("W4", backend, DOES_NOT_FIT)]
        elif settings.small:
            yield (
                SMALL,
                None,
                lambda: growth_rows(backend, seed, SMALL_POINTS, point_seconds, SMALL),
            )
        else:
            yield "W4", None, lambda: growth_rows(backend, seed, seconds=point_seconds)
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
    """Resolve backends and remove repeated ones."""
    return tuple(dict.fromkeys(_core.resolve_backend(name) for name in names))
