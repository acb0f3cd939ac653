"""Run tasks, one after another in processes of this machine or on a Ray cluster."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

from igsr import _core
from igsr._internal.event import Event, Listener
from igsr._internal.input_files import read_json
from igsr._internal.json_file import write_json
from igsr._internal.ray_jobs import RayCluster
from igsr._internal.user_warning import warn_user
from igsr._internal.worker_processes import WorkerLostError, in_a_process
from igsr.blocks.tasks import CHECKPOINT_FILE, PROGRESS_FILE, SPLATS_FILE, FitTask
from igsr.blocks.worker import read_progress, run_task
from igsr.errors import IgsrError

#: Each time that memory runs out, a block gets this fraction of its splats, down to the minimum.
RETRY_FRACTION = 0.5
MIN_SPLATS_PART = 0.25
#: Seconds between two progress events.
REPORT_INTERVAL_S = 1.0


def run_tasks(
    stage: str, tasks: Sequence[FitTask], ray: str | None, progress: Listener | None
) -> list[dict[str, Any]]:
    """Run the tasks that are not finished, and return the report row of each.

    Raises:
        IgsrError: a task fails; the message names it. Finished tasks are kept.
        UserWarning: a task is started again, or machines of the cluster differ.
    """
    rows: dict[str, dict[str, Any]] = {}
    for task in tasks:
        with contextlib.suppress(OSError, ValueError, AttributeError):
            row = read_json(task.row_file)
            if row.get("key") == task.key() and (task.folder / SPLATS_FILE).is_file():
                rows[task.name] = row
    missing = [task for task in tasks if task.name not in rows]

    def keep(task: FitTask, row: dict[str, Any]) -> None:
        rows[task.name] = {**row, "key": task.key()}
        write_json(task.row_file, rows[task.name])

    if missing and ray is not None:
        shared = missing[0].folder.parent.resolve()
        shared.mkdir(parents=True, exist_ok=True)
        with RayCluster(ray) as cluster, _reported(stage, tasks, rows, progress):
            cluster.check(shared)
            cluster.run(
                run_task,
                missing,
                keep,
                memory=lambda task: task.memory,
                spread=True,
                retry=_for_retry,
            )
    else:
        for task in missing:
            with _reported(stage, tasks, rows, progress):
                keep(task, _run_in_process(task))
    instruction_set = _core.backend_info(tasks[0].backend)["instruction_set"]
    hosts = {row["host"] for row in rows.values() if row["instruction_set"] != instruction_set}
    if hosts:
        warn_user(
            f"{', '.join(sorted(hosts))}: the instruction set is not {instruction_set}; the same "
            "run on other machines may give other bits."
        )
    return [rows[task.name] for task in tasks]


def _run_in_process(task: FitTask) -> dict[str, Any]:
    while True:
        try:
            return in_a_process(run_task, task)
        except (WorkerLostError, MemoryError) as error:
            task = _for_retry(task, error)


def _for_retry(task: FitTask, error: Exception) -> FitTask:
    """The task for the next attempt; it has fewer splats, except after the first lost process."""
    if not isinstance(error, MemoryError) and not task.was_lost:
        warn_user(f"{task.name} was lost and is started again: {error}")
        return replace(task, was_lost=True)
    part = RETRY_FRACTION * task.splats_part
    if part < MIN_SPLATS_PART:
        raise IgsrError(
            f"{task.name} ({len(task.shots)} photos) ran out of memory, with fewer splats too: "
            "give a smaller --max-size or more --blocks."
        ) from error
    warn_user(f"{task.name} ran out of memory; it is fitted again with {part:g} of the splats.")
    return replace(task, splats_part=part)


@contextlib.contextmanager
def _reported(
    stage: str, tasks: Sequence[FitTask], finished: dict[str, Any], progress: Listener | None
) -> Iterator[None]:
    """Report progress from a thread; raise the listener's exception at the end."""
    if progress is None:
        yield
        return
    ended = threading.Event()

    def report_until_end() -> None:
        while True:
            was_last = ended.wait(REPORT_INTERVAL_S)
            progress(_event(stage, tasks, finished))
            if was_last:
                return

    with ThreadPoolExecutor(1) as pool:
        reports = pool.submit(report_until_end)
        try:
            yield
        finally:
            ended.set()
    reports.result()


def _event(stage: str, tasks: Sequence[FitTask], finished: dict[str, Any]) -> Event:
    """Progress of tasks, from the files that their workers write."""
    parts = {
        task.name: 1.0 if task.name in finished else read_progress(task.folder).get("work", 0.0)
        for task in tasks
    }
    running = [f"{name} {part:.0%}" for name, part in parts.items() if 0.0 < part < 1.0]
    return Event(stage, sum(parts.values()), len(tasks), ", ".join(running), values=parts)


def remove_checkpoints(tasks: Sequence[FitTask]) -> None:
    """Remove files that only an interrupted run needs."""
    for task in tasks:
        for name in (CHECKPOINT_FILE, PROGRESS_FILE):
            with contextlib.suppress(OSError):
                (task.folder / name).unlink()
