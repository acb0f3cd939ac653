"""Independent runs, each with its own file, so that a study can be resumed."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from concurrent.futures import as_completed
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr._internal.ray_jobs import RayCluster
from igsr._internal.worker_processes import worker_processes
from igsr.errors import IgsrError

Row = dict[str, Any]
T = TypeVar("T")


@dataclass(frozen=True)
class Run:
    """One run of a study, such as a fit.

    Attributes:
        name: of its file, without ending.
        what: argument of the function that does the run.
        settings: everything that the result depends on; a change repeats the run.
        leaves: a file that it writes, if any; if that is missing, the run is repeated.
        scene: folder in the data whose files' hash is added to the settings as "data", or None.
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
    work: Callable[[str, Any], Row],
    data: str,
    jobs: int,
    on_run: Callable[[int, int, Row], None] | None,
    ray: bool = False,
) -> list[Row]:
    """Return the row of every run, in order; do the runs whose files are missing or outdated.

    Args:
        folder: of the runs' files.
        runs: the runs.
        work: called with ``data`` and ``Run.what``; returns the row, as JSON values.
        data: folder with the scenes.
        jobs, ray: as ``execute``.
        on_run: called with (done, total, row) after each run.

    Raises:
        IgsrError: a run fails, its file cannot be read or written, or Ray is not installed.
    """
    rows: dict[str, Row] = {}
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

    def keep(run: Run, row: Row) -> None:
        row = {**row, **about(run)}
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(folder / f"{run.name}.json") as temporary:
            temporary.write_text(json.dumps(row, indent=2, allow_nan=False), encoding="utf-8")
        rows[run.name] = row
        if on_run is not None:
            on_run(len(rows), len(runs), row)

    execute(partial(_do, work, data), missing, keep, jobs=jobs, ray=ray, shared=Path(data))
    return [rows[run.name] for run in runs]


def _do(work: Callable[[str, Any], Row], data: str, run: Run) -> Row:
    return work(data, run.what)


def execute(
    work: Callable[[T], Row],
    pieces: list[T],
    keep: Callable[[T, Row], None],
    *,
    jobs: int,
    ray: bool,
    shared: Path,
) -> None:
    """Do pieces of work here, in several processes, or on a Ray cluster.

    After a failure, pieces that are under way are still finished and kept.

    Args:
        work: does one piece; returns its row.
        pieces: the work.
        keep: called with each finished piece and its row.
        jobs: number of processes, which share the cores.
        ray: run on the Ray cluster of this machine, or on a local one.
        shared: a folder that all machines of the cluster must see at the same path.

    Raises:
        IgsrError: a piece fails, or Ray is not installed.
    """
    if not pieces:
        return
    if ray:
        with RayCluster() as cluster:
            cluster.check(shared.resolve())
            cluster.run(lambda piece: work(piece), pieces, keep)  # Ray does not accept a partial
        return
    if jobs == 1:
        for piece in pieces:
            keep(piece, work(piece))
        return
    with worker_processes(jobs, max(1, (os.cpu_count() or 1) // jobs)) as pool:
        pending = {pool.submit(work, piece): piece for piece in pieces}
        kept = set()
        try:
            for done in as_completed(pending):
                keep(pending[done], done.result())
                kept.add(done)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            for other, piece in pending.items():
                finished = other.done() and not other.cancelled()
                if finished and other not in kept and other.exception() is None:
                    keep(piece, other.result())
            raise


def _read(path: Path) -> Row | None:
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
