"""Search for the smallest model within a loss: prune, fine-tune, validate, try the next size."""

from __future__ import annotations

import math
import numbers
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.choices import Backend, FitBackend
from igsr._internal.event import Event, Listener
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
from igsr.fitting.fitter import fit_device
from igsr.geometry.frame import Frame
from igsr.run import open_run
from igsr.splats import MAX_SH_DEGREE, Splats
from igsr.splats import subset as splats_subset

#: Fraction of the splats that a pruning round keeps; many small rounds lose less than a large one.
KEPT_FRACTION = 0.8
#: Fine-tuning steps after a pruning round are ``steps`` divided by this.
ROUND_STEPS_DIVISOR = 4
#: Loss that further fine-tuning can recover, dB.
RECOVERABLE_DB = 0.5
DEFAULT_STEPS = 4000


@dataclass(frozen=True)
class Compaction:
    """Result of a compaction.

    Attributes:
        splats: the smallest model within the loss.
        report: "max_loss", "whole" and "result" (rows of "curve"), "curve" (a row per candidate,
            the original model first: "splats", "sh_degree", "bytes", "loss", "psnr", "ssim",
            "settled": whether fine-tuning was complete, "seconds"), "protocol", "steps", "seed",
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
    backend: FitBackend = "auto",
    progress: Listener | None = None,
) -> Compaction:
    """Find the smallest model that loses at most ``max_loss`` dB against ``splats``.

    Each round prunes the fifth of the splats that contribute least
    (``igsr.compaction.contribution``) and fine-tunes the remaining ones, until the loss is more
    than fine-tuning can recover. Then models are fine-tuned completely, the smallest first, until
    one is within the loss. At that size, lower SH degrees are tried.

    The result is deterministic for a given seed, backend and instruction set.

    Args:
        splats: the original model; splats that are not finite do not count.
        max_loss: maximum loss of PSNR, dB, in (0, 100). With a capture it is the original model's
            PSNR minus the smaller model's on held-out photos: the test views, or every eighth
            train view if there are none. Without a capture it is
            10 log10(1 + MSE of the change / MSE of the model), on renders of the original model
            from cameras around it.
        capture: the photos that the model was fitted to.
        psnr: assumed PSNR of the original model without a capture, dB; None is 30.
        sh_degree: of the smaller model, 0-4; a higher degree needs fewer splats with more bytes
            each. None starts at the original model's and tries lower ones at the size found.
        steps: fine-tuning steps of a final candidate; a quarter of them after each pruning round.
        seed: of everything random.
        background: RGB in [0, 1] behind validation renders; None is gray without a capture, white
            if photos have alpha, else black.
        backend: "auto" (a real GPU if one answers, else "cpu"), "cpu" or "gpu".
        progress: called with each ``igsr.Event``; an exception ends the search. In an interactive
            session, None shows a progress bar.

    Raises:
        IgsrError: an argument cannot be used; the message names it.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    _check_arguments(max_loss, capture, psnr, sh_degree, steps, seed, background)
    info = fit_device(backend)
    if splats.antialiased:
        raise IgsrError("Antialiased splats cannot be compacted: fits render without antialiasing.")
    name = _core.resolve_backend(backend)
    frame = Frame.of_splats(splats)
    # A backdrop would be pruned, since photos show little of it.
    given = splats.without_backdrop()
    bare = frame.splats(given)
    finite = subset(fresh_state(bare), np.flatnonzero(bare.finite))
    whole = splats_of(finite, bare.origin)
    if len(whole) == 0:
        raise IgsrError("The scene has no finite splats to compact.")
    if capture is None:
        validation = self_validation(whole, background, psnr, name)
    else:
        validation = photo_validation(whole, frame.capture(capture), background, name)
    with open_run(None, progress) as run:
        search = _Search(
            validation, frame, whole.origin, max_loss, sh_degree, steps, seed, name, run.report
        )
        best = search.run(whole)
    smallest = frame.inverse.splats(splats_of(best.state, whole.origin))
    if best.row is search.curve[0]:
        smallest = splats_subset(given, given.finite)  # without the rounding of the frame
    return Compaction(
        smallest.with_backdrop_of(splats),
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
    """A model with its optimizer state, and its row of the curve."""

    state: State
    row: dict[str, Any]

    @property
    def count(self) -> int:
        return len(self.state["means"])


@dataclass
class _Search:
    """The settings of a search, and its curve so far."""

    validation: Validation
    frame: Frame
    origin: npt.NDArray[np.float64]
    max_loss: float
    sh_degree: int | None
    steps: int
    seed: int
    backend: Backend
    report: Listener
    curve: list[dict[str, Any]] = field(default_factory=list)

    def run(self, whole: Splats) -> _Candidate:
        started, state = time.perf_counter(), fresh_state(whole)
        rounds = self._prune_rounds(self._record(state, self._score(state), True, started))
        best, too_small = self._smallest_within_loss(rounds)
        if too_small is not None:
            best = self._between(rounds, best, too_small)
        return best if self.sh_degree is not None else self._lower_sh_degree(best)

    def _prune_rounds(self, whole: _Candidate) -> list[_Candidate]:
        """Prune until the loss cannot be recovered."""
        rounds = [whole]
        steps = max(1, self.steps // ROUND_STEPS_DIVISOR)
        while rounds[-1].count > 1 and self._within_reach(rounds[-1].row["loss"]):
            count = max(1, int(KEPT_FRACTION * rounds[-1].count))
            start = rounds[-1]
            if self.sh_degree is not None:
                start = replace(start, state=with_sh_degree(start.state, self.sh_degree))
            rounds.append(self._refined_candidate(start, count, steps, settle=False))
        return rounds

    def _smallest_within_loss(self, rounds: list[_Candidate]) -> tuple[_Candidate, int | None]:
        """Find the smallest model within the loss, and the next smaller size."""
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
        """Try the geometric mean of the best size and the next smaller one."""
        count = round(math.sqrt(best.count * too_small))
        if not too_small < count < best.count:
            return best
        start = next(candidate for candidate in rounds if candidate.count == best.count)
        candidate = self._refined_candidate(start, count, self.steps, settle=True)
        return candidate if self._within_loss(candidate) else best

    def _lower_sh_degree(self, best: _Candidate) -> _Candidate:
        """Lower the SH degree as far as the loss allows."""
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
        return loss <= self.max_loss + RECOVERABLE_DB

    def _refined_candidate(
        self, start: _Candidate, count: int, steps: int, settle: bool
    ) -> _Candidate:
        """Fine-tune the ``count`` most important splats of ``start``."""
        started = time.perf_counter()
        number = len(self.curve)
        degree = round(start.state["sh"].shape[1] ** 0.5) - 1

        def on_steps(step: int) -> None:
            message = f"size {number}: {count} splats, SH {degree}"
            values = {"splats": count, "sh_degree": degree, "trial": number}
            self.report(Event("compact", step, steps, message, values=values))

        on_steps(0)
        state = start.state
        if count < start.count:
            cameras = [view.camera for view in self.validation.train_views]
            splats = splats_of(state, self.origin)
            importance = contribution(splats, cameras, self.seed, self.backend).importance
            # Stable, so that ties give the same result on all machines.
            most = np.argsort(-importance, kind="stable")[:count]
            state = subset(state, np.sort(most))
        # Each candidate has another seed, so that they see the photos in different orders.
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
        # A few steps can make a model worse that is already very good.
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
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "scene.ply"
            self.frame.inverse.splats(model).save(path)
            size = path.stat().st_size
        row = {
            "splats": len(model),
            "sh_degree": model.sh_degree,
            "bytes": size,
            **asdict(score),
            "settled": settled,
            "seconds": round(time.perf_counter() - started, 3),
        }
        self.curve.append(row)
        return _Candidate(state, row)


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
        raise IgsrError("psnr is measured on the capture's photos; give psnr or capture, not both.")
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
