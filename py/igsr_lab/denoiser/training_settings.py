"""Settings of a training. This module does not import torch, for the command line."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from igsr._internal.settings import about, validate
from igsr.denoiser.architecture import MULTIPLE
from igsr.errors import IgsrError

#: The default and the paper's three ("gan" and two with "lpips"); see ``losses.Loss``.
LossName = Literal["default", "charbonnier", "gan", "gan+lpips", "lpips"]
LOSSES: tuple[str, ...] = get_args(LossName)
#: torch's generators take seeds of 64 bits; each step adds to a million times the seed.
MAX_SEED = 2**43


def _crop(name: str, value: Any) -> int:
    if type(value) is not int or value < 1 or value % MULTIPLE:
        raise IgsrError(f"{name} must be a multiple of {MULTIPLE}, not {value!r}.")
    return value


@dataclass(frozen=True)
class Training:
    """Settings of a training; stored with the weights.

    Raises:
        IgsrError: a setting is invalid; the message names it.
    """

    steps: int = field(default=20_000, metadata=about("Training steps.", limits=(1, 10**9)))
    batch: int = field(
        default=8, metadata=about("Crops per step, of all processes together.", limits=(1, 2**20))
    )
    crop: int = field(
        default=128,
        metadata=about(
            f"Side of a crop in pixels, a multiple of {MULTIPLE}; smaller pictures are padded.",
            read=_crop,
        ),
    )
    rate: float = field(
        default=1e-3,
        metadata=about(
            "Maximum learning rate of Adam; warm-up over the first 1 % of the steps, then cosine "
            "decay.",
            limits=(1e-12, 1e3),
        ),
    )
    weight_decay: float = field(
        default=1e-4,
        metadata=about("Decoupled weight decay, as in AdamW.", limits=(0.0, 0.9999)),
    )
    dropout: float = field(
        default=0.0, metadata=about("Dropout of the deepest features.", limits=(0.0, 0.9999))
    )
    augment: bool = field(
        default=True, metadata=about("Mirror crops, swap color channels, change exposure.")
    )
    loss: LossName = field(
        default="default", metadata=about("gan, gan+lpips and lpips are the paper's.")
    )
    a: float = field(
        default=0.9, metadata=about("Weight of LPIPS in loss gan+lpips.", limits=(0.0, 1.0))
    )
    seed: int = field(default=0, metadata=about("Random seed of training.", limits=(0, MAX_SEED)))

    def __post_init__(self) -> None:
        """Check every setting."""
        validate(self)
