"""``Study``: folders of a study, execution of its runs, and its report."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr._internal.choices import FitBackend
from igsr._internal.json_file import write_json
from igsr._internal.resumable_jobs import Run, finished_runs
from igsr.errors import IgsrError

Row = dict[str, Any]


@dataclass(frozen=True)
class Study:
    """A study and how its runs are executed.

    Attributes:
        data: folder with the scenes.
        out: folder for ``study.json``, ``study.md``, ``study.png`` and ``runs/``, one file per run.
            Finished runs are not repeated.
        seeds: number of seeds, from 0.
        backend: "cpu" or "gpu", for fits and renders.
        jobs: number of parallel runs, each in its own process with its share of the cores.
        on_run: called with (done, total, row) after each run.
        ray: execute runs on a Ray cluster instead (``pip install 'igsr[ray]'``).
    """

    data: Path
    out: Path
    seeds: int = 3
    backend: FitBackend = "cpu"
    jobs: int = 1
    on_run: Callable[[int, int, Row], None] | None = None
    ray: bool = False

    def __post_init__(self) -> None:
        """Check the numbers."""
        for name in ("seeds", "jobs"):
            if getattr(self, name) < 1:
                raise IgsrError(f"{name} must be at least 1, not {getattr(self, name)}.")

    def check_scenes(self, scenes: Sequence[str], file: str = "") -> None:
        """Check that the folder of each scene exists and holds a file."""
        for scene in scenes:
            folder = self.data / scene
            if file and not (folder / file).is_file():
                raise IgsrError(f"{folder} holds no {file}; name --scene.")
            if not folder.exists():
                raise IgsrError(f"{folder} does not exist; name --scene.")

    def rows(
        self, runs: list[Run], work: Callable[[str, Any], Row], folder: str = "runs"
    ) -> list[Row]:
        """Execute the runs that are not finished; return the rows of all."""
        return finished_runs(
            self.out / folder, runs, work, str(self.data), self.jobs, self.on_run, self.ray
        )

    def write(self, report: Row, lines: Callable[[Row], Sequence[str]]) -> Row:
        """Write ``study.json``, and ``study.md`` with ``lines(report)`` below a heading.

        Args:
            report: with "title" and "protocol".
            lines: makes the Markdown.

        Returns:
            The report with the version of igsr.
        """
        report = {"title": report["title"], "igsr": _core.__version__, **report}
        write_json(self.out / "study.json", report)
        about = f"igsr {report['igsr']}; {json.dumps(report['protocol'])}"
        text = "\n".join([f"# {report['title']}", "", about, "", *lines(report)]) + "\n"
        with atomic_write(self.out / "study.md") as temporary:
            temporary.write_text(text, encoding="utf-8")
        return report


def seed_means(rows: Sequence[Row], value: Callable[[Row], float]) -> npt.NDArray[np.float64]:
    """Return the mean of a value over the rows of each seed."""
    by_seed: dict[int, list[float]] = {}
    for row in rows:
        by_seed.setdefault(row["seed"], []).append(value(row))
    return np.array([float(np.mean(values)) for values in by_seed.values()])


def deviation(values: npt.NDArray[np.float64]) -> float | None:
    """Return the standard deviation; None for fewer than two values."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else None


def standard_error(values: npt.NDArray[np.float64]) -> float | None:
    """Return the standard error of the mean; None for fewer than two values."""
    spread = deviation(values)
    return None if spread is None else spread / float(np.sqrt(len(values)))


def with_spread(value: float, spread: float | None, form: str) -> str:
    """Format a number with its spread, if there is one."""
    return format(value, form) + ("" if spread is None else f" ± {spread:{form}}")


def difference_cell(value: float, error: float | None, seeds: float | None, form: str) -> str:
    """Format a difference with its standard error and, in brackets, its deviation over seeds."""
    text = f"{value:+{form}}"
    if error is not None:
        text += f" ± {error:{form}}"
    return text if seeds is None else f"{text} ({seeds:{form}})"
