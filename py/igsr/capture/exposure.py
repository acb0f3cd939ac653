"""Exposure and white balance of a photo: a gain and an offset per channel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.errors import IgsrError


@dataclass(frozen=True)
class Exposure:
    """Exposure of a photo relative to the scene: ``gain * color + offset``, channel by channel.

    Colors are encoded as in photos (sRGB), 1 at the brightest. One stop more is a gain of about
    2^(1/2.2) = 1.37.

    Attributes:
        gain: factors of R, G and B, finite and above 0.
        offset: added to R, G and B after the gain, finite.

    Raises:
        IgsrError: a value is out of range or not a number.
    """

    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("gain", "offset"):
            object.__setattr__(self, name, _three_floats(name, getattr(self, name)))
        if min(self.gain) <= 0.0:
            raise IgsrError(f"gain must be three numbers above 0, not {list(self.gain)}.")

    def apply_to(
        self,
        colors: npt.NDArray[np.float32],
        alpha: npt.NDArray[np.float32] | None = None,
        background: tuple[float, ...] = (0.0, 0.0, 0.0),
    ) -> npt.NDArray[np.float32]:
        """Apply the exposure to rendered colors.

        Args:
            colors: float32 [H, W, 3] over ``background``.
            alpha: float32 [H, W] of the render, for a photo with alpha, whose background keeps its
                color; None for a photo without.
            background: RGB in [0, 1].

        Returns:
            float32 [H, W, 3], not clipped.
        """
        gain, offset, behind = (
            np.asarray(values, np.float32) for values in (self.gain, self.offset, background)
        )
        if alpha is None:
            return np.asarray(colors * gain + offset, np.float32)
        kept = (1.0 - alpha[..., None]) * behind
        return np.asarray((colors - kept) * gain + offset * alpha[..., None] + kept, np.float32)

    def remove_from(self, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Convert a photo to the scene's colors, clipped to 8 bits.

        Args:
            image: uint8 [H, W, 3] RGB, or [H, W, 4] with straight alpha, which does not change.

        Returns:
            uint8 of the same shape.
        """
        levels = (np.arange(256)[:, None] / 255.0 - self.offset) / self.gain
        table = np.floor(np.clip(255.0 * levels, 0.0, 255.0) + 0.5).astype(np.uint8)
        out = image.copy()
        for channel in range(3):
            out[..., channel] = table[image[..., channel], channel]
        return out

    def plain(self) -> dict[str, list[float]]:
        """Return gain and offset for JSON."""
        return {"gain": list(self.gain), "offset": list(self.offset)}


def _three_floats(name: str, values: Any) -> tuple[float, ...]:
    try:
        three = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        three = ()
    if len(three) != 3 or not np.isfinite(three).all():
        raise IgsrError(f"{name} must be three finite numbers, not {values!r}.")
    return three
