"""What learns: a network, its optimiser, the moving average of its weights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from igsr.pose.da3.network import Da3Network
from igsr.pose.da3.training.losses import losses
from igsr.pose.da3.training.training_settings import PoseTraining
from igsr.pose.da3.training.true_pass import TruePass
from igsr.training.optimization import average, descend, optimizer, schedule


class Learner:
    """A network that learns from one batch of passes after the other.

    Args:
        network: with the weights to begin with.
        training: steps and rate.
        device: where to train.

    Attributes:
        averaged: the network with the moving average of the weights, which is what is kept.
        step: steps done.
    """

    def __init__(self, network: Da3Network, training: PoseTraining, device: torch.device) -> None:
        """Place the networks on the device."""
        self._training, self.device = training, device
        self.network = network.to(device).train()
        self.averaged = Da3Network(network.config).to(device).eval()
        self.averaged.load_state_dict(network.state_dict())
        self._adam = optimizer(self.network, training.weight_decay)
        self.step = 0

    def learn(self, batch: Sequence[TruePass], shown: bool) -> dict[str, float]:
        """Do one step; returns the loss before it and its parts, by name.

        Args:
            batch: at least one pass.
            shown: whether the network is shown the true cameras and need only tell depths by them.
        """
        parts: dict[str, float] = {}

        def backward() -> None:
            # One pass after the other: memory holds the activations of one.
            for one in batch:
                true = one.to(self.device)
                cameras = {"viewmats": true.viewmats, "intrinsics": true.intrinsics}
                with torch.autocast(
                    self.device.type, torch.bfloat16, enabled=self.device.type == "cuda"
                ):
                    predicted = self.network(true.pixels, "first", **(cameras if shown else {}))
                made = losses(predicted, true)
                total = torch.stack(list(made.values())).sum() / len(batch)
                total.backward()
                for name, value in {"loss": total * len(batch), **made}.items():
                    parts[name] = parts.get(name, 0.0) + float(value.detach()) / len(batch)

        rate = self._training.rate * schedule(self.step, self._training.steps)
        descend(self._adam, rate, backward)
        self.step += 1
        average(self.averaged, self.network, self.step)
        return parts

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
        return {"network": self.network, "averaged": self.averaged, "adam": self._adam}
