"""Crops of training pairs: drawn by seed and step, augmented, stacked to batches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from igsr.denoiser.inputs import BUFFERS, CHOICES, COLOR, PHOTO
from igsr_lab.denoiser.pair_files import Pairs, unpacked
from igsr_lab.denoiser.training_settings import Training

#: Probability that a crop has no buffers, and that it has no photos: renders may come without.
DROP_PROBABILITY = 0.05
#: A crop whose mean squared error is less than this teaches nothing; another one is drawn.
MIN_ERROR = 1e-5
#: Maximum number of further draws.
MAX_REDRAWS = 3
#: Crops per validation, the same each time.
VALIDATION_CROPS = 64
#: First channels of colors, three each.
_COLORS = (0, *(COLOR + BUFFERS + k * PHOTO for k in range(CHOICES)))
_NORMAL_X, _NORMAL_Y = COLOR + 3, COLOR + 4


class Crop(NamedTuple):
    """One crop of one pair."""

    inputs: Tensor  # float32 [``CHANNELS``, H, W], input of the network
    #: float32 [4, H, W], the photo's colors in [0, 1], and 1 for known pixels. Unknown pixels have
    #: the render's colors.
    truth: Tensor


@dataclass(frozen=True, eq=False)
class Batch:
    """Crops on the training device."""

    inputs: Tensor  # float32 [B, ``CHANNELS``, H, W], channels last in memory
    truth: Tensor  # float32 [B, 3, H, W] in [0, 1]
    known: Tensor  # bool [B, 1, H, W], pixels with a known truth


def draw_batch(
    pairs: Sequence[Pairs], training: Training, step: int, share: range, device: torch.device
) -> Batch:
    """Draw the crops of one step; they depend on the seed and the step only.

    ``share`` has the indices of the crops of this process.
    """
    random = np.random.default_rng([training.seed, step, 0xBA7C])
    weights = np.array([len(one.truth) for one in pairs], np.float64)
    chosen = random.choice(len(pairs), size=training.batch, p=weights / weights.sum())
    seeds = random.integers(2**63, size=training.batch)
    crops = []
    for k in share:
        own = np.random.default_rng(int(seeds[k]))
        crop = _crop_with_errors(pairs[chosen[k]], training.crop, own)
        crops.append(_augmented(crop, own) if training.augment else crop)
    return stacked(crops, device)


def validation_crops(pairs: Sequence[Pairs], side: int) -> list[Crop]:
    """Draw ``VALIDATION_CROPS`` crops, the same for every training, from all pairs in turn."""
    random = np.random.default_rng(0xDA7A)
    return [_crop(pairs[k % len(pairs)], side, random) for k in range(VALIDATION_CROPS)]


def stacked(crops: Sequence[Crop], device: torch.device) -> Batch:
    """Stack crops of one size."""
    inputs = torch.stack([crop.inputs for crop in crops])
    truth = torch.stack([crop.truth for crop in crops]).to(device)
    inputs = inputs.contiguous(memory_format=torch.channels_last).to(device)
    return Batch(inputs, truth[:, :COLOR], truth[:, COLOR:] > 0.5)


def _crop_with_errors(pairs: Pairs, side: int, random: np.random.Generator) -> Crop:
    for _ in range(1 + MAX_REDRAWS):
        crop = _crop(pairs, side, random)
        if float((crop.inputs[:COLOR] - crop.truth[:COLOR]).square().mean()) > MIN_ERROR:
            break
    return crop


def _crop(pairs: Pairs, side: int, random: np.random.Generator) -> Crop:
    view = random.integers(len(pairs.truth))
    height, width = pairs.truth.shape[2:]
    top = random.integers(max(1, height - side + 1))
    left = random.integers(max(1, width - side + 1))
    at = (view, slice(None), slice(top, top + side), slice(left, left + side))
    inputs = unpacked(pairs.inputs[at])
    truth = pairs.truth[at].astype(np.float32) / np.float32(255.0)
    known = pairs.masks[view, at[2], at[3]]
    truth = np.concatenate([np.where(known, truth, inputs[:COLOR]), known[None].astype(np.float32)])
    short = [(0, 0), (0, max(0, side - height)), (0, max(0, side - width))]
    if height < side or width < side:
        inputs, truth = np.pad(inputs, short, mode="edge"), np.pad(truth, short, mode="edge")
    return Crop(torch.from_numpy(inputs), torch.from_numpy(truth))


def _augmented(crop: Crop, random: np.random.Generator) -> Crop:
    """Mirror, permute color channels, change exposure; sometimes drop buffers or photos."""
    inputs, truth = crop.inputs.clone(), crop.truth.clone()
    if random.uniform() < 0.5:
        inputs, truth = inputs.flip(2), truth.flip(2)
        inputs[_NORMAL_X] *= -1.0
    if random.uniform() < 0.5:
        inputs, truth = inputs.flip(1), truth.flip(1)
        inputs[_NORMAL_Y] *= -1.0
    order = torch.from_numpy(random.permutation(3))
    gain = float(np.exp(random.uniform(-0.4, 0.2)))
    for at in _COLORS:
        inputs[at : at + 3] = (gain * inputs[at : at + 3][order]).clamp(0.0, 1.0)
    truth[:COLOR] = (gain * truth[:COLOR][order]).clamp(0.0, 1.0)
    if random.uniform() < DROP_PROBABILITY:
        inputs[COLOR : COLOR + BUFFERS] = 0.0
    if random.uniform() < DROP_PROBABILITY:
        inputs[COLOR + BUFFERS :] = 0.0
    return Crop(inputs, truth)
