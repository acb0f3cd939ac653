"""Captures of ``igsr synth``: made while they are needed, kept in a folder, drawn by (seed, step).

The captures of one seed are numbered. The first are for validation, those after them are trained
on. Which a step draws, and which of their photos, depends on the seed and the step alone, so
nothing random has to be saved, and how fast captures are made decides nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.worker_processes import WorkerLostError, worker_processes
from igsr.capture import View, load_capture
from igsr.pose.da3.training.training_settings import FEWEST_PHOTOS, PoseTraining
from igsr.pose.da3.training.true_pass import TruePass, true_pass
from igsr.synth import CaptureSettings, is_made, scene_name, synthesize

#: Steps that are looked ahead for captures to be made.
AHEAD = 100
#: Part of the steps that show the network the cameras, as Depth Anything 3 has it.
SHOWN = 0.2


class CaptureSource:
    """Passes for a training; a context, which ends the processes that make captures.

    Args:
        training: the settings.
        folder: where captures are kept.
        jobs: captures that are made at a time, at least 1, each by a process of one thread.
    """

    def __init__(self, training: PoseTraining, folder: Path, jobs: int) -> None:
        """Note what to do."""
        self._training, self._folder, self._jobs = training, folder, jobs
        self._settings = CaptureSettings(training.resolution, training.views, 0, training.spp)
        self._making: dict[int, Future[Any]] = {}
        self._there: set[int] = set()

    @contextmanager
    def open(self) -> Iterator[CaptureSource]:
        """Start what makes captures and what reads them, and end it."""
        with ExitStack() as stack:
            self._makers = stack.enter_context(worker_processes(self._jobs, threads=1))
            self._reader = stack.enter_context(ThreadPoolExecutor(1))
            self._next: tuple[int, Future[list[TruePass]]] | None = None
            try:
                yield self
            finally:
                # Nobody waits for what is made ahead; what is begun is finished and kept.
                self._makers.shutdown(wait=False, cancel_futures=True)
                self._reader.shutdown(cancel_futures=True)

    def validation(self, made: Callable[[int, int], None] | None = None) -> list[TruePass]:
        """A pass of the first photos of each capture of the validation.

        Args:
            made: called with (captures that are there, all) after each.

        Raises:
            IgsrError: as ``igsr.synth.synthesize``.
        """
        count = self._training.validation
        for index in range(count):
            self._make(index)
        passes = []
        for index in range(count):
            views = self._views(index)[: self._training.photos]
            passes.append(true_pass(views, self._training.resolution))
            if made is not None:
                made(index + 1, count)
        return passes

    def batch(self, step: int) -> list[TruePass]:
        """The passes of the step after ``step`` steps; those of the next are read meanwhile.

        Raises:
            IgsrError: as ``igsr.synth.synthesize``.
        """
        if self._next is None or self._next[0] != step:
            self._next = self._reading(step)
        passes = self._next[1].result()
        self._next = self._reading(step + 1) if step + 1 < self._training.steps else None
        return passes

    def shown(self, step: int) -> bool:
        """Whether the network is shown the cameras in that step."""
        return bool(self._random(step, 0).random() < SHOWN)

    def drawn(self, step: int) -> list[int]:
        """Numbers of the captures of a step."""
        training = self._training
        random = self._random(step, 1)
        return (
            training.validation + random.integers(training.captures, size=training.batch)
        ).tolist()

    def _reading(self, step: int) -> tuple[int, Future[list[TruePass]]]:
        for index in self.drawn(step):
            self._make(index)
        for later in range(step + 1, min(step + AHEAD, self._training.steps)):
            for index in self.drawn(later):
                if len(self._making) < 2 * self._jobs:
                    self._make(index)
        return step, self._reader.submit(self._read, step)

    def _read(self, step: int) -> list[TruePass]:
        passes = []
        for slot, index in enumerate(self.drawn(step)):
            views = self._views(index)
            random = self._random(step, 2 + slot)
            most = min(self._training.photos, len(views))
            count = int(random.integers(min(FEWEST_PHOTOS, most), most + 1))
            chosen = random.permutation(len(views))[:count]
            passes.append(true_pass([views[i] for i in chosen], self._training.resolution))
        return passes

    def _random(self, step: int, stream: int) -> np.random.Generator:
        return np.random.default_rng([self._training.seed, step, stream])

    def _make(self, index: int) -> None:
        """Have a capture made, unless it is there or being made."""
        for at, making in list(self._making.items()):
            if making.done() and making.exception() is None:
                self._there.add(at)
                del self._making[at]
        if index in self._making or index in self._there:
            return
        seed, settings = self._training.seed, self._settings
        if is_made(self._folder, index, seed=seed, settings=settings):
            self._there.add(index)
            return
        with _told_if_lost():
            self._making[index] = self._makers.submit(
                synthesize, self._folder, 1, seed=seed, first=index, settings=settings
            )

    def _views(self, index: int) -> list[View]:
        """The photos of a capture, as soon as it is there."""
        making = self._making.get(index)
        if making is not None:
            with _told_if_lost():
                making.result()
        return load_capture(self._folder / scene_name(index)).train_views


@contextmanager
def _told_if_lost() -> Iterator[None]:
    try:
        yield
    except BrokenProcessPool as error:
        raise WorkerLostError(
            "A process that made captures ended without a result; the machine may have run out of "
            "memory: give fewer --jobs."
        ) from error
