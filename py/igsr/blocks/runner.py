"""Has the tasks of a run done, here or on a cluster, and tells where they stand."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from igsr import _core
from igsr._internal.resumable_jobs import Run, finished_runs
from igsr.blocks.progress import Standing, watched
from igsr.blocks.tasks import CHECKPOINT, PROGRESS, SPLATS, FitTask
from igsr.blocks.worker import do_task, in_own_process
from igsr.errors import IgsrError

#: Where memory runs out, a block is fitted again with this part of the splats, so many times.
LESS, LESS_OFTEN = 0.5, 2


class Runner:
    """Has tasks done, here or on a cluster, and tells where they stand."""

    def __init__(
        self,
        out: Path,
        capture: str,
        backend: str,
        ray: str | None,
        told: Callable[[list[Standing]], None] | None,
    ) -> None:
        """Begin without a task.

        Args:
            out: folder of the run.
            capture: the capture, for messages.
            backend: "cpu" or "gpu".
            ray: address of a Ray cluster; None: one task after another, each in its own process.
            told: called now and then with where all tasks stand.
        """
        self._folder, self._capture = out / "blocks", capture
        self._backend, self._ray = backend, ray
        self._told = told
        self._done: set[str] = set()
        self._all: list[tuple[str, Path]] = []
        self._lost: set[str] = set()
        self._less: dict[str, int] = {}

    def rows(
        self,
        tasks: Sequence[FitTask],
        keys: Sequence[dict[str, Any]],
        memory: Sequence[int | None] | None = None,
    ) -> list[dict[str, Any]]:
        """The row of each task, in order; see ``finished_runs``.

        Args:
            tasks: what there is to do.
            keys: all that each task's result depends on.
            memory: bytes that each takes, where that is known.

        Raises:
            IgsrError: a task fails; the message names it.
        """
        instruction_set = _core.backend_info(self._backend)["instruction_set"]
        runs = [
            Run(
                task.name,
                task,
                {**key, "instruction_set": instruction_set},
                leaves=task.folder / SPLATS,
                memory=None if memory is None else memory[number],
            )
            for number, (task, key) in enumerate(zip(tasks, keys, strict=True))
        ]
        self._all += [(task.name, task.folder) for task in tasks]

        def on_run(done: int, of: int, row: dict[str, Any]) -> None:
            self._done.add(row["name"])

        looking = (
            contextlib.nullcontext()
            if self._told is None
            else watched(self._all, lambda: self._done, self._told)
        )
        with looking:
            rows = finished_runs(
                self._folder,
                runs,
                do_task if self._ray is not None else in_own_process,
                self._capture,
                1,
                on_run,
                self._ray or False,
                again=self._with_less,
                spread=True,
                shared=self._shared(),
            )
        self._done |= {task.name for task in tasks}
        self._tell_of_other_bits(instruction_set, rows)
        return rows

    def _shared(self) -> Path:
        """The folder that workers write to, which all machines must see."""
        self._folder.mkdir(parents=True, exist_ok=True)
        return self._folder.resolve()

    def _with_less(self, run: Run, error: Exception) -> FitTask:
        """The task again, after its process ended without a result or memory ran out.

        First as it was, from its checkpoint: any process may be killed. Then with fewer splats.

        Raises:
            IgsrError: that has been tried; the message names the task.
        """
        task = cast(FitTask, run.what)
        if not isinstance(error, MemoryError) and task.name not in self._lost:
            self._lost.add(task.name)
            warnings.warn(f"{task.name} was lost and is begun again: {error}", stacklevel=2)
            return task
        self._less[task.name] = self._less.get(task.name, 0) + 1
        if self._less[task.name] > LESS_OFTEN:
            raise IgsrError(
                f"{task.name} ({len(task.shots)} photos) ran out of memory, with fewer splats too: "
                "give a smaller --max-size or more --blocks."
            ) from error
        part = LESS ** self._less[task.name]
        warnings.warn(
            f"{task.name} ran out of memory; it is fitted again with {part:g} of the splats.",
            stacklevel=2,
        )
        return replace(task, splats_part=part)

    @staticmethod
    def _tell_of_other_bits(instruction_set: str, rows: Sequence[dict[str, Any]]) -> None:
        others = sorted({row["host"] for row in rows if row["instruction_set"] != instruction_set})
        if others:
            warnings.warn(
                f"{', '.join(others)}: another instruction set than {instruction_set}; the same "
                "run elsewhere may end with other bits.",
                stacklevel=3,
            )

    def forget_checkpoints(self) -> None:
        """Remove what only an interrupted run needs."""
        for _, folder in self._all:
            for name in (CHECKPOINT, PROGRESS):
                with contextlib.suppress(OSError):
                    (folder / name).unlink()
