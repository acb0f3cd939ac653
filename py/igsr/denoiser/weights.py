"""Files of denoisers: weights and architecture in one safetensors file."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from igsr._internal.atomic_write import atomic_write
from igsr._internal.input_files import open_file, parse_json
from igsr.denoiser.architecture import Architecture
from igsr.denoiser.network import DenoiserNetwork
from igsr.errors import IgsrError

#: Settings of earlier architectures; only these values are supported.
_FORMER_SETTINGS = {"residual": True, "buffers": True, "photos": "concatenated"}
#: The denoiser that comes with igsr.
SHIPPED = Path(__file__).with_name("denoiser.safetensors")


def save_network(
    network: DenoiserNetwork, path: str | os.PathLike[str], recipe: dict[str, Any]
) -> None:
    """Write a network in half precision.

    Args:
        network: the network.
        path: the ``.safetensors`` file.
        recipe: how the network was trained, stored in the file.

    Raises:
        IgsrError: the file cannot be written.
    """
    weights = {name: tensor.half().contiguous() for name, tensor in network.state_dict().items()}
    metadata = {
        "architecture": json.dumps(asdict(network.architecture)),
        "recipe": json.dumps(recipe, allow_nan=False),
    }
    with atomic_write(Path(path)) as temporary:
        save_file(weights, temporary, metadata=metadata)


def load_network(path: str | os.PathLike[str] | None = None) -> DenoiserNetwork:
    """Read a network.

    Args:
        path: the ``.safetensors`` file; None is the network that comes with igsr.

    Raises:
        IgsrError: the file is missing, truncated, lacks a weight, or is not a denoiser of igsr.
    """
    if path is None and not SHIPPED.is_file():
        raise IgsrError(
            "this igsr was built without the denoiser's weights; give --weights FILE (denoiser= in "
            "Python), as written by python -m igsr_lab train (docs/guides/denoising.md)"
        )
    path = SHIPPED if path is None else Path(path)
    try:
        open_file(path).close()
        with safe_open(path, framework="pt") as file:
            architecture = _architecture((file.metadata() or {}).get("architecture"), path)
            with torch.device("meta"):  # takes no memory
                network = DenoiserNetwork(architecture)
            weights = _weights(file, network, path)
    except FileNotFoundError as error:
        raise IgsrError(f"{path} does not exist; give a denoiser's .safetensors file") from error
    except (SafetensorError, OSError) as error:
        raise IgsrError(
            f"{path} is not a complete .safetensors file; copy it again or train one"
        ) from error
    network.load_state_dict(weights, assign=True)
    # A third faster on CPUs.
    return network.to(memory_format=torch.channels_last).eval()


def _weights(file: Any, network: DenoiserNetwork, path: Path) -> dict[str, torch.Tensor]:
    """The network's weights; their shapes are compared before any is read."""
    names, expected = set(file.keys()), network.state_dict()
    for name, tensor in expected.items():
        if name not in names:
            raise IgsrError(f"{path} lacks the weight {name}; it was written by another version")
        part = file.get_slice(name)
        shape = list(part.get_shape())
        if shape != list(tensor.shape) or not part.get_dtype().startswith(("F", "BF")):
            raise IgsrError(
                f"{path}: {name} has shape {shape}, but its architecture needs {list(tensor.shape)}"
            )
    unknown = sorted(names - set(expected))
    if unknown:
        raise IgsrError(f"{path} has an unknown weight {unknown[0]}")
    weights = {name: file.get_tensor(name).float() for name in expected}
    for name, tensor in weights.items():
        if not torch.isfinite(tensor).all():
            raise IgsrError(f"{path}: {name} holds a NaN or infinite weight; train it again")
    return weights


def _architecture(text: str | None, path: Path) -> Architecture:
    try:
        settings = parse_json((text or "").encode())
        if any(settings.get(name, value) != value for name, value in _FORMER_SETTINGS.items()):
            raise IgsrError("igsr no longer has its settings; train it again")
        return Architecture(settings["width"], tuple(settings["blocks"]))
    except IgsrError as error:
        raise IgsrError(f"{path} has an unsupported architecture: {error}") from error
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise IgsrError(
            f"{path} does not record its architecture; it is not a denoiser of igsr"
        ) from error
