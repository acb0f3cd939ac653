"""Cross-validation of rounds: each fold is scored on photos that are held out of its fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from igsr.capture import View
from igsr.capture.downscaling import halved
from igsr.evaluation.scores import ScoredView
from igsr.refinement.results import HeldOutView
from igsr.refinement.selection import Rejected
from igsr.refinement.stages import (
    NOVEL_VIEWS_WORK,
    VALIDATED,
    Reconstruction,
    Stages,
)

#: Fewest photos, panoramas counted as one: each fold needs two to fit.
FEWEST_PHOTOS = 3
#: Each fold holds out one photo in eight. Where more are held out the folds' fits are worse than
#: the whole one, and denoised views help them where they do not help it.
FOLDS, HOLD_OUT_EVERY = 3, 8
#: Folds fit photos that are halved twice, so that a round that does not help costs a third of a
#: whole fit's time; none whose shorter side then has fewer pixels than this: folds of small photos
#: cost more, up to six fits.
LEAST_FOLD_SIDE = 64
#: Steps of their fits, as a part of a whole fit's, by how often the photos are halved: small ones
#: are done learning sooner. Fewer steps on whole photos would be no model of a whole fit.
FOLD_STEPS = (1.0, 1.0, 0.5)


@dataclass(eq=False)
class Fold:
    """A reconstruction of some of the photos, and the photos held out of it.

    Attributes:
        scored: each held-out photo and its render, with its scores.
    """

    reconstruction: Reconstruction
    held_out: list[View]
    scored: list[ScoredView]


@dataclass(frozen=True, eq=False)
class Validation:
    """What the folds say of a round.

    Attributes:
        before, after: mean scores of the held-out photos of all folds, before the round and after
            it; empty if no fold did it.
        held_out: the photos themselves.
        selected: novel views that the folds added.
        rejected: those that they did not.
    """

    before: dict[str, float] = field(default_factory=dict)
    after: dict[str, float] = field(default_factory=dict)
    held_out: list[HeldOutView] = field(default_factory=list)
    selected: int = 0
    rejected: list[Rejected] = field(default_factory=list)

    @property
    def accepted(self) -> bool:
        """Whether the round makes held-out photos better."""
        return bool(self.after) and combined_error(self.after) < combined_error(self.before)


class CrossValidation:
    """Folds that do each round themselves, and are scored on their held-out photos.

    The folds are fitted when the first round is validated. They keep the views that a round adds:
    the next round is validated from there.
    """

    def __init__(self, stages: Stages, photos: Sequence[View]) -> None:
        """Make the photos smaller, with as many splats per pixel."""
        self._stages = stages
        self._photos, self._share, self._steps = _fold_photos(photos)
        self._folds: list[Fold] = []

    def use(self, photos: Sequence[View]) -> None:
        """Take these photos instead, which have the scene's colors; before the first round."""
        self._photos, self._share, self._steps = _fold_photos(photos)

    @property
    def work(self) -> float:
        """What fitting all folds takes, in units of a fit to all photos."""
        return FOLDS * self._share * self._steps

    @property
    def novel_views_work(self) -> float:
        """What their novel views of a round take, in the same units."""
        return FOLDS * self._share * NOVEL_VIEWS_WORK

    def validate(self) -> Validation:
        """Held-out photos before each fold's own round and after it."""
        self._folds = self._folds or self._fitted()
        found = [self._stages.render_and_denoise(fold.reconstruction) for fold in self._folds]
        selections = [self._stages.select(views) for views in found]
        count = sum(len(selected) for selected, _ in selections)
        not_added = [view for _, some in selections for view in some]
        if not count:
            return Validation(rejected=not_added)
        before = [one for fold in self._folds for one in fold.scored]
        for fold, views, (selected, _) in zip(self._folds, found, selections, strict=True):
            if selected or views.added_before:
                fitted = fold.reconstruction
                self._stages.refit(fitted, selected, views.added_before, "cross_validate")
                fold.scored = self._scored(fitted, fold.held_out)
        after = [one for fold in self._folds for one in fold.scored]
        return Validation(_means(before), _means(after), _beside(before, after), count, not_added)

    def _fitted(self) -> list[Fold]:
        """Fit the folds: no photo is held out of two, and at least one of each."""
        names = list(dict.fromkeys(photo.photo for photo in self._photos))
        every = min(HOLD_OUT_EVERY, len(names))
        folds = []
        for number in range(FOLDS):
            # The views of a panorama are held out together.
            out = set(names[number * every // FOLDS :: every])
            held_out = [photo for photo in self._photos if photo.photo in out]
            kept = [photo for photo in self._photos if photo.photo not in out]
            fitted = self._stages.fit(f"fold{number}", kept, self._share, self._steps)
            folds.append(Fold(fitted, held_out, self._scored(fitted, held_out)))
        return folds

    def _scored(self, fitted: Reconstruction, held_out: list[View]) -> list[ScoredView]:
        return self._stages.validated(fitted.shown, held_out)


def combined_error(scores: dict[str, float]) -> float:
    """Geometric mean of root squared error, 1 - SSIM and FLIP, of which lower is better.

    With few photos a single score may get worse by chance.
    """
    errors = (10.0 ** (-scores["psnr"] / 20.0), 1.0 - scores["ssim"], scores["flip"])
    return float(np.cbrt(np.prod(errors)))


def _means(views: Sequence[ScoredView]) -> dict[str, float]:
    return {
        name: float(np.mean([float(one.scores[name] or 0.0) for one in views]))
        for name in VALIDATED
    }


def _beside(before: Sequence[ScoredView], after: Sequence[ScoredView]) -> list[HeldOutView]:
    return [
        HeldOutView(
            one.name,
            one.photo,
            one.render,
            other.render,
            float(one.scores["psnr"] or 0.0),
            float(other.scores["psnr"] or 0.0),
        )
        for one, other in zip(before, after, strict=True)
    ]


def _fold_photos(photos: Sequence[View]) -> tuple[list[View], float, float]:
    """Photos as folds fit them, their pixels as a part of the photos' own, and that of steps."""
    small, halvings = list(photos), 0
    while halvings < len(FOLD_STEPS) - 1 and _shortest(small) >= 2 * LEAST_FOLD_SIDE:
        small, halvings = [halved(photo) for photo in small], halvings + 1
    return small, _pixels(small) / _pixels(photos), FOLD_STEPS[halvings]


def _shortest(photos: Sequence[View]) -> int:
    return min(min(photo.camera.width, photo.camera.height) for photo in photos)


def _pixels(photos: Sequence[View]) -> int:
    return sum(photo.camera.width * photo.camera.height for photo in photos)
