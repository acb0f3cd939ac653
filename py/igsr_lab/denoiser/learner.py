"""What learns: a network, its optimiser, its discriminator, the moving average of its weights."""

from __future__ import annotations

from typing import Any

import torch

from igsr.denoiser.inputs import COLOR
from igsr.denoiser.network import DenoiserNetwork
from igsr_lab.denoiser.crops import Batch
from igsr_lab.denoiser.distributed import Processes
from igsr_lab.denoiser.losses import Loss, Prediction
from igsr_lab.denoiser.optimization import average, descend, optimizer, schedule
from igsr_lab.denoiser.training_settings import Training


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
        self._adam = optimizer(self.network, training.weight_decay)
        self.discriminator = loss.discriminator.to(self.device) if loss.discriminator else None
        self._discriminator_adam = (
            optimizer(self.discriminator, training.weight_decay) if self.discriminator else None
        )
        self.step = 0

    def learn(self, batch: Batch) -> dict[str, float]:
        """Do one step; returns the parts of the loss before it, by name."""
        rate = self._training.rate * schedule(self.step, self._training.steps)
        made = self._predicted(batch)
        total, parts = self._loss(made)
        descend(self._adam, rate, total.backward)  # ``_shared`` averages the gradients
        if self.discriminator is not None and self._discriminator_adam is not None:
            discriminator, processes = self.discriminator, self._processes
            wrong = discriminator.loss(made)

            def backward() -> None:
                wrong.backward()
                processes.average_gradients(discriminator)

            descend(self._discriminator_adam, rate, backward)
            parts["discriminator"] = float(wrong.detach())
        self.step += 1
        average(self.averaged, self.network, self.step)
        return parts

    def _predicted(self, batch: Batch) -> Prediction:
        torch.manual_seed(self._training.seed * 1_000_003 + self.step)  # of the dropout
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.device.type == "cuda"):
            image, log_error = self._shared(batch.inputs)
        # Where the truth is unknown everything is right as it is, and no gradient comes from there.
        image = torch.where(batch.known, image.float(), batch.truth)
        log_error = torch.where(batch.known, log_error.float(), log_error.detach().float())
        return Prediction(batch.inputs[:, :COLOR], image, log_error, batch.truth)

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
