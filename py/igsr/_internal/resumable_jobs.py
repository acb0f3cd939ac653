"""Independent runs, each kept in its own file, so that a study continues after an interruption."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr._internal.ray_jobs import RayCluster
from igsr._internal.worker_processes import WorkerLostError, worker_processes
from igsr.errors import IgsrError

Row = dict[str, Any]
#: From the data folder and the description of a run to its row.
Work = Callable[[str, Any], Row]


@dataclass(frozen=True)
class Run:
    """One run, such as a fit.

    Attributes:
        name: of its file, without ending.
        what: argument of the function that does the run.
        settings: everything that the result depends on; a change repeats the run.
        leaves: a file that it writes, if any; if that is missing, the run is repeated.
        scene: folder in the data whose files' hash is added to the settings as "data", or None.
        memory: bytes that it needs, or None; Ray starts no more runs than fit.
    """

    name: str
    what: Any
    settings: dict[str, Any]
    leaves: Path | None = None
    scene: str | None = None
    memory: int | None = None


def file_hash(path: Path) -> str:
    """SHA-256 of a file that a result depends on."""
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
    work: Work,
    data: str,
    jobs: int,
    on_run: Callable[[int, int, Row], None] | None,
    ray: bool | str = False,
    *,
    again: Callable[[Run, Exception], Any] | None = None,
    spread: bool = False,
    shared: Path | None = None,
) -> list[Row]:
    """Return the row of every run, in order; do the runs whose files are missing or outdated.

    Args:
        folder: of the runs' files.
        runs: the runs.
        work: called with ``data`` and ``Run.what``; returns the row, as JSON values.
        data: folder with the scenes.
        jobs, ray, spread, shared: as ``execute``.
        on_run: called with (done, total, row) after each run.
        again: called with a run and the exception if its process was lost or memory ran out;
            ``work`` is repeated with the returned value, if that is not None.

    Raises:
        IgsrError: a run fails, its file cannot be read or written, or Ray is not installed.
    """
    rows: dict[str, Row] = {}
    missing = []
    scenes = {run.scene for run in runs if run.scene is not None}
    hashes = {scene: folder_hash(Path(data) / scene) for scene in scenes}

    def about(run: Run) -> Row:
        of_data = {} if run.scene is None else {"data": hashes[run.scene]}
        return {"igsr": _core.__version__, "settings": run.settings | of_data}

    for run in runs:
        row = _read(folder / f"{run.name}.json")
        current = about(run)
        whole = run.leaves is None or run.leaves.is_file()
        if row is not None and whole and {key: row.get(key) for key in current} == current:
            rows[run.name] = row
        else:
            missing.append(run)

    def keep(number: int, row: Row) -> None:
        run = missing[number]
        row = {**row, **about(run)}
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(folder / f"{run.name}.json") as temporary:
            temporary.write_text(json.dumps(row, indent=2, allow_nan=False), encoding="utf-8")
        rows[run.name] = row
        if on_run is not None:
            on_run(len(rows), len(runs), row)

    execute(
        work,
        data,
        [run.what for run in missing],
        keep,
        jobs=jobs,
        ray=ray,
        again=None if again is None else lambda number, error: again(missing[number], error),
        memory=[run.memory for run in missing],
        spread=spread,
        shared=shared,
    )
    return [rows[run.name] for run in runs]


def execute(
    work: Work,
    data: str,
    pieces: Sequence[Any],
    keep: Callable[[int, Row], None],
    *,
    jobs: int = 1,
    ray: bool | str = False,
    again: Callable[[int, Exception], Any] | None = None,
    memory: Sequence[int | None] | None = None,
    spread: bool = False,
    shared: Path | None = None,
) -> None:
    """Do pieces of work here, in several processes, or on a Ray cluster.

    After a failure, pieces that are under way are still finished and kept.

    Args:
        work: called with ``data`` and a piece; returns its row.
        data: the first argument.
        pieces: the second arguments.
        keep: called with the number of each finished piece and its row.
        jobs: number of processes, which share the cores.
        ray: run on the Ray cluster of this machine, or a local one; a text is the address of a
            cluster (``igsr._internal.ray_jobs``). Its machines see ``data`` at the same path.
        again: called with the number of a piece and the exception if its process was lost or memory
            ran out; ``work`` is repeated with the returned value, if that is not None.
        memory: bytes that each piece needs, on Ray.
        spread: whether a piece uses its share of a machine's cores on Ray instead of one.
        shared: a folder that all machines must see, on Ray.

    Raises:
        IgsrError: a piece fails, or Ray is not installed.
    """
    if ray and pieces:
        with RayCluster(ray if isinstance(ray, str) else None) as cluster:
            cluster.check(shared)
            cluster.do(work, data, pieces, keep, memory=memory, spread=spread, again=again)
    elif jobs == 1:
        for number, piece in enumerate(pieces):
            keep(number, _done(work, data, number, piece, again))
    elif pieces:
        threads = max(1, (os.cpu_count() or 1) // jobs)
        with worker_processes(jobs, threads) as pool:
            pending = {pool.submit(work, data, piece): n for n, piece in enumerate(pieces)}
            kept = set()
            try:
                for done in as_completed(pending):
                    keep(pending[done], done.result())
                    kept.add(done)
            except BaseException:
                pool.shutdown(cancel_futures=True)
                for other, number in pending.items():
                    finished = other.done() and not other.cancelled()
                    if finished and other not in kept and other.exception() is None:
                        keep(number, other.result())
                raise


def _done(
    work: Work,
    data: str,
    number: int,
    piece: Any,
    again: Callable[[int, Exception], Any] | None,
) -> Row:
    while True:
        try:
            return work(data, piece)
        except (WorkerLostError, MemoryError) as error:
            other = None if again is None else again(number, error)
            if other is None:
                raise
            piece = other


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
