"""Steps of a training: AdamW, the schedule of its rate, and the moving average of the weights."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import nn

#: The weights kept are a moving average over about the last tenth of the steps, at most over these.
AVERAGED_STEPS = 500
#: Gradients are scaled down to this norm, of all weights together.
MOST_GRADIENT = 1.0


def optimizer(network: nn.Module, weight_decay: float) -> torch.optim.AdamW:
    """AdamW over all weights; ``weight_decay`` is in units of the rate."""
    return torch.optim.AdamW(network.parameters(), weight_decay=weight_decay)


def descend(
    adam: torch.optim.AdamW,
    rate: float,
    backward: Callable[[], None],
) -> None:
    """One step.

    Args:
        adam: of ``optimizer``.
        rate: of this step.
        backward: adds the gradients of the loss to those of the weights, which are none before.
    """
    for group in adam.param_groups:
        group["lr"] = rate
    adam.zero_grad()
    backward()
    weights = [weight for group in adam.param_groups for weight in group["params"]]
    nn.utils.clip_grad_norm_(weights, MOST_GRADIENT)
    adam.step()


def schedule(step: int, steps: int) -> float:
    """The rate's part of its highest: it warms up over a hundredth, then falls as a cosine."""
    warm_up = max(1, steps // 100)
    if step < warm_up:
        return (step + 1) / warm_up
    return 0.5 + 0.5 * math.cos(math.pi * (step - warm_up) / max(1, steps - warm_up))


def average(averaged: nn.Module, network: nn.Module, step: int) -> None:
    """Move the averaged weights towards those of the network after ``step`` steps."""
    # The first update of torch.optim.swa_utils.AveragedModel copies the weights; here the
    # initial ones count, too.
    share = 1.0 / min(1.0 + step / 10.0, AVERAGED_STEPS)
    with torch.no_grad():
        for mean, now in zip(averaged.parameters(), network.parameters(), strict=True):
            mean.lerp_(now, share)
