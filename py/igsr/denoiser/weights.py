"""Denoisers as files: weights and what network they belong to, in one safetensors file."""

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
from igsr.denoiser.architecture import Architecture
from igsr.denoiser.network import DenoiserNetwork
from igsr.errors import IgsrError

#: The denoiser that comes with igsr.
SHIPPED = Path(__file__).with_name("denoiser.safetensors")


def save_network(
    network: DenoiserNetwork, path: str | os.PathLike[str], recipe: dict[str, Any]
) -> None:
    """Write a network in half precision, under a temporary name first.

    Args:
        network: what to write.
        path: the ``.safetensors`` file.
        recipe: what it was trained on and how, kept beside the weights.

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
    """Read a network; None is the one that comes with igsr.

    Args:
        path: of a ``.safetensors`` file; None is the network that comes with igsr.

    Raises:
        IgsrError: the file is missing, no denoiser of igsr's, truncated, or lacks a weight.
    """
    if path is None and not SHIPPED.is_file():
        raise IgsrError(
            "this igsr has no weights of its own for the denoiser; give --weights FILE "
            "(denoiser= in Python), which python -m igsr_lab train makes (docs/guides/denoising.md)"
        )
    path = SHIPPED if path is None else Path(path)
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError as error:
        raise IgsrError(f"{path} does not exist; give a denoiser's .safetensors file") from error
    except (SafetensorError, OSError) as error:
        raise IgsrError(
            f"{path} is no whole .safetensors file; copy it again or train one"
        ) from error
    network = DenoiserNetwork(_architecture(metadata.get("architecture"), path))
    wanted = network.state_dict()
    for name, tensor in wanted.items():
        if name not in weights:
            raise IgsrError(f"{path} lacks the weight {name}; it is another version's denoiser")
        if weights[name].shape != tensor.shape or not weights[name].is_floating_point():
            raise IgsrError(
                f"{path}: {name} has shape {list(weights[name].shape)} where its architecture "
                f"needs {list(tensor.shape)}"
            )
        if not torch.isfinite(weights[name]).all():
            raise IgsrError(f"{path}: {name} holds a NaN or infinite weight; train it again")
    unknown = sorted(set(weights) - set(wanted))
    if unknown:
        raise IgsrError(f"{path} holds the weight {unknown[0]}, which igsr's denoisers do not have")
    network.load_state_dict({name: tensor.float() for name, tensor in weights.items()})
    # Faster on CPUs by a third.
    return network.to(memory_format=torch.channels_last).eval()


def _architecture(text: str | None, path: Path) -> Architecture:
    try:
        given = json.loads(text or "")
        return Architecture(**{**given, "blocks": tuple(given["blocks"])})
    except IgsrError as error:
        raise IgsrError(f"{path} is of a network that igsr does not build: {error}") from error
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise IgsrError(
            f"{path} does not say which network it is of; it is no denoiser of igsr's"
        ) from error
