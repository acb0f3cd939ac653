"""The run of a training: its steps, time, log and checkpoints, and who is told how it goes."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr.errors import IgsrError

CHECKPOINT = "checkpoint.pt"
LOG = "log.jsonl"
#: Steps between checkpoints, at most.
MOST_BETWEEN = 500


@dataclass(frozen=True)
class TrainingProgress:
    """Where a training stands.

    Attributes:
        step: steps done, of ``steps``.
        steps: steps in all.
        parts: parts of the loss and validation scores, by name.
        seconds: time spent, earlier runs that were resumed included.
    """

    step: int
    steps: int
    parts: dict[str, float]
    seconds: float


class Learner(Protocol):
    """What learns.

    Attributes:
        step: steps done.
        device: where its arrays are.
    """

    step: int
    device: torch.device

    def state(self) -> dict[str, Any]:
        """What a checkpoint holds, "step" among it, but neither "seconds" nor "about"."""
        ...

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from what ``state`` gave."""
        ...


class TrainingRun:
    """The steps of a training, its files in its folder, and the time that it takes.

    Args:
        out: folder for the log and the checkpoint.
        about: what the result depends on; a checkpoint of another training is refused.
        steps: steps in all.
        writes: whether this process writes files and reports progress.
        progress: called with each row of the log.
        log_every: steps between rows of the log.
        checkpoint_every: steps between checkpoints and validations; None is a tenth of all, at
            most ``MOST_BETWEEN``.
        resume: go on from the checkpoint, if there is one.

    Raises:
        IgsrError: a number of steps is below 1, or there is a checkpoint and ``resume`` is off.
    """

    def __init__(
        self,
        out: Path,
        about: dict[str, Any],
        steps: int,
        *,
        writes: bool,
        progress: Callable[[TrainingProgress], None] | None,
        log_every: int,
        checkpoint_every: int | None,
        resume: bool,
    ) -> None:
        """Note what to do; ``train`` begins."""
        if not resume and (out / CHECKPOINT).is_file():
            raise IgsrError(
                f"{out / CHECKPOINT} is of an earlier training; go on with it by --resume "
                "(resume=True), or give another --out."
            )
        if log_every < 1 or (checkpoint_every is not None and checkpoint_every < 1):
            raise IgsrError("log_every and checkpoint_every must be at least 1.")
        self._out, self._about, self._steps = out, about, steps
        self._writes, self._progress, self._resume = writes, progress, resume
        self._log_every = log_every
        self._checkpoint_every = checkpoint_every or min(MOST_BETWEEN, max(1, steps // 10))
        self._seconds = 0.0
        self._started = time.monotonic()
        self._board: Any = None

    def train(
        self,
        learner: Learner,
        learn: Callable[[int], dict[str, float]],
        validate: Callable[[], dict[str, float]],
        *,
        validate_first: bool = False,
    ) -> None:
        """Learn from where the learner stands to the last step.

        Args:
            learner: what learns.
            learn: does the step after the given number of steps, and returns parts of the loss.
            validate: scores by name.
            validate_first: whether what has learned nothing yet is validated, too.

        Raises:
            IgsrError: the checkpoint is damaged or of another training, or a part of the loss is
                not finite.
        """
        self._start(learner)
        if validate_first and learner.step == 0:
            self._write_row(0, validate())
        while learner.step < self._steps:
            parts = learn(learner.step)
            step = learner.step
            self._stepped(step, parts)
            row = dict(parts) if step % self._log_every == 0 or step == self._steps else {}
            checkpoint = step % self._checkpoint_every == 0 or step == self._steps
            if checkpoint:
                row |= validate()
            self._write_row(step, row)
            # After its row of the log: what comes later is cut from there, what lacks stays
            # lacking.
            if checkpoint:
                self._save_checkpoint(learner)

    def recipe(self) -> dict[str, Any]:
        """What came out was trained on and how, and with which igsr; to be kept beside it."""
        return {"igsr": _core.__version__, **self._about, "seconds": round(self._seconds)}

    def _start(self, learner: Learner) -> None:
        if self._resume and (self._out / CHECKPOINT).is_file():
            self._restore(learner)
        if self._writes:
            _cut_log(self._out / LOG, learner.step)
            self._board = _tensorboard(self._out)
        self._started = time.monotonic() - self._seconds

    def _stepped(self, step: int, parts: dict[str, float]) -> None:
        self._seconds = time.monotonic() - self._started
        if not all(math.isfinite(part) for part in parts.values()):
            raise IgsrError(
                f"the loss is not finite at step {step}; train with a lower rate, in another --out."
            )

    def _write_row(self, step: int, row: dict[str, float]) -> None:
        """Write a row of the log and report progress; an empty row is none."""
        if not (row and self._writes):
            return
        line = json.dumps({"step": step, "seconds": round(self._seconds, 1), **row})
        with (self._out / LOG).open("a", encoding="utf-8") as file:
            file.write(line + "\n")
        if self._board is not None:
            for name, value in row.items():
                self._board.add_scalar(name, value, step)
        if self._progress is not None:
            self._progress(TrainingProgress(step, self._steps, row, self._seconds))

    def _save_checkpoint(self, learner: Learner) -> None:
        if not self._writes:
            return
        content = learner.state() | {"seconds": self._seconds, "about": self._about}
        with atomic_write(self._out / CHECKPOINT) as temporary:
            torch.save(content, temporary)

    def _restore(self, learner: Learner) -> None:
        path = self._out / CHECKPOINT
        try:
            content = torch.load(path, weights_only=True, map_location=learner.device)
            same = content["about"] == self._about
        except Exception as error:  # torch raises anything at all on damaged files
            raise IgsrError(
                f"{path} is no whole checkpoint; delete it to train from the start."
            ) from error
        if not same:
            raise IgsrError(
                f"{path} is of a training with other data or settings; repeat those, or use "
                "another --out."
            )
        learner.load_state(content)
        self._seconds = content["seconds"]


def _cut_log(path: Path, step: int) -> None:
    """Leave the log's whole lines up to ``step``: later ones are written again."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return
    kept = []
    for line in lines if step else []:
        try:
            row = json.loads(line)
        except ValueError:  # torn when a training was killed
            continue
        if row["step"] <= step:
            kept.append(f"{line}\n")
    with atomic_write(path) as temporary:
        temporary.write_text("".join(kept), encoding="utf-8")


def _tensorboard(out: Path) -> Any:
    """A writer of TensorBoard's files, or None where it is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(out / "tensorboard")
