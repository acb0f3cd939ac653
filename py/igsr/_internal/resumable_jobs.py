"""Independent runs, each kept in a file of its own, so that a study resumes where it stopped."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr._internal.ray_jobs import RayCluster
from igsr._internal.worker_processes import worker_processes
from igsr.errors import IgsrError


@dataclass(frozen=True)
class Run:
    """One run of a study, such as a fit.

    Attributes:
        name: of its file, without ending.
        what: describes it; what ``work`` is called with.
        settings: all that its result depends on. A run with other settings is done again.
        leaves: a file that it leaves beside its row, if any; without that it is not done.
        scene: its folder in the data; the hash of all its files joins the settings, as "data",
            since photos and cameras may be corrected. None where the settings say all.
    """

    name: str
    what: Any
    settings: dict[str, Any]
    leaves: Path | None = None
    scene: str | None = None


def file_hash(path: Path) -> str:
    """SHA-256 of a file that a run's result depends on, for its settings."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def folder_hash(folder: Path) -> str:
    """SHA-256 of all files in a folder and of their names."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        digest.update(path.relative_to(folder).as_posix().encode())
        digest.update(bytes.fromhex(file_hash(path)))
    return digest.hexdigest()


def finished_runs(
    folder: Path,
    runs: list[Run],
    work: Callable[[str, Any], dict[str, Any]],
    data: str,
    jobs: int,
    on_run: Callable[[int, int, dict[str, Any]], None] | None,
    ray: bool = False,
) -> list[dict[str, Any]]:
    """The row of every run, in order: read where its file is there, else done and written.

    A run is done again if its file is of another version, has other settings (presets and photos
    change), or if a file that it left is gone. When one run fails, those under way are still
    finished and kept.

    Args:
        folder: of the runs' files.
        runs: what there is to do.
        work: does one run, given ``data`` and ``Run.what``; returns its row, which JSON can hold.
        data: folder that holds the scenes.
        jobs: runs at a time on this machine, each in a process of its own with its share of cores.
        on_run: called with (done, all, the run's row) after each run.
        ray: run on the Ray cluster that this machine is part of, or on a local one, as many at a
            time as it has room for; its machines see ``data`` under the same path.

    Raises:
        IgsrError: a run fails, its file cannot be read or written, or Ray is not installed.
    """
    rows: dict[str, dict[str, Any]] = {}
    missing = []
    scenes = {run.scene for run in runs if run.scene is not None}
    hashes = {scene: folder_hash(Path(data) / scene) for scene in scenes}

    def about(run: Run) -> dict[str, Any]:
        of = {} if run.scene is None else {"data": hashes[run.scene]}
        return {"igsr": _core.__version__, "settings": run.settings | of}

    for run in runs:
        row = _read(folder / f"{run.name}.json")
        current = about(run)
        whole = run.leaves is None or run.leaves.is_file()
        if row is not None and whole and {key: row.get(key) for key in current} == current:
            rows[run.name] = row
        else:
            missing.append(run)

    def keep(run: Run, row: dict[str, Any]) -> None:
        row = {**row, **about(run)}
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(folder / f"{run.name}.json") as temporary:
            temporary.write_text(json.dumps(row, indent=2, allow_nan=False), encoding="utf-8")
        rows[run.name] = row
        if on_run is not None:
            on_run(len(rows), len(runs), row)

    if ray and missing:
        with RayCluster() as cluster:
            cluster.check(Path(data).resolve())
            cluster.run(lambda run: work(data, run.what), missing, keep)
    elif jobs == 1:
        for run in missing:
            keep(run, work(data, run.what))
    elif missing:
        threads = max(1, (os.cpu_count() or 1) // jobs)
        with worker_processes(jobs, threads) as pool:
            pending = {pool.submit(work, data, run.what): run for run in missing}
            try:
                for done in as_completed(pending):
                    keep(pending[done], done.result())
            except BaseException:
                pool.shutdown(cancel_futures=True)
                for other, run in pending.items():
                    finished = other.done() and not other.cancelled()
                    if finished and run.name not in rows and other.exception() is None:
                        keep(run, other.result())
                raise
    return [rows[run.name] for run in runs]


def _read(path: Path) -> dict[str, Any] | None:
    if not path.is_file():
        return None
    try:
        row = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise IgsrError(
            f"{path} cannot be read ({error}); delete it to do the fit again."
        ) from error
    if not isinstance(row, dict):
        raise IgsrError(f"{path} does not hold a fit's row; delete it to do the fit again.")
    return row
