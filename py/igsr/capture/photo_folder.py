"""Photos without cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Photo:
    """One photo.

    Attributes:
        name: posix path relative to the folder, unique.
        image: uint8 [H, W, 3] or [H, W, 4], upright.
        mask: bool [H, W], True where the pixel may be used, or None.
        focal: pixels of ``image``, from EXIF; None where unknown.
        device: make, model and lens of the camera, or None.
    """

    name: str
    image: np.ndarray
    mask: np.ndarray | None
    focal: float | None
    device: str | None
