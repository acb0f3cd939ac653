"""Confidence of denoised pixels, and the expected error that it stands for."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F

Float32 = npt.NDArray[np.float32]

#: Expected absolute error at which the confidence is 0.5; colors range from 0 to 1.
HALF_CONFIDENCE_ERROR = 0.05
#: Changes are averaged over a window that reaches this many pixels to each side.
CHANGE_RADIUS_PX = 3
#: Error assumed of a pixel that a denoiser without confidence leaves unchanged.
MIN_CLAIMED_ERROR = 0.01


def confidence_of(error: Float32) -> Float32:
    """Convert expected absolute errors to confidence in [0, 1]."""
    half = np.float32(HALF_CONFIDENCE_ERROR)
    return np.asarray(half / (half + error), dtype=np.float32)


def error_of(confidence: Float32) -> Float32:
    """Convert confidence in [0, 1] to expected absolute errors."""
    certain = np.clip(confidence, 1e-6, 1.0)
    return np.asarray(HALF_CONFIDENCE_ERROR * (1.0 / certain - 1.0), dtype=np.float32)


def claimed_by_change(render: Float32, picture: Float32) -> Float32:
    """Estimate the error [H, W] of a denoised picture that comes without a confidence.

    Large changes mean large errors, and part of an error remains: the estimate is the mean absolute
    change around each pixel, plus ``MIN_CLAIMED_ERROR``.
    """
    change = torch.from_numpy(np.abs(picture - np.nan_to_num(render)).mean(axis=-1))
    window = 2 * CHANGE_RADIUS_PX + 1
    around = F.avg_pool2d(
        change[None, None].float(), window, 1, CHANGE_RADIUS_PX, count_include_pad=False
    )
    claimed: Float32 = around[0, 0].numpy() + np.float32(MIN_CLAIMED_ERROR)
    return claimed
