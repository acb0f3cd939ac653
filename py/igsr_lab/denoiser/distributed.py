"""Training in several processes, as torchrun starts them."""

from __future__ import annotations

import os

import torch
from torch import nn

from igsr.errors import IgsrError


def is_first_process() -> bool:
    """Whether this is the process that writes, of those that torchrun started."""
    return int(os.environ.get("RANK", "0")) == 0


class Processes:
    """This process among those that torchrun started; alone if it did not.

    Args:
        device: torch's name of where to train; "cuda" is this process's own GPU.
    """

    def __init__(self, device: str) -> None:
        """Join the others, if there are any."""
        self.count = int(os.environ.get("WORLD_SIZE", "1"))
        self.rank = int(os.environ.get("RANK", "0"))
        self.first = is_first_process()
        index = os.environ.get("LOCAL_RANK")
        self.device = torch.device(f"cuda:{index}" if device == "cuda" and index else device)
        if self.count > 1:
            torch.distributed.init_process_group("nccl" if device == "cuda" else "gloo")

    def share_of(self, batch: int) -> range:
        """Numbers of the crops of a batch that are this process's.

        Raises:
            IgsrError: the batch cannot be shared evenly.
        """
        if batch % self.count:
            raise IgsrError(
                f"batch must be a multiple of the number of processes, {self.count}, not {batch}."
            )
        return range(self.rank, batch, self.count)

    def shared(self, network: nn.Module) -> nn.Module:
        """The network, its gradients averaged over the processes."""
        if self.count == 1:
            return network
        return nn.parallel.DistributedDataParallel(network)

    def average_gradients(self, network: nn.Module) -> None:
        """Make each gradient the mean over the processes, of what ``shared`` does not wrap."""
        if self.count == 1:
            return
        for parameter in network.parameters():
            if parameter.grad is not None:
                torch.distributed.all_reduce(parameter.grad)
                parameter.grad /= self.count

    def end(self) -> None:
        """Leave the others."""
        if self.count > 1:
            torch.distributed.destroy_process_group()
