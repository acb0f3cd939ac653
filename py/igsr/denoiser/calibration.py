"""How wrong cleaned pictures are: what a denoiser claims, against photos that it has not seen.

One without confidence is taken to claim an error as large as its changes. Renders from the cameras
of photos that were held out of a fit, beside these photos, tell how wrong such pixels are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F

Float32 = npt.NDArray[np.float32]

#: Expected error, in units of the colours' range, at which the confidence is a half.
HALF_CONFIDENCE_ERROR = 0.05
#: Where a denoiser gives no confidence: how far around a pixel its changes count, pixels, and the
#: error claimed where nothing changes, in units of the colours' range.
AROUND, LEAST_CLAIMED = 3, 0.01
#: Pixels are sorted by what is claimed into so many groups of equal size.
GROUPS = 16
#: With fewer pixels nothing is learnt.
FEWEST = 1000
#: Errors below this, in units of the colours' range, are not told apart: that of 8 bits.
SMALLEST = 1.0 / 512.0
#: Claims are given at most this power: noise in a few photos must not turn a small difference
#: between claims into certainty.
STEEPEST = 1.5


@dataclass(frozen=True)
class Calibration:
    """Expected error as a power law of the claimed one, ``factor * claimed ** power``.

    Attributes:
        factor: of errors in units of the colours' range.
        power: 0: claims say nothing; 1: they are off by a factor at most.
    """

    factor: float = 1.0
    power: float = 1.0

    def expected(self, claimed: Float32) -> Float32:
        """Expected absolute errors of what is claimed, both in units of the colours' range."""
        powers = np.maximum(claimed, np.float32(SMALLEST)) ** np.float32(self.power)
        return np.asarray(np.float32(self.factor) * powers, dtype=np.float32)

    def confidence(self, claimed: Float32) -> Float32:
        """Confidence in [0, 1], as ``igsr.denoise`` has it, where such errors are claimed."""
        return confidence_of(self.expected(claimed))


def confidence_of(error: Float32) -> Float32:
    """Confidence in [0, 1] of expected absolute errors: a half at ``HALF_CONFIDENCE_ERROR``."""
    half = np.float32(HALF_CONFIDENCE_ERROR)
    return np.asarray(half / (half + error), dtype=np.float32)


def error_of(confidence: Float32) -> Float32:
    """The expected absolute error that a confidence in [0, 1] stands for."""
    certain = np.clip(confidence, 1e-6, 1.0)
    return np.asarray(HALF_CONFIDENCE_ERROR * (1.0 / certain - 1.0), dtype=np.float32)


def claimed_by_change(render: Float32, picture: Float32) -> Float32:
    """The error [H, W] that a denoiser is taken to claim which gives no confidence.

    Where it changes much, much was wrong, and part of that stays: the mean absolute change round
    each pixel, and ``LEAST_CLAIMED``.

    Args:
        render: float [H, W, 3], before.
        picture: float [H, W, 3], after.
    """
    change = torch.from_numpy(np.abs(picture - np.nan_to_num(render)).mean(axis=-1))
    around = F.avg_pool2d(
        change[None, None].float(), 2 * AROUND + 1, 1, AROUND, count_include_pad=False
    )
    claimed: Float32 = around[0, 0].numpy() + np.float32(LEAST_CLAIMED)
    return claimed


def calibrate(claimed: Sequence[Float32], measured: Sequence[Float32]) -> Calibration:
    """What a denoiser's claims mean, from pixels whose true colour is known.

    The mean measured error of pixels of about the same claim is what such a claim means. A line
    through these means, both in logarithms, is the power law.

    Args:
        claimed: expected absolute errors, one array of any shape for each picture.
        measured: absolute errors of the same pixels; those that are not finite do not count.

    Returns:
        The calibration; that of an honest denoiser where there are too few pixels.
    """
    if not claimed:
        return Calibration()
    said = np.concatenate([picture.ravel() for picture in claimed])
    true = np.concatenate([picture.ravel() for picture in measured])
    if said.shape != true.shape:
        raise ValueError("claimed and measured errors must be of the same pixels")
    known = np.isfinite(said) & np.isfinite(true)
    said, true = np.maximum(said[known].astype(np.float64), SMALLEST), true[known]
    if len(said) < FEWEST:
        return Calibration()
    order = np.argsort(said, kind="stable")
    x, y = (_log_means(values[order]) for values in (said, true))
    spread = float(((x - x.mean()) ** 2).sum())
    slope = float(((x - x.mean()) * (y - y.mean())).sum()) / spread if spread > 1e-6 else 0.0
    power = float(np.clip(slope, 0.0, STEEPEST))
    return Calibration(float(np.exp(y.mean() - power * x.mean())), power)


def _log_means(values: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Logarithms of the means of ``GROUPS`` parts of the values, in their order."""
    means = [float(part.mean()) for part in np.array_split(values, GROUPS)]
    return np.log(np.maximum(means, SMALLEST))
