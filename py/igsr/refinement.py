"""The loop: fit, look from where no photo was taken, clean, choose, add, fit again.

``refine`` reads like Figure 1 of the paper, with two things that it lacked: what is chosen, and how
much each pixel of it counts, is decided without the true pictures; and a round is kept only if
photos that it has not seen say that it helped.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from .capture import Capture, View
from .denoiser import Denoiser, photo_sources, photo_support, render_buffers
from .errors import IgsrError
from .evaluation import default_background, score_views
from .fitting import Progress, fit
from .pose import estimate_poses
from .presets import preset_settings
from .selection import Candidate, candidate, select
from .splats import Splats
from .views import unseen_views

#: Unseen views rendered in a round, and how many of them are added at most.
CANDIDATES, CHOSEN = 16, 8
#: A refit goes on from the splats that there are, with this part of a whole fit's steps.
REFIT_STEPS = 0.25
#: Each of two folds leaves out one photo in so many, and fits with this part of the steps.
FOLDS, LEFT_OUT, FOLD_STEPS = 2, 4, 0.2
#: What an invented pixel counts at most beside a photo's in its first round, and by what this falls
#: from round to round: later renders know what earlier ones invented.
VIEW_WEIGHT, VIEW_DECAY = 0.5, 0.5
#: Most rounds of "auto".
AUTO, MOST_ROUNDS = "auto", 4
#: Scores of photos left out that must become better, and their signs.
DECIDING = {"psnr": 1.0, "ssim": 1.0, "flip": -1.0}


@dataclass(frozen=True)
class RefineProgress:
    """Where a refinement stands.

    Attributes:
        round: 0 is the fit to the photos alone.
        doing: "fit", "look", "judge" or "refit".
        done: part of all that may be to do, in [0, 1]; it ends early if a round does not help.
        seconds: so far.
    """

    round: int
    doing: str
    done: float
    seconds: float


@dataclass(frozen=True, eq=False)
class Round:
    """What one round did.

    Attributes:
        chosen: the views that were added, the one worth most first.
        candidates: how many there were to choose from.
        without: scores ("psnr", "ssim", "flip") of photos left out, by fits that took as many steps
            without the round's views.
        left_out: the same by fits with them.
        accepted: whether all became better; if not, the round's splats are not kept.
        splats: after the round; None where it was not accepted.
    """

    chosen: list[Candidate]
    candidates: int
    without: dict[str, float]
    left_out: dict[str, float]
    accepted: bool
    splats: Splats | None


@dataclass(frozen=True, eq=False)
class Refined:
    """What ``refine`` returns.

    Attributes:
        splats: after the last round that was accepted.
        first: after the fit to the photos alone, which is round 0.
        capture: photos and cameras.
        rounds: those that were tried, in order; only the last can be one that was not accepted.
        stopped: why there was no further round.
    """

    splats: Splats
    first: Splats
    capture: Capture
    rounds: list[Round]
    stopped: str


@dataclass(eq=False)
class _Chain:
    """Splats of some of the photos, with the views that their rounds have added."""

    name: str
    photos: list[View]
    splats: Splats
    added: list[tuple[View, int]] = field(default_factory=list)

    def with_views(self, round_: int, views: Sequence[View]) -> list[View]:
        """Photos, and views of this round and of those before, which count less."""
        return [
            *self.photos,
            *(_faded(view, round_ - since) for view, since in self.added),
            *views,
        ]


def refine(
    photos: str | os.PathLike[str] | Capture,
    rounds: int | str = AUTO,
    progress: Callable[[RefineProgress], bool | None] | None = None,
    *,
    steps: int | None = None,
    backend: str = "auto",
    seed: int = 0,
    denoiser: Denoiser | None = None,
    work: str | os.PathLike[str] | None = None,
    resume: bool = False,
) -> Refined:
    """Fit photos, and make the fit better from views that nobody photographed.

    Args:
        photos: a capture, or a folder of photos, whose cameras are found if it has none.
        rounds: at most so many, or "auto": until one does not help.
        progress: called now and then; returning False ends it with an ``IgsrError``, and what
            is done so far stays in ``work``.
        steps: of the first fit; None is the default preset's.
        backend: "auto", "cpu" or "gpu".
        seed: of everything random; same seed, same bits.
        denoiser: what cleans; None is the one that comes with igsr.
        work: folder for the fits' checkpoints.
        resume: go on from those in ``work``, to the same end.

    Raises:
        IgsrError: an argument cannot be used, or as ``igsr.fit`` and ``igsr.estimate_poses``.
    """
    capture = photos if isinstance(photos, Capture) else estimate_poses(photos, seed=seed)
    loop = _Loop(capture, rounds, progress, steps, backend, seed, denoiser, work, resume)
    whole = loop.fitted("whole", capture.train_views)
    first = whole.splats
    folds = [
        (
            loop.fitted(f"fold{k}", [v for i, v in enumerate(whole.photos) if i not in out], True),
            out,
        )
        for k, out in enumerate(_left_out(len(whole.photos)))
    ]
    done: list[Round] = []
    while len(done) < loop.rounds:
        number = len(done) + 1
        chosen, candidates = loop.looked(number, whole)
        if not chosen:
            return Refined(whole.splats, first, capture, done, loop.why_none(candidates))
        without, left_out = loop.judged(number, folds)
        accepted = all(sign * (left_out[s] - without[s]) > 0.0 for s, sign in DECIDING.items())
        if accepted:
            loop.refitted(number, whole, chosen)
        splats = whole.splats if accepted else None
        done.append(Round(chosen, candidates, without, left_out, accepted, splats))
        if not accepted:
            return Refined(whole.splats, first, capture, done, f"round {number} did not help")
    return Refined(whole.splats, first, capture, done, f"{loop.rounds} rounds were asked for")


class _Loop:
    """The parts of ``refine``, each with what they share."""

    def __init__(
        self,
        capture: Capture,
        rounds: int | str,
        progress: Callable[[RefineProgress], bool | None] | None,
        steps: int | None,
        backend: str,
        seed: int,
        denoiser: Denoiser | None,
        work: str | os.PathLike[str] | None,
        resume: bool,
    ) -> None:
        if rounds != AUTO and (not isinstance(rounds, int) or isinstance(rounds, bool)):
            raise IgsrError(f'rounds must be a whole number or "auto", not {rounds!r}.')
        self.rounds = MOST_ROUNDS if isinstance(rounds, str) else rounds
        if self.rounds < 0:
            raise IgsrError(f"rounds must not be negative, not {rounds}.")
        if resume and work is None:
            raise IgsrError("resume needs work, the folder to go on from.")
        if not capture.train_views:
            raise IgsrError(f"{capture.path} has no train views to fit.")
        self.capture, self.backend, self.seed, self.denoiser = capture, backend, seed, denoiser
        self.background = default_background(capture)
        photos = len(capture.train_views)
        self.steps = int(preset_settings("default", photos, steps=steps)["steps"])
        self.work = None if work is None else Path(work)
        self.resume = resume
        self.progress = progress
        self.started = time.monotonic()
        # In units of a whole fit; looking takes about as long as a refit.
        a_round = 2.0 * REFIT_STEPS + 2.0 * FOLDS * FOLD_STEPS
        self.all = 1.0 + FOLDS * FOLD_STEPS + self.rounds * a_round
        self.done, self.round = 0.0, 0

    def fitted(self, name: str, photos: list[View], short: bool = False) -> _Chain:
        """Photos fitted from the start."""
        steps = self._part(FOLD_STEPS) if short else self.steps
        return _Chain(name, photos, self._fit(name, "fit", photos, steps, None))

    def looked(self, number: int, chain: _Chain) -> tuple[list[Candidate], int]:
        """Unseen views of a chain, cleaned: those chosen, and how many there were."""
        self.round = number
        self._tell("look", 0.0)
        photos, splats = chain.photos, chain.splats
        cameras = [view.camera for view in photos] + [view.camera for view, _ in chain.added]
        views = unseen_views(splats, cameras, CANDIDATES, self.backend)
        support = photo_support(splats, [view.camera for view in photos], self.backend)
        sources = photo_sources(splats, photos, self.background, self.backend)
        found = []
        for view in views:
            buffers = render_buffers(splats, view.camera, support, self.background, self.backend)
            found.append(candidate(view, buffers, sources, self.denoiser))
            self._tell("look", 0.0)
        return select(found, CHOSEN), len(found)

    def judged(
        self, number: int, folds: Sequence[tuple[_Chain, list[int]]]
    ) -> tuple[dict[str, float], dict[str, float]]:
        """Scores of photos left out, without and with what each fold's own round adds.

        A fold goes on with its views: the next round is judged from there.
        """
        scores: tuple[list[dict[str, float]], ...] = ([], [])
        for chain, out in folds:
            left = [self.capture.train_views[i] for i in out]
            chosen, _ = self.looked(number, chain)
            steps = self._part(FOLD_STEPS)
            name = f"{chain.name}-round{number}"
            plain = self._fit(
                f"{name}-without", "judge", chain.with_views(number, []), steps, chain.splats
            )
            self._add(number, chain, chosen, steps, "judge")
            for splats, to in zip((plain, chain.splats), scores, strict=True):
                for scored in score_views(splats, left, self.background, self.backend):
                    to.append({name: float(scored.scores[name] or 0.0) for name in DECIDING})
        without, left_out = (
            {name: float(np.mean([row[name] for row in rows])) for name in DECIDING}
            for rows in scores
        )
        return without, left_out

    def refitted(self, number: int, chain: _Chain, chosen: list[Candidate]) -> None:
        """Go on with all photos and the chosen views."""
        self._add(number, chain, chosen, self._part(REFIT_STEPS), "refit")

    def why_none(self, candidates: int) -> str:
        """Why no view was chosen."""
        if candidates == 0:
            return "there is no unseen view nearby"
        return f"none of {candidates} unseen views can be trusted"

    def _add(
        self, number: int, chain: _Chain, chosen: list[Candidate], steps: int, doing: str
    ) -> None:
        views = [
            self._view(f"{chain.name}-round{number}-{k}.png", one) for k, one in enumerate(chosen)
        ]
        fitted = chain.with_views(number, views)
        name = f"{chain.name}-round{number}"
        chain.splats = self._fit(name, doing, fitted, steps, chain.splats)
        chain.added += [(view, number) for view in views]

    def _view(self, name: str, one: Candidate) -> View:
        """A cleaned view as the fit takes it; with alpha, as rendered, where the photos have it."""
        image = one.picture
        if self.capture.train_views[0].image.shape[2] == 4:
            image = _straight(image, one.alpha, self.background)
        weights = np.float32(VIEW_WEIGHT) * one.trust
        return View(name, one.view.camera, "train", image, None, weights)

    def _part(self, part: float) -> int:
        return max(1, round(part * self.steps))

    def _fit(
        self, name: str, doing: str, views: list[View], steps: int, start: Splats | None
    ) -> Splats:
        share = steps / self.steps

        def progress(now: Progress) -> bool:
            first = now.steps - steps
            self._tell(doing, share * (now.step - first) / steps)
            return True

        path = None if self.work is None else self.work / f"{name}.npz"
        splats = fit(
            Capture(self.capture.path, views, self.capture.points),
            steps,
            progress,
            self.backend,
            self.seed,
            start=start,
            checkpoint=path,
            resume=self.resume and path is not None and path.is_file(),
        )
        self.done += share
        return splats

    def _tell(self, doing: str, doing_done: float) -> None:
        if self.progress is None:
            return
        done = min(1.0, (self.done + doing_done) / self.all)
        seconds = time.monotonic() - self.started
        if self.progress(RefineProgress(self.round, doing, done, seconds)) is False:
            raise IgsrError("refinement was stopped; go on with resume.")


def _left_out(photos: int) -> list[list[int]]:
    """The photos that each fold leaves out, by number; no photo is in two."""
    if photos < 3:
        return []
    return [list(range(k * LEFT_OUT // FOLDS, photos, LEFT_OUT)) for k in range(FOLDS)]


def _faded(view: View, rounds: int) -> View:
    assert view.weights is not None
    return replace(view, weights=view.weights * np.float32(VIEW_DECAY**rounds))


def _straight(
    picture: npt.NDArray[np.uint8],
    alpha: npt.NDArray[np.float32],
    background: Sequence[float],
) -> npt.NDArray[np.uint8]:
    """A picture over a background as RGBA with straight alpha, [H, W, 4]."""
    share = np.clip(alpha, 0.0, 1.0)[..., None]
    behind = np.asarray(background, np.float32) * (1.0 - share)
    own = (picture.astype(np.float32) / 255.0 - behind) / np.maximum(share, 1.0 / 255.0)
    return np.rint(255.0 * np.concatenate([np.clip(own, 0.0, 1.0), share], axis=2)).astype(np.uint8)
