"""Exposure and white balance of a photo: a gain and an offset per channel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.errors import IgsrError


@dataclass(frozen=True)
class Exposure:
    """What a photo's colors are of the scene's: ``gain * color + offset``, channel by channel.

    Colors are encoded as in photos (sRGB), 1 at the brightest. One stop more of light is a gain of
    about 2^(1/2.2) = 1.37.

    Attributes:
        gain: factors of R, G and B, finite and above 0.
        offset: added to R, G and B after it, finite.

    Raises:
        IgsrError: a value is none of these.
    """

    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Check the values."""
        for name in ("gain", "offset"):
            object.__setattr__(self, name, _three(name, getattr(self, name)))
        if min(self.gain) <= 0.0:
            raise IgsrError(f"gain must be three numbers above 0, not {list(self.gain)}.")

    def given_to(
        self,
        colors: npt.NDArray[np.float32],
        alpha: npt.NDArray[np.float32] | None = None,
        background: tuple[float, ...] = (0.0, 0.0, 0.0),
    ) -> npt.NDArray[np.float32]:
        """Rendered colors as the photo has them.

        Args:
            colors: float32 [H, W, 3] over ``background``.
            alpha: float32 [H, W] of the render, for a photo with alpha, whose background is none of
                what the camera saw and stays as it is; None for a photo without.
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

    def taken_out_of(self, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """A photo with the scene's colors, clipped to what 8 bits hold.

        Args:
            image: uint8 [H, W, 3] RGB, or [H, W, 4] with straight alpha, which stays as it is.

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
        """Gain and offset as JSON has them."""
        return {"gain": list(self.gain), "offset": list(self.offset)}


def _three(name: str, values: Any) -> tuple[float, ...]:
    try:
        three = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        three = ()
    if len(three) != 3 or not np.isfinite(three).all():
        raise IgsrError(f"{name} must be three finite numbers, not {values!r}.")
    return three
