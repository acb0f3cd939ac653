"""How far the picture moves from frame to frame of a video, along the camera's path."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

UInt8 = npt.NDArray[np.uint8]
Complex = npt.NDArray[np.complex128]

#: Longer side in pixels of the gray frames that are compared, and side and spacing of the blocks
#: that motion is measured in.
SIDE, BLOCK, SPACING = 240, 64, 32
#: One step of the path: content moves by this part of the picture's longer side, in the mean over
#: blocks.
STEP = 0.05
#: Frames are compared with one that is at most so many steps back: under a fifth of a block.
BACK = 0.8
#: A block with less contrast (standard deviation, of 255) shows no motion.
CONTRAST = 3.0
#: A peak of the phase correlation below this may be chance (of 64 x 64 values of standard deviation
#: 1/64, the largest is about 0.06): the block shows something else.
PEAK = 0.1


class CameraPath:
    """Measures a path frame by frame, in steps.

    Each frame is compared with one that lies most of a step back, not with the one before it, so
    that slow motion is not lost to rounding, and noise in a still picture adds up to nothing. Where
    two frames have nothing in common, as after a cut, that counts as one step.
    """

    def __init__(self) -> None:
        self._key: list[Complex | None] = []
        self._at_key = self._at = 0.0

    def add(self, gray: UInt8) -> float:
        """Go on to the next frame.

        Args:
            gray: uint8 [H, W], of the same size as all others, at least 64 pixels each way.

        Returns:
            Length of the path up to it, in steps; it never falls.
        """
        blocks = _spectra(gray)
        if not self._key:
            self._key = blocks
            return 0.0
        moved = _motion(self._key, blocks) / (STEP * max(gray.shape))
        self._at = max(self._at, self._at_key + moved)
        if moved >= BACK:
            self._key, self._at_key = blocks, self._at
        return self._at


def _spectra(gray: UInt8) -> list[Complex | None]:
    """The Fourier transform of each block under a Hann window; None where it has no contrast."""
    window = np.outer(np.hanning(BLOCK), np.hanning(BLOCK))
    height, width = gray.shape
    result: list[Complex | None] = []
    for top in _places(height):
        for left in _places(width):
            block = gray[top : top + BLOCK, left : left + BLOCK].astype(np.float64)
            shows = block.std() >= CONTRAST
            spectrum: Complex = np.fft.rfft2((block - block.mean()) * window)
            result.append(spectrum if shows else None)
    return result


def _places(length: int) -> list[int]:
    """First pixels of evenly spaced blocks, both edges covered."""
    count = 1 + -(-(length - BLOCK) // SPACING)
    return [int(place) for place in np.linspace(0, length - BLOCK, count).round()]


def _motion(key: list[Complex | None], now: list[Complex | None]) -> float:
    """Mean distance in pixels that blocks moved by, by phase correlation (Kuglin, Hines 1975).

    Where at least half of the blocks that show something have lost what they showed, it is one
    step; 0 where no block shows anything.
    """
    found, lost = [], 0
    for before, after in zip(key, now, strict=True):
        if before is None and after is None:
            continue
        if before is None or after is None:
            lost += 1
            continue
        product = after * before.conj()
        surface = np.fft.irfft2(product / np.maximum(np.abs(product), 1e-9), s=(BLOCK, BLOCK))
        peak = int(surface.argmax())
        if surface.flat[peak] < PEAK:
            lost += 1
            continue
        away = [min(place, BLOCK - place) for place in divmod(peak, BLOCK)]
        found.append(float(np.hypot(away[0], away[1])))
    if not found and not lost:
        return 0.0
    if lost >= len(found):
        return STEP * SIDE
    return float(np.mean(found))
