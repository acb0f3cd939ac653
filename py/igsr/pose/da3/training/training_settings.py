"""How to train. Free of torch, so that the command line can make its options from the settings."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from igsr._internal.settings import about, validate
from igsr.errors import IgsrError
from igsr.pose.da3.config import PATCH, checked_resolution

#: Fewest photos of a pass: one has no other to be placed by.
FEWEST_PHOTOS = 2
#: Below, nothing is left of the shorter side of some photos.
LEAST_RESOLUTION = 2 * PATCH


def _resolution(name: str, value: Any) -> int:
    if checked_resolution(name, value) < LEAST_RESOLUTION:
        raise IgsrError(f"{name} is {value}; give at least {LEAST_RESOLUTION}")
    return int(value)


@dataclass(frozen=True)
class PoseTraining:
    """Settings of a training; stored with the weights that come out.

    Raises:
        IgsrError: a setting cannot be used; the message names it.
    """

    steps: int = field(default=100_000, metadata=about("Training steps.", limits=(1, 10**9)))
    batch: int = field(
        default=8, metadata=about("Captures per step, one pass of each.", limits=(1, 4096))
    )
    photos: int = field(
        default=8,
        metadata=about(
            "Most photos of a pass; from two up to these are drawn of a capture's.",
            limits=(FEWEST_PHOTOS, 64),
        ),
    )
    resolution: int = field(
        default=224,
        metadata=about(
            "Longer side of the photos, pixels, a multiple of 14; the network is used at it, too.",
            read=_resolution,
        ),
    )
    rate: float = field(
        default=3e-4,
        metadata=about(
            "AdamW's highest learning rate. It warms up over the first hundredth of the steps and "
            "falls as a cosine.",
            limits=(1e-12, 1e3),
        ),
    )
    weight_decay: float = field(
        default=0.05,
        metadata=about("Decoupled, as in AdamW, in units of the rate.", limits=(0.0, 0.9999)),
    )
    captures: int = field(
        default=4000,
        metadata=about(
            "Captures to learn from, made when they are first drawn.", limits=(1, 90000)
        ),
    )
    validation: int = field(
        default=32,
        metadata=about("Captures to validate on, never trained on.", limits=(1, 10_000)),
    )
    views: int = field(
        default=16,
        metadata=about("Photos of each capture, of which passes draw theirs.", limits=(2, 1000)),
    )
    spp: int = field(
        default=4,
        metadata=about("Light paths per pixel of the photos, a square number.", limits=(1, 4096)),
    )
    seed: int = field(
        default=0,
        metadata=about(
            "Captures and, on a CPU, training are deterministic for a given seed.",
            limits=(0, 2**43),
        ),
    )

    def __post_init__(self) -> None:
        """Check every setting."""
        validate(self)
        if self.photos > self.views:
            raise IgsrError(
                f"photos is {self.photos}, but a capture has {self.views} (views); give at most as "
                "many, or more views"
            )
