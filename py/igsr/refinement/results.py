"""What a refinement returns and reports, as data."""

from __future__ import annotations

from dataclasses import dataclass

from igsr.capture import Capture
from igsr.refinement.selection import Candidate, Passed
from igsr.splats import Splats


@dataclass(frozen=True)
class RefineProgress:
    """Where a refinement stands.

    Attributes:
        round: 0 is the fit to the photos alone.
        doing: "pose" (find cameras), "fit", "look" (render and clean unseen views), "judge",
            "refit" or "test".
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
        chosen: the views that were added, the one worth most first. Those of earlier rounds were
            rendered and cleaned anew, and are not in it.
        passed: those that were looked at and not chosen.
        before: scores ("psnr", "ssim", "flip") of photos left out, by fits without the round's
            views.
        left_out: the same by fits with them. Both are empty where rounds are not judged.
        accepted: whether with them the geometric mean of root squared error, 1 - SSIM and FLIP is
            less; if not, the round's splats are not kept. Always where rounds are not judged.
        splats: after the round; None where it was not accepted.
        test: mean scores of the capture's test views by those, which decide nothing; None without
            splats or views.
    """

    chosen: list[Candidate]
    passed: list[Passed]
    before: dict[str, float]
    left_out: dict[str, float]
    accepted: bool
    splats: Splats | None
    test: dict[str, float | None] | None


@dataclass(frozen=True, eq=False)
class Refined:
    """What ``refine`` returns.

    Attributes:
        splats: after the last round that was accepted.
        first: after the fit to the photos alone, which is round 0.
        first_test: mean scores of the capture's test views by those, if it has any.
        capture: photos and cameras.
        rounds: those that were tried, in order; only the last can be one that was not accepted.
        stopped: why there was no further round; empty while there may be one.
        passed: views that were looked at for a round that then was not begun.
        seconds: that each part but finding cameras took, by the names of
            ``RefineProgress.doing``, with what earlier calls took by the report that this one
            went on from.
    """

    splats: Splats
    first: Splats
    first_test: dict[str, float | None] | None
    capture: Capture
    rounds: list[Round]
    stopped: str
    passed: list[Passed]
    seconds: dict[str, float]
