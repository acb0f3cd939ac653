"""What limits a scene: more splats and steps, more photos, or better cameras.

The rule compares three lengths on one scale, in dB of PSNR:

* what is left to gain on the photos that were fitted: ``REPRODUCED`` minus their PSNR;
* what held-out photos lose against them: their PSNR minus that of held-out photos, whose cameras
  are refined where that was done;
* what held-out photos gain by refined cameras.

The longest names the limit. Where none reaches ``WORTH_IT``, nothing does.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

#: A fit whose PSNR on its own photos is this has reproduced them, dB: an error of 8 of 255 levels,
#: the most that noise, JPEG and small differences of exposure leave between photos as they are.
REPRODUCED = 30.0
#: Differences below this limit nothing, dB: less than a third of the squared error, which seeds and
#: the choice of held-out photos may make as well.
WORTH_IT = 1.5


class LimitKind(str, Enum):
    """What a scene would gain most by."""

    splats_and_steps = "splats_and_steps"
    photos = "photos"
    cameras = "cameras"
    nothing = "nothing"


@dataclass(frozen=True)
class Limit:
    """What limits a scene, and by how much.

    Attributes:
        kind: what it would gain most by.
        train_left: dB left to gain on the photos that were fitted.
        held_out_gap: dB that held-out photos lose against them; None without held-out photos.
        camera_gain: dB that held-out photos gain by refined cameras; None where they were not.
        sentence: for people.
    """

    kind: LimitKind
    train_left: float
    held_out_gap: float | None
    camera_gain: float | None
    sentence: str

    def plain(self) -> dict[str, Any]:
        """As reports have it."""
        return {
            "kind": self.kind.value,
            "train_left": round(self.train_left, 4),
            "held_out_gap": None if self.held_out_gap is None else round(self.held_out_gap, 4),
            "camera_gain": None if self.camera_gain is None else round(self.camera_gain, 4),
            "sentence": self.sentence,
        }


def limit_of(train: float, held_out: float | None = None, refined: float | None = None) -> Limit:
    """What limits a scene, by the rule of this module.

    Args:
        train: mean PSNR of photos that were fitted, dB.
        held_out: mean PSNR of held-out photos with the cameras that they were given, dB; None if
            there are none.
        refined: the same with refined cameras, or None.
    """
    left = max(0.0, REPRODUCED - train)
    if held_out is None:
        kind = LimitKind.splats_and_steps if left >= WORTH_IT else LimitKind.nothing
        return Limit(kind, left, None, None, _train_only(train, kind))
    best = held_out if refined is None else max(held_out, refined)
    gap = max(0.0, train - best)
    gain = None if refined is None else best - held_out
    lengths = {
        LimitKind.splats_and_steps: left,
        LimitKind.photos: gap,
        LimitKind.cameras: gain or 0.0,
    }
    kind = max(lengths, key=lambda one: lengths[one])
    if lengths[kind] < WORTH_IT:
        kind = LimitKind.nothing
    said = f"Fitted photos have {train:.1f} dB, held-out photos {held_out:.1f} dB"
    if refined is not None:
        said += f" ({refined:.1f} dB with refined cameras)"
    return Limit(kind, left, gap, gain, f"{said}: {_advice(kind, left, gap)}")


def _train_only(train: float, kind: LimitKind) -> str:
    would = "help" if kind is LimitKind.splats_and_steps else "add little"
    return (
        f"Fitted photos have {train:.1f} dB: more splats and steps would {would}; hold photos out "
        "(--holdout 8) to learn what more photos would add."
    )


def _advice(kind: LimitKind, left: float, gap: float) -> str:
    if kind is LimitKind.splats_and_steps:
        also = "; more photos would, too" if gap >= max(WORTH_IT, left / 2.0) else ""
        return f"more splats and steps would help most{also}."
    if kind is LimitKind.photos:
        also = "; more splats and steps would, too" if left >= max(WORTH_IT, gap / 2.0) else ""
        return f"more photos would help most{also}."
    if kind is LimitKind.cameras:
        return "cameras are off by more than the scene is; better cameras would help most."
    return "nothing that more splats, steps or photos would mend limits the scene."
