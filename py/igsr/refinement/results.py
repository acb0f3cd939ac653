"""Results of a refinement."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np
import numpy.typing as npt

from igsr._internal.array_equality import ArrayEquality
from igsr._internal.notebook import NotebookPicture
from igsr.capture import Capture
from igsr.evaluation.scores import default_background
from igsr.refinement.selection import Candidate, Rejected
from igsr.rendering.notebook_page import NotebookPage, notebook_page
from igsr.rendering.scene_page import PageModel, compared
from igsr.splats import Splats

#: Stages: fit the photos; cross-validate; render, denoise and select novel views; fit photos and
#: novel views; score the test views.
Stage = Literal["fit", "cross_validate", "novel_views", "refit", "test"]
#: Mean scores by name ("psnr", "ssim", "ms_ssim", "flip", "cc_psnr", "cc_ssim"); None where a score
#: is not defined.
MeanScores = dict[str, float | None]

#: Minimum number of held-out photos for a standard error.
MIN_FOR_ERROR = 3
#: Longest side of the images of held-out photos, pixels.
HELD_OUT_SIDE_PX = 480


class StopReason(enum.Enum):
    """Why there was no further round."""

    ROUNDS_DONE = "rounds_done"
    TOO_FEW_PHOTOS = "too_few_photos"
    ENOUGH_PHOTOS = "enough_photos"
    NO_NOVEL_VIEW = "no_novel_view"
    NONE_SELECTED = "none_selected"
    NOT_ACCEPTED = "not_accepted"


@dataclass(frozen=True)
class Stop:
    """Why a refinement ended; ``str(stop)`` is a message for people.

    Attributes:
        reason: the reason.
        count: number of rounds (``ROUNDS_DONE``), of photos that cross-validation needs
            (``TOO_FEW_PHOTOS``), of photos that see the same place (``ENOUGH_PHOTOS``) or of novel
            views that were rejected in all folds (``NONE_SELECTED``); the rejected round
            (``NOT_ACCEPTED``); 0 (``NO_NOVEL_VIEW``).
    """

    reason: StopReason
    count: int = 0

    def __str__(self) -> str:
        rounds = "1 round is" if self.count == 1 else f"{self.count} rounds are"
        views = "the only novel view" if self.count == 1 else f"all {self.count} novel views"
        return {
            StopReason.ROUNDS_DONE: f"{rounds} done",
            StopReason.TOO_FEW_PHOTOS: f"cross-validation needs at least {self.count} photos",
            StopReason.ENOUGH_PHOTOS: f"every point is seen by {self.count} photos on average; "
            "novel views would add nothing",
            StopReason.NO_NOVEL_VIEW: "there is no novel view near the photos",
            StopReason.NONE_SELECTED: f"{views} had too little confidence or gain",
            StopReason.NOT_ACCEPTED: f"round {self.count} did not improve cross-validation scores",
        }[self.reason]


@dataclass(frozen=True, eq=False)
class HeldOutView:
    """A photo that was held out of a fold, and the fold's renders of it.

    Attributes:
        name: of the photo.
        photo: uint8 [H, W, 3], reduced to ``HELD_OUT_SIDE_PX``, like the renders.
        before, after: uint8 [H, W, 3], renders before and after the fold's round.
        psnr_before, psnr_after: dB, at the fold's image size.
    """

    name: str
    photo: npt.NDArray[np.uint8]
    before: npt.NDArray[np.uint8]
    after: npt.NDArray[np.uint8]
    psnr_before: float
    psnr_after: float


@dataclass(frozen=True, eq=False)
class Round:
    """One round.

    Attributes:
        selected: novel views that the round added, largest gain first; empty if the round was not
            accepted, since only the folds did it.
        rejected: novel views that were rendered and not added.
        validation_before: mean scores ("psnr", "ssim", "flip") of the held-out photos of all
            folds, before the round; empty without cross-validation.
        validation_after: the same after the round.
        accepted: whether the geometric mean of root squared error, 1 - SSIM and FLIP of the
            held-out photos fell. True without cross-validation.
        splats: after the round; None if it was not accepted.
        test: mean scores of the test views, which decide nothing. None if the round was not
            accepted or there are no test views.
        held_out: the held-out photos of all folds; empty without cross-validation.
    """

    selected: list[Candidate]
    rejected: list[Rejected]
    validation_before: dict[str, float]
    validation_after: dict[str, float]
    accepted: bool
    splats: Splats | None
    test: MeanScores | None
    held_out: list[HeldOutView] = field(default_factory=list)

    @property
    def gain(self) -> tuple[float, float] | None:
        """Mean PSNR gain of held-out photos, dB, and its standard error; None for less than 3."""
        gains = [view.psnr_after - view.psnr_before for view in self.held_out]
        if len(gains) < MIN_FOR_ERROR or not np.isfinite(gains).all():
            return None
        return float(np.mean(gains)), float(np.std(gains, ddof=1) / np.sqrt(len(gains)))

    @property
    def verdict(self) -> str:
        """A sentence on the significance of the gain; empty if it is unknown."""
        count = len(self.held_out)
        if 0 < count < MIN_FOR_ERROR:
            return f"{count} held-out photos are too few to tell gain from chance."
        if self.gain is None:
            return ""
        mean, error = self.gain
        text = f"{count} held-out photos change by {mean:+.2f} ± {error:.2f} dB: "
        return text + ("more than chance." if abs(mean) > 2.0 * error else "it may be chance.")


@dataclass(frozen=True, eq=False, repr=False)
class Refined(ArrayEquality, NotebookPicture):
    """What ``refine`` returns.

    Attributes:
        splats: after the last round that was accepted.
        first: after the fit to the photos alone, which is round 0.
        first_test: mean scores of ``first`` on the test views; None if there are none.
        capture: photos and cameras.
        rounds: all rounds in order; only the last one may have been rejected.
        stop: why there was no further round; None while there may be one.
        rejected: novel views of a last round that selected none.
        seconds: time of each stage by name, with resumed earlier runs.
        not_placed: names of the photos whose cameras were not found.
    """

    splats: Splats
    first: Splats
    first_test: MeanScores | None
    capture: Capture
    rounds: list[Round]
    stop: Stop | None
    rejected: list[Rejected]
    seconds: dict[str, float]
    not_placed: tuple[str, ...] = ()

    _pictures_by: ClassVar[str] = "igsr.rendering.thumbnails:refined_pictures"

    def models(self) -> list[PageModel]:
        """The models of the rounds by name: the first fit, and each round that was accepted."""
        rounds = [
            PageModel(f"round {number}", done.splats)
            for number, done in enumerate(self.rounds, 1)
            if done.splats is not None
        ]
        return [PageModel("first fit", self.first), *rounds]

    def show(self, height: int = 480) -> NotebookPage:
        """A viewer for notebooks: return it from a cell, then drag to orbit.

        It starts at the first photo's camera, with the first fit left of a divider and the last
        round right of it. Lists choose other rounds. Above 300 000 splats in all it has the last
        round alone.

        Args:
            height: of the viewer, pixels.

        Returns:
            An object that notebooks show (``_repr_html_``).

        Raises:
            IgsrError: ``height`` is under 1, or the page cannot hold the splats.
        """
        background = default_background(self.capture)
        return notebook_page(compared(self.models()), self.capture, background, height)

    def __repr__(self) -> str:
        """The rounds, the scene and why it stopped, in one line."""
        accepted = sum(one.accepted for one in self.rounds)
        stopped = "unfinished" if self.stop is None else str(self.stop)
        return (
            f"Refined({accepted} of {len(self.rounds)} rounds accepted, {len(self.splats)} splats; "
            f"{stopped})"
        )
