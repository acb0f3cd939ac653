"""The loop: fit, look from where no photo was taken, clean, choose, add, fit again.

``refine`` reads like Figure 1 of the paper, with two things that it lacked: what is chosen, and how
much each pixel of it counts, is decided without the true pictures; and a round is kept only if
photos that it has not seen say that it helped.
"""

from __future__ import annotations

import contextlib
import os
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from igsr._internal.atomic_write import remove_unfinished
from igsr.capture import Camera, Capture, View, load_capture
from igsr.capture.downscaling import halved
from igsr.capture.load import holds_cameras
from igsr.capture.photo_checks import check_photos
from igsr.capture.write_colmap import write_colmap
from igsr.denoiser import (
    Denoiser,
    NetworkDenoiser,
    load_network,
    photo_sources,
    photo_support,
    render_buffers,
)
from igsr.errors import IgsrError
from igsr.evaluation.scores import (
    METRICS,
    check_masks,
    default_background,
    evaluate,
    known_background,
    score_views,
)
from igsr.fitting.presets import preset_settings
from igsr.fitting.run import Progress, check_fits, check_whole_number, fit
from igsr.pose import AUTO, estimate_poses, found_before, kept_cameras, photos_note
from igsr.refinement.novel_views import UnseenView, unseen_views
from igsr.refinement.report import seconds_so_far, write_refinement
from igsr.refinement.results import Refined, RefineProgress, Round
from igsr.refinement.selection import Candidate, Passed, candidate, passed, select
from igsr.splats import Splats

#: Unseen views rendered in a round, and how many of them are added at most.
CANDIDATES, CHOSEN = 24, 16
#: With fewer photos there is no round to be judged: each fold needs two to fit.
FEWEST = 3
#: Each of two folds leaves out one photo in so many. With more left out, cleaning helps the folds'
#: fits, which are worse, where it helps no whole one.
FOLDS, LEFT_OUT = 2, 8
#: Folds fit photos of half the size, unless their smaller side is then shorter than so many pixels,
#: with as many splats per pixel: whole fits for a part of the time. Short ones of whole photos are
#: unlike what is judged.
FOLD_SIDE = 64
#: Looking takes about this part of a whole fit's time.
LOOK_SHARE = 0.1
#: Most rounds of "auto".
MOST_ROUNDS = 4
#: Where to look from: the splats, the known cameras, how many views at most, and what renders.
Look = Callable[[Splats, Sequence[Camera], int, str], Sequence[UnseenView]]
#: Which of the cleaned views to add, and how many at most.
Choose = Callable[[Sequence[Candidate], int], list[Candidate]]
#: What one that was cancelled ends with.
STOPPED = "the refinement was stopped; go on with resume."
#: Scores of photos left out that decide about a round.
DECIDING = ("psnr", "ssim", "flip")


@dataclass(eq=False)
class _Chain:
    """Splats of some of the photos, and where the views are from that their rounds have added.

    ``share`` is the part of the photos' pixels that is fitted, which a step's time goes by.
    """

    name: str
    photos: list[View]
    share: float
    splats: Splats
    added: list[UnseenView] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class _Looked:
    """Cleaned views of a chain: unseen ones, chosen or not, and those that were added before."""

    chosen: list[Candidate]
    passed: list[Passed]
    again: list[Candidate]


@dataclass(eq=False)
class _Fold:
    """A chain of some of the photos, those that it leaves out, and their scores by it."""

    chain: _Chain
    left: list[View]
    scores: list[dict[str, float]]


def refine(
    photos: str | os.PathLike[str] | Capture,
    rounds: int | str = AUTO,
    progress: Callable[[RefineProgress], bool | None] | None = None,
    *,
    steps: int | None = None,
    backend: str = "auto",
    seed: int = 0,
    denoiser: Denoiser | None = None,
    out: str | os.PathLike[str] | None = None,
    resume: bool = False,
    look: Look = unseen_views,
    choose: Choose = select,
    judge: bool = True,
) -> Refined:
    """Fit photos, and make the fit better from views that nobody photographed.

    Args:
        photos: a capture, or a folder of photos, whose cameras are found if it has none.
        rounds: at most so many, or "auto": until one does not help, and at most four.
        progress: called now and then; returning False ends it with an ``IgsrError``, and what
            is done so far stays in ``out``.
        steps: of each fit; None is the default preset's.
        backend: "auto", "cpu" or "gpu".
        seed: of everything random; same seed, same bits.
        denoiser: what cleans; None is ``round_denoiser()``.
        out: folder for ``scene.ply``, ``cameras.json``, ``rounds/``, ``views.png``,
            ``report.json`` and ``report.html`` (``igsr.refinement.report``), written after every
            round, ``checkpoints/``, and ``capture/`` with cameras that had to be found; None
            writes nothing.
        resume: go on from the checkpoints in ``out``, to the same end; what lies there is left as
            it is until there is more. Without, checkpoints of an earlier run are removed.
        look: where to look from; the paper's experiments have cameras that are given.
        choose: which of the cleaned views to add.
        judge: whether photos that are left out decide about a round; without, all are accepted.

    Raises:
        IgsrError: an argument cannot be used, photos lie in ``out/capture``, or as ``igsr.fit`` and
            ``igsr.estimate_poses``.
    """
    started = time.monotonic()
    check_arguments(rounds, steps, backend, seed, out, resume)
    capture = (
        photos
        if isinstance(photos, Capture)
        else _posed(photos, out, resume, seed, progress, started)
    )
    loop = _Loop(
        capture, rounds, progress, steps, backend, seed, denoiser, out, resume, look, choose, judge,
        started,
    )  # fmt: skip
    whole = loop.fitted("whole", capture.train_views)
    first, first_test = whole.splats, loop.tested(whole.splats)
    folds: list[_Fold] = []
    done: list[Round] = []

    def so_far(stopped: str, passed: Sequence[Passed] = ()) -> Refined:
        rounds, seconds = list(done), dict(loop.seconds)
        refined = Refined(
            whole.splats, first, first_test, capture, rounds, stopped, list(passed), seconds
        )
        loop.write(refined)
        return refined

    while True:
        so_far("")
        number = len(done) + 1
        why_none = loop.why_no_round(number, whole)
        if why_none:
            return so_far(why_none)
        looked = loop.looked(number, whole)
        if not looked.chosen:
            some = len(looked.passed)
            return so_far(
                f"none of {some} unseen views can be trusted to add anything"
                if some
                else "no view near the photos is unseen",
                looked.passed,
            )
        before: dict[str, float] = {}
        left_out, accepted = before, True
        if judge:
            folds = folds or loop.folds()
            before, left_out = loop.judged(number, folds)
            accepted = _error(left_out) < _error(before)
        if accepted:
            loop.refit(number, whole, looked, "refit")
        splats = whole.splats if accepted else None
        test = loop.tested(splats)
        done.append(Round(looked.chosen, looked.passed, before, left_out, accepted, splats, test))
        if not accepted:
            return so_far(f"round {number} did not make photos that were left out better")


def round_denoiser(weights: str | os.PathLike[str] | None = None) -> NetworkDenoiser:
    """A denoiser as rounds use it; None is the one that comes with igsr.

    It makes every change, sure or not: what is added to a fit is weighed by its confidence there.

    Raises:
        IgsrError: as ``igsr.denoiser.load_network``.
    """
    return NetworkDenoiser(load_network(weights), doubt=0.0)


def check_arguments(
    rounds: int | str,
    steps: int | None,
    backend: str,
    seed: int,
    out: str | os.PathLike[str] | None,
    resume: bool,
) -> None:
    """Find what cannot be used before cameras are looked for, or an earlier run's fits removed.

    Raises:
        IgsrError: an argument of ``refine`` cannot be used.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    if rounds != AUTO and (not isinstance(rounds, int) or isinstance(rounds, bool)):
        raise IgsrError(f'rounds must be a whole number or "auto", not {rounds!r}.')
    if isinstance(rounds, int) and rounds < 0:
        raise IgsrError(f"rounds must not be negative, not {rounds}.")
    if steps is not None:
        check_whole_number("steps", steps)
    check_whole_number("seed", seed)
    check_fits(backend)
    if resume and out is None:
        raise IgsrError("resume needs out, the folder to go on from.")


def _posed(
    photos: str | os.PathLike[str],
    out: str | os.PathLike[str] | None,
    resume: bool,
    seed: int,
    progress: Callable[[RefineProgress], bool | None] | None,
    started: float,
) -> Capture:
    """Photos with cameras. What is fitted is what lies in ``out``, so that resuming finds it."""

    def told(stage: str, done: int, total: int) -> None:
        seconds = time.monotonic() - started
        if progress is not None and progress(RefineProgress(0, "pose", 0.0, seconds)) is False:
            raise IgsrError(STOPPED)

    if out is None or holds_cameras(photos):
        return estimate_poses(photos, seed=seed, progress=told)
    kept = kept_cameras(Path(photos), Path(out))
    if not (resume and found_before(Path(photos), kept)):
        found = estimate_poses(photos, seed=seed, progress=told)
        write_colmap(found, kept, replace=True, notes=photos_note(Path(photos)))
    return load_capture(kept)


def _error(scores: dict[str, float]) -> float:
    """Geometric mean of the root of the squared error, 1 - SSIM and FLIP.

    Of a few photos one of them may go the other way by chance.
    """
    errors = (10.0 ** (-scores["psnr"] / 20.0), 1.0 - scores["ssim"], scores["flip"])
    return float(np.cbrt(np.prod(errors)))


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
        out: str | os.PathLike[str] | None,
        resume: bool,
        look: Look,
        choose: Choose,
        judge: bool,
        started: float,
    ) -> None:
        self.rounds = MOST_ROUNDS if isinstance(rounds, str) else rounds
        if not capture.train_views:
            raise IgsrError(f"{capture.path} has no train views to fit.")
        self.capture, self.backend, self.seed = capture, backend, int(seed)
        self.denoiser = denoiser or round_denoiser()
        self.background = default_background(capture)
        self.behind = known_background(capture.views)
        views = capture.train_views
        _check_views(views, capture.test_views)
        # All fits have those of the first: a fold's fewer photos are to be fitted as all of them.
        settings = preset_settings("default", len(views), steps=steps)
        self.settings = {
            name: settings[name] for name in ("steps", "sh_degree", "density", "dropout")
        }
        self.max_splats = int(settings["max_splats"])
        self.out = None if out is None else Path(out)
        self.resume = resume
        self.further = not resume
        if self.out is not None:
            for folder in (self.out, _checkpoints(self.out), *self.out.glob("rounds/[0-9]*")):
                remove_unfinished(folder)
            if not resume:
                _remove_checkpoints(self.out)
        self.progress = progress
        self.look, self.choose, self.fewest = look, choose, FEWEST if judge else 1
        self.started, self.noted = started, time.monotonic()
        self.seconds = seconds_so_far(self.out) if resume and self.out is not None else {}
        # In units of a whole fit.
        self.folded, self.fold_share = _folded(views)
        folds = self.fold_share * FOLDS if judge else 0.0
        self.all = (1.0 + folds) * (1.0 + self.rounds * (LOOK_SHARE + 1.0))
        self.done, self.round = 0.0, 0

    def fitted(self, name: str, photos: list[View], share: float = 1.0) -> _Chain:
        """Photos fitted from the start."""
        return _Chain(name, photos, share, self._fit(name, "fit", photos, share))

    def folds(self) -> list[_Fold]:
        """Fits that each leave photos out, which scores then are of."""
        photos, out = self.folded, []
        every = min(LEFT_OUT, len(photos))  # so that each fold leaves one out
        for k in range(FOLDS):
            left = photos[k * every // FOLDS :: every]
            kept = [photo for photo in photos if not any(photo is one for one in left)]
            chain = self.fitted(f"fold{k}", kept, self.fold_share)
            out.append(_Fold(chain, left, self._scores(chain.splats, left)))
        return out

    def why_no_round(self, number: int, whole: _Chain) -> str:
        """Why there is nothing to look for; empty where there is."""
        if number > self.rounds:
            return "1 round is done" if self.rounds == 1 else f"{self.rounds} rounds are done"
        if len(whole.photos) < self.fewest:
            return f"fewer than {self.fewest} photos leave none to judge a round by"
        return ""

    def looked(self, number: int, chain: _Chain) -> _Looked:
        self.round = number
        self._tell("look")
        known = [photo.camera for photo in chain.photos] + [view.camera for view in chain.added]
        unseen = self.look(chain.splats, known, CANDIDATES, self.backend)
        cleaned = self._cleaned(chain, [*unseen, *chain.added])
        self.done += LOOK_SHARE * chain.share
        candidates, again = cleaned[: len(unseen)], cleaned[len(unseen) :]
        chosen = self.choose(candidates, CHOSEN)
        others = [one for one in candidates if not any(one is other for other in chosen)]
        return _Looked(chosen, [*map(passed, others)], again)

    def _cleaned(self, chain: _Chain, views: Sequence[UnseenView]) -> list[Candidate]:
        photos, splats = chain.photos, chain.splats
        support = photo_support(splats, photos, self.backend)
        sources = photo_sources(splats, photos, self.background, self.backend)
        found = []
        for view in views:
            buffers = render_buffers(splats, view.camera, support, self.behind, self.backend)
            found.append(candidate(view, buffers, sources, self.denoiser))
            self._tell("look")
        return found

    def judged(self, number: int, folds: Sequence[_Fold]) -> list[dict[str, float]]:
        """Mean scores of the photos left out, before and after each fold's own round.

        A fold keeps its views: the next round is judged from there.
        """
        rows: list[list[dict[str, float]]] = [[], []]
        for fold in folds:
            rows[0] += fold.scores
            self.refit(number, fold.chain, self.looked(number, fold.chain), "judge")
            fold.scores = self._scores(fold.chain.splats, fold.left)
            rows[1] += fold.scores
        return [{s: float(np.mean([one[s] for one in some])) for s in DECIDING} for some in rows]

    def _scores(self, splats: Splats, left: list[View]) -> list[dict[str, float]]:
        scores = [
            {name: float(one.scores[name] or 0.0) for name in DECIDING}
            for one in score_views(splats, left, self.background, self.backend)
        ]
        self._tell("judge")
        return scores

    def refit(self, number: int, chain: _Chain, looked: _Looked, doing: str) -> None:
        """Fit the photos and the views from the start, as the photos alone were.

        What the first fit made up where no photo told better is not what this one begins with.
        """
        name = f"{chain.name}-round{number}"
        views = [
            self._view(f"{name}-{k}.png", one)
            for k, one in enumerate((*looked.chosen, *looked.again))
        ]
        chain.splats = self._fit(name, doing, [*chain.photos, *views], chain.share)
        chain.added += [one.view for one in looked.chosen]

    def _view(self, name: str, one: Candidate) -> View:
        """A cleaned view as the fit takes it: over what stands behind photos with alpha."""
        camera, picture = one.view.camera, one.picture
        return View(name, camera, "train", picture, None, one.trust, self.behind)

    def _fit(self, name: str, doing: str, views: list[View], share: float) -> Splats:
        goes_on = True

        def progress(now: Progress) -> bool:
            nonlocal goes_on
            self.further = True
            goes_on = self._goes_on(doing, share * now.step / now.steps)
            return goes_on

        path = None if self.out is None else _checkpoints(self.out) / f"{name}.npz"
        splats = fit(
            Capture(self.capture.path, views, self.capture.points),
            progress=progress,
            backend=self.backend,
            seed=self.seed,
            max_splats=max(1, round(share * self.max_splats)),
            checkpoint=path,
            resume=self.resume and path is not None and path.is_file(),
            **self.settings,
        )
        if not goes_on:  # asked after the fit has saved what it has
            raise IgsrError(STOPPED)
        self.done += share
        return splats

    def tested(self, splats: Splats | None) -> dict[str, float | None] | None:
        """Mean scores of the test views."""
        if splats is None or not self.capture.test_views:
            return None
        scores = evaluate(splats, self.capture, "test", self.background, self.backend)
        self._tell("test")
        return {metric: scores[metric] for metric in METRICS}

    def write(self, refined: Refined) -> None:
        """Put what there is so far into ``out``, once it is more than lay there."""
        if self.out is not None and (self.further or refined.stopped):
            write_refinement(self.out, refined, self.backend, self.seed)

    def _tell(self, doing: str) -> None:
        if not self._goes_on(doing, 0.0):
            raise IgsrError(STOPPED)

    def _goes_on(self, doing: str, doing_done: float) -> bool:
        now = time.monotonic()
        self.seconds[doing] = self.seconds.get(doing, 0.0) + now - self.noted
        self.noted = now
        if self.progress is None:
            return True
        done = min(1.0, (self.done + doing_done) / self.all)
        seconds = now - self.started
        return self.progress(RefineProgress(self.round, doing, done, seconds)) is not False


def _check_views(photos: list[View], tests: list[View]) -> None:
    """Find what cannot be fitted or scored before anything of an earlier run is removed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the first fit warns
        check_photos(photos)
    check_masks(tests)


def _folded(photos: Sequence[View]) -> tuple[list[View], float]:
    """Photos as folds fit them, and the part of the pixels that these have."""
    if min(min(photo.camera.width, photo.camera.height) for photo in photos) < 2 * FOLD_SIDE:
        return list(photos), 1.0
    small = [halved(photo) for photo in photos]
    pixels = (sum(v.camera.width * v.camera.height for v in some) for some in (small, photos))
    return small, next(pixels) / next(pixels)


def _checkpoints(out: Path) -> Path:
    return out / "checkpoints"


def _remove_checkpoints(out: Path) -> None:
    """Remove an earlier run's fits and how long they took: resuming must not find them."""
    with contextlib.suppress(OSError):
        (out / "report.json").unlink()
    for pattern in ("whole", "fold[0-9]"):
        for kind in (f"{pattern}.npz", f"{pattern}-round[0-9]*.npz"):
            for path in _checkpoints(out).glob(kind):
                path.unlink(missing_ok=True)
