"""The benchmark: which workloads run on which backends, and what did not run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .. import _core
from ..capture import Capture, load_capture
from .fit_rows import capture_rows
from .growth import POINT_SECONDS, growth_rows, pair_rows
from .machine import describe_machine
from .scenes import garden
from .stage_rows import SECONDS, pipeline_rows, rasterize_rows

Row = dict[str, Any]

WORKLOADS = ("W1", "W2", "W3", "W4")
#: Splats of W3's two models.
MODEL_COUNTS = (20_000, 100_000)
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
    """

    backends: tuple[str, ...]
    workloads: tuple[str, ...] = WORKLOADS
    garden: Path | None = None
    capture: Path | None = None
    models: Path = Path("out/bench")
    seed: int = 0
    seconds: float = SECONDS


def not_run(workload: str, backend: str, reason: str) -> Row:
    """A row that says why a workload has no figures."""
    return {**COLUMNS, "workload": workload, "backend": backend, "not_run": reason}


def run_benchmark(
    settings: Settings, on_row: Callable[[str], object] = lambda doing: None
) -> dict[str, Any]:
    """Run the workloads; ``{"machine": ..., "rows": [...]}``.

    Args:
        settings: what to run.
        on_row: told what is about to run.

    Raises:
        IgsrError: a file that was given cannot be used.
    """
    # A mistake in a path is found before the first minute of work.
    scene = None if settings.garden is None else garden(settings.garden, settings.seed)
    capture = None if settings.capture is None else load_capture(settings.capture)
    machine = describe_machine(list(settings.backends), settings.seed)
    rows: list[Row] = []
    for backend in settings.backends:
        for doing, work in _work(settings, backend, scene, capture):
            on_row(f"{doing} on {backend}")
            rows.extend({**COLUMNS, **row} for row in work())
    peaks = [row["peak_gflops"] for row in rows if row.get("peak_gflops")]
    machine["peak_gflops"] = max([machine["peak_gflops"], *peaks])
    return {"machine": machine, "rows": rows}


def _work(
    settings: Settings, backend: str, scene: Any, capture: Capture | None
) -> Iterator[tuple[str, Callable[[], list[Row]]]]:
    """What is to run on one backend, named."""
    seed, seconds = settings.seed, settings.seconds
    if "W1" in settings.workloads:
        yield "W1", lambda: rasterize_rows(backend, seed, seconds)
    if "W2" in settings.workloads:
        if scene is None:
            reason = "it needs gsplat's test_garden.npz: --garden FILE"
            yield "W2", lambda: [not_run("W2", backend, reason)]
        else:
            yield "W2", lambda: pipeline_rows("W2", scene, backend, seed, seconds)
    if "W3" in settings.workloads:
        for count in MODEL_COUNTS:
            yield f"W3 with {count} splats", _capture_work(settings, backend, capture, count)
    if "W4" in settings.workloads:
        yield (
            "W4",
            lambda: [
                *growth_rows(backend, seed, seconds=min(seconds, POINT_SECONDS)),
                *pair_rows(backend, seed, seconds),
            ],
        )


def _capture_work(
    settings: Settings, backend: str, capture: Capture | None, count: int
) -> Callable[[], list[Row]]:
    if backend == "reference":
        return lambda: [not_run("W3", backend, "the reference does not fit")]
    if capture is None:
        return lambda: [
            {**not_run("W3", backend, "it needs a capture: --capture DIR"), "splats": count}
        ]
    return lambda: capture_rows(
        capture, count, backend, settings.models, settings.seed, settings.seconds
    )


def resolved_backends(names: list[str]) -> tuple[str, ...]:
    """Backends by the names that run, each once."""
    return tuple(dict.fromkeys(_core.resolve_backend(name) for name in names))
