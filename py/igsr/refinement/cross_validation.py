"""Cross-validation of rounds: folds do each round and are scored on photos they hold out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr.capture import View
from igsr.capture.downscaling import halved
from igsr.evaluation.scores import ScoredView, score_views
from igsr.refinement import rounds
from igsr.refinement.results import HELD_OUT_SIDE_PX, HeldOutView
from igsr.refinement.rounds import NOVEL_VIEWS_WORK, Context, Reconstruction
from igsr.refinement.selection import Candidate, Rejected

#: Minimum number of photos, panoramas counted as one: each fold needs two to fit.
MIN_PHOTOS = 3
FOLDS = 3
#: Each fold holds out every Nth photo. With more held out, the folds' fits are worse than the
#: whole fit, and denoised views help them where they do not help it.
HOLD_OUT_EVERY = 8
#: Folds fit photos that are halved twice, so that a rejected round costs a third of a whole fit;
#: photos whose shorter side would have fewer pixels than this are not halved.
MIN_FOLD_SIDE_PX = 64
#: Steps of the folds' fits, as a fraction of the whole fit's, by how often photos are halved.
FOLD_STEPS = (1.0, 1.0, 0.5)
#: Scores that decide.
DECIDING_SCORES = ("psnr", "ssim", "flip")


@dataclass(frozen=True, eq=False)
class Fold:
    """A reconstruction of some photos, and the photos held out of it.

    Attributes:
        fitted: the reconstruction.
        held_out: the other photos.
        scored: each held-out photo and its render, with scores.
    """

    fitted: Reconstruction
    held_out: list[View]
    scored: list[ScoredView]


@dataclass(frozen=True, eq=False)
class Validation:
    """What the folds show about a round.

    Attributes:
        before, after: mean scores of all held-out photos before and after the round; empty if no
            fold did it.
        held_out: the held-out photos.
        selected: number of novel views that the folds added.
        rejected: novel views that they did not add.
    """

    before: dict[str, float] = field(default_factory=dict)
    after: dict[str, float] = field(default_factory=dict)
    held_out: list[HeldOutView] = field(default_factory=list)
    selected: int = 0
    rejected: list[Rejected] = field(default_factory=list)

    @property
    def accepted(self) -> bool:
        """Whether the round improves the held-out photos."""
        return bool(self.after) and combined_error(self.after) < combined_error(self.before)


@dataclass(frozen=True, eq=False)
class FoldPhotos:
    """Photos as folds fit them.

    Attributes:
        photos: the photos, halved.
        share: their pixels as a fraction of the original photos'.
        steps: steps of a fold's fit as a fraction of the whole fit's.
    """

    photos: list[View]
    share: float
    steps: float

    @property
    def fit_work(self) -> float:
        """Work of fitting all folds, in units of a fit to all photos."""
        return FOLDS * self.share * self.steps

    @property
    def novel_views_work(self) -> float:
        """Work of all folds' novel views in a round, in the same units."""
        return FOLDS * self.share * NOVEL_VIEWS_WORK


def fold_photos(photos: Sequence[View]) -> FoldPhotos:
    """Halve the photos as often as folds do."""
    small, halvings = list(photos), 0
    while halvings < len(FOLD_STEPS) - 1 and _shortest(small) >= 2 * MIN_FOLD_SIDE_PX:
        small, halvings = [halved(photo) for photo in small], halvings + 1
    return FoldPhotos(small, _pixels(small) / _pixels(photos), FOLD_STEPS[halvings])


def fit_folds(context: Context, photos: Sequence[View]) -> list[Fold]:
    """Fit the folds: each holds out at least one photo, and no photo is held out twice."""
    small = fold_photos(photos)
    names = list(dict.fromkeys(photo.photo for photo in small.photos))
    every = min(HOLD_OUT_EVERY, len(names))
    folds = []
    for number in range(FOLDS):
        # The views of a panorama are held out together.
        out = set(names[number * every // FOLDS :: every])
        held_out = [photo for photo in small.photos if photo.photo in out]
        kept = [photo for photo in small.photos if photo.photo not in out]
        fitted = rounds.fit_photos(context, f"fold{number}", kept, small.share, small.steps)
        folds.append(Fold(fitted, held_out, _scored(context, fitted, held_out)))
    return folds


def validate(context: Context, folds: Sequence[Fold]) -> tuple[Validation, list[Fold]]:
    """Let each fold do the round; return the verdict and the folds after it."""
    proposals = [(fold, *_denoised(context, fold.fitted)) for fold in folds]
    selections = [rounds.select_candidates(context, novel) for _, novel, _ in proposals]
    not_added = [view for _, others in selections for view in others]
    count = sum(len(selected) for selected, _ in selections)
    if not count:
        return Validation(rejected=not_added), list(folds)
    before = [scored for fold in folds for scored in fold.scored]
    new_folds = []
    for (fold, _, again), (selected, _) in zip(proposals, selections, strict=True):
        if selected or again:
            fitted = rounds.refit(context, fold.fitted, selected, again, "cross_validate")
            fold = Fold(fitted, fold.held_out, _scored(context, fitted, fold.held_out))
        new_folds.append(fold)
    after = [scored for fold in new_folds for scored in fold.scored]
    compared = _compared(before, after)
    verdict = Validation(_means(before), _means(after), compared, count, not_added)
    return verdict, new_folds


def combined_error(scores: dict[str, float]) -> float:
    """Geometric mean of root squared error, 1 - SSIM and FLIP; lower is better.

    With few photos, a single score may get worse by chance.
    """
    errors = (10.0 ** (-scores["psnr"] / 20.0), 1.0 - scores["ssim"], scores["flip"])
    return float(np.cbrt(np.prod(errors)))


def _denoised(context: Context, fitted: Reconstruction) -> tuple[list[Candidate], list[Candidate]]:
    """Novel views of a fold, and those that it added before, denoised."""
    novel = rounds.propose_views(context, fitted)
    candidates = rounds.denoise_views(context, fitted, [*novel, *fitted.added])
    return candidates[: len(novel)], candidates[len(novel) :]


def _scored(context: Context, fitted: Reconstruction, held_out: list[View]) -> list[ScoredView]:
    """Held-out photos with scores, in small pictures."""
    scored = [
        replace(view, photo=_small(view.photo), render=_small(view.render), mask=None)
        for view in score_views(
            fitted.shown, held_out, context.background, context.backend, DECIDING_SCORES
        )
    ]
    context.progress.report("cross_validate")
    return scored


def _score(view: ScoredView, name: str) -> float:
    score = view.scores[name]
    assert score is not None, "only ms_ssim may be None"
    return float(score)


def _means(views: Sequence[ScoredView]) -> dict[str, float]:
    return {
        name: float(np.mean([_score(view, name) for view in views])) for name in DECIDING_SCORES
    }


def _compared(before: Sequence[ScoredView], after: Sequence[ScoredView]) -> list[HeldOutView]:
    return [
        HeldOutView(
            old.name,
            old.photo,
            old.render,
            new.render,
            _score(old, "psnr"),
            _score(new, "psnr"),
        )
        for old, new in zip(before, after, strict=True)
    ]


def _small(picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    image = Image.fromarray(picture)
    image.thumbnail((HELD_OUT_SIDE_PX, HELD_OUT_SIDE_PX), Image.Resampling.BOX)
    return np.asarray(image)


def _shortest(photos: Sequence[View]) -> int:
    return min(min(photo.camera.width, photo.camera.height) for photo in photos)


def _pixels(photos: Sequence[View]) -> int:
    return sum(photo.camera.width * photo.camera.height for photo in photos)
