"""How to train. Free of torch, so that the command line can show the defaults."""

from __future__ import annotations

import math
from dataclasses import dataclass

from igsr.denoiser.architecture import MULTIPLE
from igsr.errors import IgsrError


@dataclass(frozen=True)
class Training:
    """Settings of a training; stored with the weights that come out.

    Attributes:
        steps: batches to learn from.
        batch: crops per step, of all processes together.
        crop: side of a crop, pixels, a multiple of 8; smaller pictures are taken whole.
        rate: Adam's highest learning rate. It warms up over the first hundredth of the steps and
            falls as a cosine.
        weight_decay: decoupled (AdamW), per step in units of the rate.
        dropout: part of the features at an eighth of the resolution that is left out.
        augment: mirror crops, swap their colour channels, change their exposure.
        loss: a name of ``igsr.denoiser.training.losses.LOSSES``.
        a: part that LPIPS has in loss "gan+lpips".
        seed: training is deterministic for a given seed.

    Raises:
        IgsrError: a setting cannot be used; the message names it.
    """

    steps: int = 20_000
    batch: int = 8
    crop: int = 128
    rate: float = 1e-3
    weight_decay: float = 1e-4
    dropout: float = 0.0
    augment: bool = True
    loss: str = "default"
    a: float = 0.9
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the numbers."""
        for name in ("steps", "batch", "crop"):
            if getattr(self, name) < 1:
                raise IgsrError(f"{name} must be at least 1, not {getattr(self, name)}.")
        if self.crop % MULTIPLE:
            raise IgsrError(f"crop must be a multiple of {MULTIPLE}, not {self.crop}.")
        if not (math.isfinite(self.rate) and self.rate > 0.0):
            raise IgsrError(f"rate must be positive, not {self.rate:g}.")
        if self.seed < 0:
            raise IgsrError(f"seed must not be negative, not {self.seed}.")
        for name in ("weight_decay", "dropout"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise IgsrError(f"{name} must be from 0 to 1, not {getattr(self, name):g}.")
