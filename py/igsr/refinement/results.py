"""Results of a refinement."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import ClassVar, Literal

from igsr._internal.array_equality import ArrayEquality
from igsr._internal.notebook import NotebookPicture
from igsr.capture import Capture
from igsr.evaluation.scores import default_background
from igsr.refinement.selection import Candidate, Rejected
from igsr.rendering.notebook_page import NotebookPage, notebook_page
from igsr.rendering.scene_page import PageModel, compared
from igsr.splats import Splats

#: Stages: fit the photos; render, denoise and select novel views; fit photos and novel views; score
#: the test views.
Stage = Literal["fit", "novel_views", "refit", "test"]
#: Mean scores by name ("psnr", "ssim", "ms_ssim", "flip", "cc_psnr", "cc_ssim"); None where a score
#: is not defined.
MeanScores = dict[str, float | None]


class StopReason(enum.Enum):
    """Why there was no further round."""

    ROUNDS_DONE = "rounds_done"
    ENOUGH_PHOTOS = "enough_photos"
    NO_NOVEL_VIEW = "no_novel_view"
    NONE_SELECTED = "none_selected"
    HARMFUL_DENOISER = "harmful_denoiser"


@dataclass(frozen=True)
class Stop:
    """Why a refinement ended; ``str(stop)`` is a message for people.

    Attributes:
        reason: the reason.
        count: number of rounds (``ROUNDS_DONE``), of photos that see the same place
            (``ENOUGH_PHOTOS``) or of novel views that were rejected (``NONE_SELECTED``); 0
            otherwise.
    """

    reason: StopReason
    count: int = 0

    def __str__(self) -> str:
        rounds = "1 round is" if self.count == 1 else f"{self.count} rounds are"
        views = "the only novel view" if self.count == 1 else f"all {self.count} novel views"
        return {
            StopReason.ROUNDS_DONE: f"{rounds} done",
            StopReason.ENOUGH_PHOTOS: f"every point is seen by {self.count} photos on average; "
            "novel views would add nothing",
            StopReason.NO_NOVEL_VIEW: "there is no novel view near the photos",
            StopReason.NONE_SELECTED: f"{views} had too little confidence or gain",
            StopReason.HARMFUL_DENOISER: "the denoiser makes renders of the photos much worse; use "
            "another, or give the number of rounds to use it anyway",
        }[self.reason]


@dataclass(frozen=True, eq=False)
class Round:
    """One round.

    Attributes:
        selected: novel views that the round added, largest gain first.
        rejected: novel views that were rendered and not added.
        splats: after the round.
        test: mean scores of the test views, which decide nothing; None without test views.
    """

    selected: list[Candidate]
    rejected: list[Rejected]
    splats: Splats
    test: MeanScores | None


@dataclass(frozen=True, eq=False, repr=False)
class Refined(ArrayEquality, NotebookPicture):
    """What ``refine`` returns.

    Attributes:
        splats: after the last round.
        first: after the fit to the photos alone, which is round 0.
        first_test: mean scores of ``first`` on the test views; None if there are none.
        capture: photos and cameras.
        rounds: all rounds in order.
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
        """The models of the rounds by name: the first fit, and each round."""
        rounds = [PageModel(f"round {n}", done.splats) for n, done in enumerate(self.rounds, 1)]
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
        stopped = "unfinished" if self.stop is None else str(self.stop)
        count = len(self.rounds)
        rounds = f"{count} round{'' if count == 1 else 's'}"
        return f"Refined({rounds}, {len(self.splats)} splats; {stopped})"
