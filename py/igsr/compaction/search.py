"""Search for the smallest model within a loss: prune, fine-tune, validate, try the next size."""

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
from igsr._internal.choices import Backend, FitBackend
from igsr._internal.progress_bar import BarState, progress_or_bar
from igsr.capture import Capture
from igsr.compaction.contribution import contribution
from igsr.compaction.finetuning import (
    State,
    fresh_state,
    refined,
    splats_of,
    subset,
    with_sh_degree,
)
from igsr.compaction.validation import (
    Validation,
    ValidationScore,
    photo_validation,
    self_validation,
)
from igsr.errors import IgsrError
from igsr.fitting.fit_capture import check_fits
from igsr.splats import MAX_SH_DEGREE, Splats

#: Fraction of the splats that a pruning round keeps. Many small rounds lose less than one large.
KEEP = 0.8
#: A pruning round is followed by ``steps`` divided by this.
DESCENT_PART = 4
#: Fine-tuning to the end recovers at most this much of the loss, dB; the search stops beyond it.
RECOVERABLE = 0.5
DEFAULT_STEPS = 4000


@dataclass(frozen=True)
class CompactProgress:
    """Progress of a compaction.

    Attributes:
        trial: number of the current candidate model, from 1.
        splats: its number of splats.
        sh_degree: its SH degree.
        step: fine-tuning steps done, of ``steps``.
        steps: fine-tuning steps of this candidate.
    """

    trial: int
    splats: int
    sh_degree: int
    step: int
    steps: int


def _bar_state(now: CompactProgress) -> BarState:
    return BarState(
        now.step, now.steps, f"size {now.trial}: {now.splats} splats, SH {now.sh_degree}"
    )


@dataclass(frozen=True)
class Compaction:
    """The smallest model found, and the curve of all sizes tried.

    Attributes:
        splats: the model.
        report: "max_loss", "whole" and "result" (rows of "curve"), "curve" (a row per size tried,
            the original model first: "splats", "sh_degree", "bytes", "loss", "psnr", "ssim",
            "settled": whether it was fine-tuned to the end, "seconds"), "protocol", "steps",
            "seed", "backend", "device", "instruction_set", "version". Losses and PSNR in dB.
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
    backend: FitBackend = "auto",
    progress: Callable[[CompactProgress], bool | None] | None = None,
) -> Compaction:
    """Find the smallest model that loses at most ``max_loss`` dB against ``splats``.

    Each round prunes the fifth of the splats that contribute least
    (``igsr.compaction.contribution``) and fine-tunes the others, until the loss is more than
    fine-tuning can recover. From there upwards, models are fine-tuned to the end until one is
    within the loss. At that size, lower SH degrees are tried.

    Deterministic for a given seed on one backend and instruction set.

    Args:
        splats: the original model; splats that are not finite are never drawn and do not count.
        max_loss: dB of PSNR that may be lost, in (0, 100). With a capture the loss is the
            original model's PSNR minus the smaller one's on held-out photos: the test views, or
            every eighth train view where there are none. Without a capture it is
            10 log10(1 + MSE of the change / MSE of the model), on renders of the original model
            from cameras around it.
        capture: the photos that the model was fitted to.
        psnr: without a capture, the PSNR assumed of the original model, dB; 30 if None.
        sh_degree: of the smaller model, 0-4: a higher one needs fewer splats but more bytes for
            each. None is the original model's; lower ones are tried at the size found.
        steps: fine-tuning steps of a model that may be the result; a quarter of them after each
            pruning round.
        seed: of everything random.
        background: RGB in [0, 1] behind validation renders; None is white where photos have
            alpha, black where they have none, grey without a capture.
        backend: "auto" (a real GPU if one answers, else "cpu"), "cpu" or "gpu".
        progress: called every few fine-tuning steps; returning False ends it with an ``IgsrError``.
            In an interactive session, None shows a progress bar.

    Raises:
        IgsrError: an argument cannot be used; the message names it.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    _check_arguments(max_loss, capture, psnr, sh_degree, steps, seed, background)
    info = check_fits(backend)
    if splats.antialiased:
        raise IgsrError("Antialiased splats cannot be compacted: fits render without antialiasing.")
    name = _core.resolve_backend(backend)
    # Photos show nearly nothing of a backdrop: by what they show it would go.
    bare = splats.without_backdrop()
    finite = subset(fresh_state(bare), np.flatnonzero(bare.finite))
    whole = splats_of(finite, splats.origin)
    if len(whole) == 0:
        raise IgsrError("The scene has no finite splats to compact.")
    if capture is None:
        validation = self_validation(whole, background, psnr, name)
    else:
        validation = photo_validation(whole, capture, background, name)
    with progress_or_bar(progress, "compact", _bar_state) as report:
        search = _Search(validation, whole.origin, max_loss, sh_degree, steps, seed, name, report)
        best = search.run(whole)
    return Compaction(
        splats_of(best.state, whole.origin).with_backdrop_of(splats),
        {
            "max_loss": float(max_loss),
            "whole": search.curve[0],
            "result": best.row,
            "curve": search.curve,
            "protocol": validation.protocol,
            "steps": int(steps),
            "seed": int(seed),
            **info,
            "version": _core.__version__,
        },
    )


@dataclass(frozen=True)
class _Candidate:
    """A model with its optimiser state, and its row of the curve."""

    state: State
    row: dict[str, Any]

    @property
    def count(self) -> int:
        return len(self.state["means"])


class _Search:
    """The curve so far and what is the same for all trials."""

    def __init__(
        self,
        validation: Validation,
        origin: npt.NDArray[np.float64],
        max_loss: float,
        sh_degree: int | None,
        steps: int,
        seed: int,
        backend: Backend,
        progress: Callable[[CompactProgress], bool | None] | None,
    ) -> None:
        self.validation = validation
        self.origin = origin
        self.max_loss = max_loss
        self.sh_degree = sh_degree
        self.steps = steps
        self.seed = seed
        self.backend = backend
        self.progress = progress
        self.curve: list[dict[str, Any]] = []

    def run(self, whole: Splats) -> _Candidate:
        """The smallest model within the loss."""
        started, state = time.perf_counter(), fresh_state(whole)
        rounds = self._prune_rounds(self._record(state, self._score(state), True, started))
        best, too_small = self._smallest_within_loss(rounds)
        if too_small is not None:
            best = self._between(rounds, best, too_small)
        return best if self.sh_degree is not None else self._lower_sh_degree(best)

    def _prune_rounds(self, whole: _Candidate) -> list[_Candidate]:
        """Smaller and smaller models, down to the first beyond recovery."""
        rounds = [whole]
        steps = max(1, self.steps // DESCENT_PART)
        while rounds[-1].count > 1 and self._within_reach(rounds[-1].row["loss"]):
            count = max(1, int(KEEP * rounds[-1].count))
            start = rounds[-1]
            if self.sh_degree is not None:
                start = replace(start, state=with_sh_degree(start.state, self.sh_degree))
            rounds.append(self._refined_candidate(start, count, steps, settle=False))
        return rounds

    def _smallest_within_loss(self, rounds: list[_Candidate]) -> tuple[_Candidate, int | None]:
        """From below, the first model within the loss, and the size of the one before."""
        too_small = None
        for candidate in reversed(rounds):
            if self._within_loss(candidate):
                return candidate, too_small
            if self._within_reach(candidate.row["loss"]):
                candidate = self._refined_candidate(
                    candidate, candidate.count, self.steps, settle=True
                )
                if self._within_loss(candidate):
                    return candidate, too_small
            too_small = candidate.count
        return rounds[0], too_small

    def _between(self, rounds: list[_Candidate], best: _Candidate, too_small: int) -> _Candidate:
        """A last candidate half way (geometric mean) to the size that is too small."""
        count = round(math.sqrt(best.count * too_small))
        if not too_small < count < best.count:
            return best
        start = next(candidate for candidate in rounds if candidate.count == best.count)
        candidate = self._refined_candidate(start, count, self.steps, settle=True)
        return candidate if self._within_loss(candidate) else best

    def _lower_sh_degree(self, best: _Candidate) -> _Candidate:
        """The same number of splats with the lowest SH degree that the loss allows."""
        while (degree := best.row["sh_degree"] - 1) >= 0:
            state = with_sh_degree(best.state, degree)
            if not self._within_reach(self._score(state).loss):
                break
            candidate = self._refined_candidate(
                _Candidate(state, {}), best.count, self.steps, settle=True
            )
            if not self._within_loss(candidate):
                break
            best = candidate
        return best

    def _within_loss(self, candidate: _Candidate) -> bool:
        return bool(candidate.row["loss"] <= self.max_loss)

    def _within_reach(self, loss: float) -> bool:
        return loss <= self.max_loss + RECOVERABLE

    def _refined_candidate(
        self, start: _Candidate, count: int, steps: int, settle: bool
    ) -> _Candidate:
        """``start`` with its ``count`` most important splats, fine-tuned."""
        started = time.perf_counter()
        number = len(self.curve)
        degree = round(start.state["sh"].shape[1] ** 0.5) - 1

        def on_steps(step: int) -> None:
            if self.progress is None:
                return
            if self.progress(CompactProgress(number, count, degree, step, steps)) is False:
                raise IgsrError("The compaction was stopped.")

        on_steps(0)
        state = start.state
        if count < start.count:
            cameras = [view.camera for view in self.validation.train_views]
            splats = splats_of(state, self.origin)
            importance = contribution(splats, cameras, self.seed, self.backend).importance
            # Stable: equal importance must not depend on the sorting of one machine.
            most = np.argsort(-importance, kind="stable")[:count]
            state = subset(state, np.sort(most))
        # A seed of its own, or every candidate would see the photos in the same order.
        seed = int(np.random.default_rng([self.seed, number]).integers(2**63))
        after = refined(
            state,
            self.origin,
            self.validation.train_views,
            steps,
            settle,
            seed,
            self.backend,
            on_steps,
        )
        # A few steps of fitting can make a model worse that is already very near: keep the better.
        score, state = min(
            ((self._score(either), either) for either in (after, state)),
            key=lambda scored: scored[0].loss,
        )
        return self._record(state, score, settle, started)

    def _score(self, state: State) -> ValidationScore:
        return self.validation.score(splats_of(state, self.origin), self.backend)

    def _record(
        self, state: State, score: ValidationScore, settled: bool, started: float
    ) -> _Candidate:
        model = splats_of(state, self.origin)
        row = {
            "splats": len(model),
            "sh_degree": model.sh_degree,
            "bytes": _bytes(model),
            "loss": score.loss,
            "psnr": score.psnr,
            "ssim": score.ssim,
            "settled": settled,
            "seconds": round(time.perf_counter() - started, 3),
        }
        self.curve.append(row)
        return _Candidate(state, row)


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
