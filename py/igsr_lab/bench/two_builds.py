"""Time two builds of the renderer in turns: ratios of their times, and their errors.

Times on shared machines change by tens of percent within minutes. Here two processes, each with one
build, take turns within seconds, and only ratios of neighboring times count.

The parent asks by one JSON value per line on standard input, ``[name, seconds]``. The child answers
with the milliseconds of each pass or, if ``seconds`` is None, its errors against the f64 reference.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO, Any, cast

import numpy as np

from igsr import _core
from igsr.errors import IgsrError
from igsr_lab.bench.comparison import size_row
from igsr_lab.bench.fit_rows import fit_step_ms
from igsr_lab.bench.growth import evenly_chosen, shot_of
from igsr_lab.bench.kernel_times import SIZES
from igsr_lab.bench.scenes import Arrays, splats2d, upstream
from igsr_lab.bench.stage_rows import compare, repeated, w1_comparison
from igsr_lab.bench.table import describe_machine

#: Number of turns; each gives a ratio.
ROUNDS = 7
#: Splats and side of W1's picture.
STAGES = (20_000, 400)
PAIR_PROTOCOL = (
    "Two processes, each with one build, take turns; the order alternates. ratio is old : new, "
    "each the minimum over its repeats of that round: the median over the rounds, with the "
    "smallest and the largest. Errors are against the f64 reference."
)
#: The build must be loaded before the benchmark is imported.
_CHILD = """
import sys
from igsr_lab.other_build import use_build
use_build(sys.argv[1])
from igsr_lab.bench.two_builds import answer
answer(sys.argv[2])
"""

#: Milliseconds of every repeat, or largest and mean error, by pass.
Figures = dict[str, list[float]]


@dataclass(frozen=True)
class TimedWork:
    """One workload of one size; ``times`` measures milliseconds for some seconds."""

    name: str
    workload: str
    splats: int
    side: int
    times: Callable[[float], Figures]
    errors: Callable[[], Figures]


def all_work(workloads: list[str], backend: str, seed: int) -> list[TimedWork]:
    """The workloads ("W1", "W4" or both) of one backend."""
    sizes = [("W1", *STAGES)] * ("W1" in workloads)
    sizes += [("W4", *size) for size in SIZES if "W4" in workloads]
    make = {"W1": _stages, "W4": _step}
    return [
        make[workload](f"{workload} {count} {side}", backend, seed, count, side)
        for workload, count, side in sizes
    ]


def _stages(name: str, backend: str, seed: int, count: int, side: int) -> TimedWork:
    dtype = _core.working_dtype(backend)
    own = splats2d(seed, count, side, side)
    v_own: Arrays = {key: v.astype(dtype) for key, v in upstream(seed, side, side).items()}
    background = np.zeros(3, dtype)

    def times(seconds: float) -> Figures:
        found = repeated(
            lambda n: _core.time_rasterize(
                {key: array.astype(dtype) for key, array in own.items()},
                width=side,
                height=side,
                **v_own,
                background=background,
                backend=backend,
                repeats=n,
            ),
            seconds,
        )
        return {key: ms.tolist() for key, ms in found.items()}

    def errors() -> Figures:
        picture, gradients, *_ = w1_comparison(backend, seed, count, side)
        return {
            "rasterize": [picture.max, picture.mean],
            "rasterize_backward": [gradients.max, gradients.mean],
        }

    return TimedWork(name, "W1", count, side, times, errors)


def _step(name: str, backend: str, seed: int, count: int, side: int) -> TimedWork:
    shot = cache(lambda: shot_of(seed, count, side))  # a million splats are drawn on demand

    def times(seconds: float) -> Figures:
        return {"fit step": fit_step_ms(shot(), backend, seconds)}

    def errors() -> Figures:
        comparison, _ = compare(shot().scene, backend, upstream(seed, side, side), evenly_chosen)
        return {"fit step": [comparison.gradients.max, comparison.gradients.mean]}

    return TimedWork(name, "W4", count, side, times, errors)


def answer(settings: str) -> None:
    """Answer the parent's questions; ``settings`` are keywords of ``all_work`` as JSON."""
    work = {work.name: work for work in all_work(**json.loads(settings))}
    for line in sys.stdin:
        name, seconds = json.loads(line)
        found: dict[str, Any]
        try:
            found = work[name].errors() if seconds is None else work[name].times(seconds)
        except Exception as error:  # another build may lack an argument or a function
            found = {"failed": f"{type(error).__name__}: {error}"}
        print(json.dumps(found), flush=True)


class Build:
    """A process with one build; ``with`` ends it."""

    def __init__(self, file: Path | None, settings: dict[str, Any]) -> None:
        """Start it with a compiled module (None is this one) and keywords of ``all_work``."""
        self.name = "this build" if file is None else str(file)
        # A file: a full pipe would stop a driver that prints much.
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115 (__exit__ closes it)
        module = _core.__file__ if file is None else str(file)
        self._process = subprocess.Popen(
            [sys.executable, "-c", _CHILD, module, json.dumps(settings)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        )

    def __enter__(self) -> Build:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()
        self._errors.close()

    def ask(self, name: str, seconds: float | None) -> dict[str, Any]:
        """Times of one workload, or its errors if ``seconds`` is None."""
        questions, answers = (
            cast(IO[str], stream) for stream in (self._process.stdin, self._process.stdout)
        )
        try:
            print(json.dumps([name, seconds]), file=questions, flush=True)
            line = answers.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            self._process.wait()
            self._errors.seek(0)
            reason = (self._errors.read().strip().splitlines() or ["no reason given"])[-1]
            raise IgsrError(f"{self.name} could not be run ({reason}); give --compare a build.")
        found: dict[str, Any] = json.loads(line)
        return found


def compare_builds(
    other: Path,
    backends: tuple[str, ...],
    workloads: tuple[str, ...],
    seed: int,
    seconds: float,
    on_row: Callable[[str], object] = lambda doing: None,
    rounds: int = ROUNDS,
) -> dict[str, Any]:
    """Time another build's compiled module, "old" in ratios, and this build in turns.

    Returns ``{"machine": ..., "rows": [...]}``.
    """
    if not other.is_file():
        raise IgsrError(f"There is no file {other}; give --compare a build's compiled module.")
    machine = describe_machine(list(backends), seed) | {"protocol": PAIR_PROTOCOL}
    rows = []
    for backend in backends:
        settings: dict[str, Any] = {"workloads": list(workloads), "backend": backend, "seed": seed}
        with Build(other.resolve(), settings) as old, Build(None, settings) as new:
            for work in all_work(**settings):
                common = size_row(work.workload, backend, work.splats, work.side, work.side)
                on_row(f"{work.name.replace(' ', ', ')} on {backend}, two builds")
                rows += pair_rows(common, old, new, work.name, seconds / rounds, rounds)
    return {"machine": machine, "rows": rows}


def pair_rows(
    common: dict[str, Any], old: Build, new: Build, name: str, seconds: float, rounds: int
) -> list[dict[str, Any]]:
    """Rows of one workload, by pass; one row with the reason if a build fails."""
    fastest: dict[str, list[tuple[float, float]]] = {}
    errors = old.ask(name, None), new.ask(name, None)
    # The first turn wakes threads and devices and does not count.
    for turn in range(-1, rounds):
        order = (old, new) if turn % 2 == 0 else (new, old)
        found = {id(build): build.ask(name, seconds if turn >= 0 else 0.0) for build in order}
        pair = found[id(old)], found[id(new)]
        for build, answers in (("old", (errors[0], pair[0])), ("new", (errors[1], pair[1]))):
            for given in answers:
                if "failed" in given:
                    reason = f"the {build} build failed: {given['failed']}"
                    failure = {"ratio": None, "failed": build, "not_run": reason}
                    return [{**common, "pass": "", **failure}]
        if turn >= 0:
            for key in pair[0]:
                fastest.setdefault(key, []).append((min(pair[0][key]), min(pair[1][key])))
    rows = []
    for key, times in fastest.items():
        ms = np.array(times)
        ratios = ms[:, 0] / ms[:, 1]
        rows.append(
            {
                **common,
                "pass": key,
                "ms_old": float(ms[:, 0].min()),
                "ms_new": float(ms[:, 1].min()),
                "ratio": float(np.median(ratios)),
                "ratio_least": float(ratios.min()),
                "ratio_most": float(ratios.max()),
                "rounds": rounds,
                "max_error_old": errors[0][key][0],
                "max_error_new": errors[1][key][0],
                "mean_error_old": errors[0][key][1],
                "mean_error_new": errors[1][key][1],
            }
        )
    return rows


def slower_rows(rows: list[dict[str, Any]], percent: float) -> list[str]:
    """One sentence per row in which this build takes more than ``percent`` longer, or fails."""
    failed = [
        f"{row['workload']} with {row['splats']} splats on {row['backend']}: {row['not_run']}."
        for row in rows
        if row["ratio"] is None and row["failed"] == "new"
    ]
    return failed + [
        f"{row['workload']} {row['pass']} with {row['splats']} splats at {row['width']} x "
        f"{row['height']} on {row['backend']} takes {100.0 / row['ratio'] - 100.0:.0f} % longer."
        for row in rows
        if row["ratio"] is not None and row["ratio"] < 1.0 / (1.0 + percent / 100.0)
    ]
