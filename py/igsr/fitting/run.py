"""A fit in progress: steps in chunks, with progress, time and checkpoints."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy.typing as npt

from igsr import _core
from igsr._internal.progress_bar import BarState
from igsr.errors import IgsrError
from igsr.fitting.checkpoint import CheckpointFile
from igsr.fitting.settings import FitSettings
from igsr.fitting.time_estimate import work_done
from igsr.fitting.transient_search import TransientSearch

#: A killed run loses at most this much work.
CHECKPOINT_STEPS = 500
CHECKPOINT_SECONDS = 20.0
#: How long the Rust side runs before Python may look at Ctrl-C and the progress callback.
CHUNK_SECONDS = 0.2


@dataclass(frozen=True)
class Progress:
    """Where a fit stands.

    Attributes:
        step: steps done, of ``steps``. Where transient things are found, a fit begins anew once.
        steps: steps in all.
        loss: 0.8 L1 + 0.2 D-SSIM of the last step's photo, before that step; nan where a resumed
            fit had no step left to take.
        splats: number of splats now.
        started: what the splats were initialized from ("points", "hull" ...) and their number.
        seconds: time spent on steps, and on what comes before them, earlier runs that were resumed
            included.
        steps_per_second: of the last chunk of steps.
        backend: what runs: "backend", "device" and "instruction_set".
        work: part of the fit's time, in [0, 1], that the steps done take of all.
        removed: None before the last progress, which all fits that are not told to end give: how
            many floaters of which kind were removed in the end.
        transients: which part of the pixels is masked as transient, by name of the photo; only
            photos that have such pixels.
    """

    step: int
    steps: int
    loss: float
    splats: int
    started: tuple[str, int]
    seconds: float
    steps_per_second: float
    backend: dict[str, str]
    work: float = 0.0
    removed: Mapping[str, int] | None = None
    transients: Mapping[str, float] = field(default_factory=dict)


def bar_state(now: Progress) -> BarState:
    """What a progress bar shows of a fit."""
    speed = f"{now.steps_per_second:.0f} steps/s"
    details = [f"loss {now.loss:.4f}", f"{now.splats} splats", speed]
    if now.transients:
        details.append(f"{len(now.transients)} photos masked")
    if math.isnan(now.loss):
        details = details[1:2]
    return BarState(now.step, now.steps, "  ".join(details), now.work)


#: What is called with the progress of a fit; False ends the fit early.
Report: TypeAlias = Callable[[Progress], bool | None]


@dataclass
class FitRun:
    """One fit in progress; it keeps progress, time and the checkpoint file.

    Attributes:
        fitter: the renderer's fitter.
        settings: the fit's.
        started: what the splats were initialized from, and their number.
        backend: what runs; see ``Progress``.
        report: what is called after each chunk of steps.
        checkpoint: the file to save to.
        size: width and height of the photos, pixels.
        kept: arrays that checkpoints hold beside the fitter's.
        transients: the search for transient things, if there is one.
        seconds_before: time spent before this run.
    """

    fitter: _core.Fitter
    settings: FitSettings
    started: tuple[str, int]
    backend: dict[str, str]
    report: Report | None = None
    checkpoint: CheckpointFile | None = None
    size: tuple[float, float] = (1.0, 1.0)
    kept: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)
    seconds_before: float = 0.0
    transients: TransientSearch | None = None

    def __post_init__(self) -> None:
        """Start the clock."""
        self._began = self._saved_at = time.perf_counter()
        self._step = self._saved_step = int(self.fitter.steps_done)
        self._last: Progress | None = None

    def save(self) -> None:
        """Save a checkpoint, if there is a file for it.

        Raises:
            IgsrError: it cannot be written.
        """
        if self.checkpoint is not None:
            seconds = self.seconds_before + time.perf_counter() - self._began
            kept = dict(self.kept)
            if self.transients is not None:
                kept |= self.transients.kept()
            self.checkpoint.save({**self.fitter.state(), **kept}, self.started, seconds)
        self._saved_step, self._saved_at = self._step, time.perf_counter()

    def optimize(self) -> None:
        """Step until done or told to stop. Save on the way, at the end and on Ctrl-C.

        Raises:
            IgsrError: a step fails, or a checkpoint cannot be written.
            RuntimeError: the GPU fails; the last checkpoint stays.
            UserWarning: the last checkpoint cannot be written.
            KeyboardInterrupt: on Ctrl-C, after a checkpoint.
        """
        chunk = 1
        try:
            while not self.is_done:
                self._look_for_transients()
                now = self._last = self._stepped(chunk)
                # A step's time follows the number of splats: follow it, a factor two at a time.
                chunk = max(1, min(2 * chunk, int(now.steps_per_second * CHUNK_SECONDS)))
                if self.report is not None and self.report(now) is False:
                    break
                if self._is_save_due():
                    self.save()
            if self._step > self._saved_step:
                try:
                    self.save()
                except IgsrError as error:
                    # The splats are finished: losing them to a full disk would be the greater harm.
                    warnings.warn(str(error), stacklevel=4)
        except KeyboardInterrupt:
            self.save()
            raise

    @property
    def is_done(self) -> bool:
        """Whether all steps are taken."""
        return self._step >= self.settings.steps

    def end(self, splats: int, removed: Mapping[str, int]) -> None:
        """Report the end of the fit.

        Args:
            splats: number of splats that it ends with.
            removed: of ``Progress``.
        """
        if self.report is None:
            return
        last = self._last or Progress(
            step=self._step,
            steps=self.settings.steps,
            loss=math.nan,
            splats=splats,
            started=self.started,
            seconds=self.seconds_before,
            steps_per_second=0.0,
            backend=self.backend,
            work=work_done(self.settings, *self.size, self._step),
            transients={} if self.transients is None else self.transients.parts(),
        )
        self.report(replace(last, splats=splats, removed=removed))

    def _look_for_transients(self) -> None:
        """Look for transient things where that is due, and go on with what was found."""
        search = self.transients
        if search is None or not search.is_due(self._step):
            return
        try:
            self.fitter = search.look(self.fitter)
        except IgsrError:
            raise
        except ValueError as error:
            raise IgsrError(f"{error}.") from error
        # Where the fit begins anew, it has taken fewer.
        self._step = int(self.fitter.steps_done)
        self.started = search.begun or self.started

    def _stepped(self, count: int) -> Progress:
        """Take ``count`` steps, or as many as there are before the next look or the end."""
        until = self.settings.steps
        if self.transients is not None:
            until = self.transients.next_look(self._step) or until
        began = time.perf_counter()
        try:
            done: dict[str, Any] = self.fitter.step(min(count, until - self._step))
        except ValueError as error:
            raise IgsrError(f"{error}.") from error
        except RuntimeError as error:  # the renderer's RuntimeErrors are the GPU's
            raise RuntimeError(f"{error}{self._kept_words()}") from error
        now = time.perf_counter()
        advanced, self._step = done["step"] - self._step, done["step"]
        return Progress(
            step=self._step,
            steps=self.settings.steps,
            loss=done["loss"],
            splats=done["splats"],
            started=self.started,
            seconds=self.seconds_before + now - self._began,
            steps_per_second=advanced / max(now - began, 1e-9),
            backend=self.backend,
            work=work_done(self.settings, *self.size, self._step),
            transients={} if self.transients is None else self.transients.parts(),
        )

    def _kept_words(self) -> str:
        """What is left of a fit whose device failed."""
        if self.checkpoint is None or not self.checkpoint.path.is_file():
            return ""
        return f"; {self.checkpoint.path} keeps step {self._saved_step}, and resume goes on there"

    def _is_save_due(self) -> bool:
        steps, seconds = self._step - self._saved_step, time.perf_counter() - self._saved_at
        return steps >= CHECKPOINT_STEPS or seconds >= CHECKPOINT_SECONDS
