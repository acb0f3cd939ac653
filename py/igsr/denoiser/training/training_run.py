"""The run of a training: its time, its log, its checkpoints, and who is told how it goes."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr.denoiser.training.learner import Learner
from igsr.denoiser.weights import save_network
from igsr.errors import IgsrError

CHECKPOINT = "checkpoint.pt"
LOG = "log.jsonl"
WEIGHTS = "denoiser.safetensors"
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


class TrainingRun:
    """The files of a training in its folder, and the time that it takes.

    Args:
        out: folder for the log, the checkpoint and the weights.
        about: what the result depends on; a checkpoint of another training is refused.
        steps: steps in all.
        writes: whether this process writes files and reports progress.
        progress: called with each row of the log.
        log_every: steps between rows of the log.
        checkpoint_every: steps between checkpoints and validations; None is a tenth of all, at
            most ``MOST_BETWEEN``.

    Raises:
        IgsrError: a number of steps is below 1.
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
    ) -> None:
        """Note what to do; ``start`` begins."""
        if log_every < 1 or (checkpoint_every is not None and checkpoint_every < 1):
            raise IgsrError("log_every and checkpoint_every must be at least 1.")
        self._out, self._about, self._steps = out, about, steps
        self._writes, self._progress = writes, progress
        self._log_every = log_every
        self._checkpoint_every = checkpoint_every or min(MOST_BETWEEN, max(1, steps // 10))
        self._seconds = 0.0
        self._started = time.monotonic()
        self._board: Any = None

    def start(self, learner: Learner, resume: bool) -> None:
        """Begin, or go on from the checkpoint if there is one and ``resume`` says so.

        Raises:
            IgsrError: the checkpoint is damaged or of another training.
        """
        if resume and (self._out / CHECKPOINT).is_file():
            self._restore(learner)
        if self._writes:
            _cut_log(self._out / LOG, learner.step)
            self._board = _tensorboard(self._out)
        self._started = time.monotonic() - self._seconds

    def stepped(self, step: int, parts: dict[str, float]) -> None:
        """Take the time after a step.

        Raises:
            IgsrError: a part of the loss is not finite.
        """
        self._seconds = time.monotonic() - self._started
        if not all(math.isfinite(part) for part in parts.values()):
            raise IgsrError(
                f"the loss is not finite at step {step}; train with a lower rate, in another --out."
            )

    def logs_at(self, step: int) -> bool:
        """Whether the parts of the loss of this step are logged."""
        return step % self._log_every == 0 or step == self._steps

    def checkpoint_at(self, step: int) -> bool:
        """Whether a validation and a checkpoint follow this step."""
        return step % self._checkpoint_every == 0 or step == self._steps

    def log(self, step: int, row: dict[str, float]) -> None:
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

    def save_checkpoint(self, learner: Learner) -> None:
        """Write a checkpoint that ``start`` goes on from."""
        if not self._writes:
            return
        content = learner.state() | {"seconds": self._seconds, "about": self._about}
        with atomic_write(self._out / CHECKPOINT) as temporary:
            torch.save(content, temporary)

    def save_weights(self, learner: Learner) -> None:
        """Write the denoiser that came out, with what it was trained on and how."""
        if self._writes:
            recipe = {"igsr": _core.__version__, **self._about, "seconds": round(self._seconds)}
            save_network(learner.averaged, self._out / WEIGHTS, recipe)

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
                f"{path} is of a training with other pairs or settings; repeat those, or use "
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
