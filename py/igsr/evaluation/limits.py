"""What limits a scene: splats and steps, photos, or cameras.

The rule compares three differences of PSNR, in dB:

* the fitted photos' PSNR to ``REPRODUCED_DB``;
* the held-out photos' PSNR, with refined cameras if known, to the fitted photos';
* the held-out photos' PSNR to that with refined cameras.

The largest one is the limit; if it is less than ``MIN_GAIN_DB``, there is none.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import Enum
from typing import Any

#: PSNR of fitted photos, dB, that counts as reproduced: an error of 8 of 255 levels, caused by
#: noise, JPEG and exposure.
REPRODUCED_DB = 30.0
#: Smaller differences, dB, may come from the seed or the choice of held-out photos.
MIN_GAIN_DB = 1.5


class LimitKind(str, Enum):
    """The improvement that a scene would gain most from."""

    splats_and_steps = "splats_and_steps"
    photos = "photos"
    cameras = "cameras"
    nothing = "nothing"


@dataclass(frozen=True)
class Limit:
    """What limits a scene, and by how much.

    Attributes:
        kind: the improvement that it would gain most from.
        train_left: possible gain on fitted photos, dB.
        held_out_gap: loss of held-out photos against fitted ones, dB; None without held-out photos.
        camera_gain: gain of held-out photos by refined cameras, dB; None if they were not refined.
        sentence: the explanation for users.
    """

    kind: LimitKind
    train_left: float
    held_out_gap: float | None
    camera_gain: float | None
    sentence: str

    def plain(self) -> dict[str, Any]:
        """Return the fields for JSON reports."""
        plain = {**asdict(self), "kind": self.kind.value}
        for name in ("train_left", "held_out_gap", "camera_gain"):
            plain[name] = None if plain[name] is None else round(plain[name], 4)
        return plain


def limit_of(train: float, held_out: float | None = None, refined: float | None = None) -> Limit:
    """Find the limit of a scene; see the module for the rule.

    Args:
        train: mean PSNR of fitted photos, dB.
        held_out: of held-out photos with their given cameras, dB; None without them.
        refined: of held-out photos with refined cameras, dB; or None.
    """
    left = max(0.0, REPRODUCED_DB - train)
    if held_out is None:
        helps = left >= MIN_GAIN_DB
        sentence = (
            f"Fitted photos have {train:.1f} dB: more splats and steps would "
            f"{'help' if helps else 'add little'}; hold photos out (--holdout 8) to see if more "
            "photos would."
        )
        kind = LimitKind.splats_and_steps if helps else LimitKind.nothing
        return Limit(kind, left, None, None, sentence)
    best = held_out if refined is None else max(held_out, refined)
    gap = max(0.0, train - best)
    gain = None if refined is None else best - held_out
    gains = {
        LimitKind.splats_and_steps: left,
        LimitKind.photos: gap,
        LimitKind.cameras: gain or 0.0,
    }
    kind = max(gains, key=lambda one: gains[one])
    if gains[kind] < MIN_GAIN_DB:
        kind = LimitKind.nothing
    scores = f"Fitted photos have {train:.1f} dB, held-out photos {held_out:.1f} dB"
    if refined is not None:
        scores += f" ({refined:.1f} dB with refined cameras)"
    return Limit(kind, left, gap, gain, f"{scores}: {_advice(kind, left, gap)}")


def _advice(kind: LimitKind, left: float, gap: float) -> str:
    if kind is LimitKind.splats_and_steps:
        also = "; more photos would, too" if gap >= max(MIN_GAIN_DB, left / 2.0) else ""
        return f"more splats and steps would help most{also}."
    if kind is LimitKind.photos:
        also = "; more splats and steps would, too" if left >= max(MIN_GAIN_DB, gap / 2.0) else ""
        return f"more photos would help most{also}."
    if kind is LimitKind.cameras:
        return "the cameras are the largest error; better cameras would help most."
    return "more splats, steps, photos or better cameras would add little."
