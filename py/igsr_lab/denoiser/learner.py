"""``Learner``: a network with optimizer, discriminator and moving average of its weights."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import Any

import torch
from torch import nn

from igsr.denoiser.inputs import COLOR
from igsr.denoiser.network import DenoiserNetwork
from igsr.errors import IgsrError
from igsr_lab.denoiser.crops import Batch
from igsr_lab.denoiser.losses import Loss, Prediction
from igsr_lab.denoiser.training_settings import Training

#: The moving average is over about the last tenth of the steps, and at most over this many.
MAX_AVERAGED_STEPS = 500
#: Maximum norm of the gradient of all weights.
MAX_GRADIENT_NORM = 1.0


class Processes:
    """The processes that torchrun started, or this one; device "cuda" is this process's GPU."""

    def __init__(self, device: str) -> None:
        self.count = int(os.environ.get("WORLD_SIZE", "1"))
        self.rank = int(os.environ.get("RANK", "0"))
        index = os.environ.get("LOCAL_RANK")
        self.device = torch.device(f"cuda:{index}" if device == "cuda" and index else device)
        if self.count > 1:
            torch.distributed.init_process_group("nccl" if device == "cuda" else "gloo")

    def share_of(self, batch: int) -> range:
        """Indices of this process's crops of a batch."""
        if batch % self.count:
            raise IgsrError(
                f"batch must be a multiple of the number of processes, {self.count}, not {batch}."
            )
        return range(self.rank, batch, self.count)

    def average_gradients(self, network: nn.Module) -> None:
        """Average the gradients of all processes."""
        if self.count == 1:
            return
        for parameter in network.parameters():
            if parameter.grad is not None:
                torch.distributed.all_reduce(parameter.grad)
                parameter.grad /= self.count

    def end(self) -> None:
        """Leave the group."""
        if self.count > 1:
            torch.distributed.destroy_process_group()


class Learner:
    """A network in training, with the discriminator of its loss.

    ``averaged`` has the moving average of its weights, ``step`` is the number of steps done.
    """

    def __init__(
        self, network: DenoiserNetwork, loss: Loss, training: Training, processes: Processes
    ) -> None:
        self._training, self._processes, self._loss = training, processes, loss
        self.device = processes.device
        self.network = _placed(network, self.device).train()
        # Averages the gradients of all processes.
        self._shared = (
            self.network
            if processes.count == 1
            else nn.parallel.DistributedDataParallel(self.network)
        )
        self.averaged = _placed(DenoiserNetwork(network.architecture), self.device).eval()
        self.averaged.load_state_dict(network.state_dict())
        self._adam = _adam(self.network, training)
        self.discriminator = loss.discriminator.to(self.device) if loss.discriminator else None
        self._discriminator_adam = (
            _adam(self.discriminator, training) if self.discriminator else None
        )
        self.step = 0

    def learn(self, batch: Batch) -> dict[str, float]:
        """Do one step; return the parts of the loss before it, by name."""
        rate = self._training.rate * schedule(self.step, self._training.steps)
        prediction = self._predicted(batch)
        total, parts = self._loss(prediction)
        _descend(self._adam, rate, total.backward)
        if self.discriminator is not None and self._discriminator_adam is not None:
            discriminator, processes = self.discriminator, self._processes
            wrong = discriminator.loss(prediction)

            def backward() -> None:
                wrong.backward()
                processes.average_gradients(discriminator)

            _descend(self._discriminator_adam, rate, backward)
            parts["discriminator"] = float(wrong.detach())
        self.step += 1
        self._average()
        return parts

    def _predicted(self, batch: Batch) -> Prediction:
        torch.manual_seed(self._training.seed * 1_000_003 + self.step)  # of the dropout
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.device.type == "cuda"):
            image, log_error = self._shared(batch.inputs)
        # Pixels with an unknown truth have no error and no gradient.
        image = torch.where(batch.known, image.float(), batch.truth)
        log_error = torch.where(batch.known, log_error.float(), log_error.detach().float())
        return Prediction(batch.inputs[:, :COLOR], image, log_error, batch.truth)

    def _average(self) -> None:
        # The first update of torch.optim.swa_utils.AveragedModel would copy the weights.
        share = 1.0 / min(1.0 + self.step / 10.0, MAX_AVERAGED_STEPS)
        with torch.no_grad():
            pairs = zip(self.averaged.parameters(), self.network.parameters(), strict=True)
            for mean, now in pairs:
                mean.lerp_(now, share)

    def state(self) -> dict[str, Any]:
        """A state dict of each part, and "step", for a checkpoint."""
        return {name: part.state_dict() for name, part in self._parts().items()} | {
            "step": self.step
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from a checkpoint."""
        for name, part in self._parts().items():
            part.load_state_dict(state[name])
        self.step = state["step"]

    def _parts(self) -> dict[str, Any]:
        parts = {"network": self.network, "averaged": self.averaged, "adam": self._adam}
        if self.discriminator is not None:
            parts |= {"judge": self.discriminator, "judge_adam": self._discriminator_adam}
        return parts


def schedule(step: int, steps: int) -> float:
    """Factor on the learning rate: warm-up over 1 % of the steps, then cosine decay."""
    warm_up = max(1, steps // 100)
    if step < warm_up:
        return (step + 1) / warm_up
    return 0.5 + 0.5 * math.cos(math.pi * (step - warm_up) / max(1, steps - warm_up))


def _adam(network: nn.Module, training: Training) -> torch.optim.AdamW:
    return torch.optim.AdamW(network.parameters(), weight_decay=training.weight_decay)


def _descend(adam: torch.optim.AdamW, rate: float, backward: Callable[[], None]) -> None:
    """Do one step of the optimizer; ``backward`` computes the gradients."""
    for group in adam.param_groups:
        group["lr"] = rate
    adam.zero_grad()
    backward()
    weights = [weight for group in adam.param_groups for weight in group["params"]]
    nn.utils.clip_grad_norm_(weights, MAX_GRADIENT_NORM)
    adam.step()


def _placed(network: DenoiserNetwork, device: torch.device) -> DenoiserNetwork:
    return network.to(device).to(memory_format=torch.channels_last)
