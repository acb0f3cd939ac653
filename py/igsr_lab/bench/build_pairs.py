"""Two builds of the renderer in one run: ratio of their times with its spread, and their errors.

Times of shared machines change by tens of percent from minute to minute. Here two processes, each
with a build of its own, take turns within seconds, and only the ratio of neighbours counts.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, cast

import numpy as np

from igsr import _core
from igsr.errors import IgsrError
from igsr_lab.bench.machine import describe_machine
from igsr_lab.bench.timed_work import all_work

#: Turns of the two builds, of which each gives a ratio.
ROUNDS = 7
PAIR_PROTOCOL = (
    "Two processes, each with one build, take turns, and the order changes from round to round. "
    "ratio is old : new, each the least over its repeats of that round: the median over the "
    "rounds, with the least and the most. Errors are against the f64 reference as everywhere."
)
#: The build must be there before anything of igsr's benchmark is imported.
_CHILD = """
import sys
from igsr_lab.bench.other_build import use_build
use_build(sys.argv[1])
from igsr_lab.bench.build_process import main
main(sys.argv[2])
"""


class Build:
    """A process with one build; closes with ``with``."""

    def __init__(self, file: Path | None, settings: dict[str, Any]) -> None:
        """Start it.

        Args:
            file: the build's compiled module; None is the one in use.
            settings: keywords of ``all_work``.
        """
        self.name = "this build" if file is None else str(file)
        # A file: a pipe that nobody reads would stop a driver that says much.
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115 (__exit__ closes it)
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-c",
                _CHILD,
                _core.__file__ if file is None else str(file),
                json.dumps(settings),
            ],
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
        """Times of one workload, or its errors where ``seconds`` is None.

        Raises:
            IgsrError: the process ended.
        """
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
    most_splats: int = 1_000_000,
) -> dict[str, Any]:
    """Time another build and this one in turns; ``{"machine": ..., "rows": [...]}``.

    Args:
        other: the other build's compiled module (``igsr/_core*.so``), the "old" one of all ratios.
        backends: resolved names.
        workloads: some of "W1" and "W4".
        seed: of all that is drawn.
        seconds: how long a workload is repeated by each build.
        on_row: told what is about to run.
        rounds: turns.
        most_splats: larger workloads are left out.

    Raises:
        IgsrError: there is no such file, or it is no build for this Python.
    """
    if not other.is_file():
        raise IgsrError(f"There is no file {other}; give --compare a build's compiled module.")
    machine = describe_machine(list(backends), seed) | {"protocol": PAIR_PROTOCOL}
    rows = []
    for backend in backends:
        settings: dict[str, Any] = {
            "workloads": list(workloads),
            "backend": backend,
            "seed": seed,
            "most_splats": most_splats,
        }
        with Build(other.resolve(), settings) as old, Build(None, settings) as new:
            for work in all_work(**settings):
                common = {"workload": work.workload, "backend": backend, "splats": work.splats}
                common |= {"width": work.side, "height": work.side}
                on_row(f"{work.name.replace(' ', ', ')} on {backend}, two builds")
                rows += _pair_rows(common, old, new, work.name, seconds / rounds, rounds)
    return {"machine": machine, "rows": rows}


def _pair_rows(
    common: dict[str, Any], old: Build, new: Build, name: str, seconds: float, rounds: int
) -> list[dict[str, Any]]:
    fastest: dict[str, list[tuple[float, float]]] = {}
    errors = old.ask(name, None), new.ask(name, None)
    # The first turn wakes threads and devices, and does not count.
    for turn in range(-1, rounds):
        order = (old, new) if turn % 2 == 0 else (new, old)
        found = {id(build): build.ask(name, seconds if turn >= 0 else 0.0) for build in order}
        pair = found[id(old)], found[id(new)]
        for build, answers in (("old", (errors[0], pair[0])), ("new", (errors[1], pair[1]))):
            for answer in answers:
                if "failed" in answer:
                    why = f"the {build} build failed: {answer['failed']}"
                    return [{**common, "pass": "", "ratio": None, "failed": build, "not_run": why}]
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
    """One sentence per row in which this build takes more than ``percent`` longer, or fails.

    Args:
        rows: of ``compare_builds``.
        percent: of the other build's time.
    """
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
