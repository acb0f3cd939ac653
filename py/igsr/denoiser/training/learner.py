"""What learns: a network, its optimiser, its discriminator, the moving average of its weights."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from igsr.denoiser.inputs import COLOR
from igsr.denoiser.network import DenoiserNetwork
from igsr.denoiser.training.crops import Batch
from igsr.denoiser.training.distributed import Processes
from igsr.denoiser.training.losses import Loss, Prediction
from igsr.denoiser.training.training_settings import Training

#: The weights kept are a moving average over about the last tenth of the steps, at most over these.
AVERAGED_STEPS = 500
#: Gradients are scaled down to this norm, of all weights together.
MOST_GRADIENT = 1.0


class Learner:
    """A network that learns from one batch after the other.

    Args:
        network: with the weights to begin with.
        loss: what to make small; its discriminator learns along.
        training: steps, rate and seed.
        processes: those that learn together, and this one's device.

    Attributes:
        averaged: the network with the moving average of the weights, which is what is kept.
        step: steps done.
    """

    def __init__(
        self, network: DenoiserNetwork, loss: Loss, training: Training, processes: Processes
    ) -> None:
        """Place the networks on the device."""
        self._training, self._processes, self._loss = training, processes, loss
        self.device = processes.device
        self.network = _placed(network, self.device).train()
        self._shared = processes.shared(self.network)
        self.averaged = _placed(DenoiserNetwork(network.architecture), self.device).eval()
        self.averaged.load_state_dict(network.state_dict())
        self._adam = _adam(self.network, training)
        self.discriminator = loss.discriminator.to(self.device) if loss.discriminator else None
        self._discriminator_adam = (
            _adam(self.discriminator, training) if self.discriminator else None
        )
        self.step = 0

    def learn(self, batch: Batch) -> dict[str, float]:
        """Do one step; returns the parts of the loss before it, by name."""
        rate = self._training.rate * _schedule(self.step, self._training.steps)
        made = self._predicted(batch)
        total, parts = self._loss(made)
        _step(self._adam, total, rate)  # ``_shared`` has averaged its gradients
        if self.discriminator is not None and self._discriminator_adam is not None:
            discriminator, processes = self.discriminator, self._processes
            wrong = discriminator.loss(made)
            _step(
                self._discriminator_adam,
                wrong,
                rate,
                lambda: processes.average_gradients(discriminator),
            )
            parts["discriminator"] = float(wrong.detach())
        self.step += 1
        self._average()
        return parts

    def _predicted(self, batch: Batch) -> Prediction:
        torch.manual_seed(self._training.seed * 1_000_003 + self.step)  # of the dropout
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.device.type == "cuda"):
            image, log_error = self._shared(batch.inputs)
        # Where the truth is unknown everything is right as it is, and no gradient comes from there.
        image = torch.where(batch.known, image.float(), batch.truth)
        log_error = torch.where(batch.known, log_error.float(), log_error.detach().float())
        return Prediction(batch.inputs[:, :COLOR], image, log_error, batch.truth)

    def _average(self) -> None:
        # The first update of torch.optim.swa_utils.AveragedModel copies the weights; here the
        # initial ones count, too.
        share = 1.0 / min(1.0 + self.step / 10.0, AVERAGED_STEPS)
        with torch.no_grad():
            for mean, now in zip(
                self.averaged.parameters(), self.network.parameters(), strict=True
            ):
                mean.lerp_(now, share)

    def state(self) -> dict[str, Any]:
        """What a checkpoint holds: a state dict for each part, and "step"."""
        return {name: part.state_dict() for name, part in self._parts().items()} | {
            "step": self.step
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from what ``state`` gave."""
        for name, part in self._parts().items():
            part.load_state_dict(state[name])
        self.step = state["step"]

    def _parts(self) -> dict[str, Any]:
        parts = {"network": self.network, "averaged": self.averaged, "adam": self._adam}
        if self.discriminator is not None:
            parts |= {"judge": self.discriminator, "judge_adam": self._discriminator_adam}
        return parts


def _placed(network: DenoiserNetwork, device: torch.device) -> DenoiserNetwork:
    return network.to(device).to(memory_format=torch.channels_last)


def _adam(network: nn.Module, training: Training) -> torch.optim.AdamW:
    return torch.optim.AdamW(network.parameters(), weight_decay=training.weight_decay)


def _step(
    adam: torch.optim.AdamW,
    loss: Tensor,
    rate: float,
    average_gradients: Callable[[], None] | None = None,
) -> None:
    for group in adam.param_groups:
        group["lr"] = rate
    adam.zero_grad()
    loss.backward()
    if average_gradients is not None:
        average_gradients()
    weights = [weight for group in adam.param_groups for weight in group["params"]]
    nn.utils.clip_grad_norm_(weights, MOST_GRADIENT)
    adam.step()


def _schedule(step: int, steps: int) -> float:
    """The rate's part of its highest: it warms up over a hundredth, then falls as a cosine."""
    warm_up = max(1, steps // 100)
    if step < warm_up:
        return (step + 1) / warm_up
    return 0.5 + 0.5 * math.cos(math.pi * (step - warm_up) / max(1, steps - warm_up))
