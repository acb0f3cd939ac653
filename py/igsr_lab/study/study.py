"""``Study``: folders of a study, execution of its runs, and its report."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr._internal.choices import FitBackend
from igsr._internal.json_file import write_json
from igsr.errors import IgsrError
from igsr_lab.resumable_jobs import Run, finished_runs

Row = dict[str, Any]

#: Headings and formats of scores in tables.
SCORE_COLUMNS = {
    "psnr": ("PSNR, dB", ".2f"),
    "psnr_refined": ("refined PSNR, dB", ".2f"),
    "ssim": ("SSIM", ".4f"),
    "lpips": ("LPIPS", ".4f"),
    "ms_ssim": ("MS-SSIM", ".4f"),
    "flip": ("FLIP", ".4f"),
    "cc_psnr": ("cc PSNR, dB", ".2f"),
    "cc_ssim": ("cc SSIM", ".4f"),
    "perceptual": ("perceptual", ".4f"),
    "lh_psnr": ("left-half PSNR, dB", ".2f"),
    "lh_ssim": ("left-half SSIM", ".4f"),
    "train_psnr": ("train PSNR, dB", ".2f"),
    "train_ssim": ("train SSIM", ".4f"),
    "splats": ("splats", ".0f"),
    "seconds": ("seconds", ".0f"),
    "cpu_seconds": ("CPU seconds", ".0f"),
    "peak_memory_bytes": ("peak, GiB", ".2f"),
}


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


def grouped(rows: Sequence[Row], name: str) -> dict[Any, list[Row]]:
    """Group rows by one of their values, in order of appearance."""
    groups: dict[Any, list[Row]] = {}
    for row in rows:
        groups.setdefault(row[name], []).append(row)
    return groups


def summarized(rows: Sequence[Row], scores: Iterable[str]) -> Row:
    """Mean of each score over the rows that have it, and its deviation over seeds ("_spread")."""
    summary: Row = {"fits": len(rows)}
    for score in scores:
        known = [row for row in rows if row.get(score) is not None]
        means = seed_means(known, lambda row, score=score: row[score])  # type: ignore[misc]
        summary[score] = float(means.mean()) if len(means) else None
        summary[f"{score}_spread"] = deviation(means)
    return summary


def by_preset(rows: Sequence[Row], scores: Iterable[str]) -> Row:
    """``summarized`` rows by preset."""
    return {preset: summarized(same, scores) for preset, same in grouped(rows, "preset").items()}


def seed_means(rows: Sequence[Row], value: Callable[[Row], float]) -> npt.NDArray[np.float64]:
    """Return the mean of a value over the rows of each seed."""
    by_seed = grouped(rows, "seed").values()
    return np.array([float(np.mean([value(row) for row in same])) for same in by_seed])


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
