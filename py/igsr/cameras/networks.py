"""Common parts of the pose networks: layers, precision, and loading of checkpoints."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from igsr._internal.input_files import read_json
from igsr._internal.name_lists import listed
from igsr.errors import IgsrError

#: Hidden channels of a block's MLP per channel of the block.
MLP_RATIO = 4
#: Base of the frequencies of rotary embeddings.
ROTARY_BASE = 100.0
#: Maximum number of ignored keys that a warning names.
MAX_NAMED_KEYS = 20
#: Maximum size of a config.json.
MAX_CONFIG_BYTES = 100_000

Rotation = tuple[Tensor, Tensor]
Network = TypeVar("Network", bound=nn.Module)
Config = TypeVar("Config")


class Mlp(nn.Module):
    """MLP of a transformer block, named as in the checkpoints."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, MLP_RATIO * dim)
        self.act = nn.GELU()
        self.fc2 = nn.Linear(MLP_RATIO * dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(self.act(self.fc1(x)))


class ResidualConvs(nn.Module):
    """Two convolutions, each after a ReLU, added to their input."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(features, features, 3, padding=1)
        self.conv2 = nn.Conv2d(features, features, 3, padding=1)

    def forward(self, maps: Tensor) -> Tensor:
        return maps + self.conv2(self.conv1(maps.relu()).relu_())


def rotary_tables(positions: Tensor, head_dim: int) -> Rotation:
    """Compute rotary embeddings of rows and columns (Su et al. 2021; Weinzaepfel et al. 2023).

    The row rotates the first half of a head's channels, the column the second. Within a half of
    2q channels, channels i and i + q are rotated together by the angle row * 100^(-i / q).

    Args:
        positions: [T, 2], row and column.
        head_dim: channels of a head, a multiple of four.

    Returns:
        Cosines and sines, float32 [T, 2, head_dim / 4].
    """
    quarter = head_dim // 4
    frequencies = ROTARY_BASE ** (-torch.arange(quarter, device=positions.device) / quarter)
    angles = positions.float()[..., None] * frequencies
    return angles.cos(), angles.sin()


def rotated(x: Tensor, rotation: Rotation | None) -> Tensor:
    """Rotate queries or keys [..., T, head_dim] by their positions; unchanged for None."""
    if rotation is None:
        return x
    cosine, sine = rotation
    # float32: half precision cannot resolve the angles of distant tokens.
    u, v = x.float().unflatten(-1, (2, 2, -1)).unbind(-2)
    turned = torch.stack([u * cosine - v * sine, v * cosine + u * sine], dim=-2)
    return turned.flatten(-3).to(x.dtype)


def half_precision(device: torch.device) -> torch.autocast:
    """Autocast to bfloat16, else float16, on a GPU; no change on other devices."""
    if device.type != "cuda":
        return torch.autocast(device.type, enabled=False)
    native = torch.cuda.is_bf16_supported(including_emulation=False)
    return torch.autocast("cuda", dtype=torch.bfloat16 if native else torch.float16)


def float32_array(tensor: Tensor) -> npt.NDArray[np.float32]:
    """Copy a tensor of any device and precision to a float32 array."""
    array: npt.NDArray[np.float32] = tensor.float().cpu().numpy()
    return array


@dataclass(frozen=True, eq=False)
class Checkpoint(Generic[Config]):
    """A checked checkpoint."""

    config: Config  # sizes of the network
    weights: dict[str, Tensor]  # float32, exactly the keys and shapes of that network
    unknown: list[str]  # sorted keys of the file that the network does not have


def config_of(path: Path) -> dict[str, Any] | None:
    """Read the ``config.json`` next to a checkpoint; None if there is none.

    Raises:
        IgsrError: it cannot be read, is too long or is not a JSON object.
    """
    config = path.parent / "config.json"
    try:
        if not config.exists():
            return None
        content = read_json(config, MAX_CONFIG_BYTES)
        if not isinstance(content, dict):
            raise ValueError("it is not a JSON object")
    except (OSError, ValueError) as error:
        raise IgsrError(f"{config} cannot be read ({error}); download it again") from error
    return content


def checked_weight(path: Path, key: str, value: Any, shape: Sequence[int]) -> Tensor:
    """Check a stored value against the shape that the network needs, and convert it to float32.

    Raises:
        IgsrError: it is not a plain tensor of floats, or has another shape.
    """
    if (
        not isinstance(value, Tensor)
        or value.layout != torch.strided
        or value.device.type != "cpu"
        or not value.is_floating_point()
    ):
        raise IgsrError(f"{path}: {key} is not an array of floats; use the published checkpoint")
    if tuple(value.shape) != tuple(shape):
        raise IgsrError(
            f"{path}: {key} has shape {list(value.shape)} instead of {list(shape)}; the file is "
            "damaged or of another network"
        )
    return value.detach().to(torch.float32).contiguous()


def without_weights(make: Callable[[Config], Network], config: Config) -> Network:
    """Make a network on the meta device, which takes no memory."""
    with torch.device("meta"):
        return make(config).eval()


def with_weights(
    make: Callable[[Config], Network],
    checkpoint: Checkpoint[Config],
    path: str | Path,
    device: str | None,
) -> Network:
    """Make a network with the weights of a checkpoint; a warning names ignored keys.

    Raises:
        IgsrError: the device cannot be used.
    """
    if checkpoint.unknown:
        warnings.warn(
            f"{path}: keys that the network does not have were ignored: "
            f"{listed(checkpoint.unknown, MAX_NAMED_KEYS)}.",
            stacklevel=3,
        )
    network = without_weights(make, checkpoint.config)
    network.load_state_dict(checkpoint.weights, assign=True)
    network.requires_grad_(False)
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return network.to(device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).strip().splitlines() or ["no reason given"]
        raise IgsrError(
            f"device {device!r} cannot hold the network ({reason[0]}); use 'cpu'"
        ) from error
