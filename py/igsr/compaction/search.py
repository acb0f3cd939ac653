"""The smallest model within a loss: prune, refine, judge, and choose the next size by that."""

from __future__ import annotations

import math
import numbers
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.capture import Capture
from igsr.compaction.contribution import contribution
from igsr.compaction.finetuning import (
    State,
    chosen,
    fresh_state,
    refined,
    splats_of,
    with_sh_degree,
)
from igsr.compaction.yardstick import Verdict, Yardstick, own_yardstick, photo_yardstick
from igsr.errors import IgsrError
from igsr.fitting.run import check_fits
from igsr.splats import MAX_SH_DEGREE, Splats

#: Part of the splats that one round of pruning leaves. Many small rounds lose less than one large.
KEEP = 0.8
#: Part of ``steps`` that follows each round.
DESCENT_PART = 4
#: What refining to the end may win back of the loss, dB; what needs more is given up.
HOPE = 0.5
DEFAULT_STEPS = 4000


@dataclass(frozen=True)
class CompactProgress:
    """Where a compaction stands.

    Attributes:
        trial: number of the model that is tried now, from 1.
        splats: its size.
        sh_degree: its SH degree.
        step: refinement steps done, of ``steps``.
        steps: refinement steps of this model.
    """

    trial: int
    splats: int
    sh_degree: int
    step: int
    steps: int


@dataclass(frozen=True)
class Compaction:
    """The smallest model found, and what else was tried.

    Attributes:
        splats: the model.
        report: "max_loss", "whole" and "result" (rows of "curve"), "curve" (a row per size tried,
            the whole model first: "splats", "sh_degree", "bytes", "loss", "psnr", "ssim",
            "settled": whether it was refined to the end, "seconds"), "protocol", "steps", "seed",
            "backend", "device", "instruction_set", "version". Losses and PSNR in dB.
    """

    splats: Splats
    report: dict[str, Any]


def compact(
    splats: Splats,
    max_loss: float = 0.1,
    capture: Capture | None = None,
    *,
    psnr: float | None = None,
    sh_degree: int | None = None,
    steps: int = DEFAULT_STEPS,
    seed: int = 0,
    background: Sequence[float] | None = None,
    backend: str = "auto",
    progress: Callable[[CompactProgress], None] | None = None,
) -> Compaction:
    """The smallest model whose pictures are as good as those of ``splats``, but for ``max_loss``.

    Round by round, the fifth of the splats that contribute least
    (``igsr.compaction.contribution``) is removed and the others are refined, until the loss is
    beyond hope. From there upwards, models are refined to the end until one is good. At that size,
    lower SH degrees are tried.
    The same arguments give the same bits on one backend and instruction set.

    Args:
        splats: the whole model; splats that are not finite, which are never drawn, do not count.
        max_loss: dB of PSNR that may be lost, above 0. With a capture the loss is the whole
            model's PSNR less the smaller one's, on photos that judge and are not refined to: the
            test views, or every eighth train view where there are none. Without a capture it is
            10 log10(1 + MSE of the change / MSE of the model), on pictures of the model from
            cameras around it.
        capture: the photos that the model was fitted to.
        psnr: without a capture, what the model's own PSNR is taken to be, dB; 30 if None.
        sh_degree: of the smaller model, 0-4: a higher one needs fewer splats but more bytes for
            each. None is the whole model's, and lower ones are tried at the size found.
        steps: refinement steps to the end; a quarter of it after each round of pruning.
        seed: of everything random.
        background: RGB in [0, 1] behind judged pictures; None is white where photos have alpha,
            black where they have none, grey without a capture.
        backend: "auto" (a real GPU if one answers, else "cpu"), "cpu" or "gpu".
        progress: called every few refinement steps.

    Raises:
        IgsrError: an argument cannot be used; the message names it.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    _check_arguments(max_loss, capture, psnr, sh_degree, steps, seed, background)
    info = check_fits(backend)
    if splats.antialiased:
        raise IgsrError("Antialiased splats cannot be made fewer: fits draw without that.")
    name = info["backend"]
    finite = chosen(fresh_state(splats), np.flatnonzero(splats.finite))
    whole = splats_of(finite, splats.origin)
    if len(whole) == 0:
        raise IgsrError("The scene has no finite splats to make fewer.")
    if capture is None:
        yardstick = own_yardstick(whole, background, psnr, name)
    else:
        yardstick = photo_yardstick(whole, capture, background, name)
    search = _Search(yardstick, whole.origin, max_loss, sh_degree, steps, seed, name, progress)
    best = search.run(whole)
    return Compaction(
        splats_of(best.state, whole.origin),
        {
            "max_loss": float(max_loss),
            "whole": search.curve[0],
            "result": best.row,
            "curve": search.curve,
            "protocol": yardstick.protocol,
            "steps": int(steps),
            "seed": int(seed),
            **info,
            "version": _core.__version__,
        },
    )


@dataclass(frozen=True)
class _Trial:
    """A model with what its refinement can go on from, and its row of the curve."""

    state: State
    row: dict[str, Any]

    @property
    def count(self) -> int:
        return len(self.state["means"])


class _Search:
    """What is tried so far and what is the same for all trials."""

    def __init__(
        self,
        yardstick: Yardstick,
        origin: npt.NDArray[np.float64],
        max_loss: float,
        sh_degree: int | None,
        steps: int,
        seed: int,
        backend: str,
        progress: Callable[[CompactProgress], None] | None,
    ) -> None:
        self.yardstick = yardstick
        self.origin = origin
        self.max_loss = max_loss
        self.sh_degree = sh_degree
        self.steps = steps
        self.seed = seed
        self.backend = backend
        self.progress = progress
        self.curve: list[dict[str, Any]] = []

    def run(self, whole: Splats) -> _Trial:
        """The smallest model within the loss."""
        started, state = time.perf_counter(), fresh_state(whole)
        ladder = self._descend(self._recorded(state, self._verdict(state), True, started))
        best, too_few = self._smallest_good(ladder)
        if too_few is not None:
            best = self._between(ladder, best, too_few)
        return best if self.sh_degree is not None else self._fewer_bands(best)

    def _descend(self, whole: _Trial) -> list[_Trial]:
        """Models smaller and smaller, down to the first that is beyond hope."""
        ladder = [whole]
        steps = max(1, self.steps // DESCENT_PART)
        while ladder[-1].count > 1 and self._hopeful(ladder[-1].row["loss"]):
            count = max(1, int(KEEP * ladder[-1].count))
            start = ladder[-1]
            if self.sh_degree is not None:
                start = replace(start, state=with_sh_degree(start.state, self.sh_degree))
            ladder.append(self._tried(start, count, steps, settle=False))
        return ladder

    def _smallest_good(self, ladder: list[_Trial]) -> tuple[_Trial, int | None]:
        """From below, the first of the ladder within the loss, and the size of the one before."""
        too_few = None
        for trial in reversed(ladder):
            if self._good(trial):
                return trial, too_few
            if self._hopeful(trial.row["loss"]):
                trial = self._tried(trial, trial.count, self.steps, settle=True)
                if self._good(trial):
                    return trial, too_few
            too_few = trial.count
        return ladder[0], too_few

    def _between(self, ladder: list[_Trial], best: _Trial, too_few: int) -> _Trial:
        """A last try half way to what is too few."""
        count = round(math.sqrt(best.count * too_few))
        if not too_few < count < best.count:
            return best
        start = next(trial for trial in ladder if trial.count == best.count)
        trial = self._tried(start, count, self.steps, settle=True)
        return trial if self._good(trial) else best

    def _fewer_bands(self, best: _Trial) -> _Trial:
        """The same with as low an SH degree as the loss allows."""
        while (degree := best.row["sh_degree"] - 1) >= 0:
            state = with_sh_degree(best.state, degree)
            if not self._hopeful(self._verdict(state).loss):
                break
            trial = self._tried(_Trial(state, {}), best.count, self.steps, settle=True)
            if not self._good(trial):
                break
            best = trial
        return best

    def _good(self, trial: _Trial) -> bool:
        return bool(trial.row["loss"] <= self.max_loss)

    def _hopeful(self, loss: float) -> bool:
        return loss <= self.max_loss + HOPE

    def _tried(self, start: _Trial, count: int, steps: int, settle: bool) -> _Trial:
        """``start`` with its ``count`` most important splats, refined."""
        started = time.perf_counter()
        number = len(self.curve)
        degree = round(start.state["sh"].shape[1] ** 0.5) - 1

        def on_steps(step: int) -> None:
            if self.progress is not None:
                self.progress(CompactProgress(number, count, degree, step, steps))

        on_steps(0)
        state = start.state
        if count < start.count:
            cameras = [view.camera for view in self.yardstick.refine_views]
            splats = splats_of(state, self.origin)
            importance = contribution(splats, cameras, self.seed, self.backend).importance
            # Stable: equal importance must not depend on the sorting of one machine.
            most = np.argsort(-importance, kind="stable")[:count]
            state = chosen(state, np.sort(most))
        # Draws of its own, or every trial would see the photos in the same order.
        seed = int(np.random.default_rng([self.seed, number]).integers(2**63))
        after = refined(
            state,
            self.origin,
            self.yardstick.refine_views,
            steps,
            settle,
            seed,
            self.backend,
            on_steps,
        )
        # A model that is nearer to the pictures than a few steps of fitting come is left alone.
        verdict, state = min(
            ((self._verdict(either), either) for either in (after, state)),
            key=lambda judged: judged[0].loss,
        )
        return self._recorded(state, verdict, settle, started)

    def _verdict(self, state: State) -> Verdict:
        return self.yardstick.judge(splats_of(state, self.origin), self.backend)

    def _recorded(self, state: State, verdict: Verdict, settled: bool, started: float) -> _Trial:
        model = splats_of(state, self.origin)
        row = {
            "splats": len(model),
            "sh_degree": model.sh_degree,
            "bytes": _bytes(model),
            "loss": verdict.loss,
            "psnr": verdict.psnr,
            "ssim": verdict.ssim,
            "settled": settled,
            "seconds": round(time.perf_counter() - started, 3),
        }
        self.curve.append(row)
        return _Trial(state, row)


def _bytes(splats: Splats) -> int:
    """Size of the file that ``splats`` are saved as."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.ply"
        splats.save(path)
        return path.stat().st_size


def _check_arguments(
    max_loss: object,
    capture: Capture | None,
    psnr: object,
    sh_degree: object,
    steps: object,
    seed: object,
    background: object,
) -> None:
    numbers_above_zero = [("max_loss", max_loss)] + ([] if psnr is None else [("psnr", psnr)])
    for name, value in numbers_above_zero:
        real = isinstance(value, numbers.Real) and not isinstance(value, bool)
        if not real or not 0.0 < float(value) < 100.0:  # type: ignore[arg-type]
            raise IgsrError(f"{name} must be a number of dB above 0 and below 100, not {value!r}.")
    if psnr is not None and capture is not None:
        raise IgsrError("psnr is measured on the capture's photos; leave psnr or capture out.")
    limits = [("steps", steps, 1, 10_000_000), ("seed", seed, 0, 2**63 - 1)]
    if sh_degree is not None:
        limits.append(("sh_degree", sh_degree, 0, MAX_SH_DEGREE))
    for name, value, low, high in limits:
        whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
        if not whole or not low <= int(value) <= high:  # type: ignore[call-overload]
            raise IgsrError(f"{name} must be a whole number from {low} to {high}, not {value!r}.")
    if background is not None:
        try:
            color = np.asarray(background, dtype=np.float64)
        except (TypeError, ValueError):
            color = np.zeros(0)
        if color.shape != (3,) or not ((color >= 0.0) & (color <= 1.0)).all():
            raise IgsrError(f"background must be three numbers in 0..1, not {background!r}.")
