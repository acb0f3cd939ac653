"""Read and check checkpoints of DUSt3R, which are untrusted files.

Two formats hold the same weights: ``torch.save`` with the sizes as the text of a constructor call,
and safetensors with the sizes in a ``config.json`` next to it. Nothing in them is run.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file

from igsr.cameras.checkpoint_search import exists
from igsr.cameras.dust3r.network import Dust3rNetwork, NetworkConfig
from igsr.cameras.networks import (
    Checkpoint,
    checked_weight,
    config_of,
    with_weights,
    without_weights,
)
from igsr.errors import IgsrError

LICENSE = (
    "The weights of DUSt3R are under CC BY-NC-SA 4.0, which forbids commercial use of them and of "
    "their results, and come with the terms of the data sets that they were trained on "
    "(https://github.com/naver/dust3r)."
)

#: Names of sizes in checkpoints, and in ``NetworkConfig``.
_SIZES = {
    "enc_embed_dim": "encoder_dim",
    "enc_depth": "encoder_depth",
    "enc_num_heads": "encoder_heads",
    "dec_embed_dim": "decoder_dim",
    "dec_depth": "decoder_depth",
    "dec_num_heads": "decoder_heads",
}
#: Settings that change the meaning of the weights, with the only values that are implemented.
_IMPLEMENTED = {
    "pos_embed": "RoPE100",
    "output_mode": "pts3d",
    "depth_mode": ("exp", float("-inf"), float("inf")),
    "conf_mode": ("exp", 1.0, float("inf")),
}
_CALL = re.compile(r"\s*(\w+)\s*\((.*)\)\s*", re.DOTALL)
_SCALAR = r"""'[^']*'|"[^"]*"|[-+\w.]+"""
_ARGUMENT = re.compile(rf"\s*(\w+)\s*=\s*({_SCALAR}|[(\[][^()\[\]]*[)\]])\s*(?:,|$)", re.DOTALL)
#: Maximum number of characters of a constructor call.
_MAX_CALL_LENGTH = 10_000

# mask_token is for training; layer_rn repeats layer1_rn to layer4_rn.
_UNUSED = re.compile(r"mask_token|downstream_head[12]\.dpt\.scratch\.layer_rn\.[0-3]\.weight")

_license_shown = False


def load_network(path: Path, device: str | None = None) -> Dust3rNetwork:
    """Load a network to a device, by default "cuda" if available, else "cpu".

    A warning shows the license of the weights once per process.

    Raises:
        IgsrError: as ``load_checkpoint``, or the device cannot be used.
    """
    global _license_shown
    checkpoint = load_checkpoint(path)
    if not _license_shown:
        warnings.warn(LICENSE, stacklevel=2)
        _license_shown = True
    return with_weights(Dust3rNetwork, checkpoint, path, device)


def load_checkpoint(path: Path) -> Checkpoint[NetworkConfig]:
    """Read and check a ``.pth`` file of torch.save, or ``.safetensors`` next to a ``config.json``.

    Float32 weights of torch.save are mapped into memory.

    Raises:
        IgsrError: the file is missing or damaged, holds anything but tensors and text, is of
            another network, or lacks a key or has it in another shape.
    """
    path = Path(path)
    if not exists(path):
        raise IgsrError(f"{path} does not exist; name a checkpoint of DUSt3R")
    read = _read_safetensors if path.suffix == ".safetensors" else _read_torch
    config, stored = read(path)
    if not all(isinstance(key, str) for key in stored):
        raise IgsrError(f"{path} has keys that are not text; use the published checkpoint")
    wanted = without_weights(Dust3rNetwork, config).state_dict()
    weights = {}
    for key, tensor in wanted.items():
        value = stored.get(key)
        repeated = re.fullmatch(r"(.*\.scratch\.)layer([1-4])_rn\.weight", key)
        if value is None and repeated:
            value = stored.get(f"{repeated[1]}layer_rn.{int(repeated[2]) - 1}.weight")
        if value is None:
            raise IgsrError(f"{path} has no {key}; it is incomplete or of another network")
        weights[key] = checked_weight(path, key, value, tensor.shape)
    unknown = sorted(k for k in stored if k not in wanted and not _UNUSED.fullmatch(k))
    return Checkpoint(config, weights, unknown)


@contextlib.contextmanager
def _allowed(name: type) -> Iterator[None]:
    """Let torch's restricted unpickler make one more class.

    torch's own context manager would also remove a class that was allowed before.
    """
    if name in torch.serialization.get_safe_globals():
        yield
        return
    with torch.serialization.safe_globals([name]):
        yield


def _read_torch(path: Path) -> tuple[NetworkConfig, dict[str, Any]]:
    damaged = f"{path} is damaged or not a checkpoint of torch.save; download it again"
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            held = sum(member.file_size for member in members)
            # Compressed members could ask for far more memory than the file has bytes.
            if any(m.compress_type != zipfile.ZIP_STORED for m in members) or (
                held > path.stat().st_size
            ):
                raise IgsrError(damaged)
        with _allowed(argparse.Namespace):
            content = torch.load(path, map_location="cpu", mmap=True, weights_only=True)
    except IgsrError:
        raise
    except Exception as error:  # zipfile, the restricted unpickler and torch raise many types
        refused = re.search(r"(?:GLOBAL|class|function) ([\w.]+)", str(error))
        if "nsupported" in str(error) and refused:
            raise IgsrError(
                f"{path} was not loaded, because it contains {refused[1]} and not only tensors and "
                "settings; use the published checkpoint"
            ) from error
        raise IgsrError(damaged) from error
    stored = content.get("model") if isinstance(content, dict) else None
    if not isinstance(stored, dict):
        raise IgsrError(f"{path} has no weights under 'model'; name a checkpoint of DUSt3R")
    settings = content.get("args")
    call = getattr(settings, "model", None) if isinstance(settings, argparse.Namespace) else None
    if not isinstance(call, str):
        raise IgsrError(
            f"{path} does not give the network's sizes as text under 'args.model'; name a "
            "checkpoint of DUSt3R"
        )
    return _checked_config(_parsed_call(call, path), path), stored


def _read_safetensors(path: Path) -> tuple[NetworkConfig, dict[str, Any]]:
    arguments = config_of(path)
    if arguments is None:
        raise IgsrError(
            f"{path} needs its config.json next to it, which gives the sizes; download it too"
        )
    config = _checked_config(arguments, path.parent / "config.json")
    try:
        return config, load_file(path)
    except Exception as error:  # the library raises more than its own exception
        raise IgsrError(f"{path} is damaged or not safetensors; download it again") from error


def _parsed_call(call: str, path: Path) -> dict[str, Any]:
    """Parse the keyword arguments of a constructor call: text, numbers and tuples of them."""
    match = _CALL.fullmatch(call) if len(call) <= _MAX_CALL_LENGTH else None
    if match is None:
        raise IgsrError(
            f"{path}: args.model is not a constructor call; name a checkpoint of DUSt3R"
        )
    name, inside = match.groups()
    if name != "AsymmetricCroCo3DStereo":
        raise IgsrError(f"{path} is a checkpoint of {name}; name one of DUSt3R")
    arguments, at = {}, 0
    while inside[at:].strip():
        argument = _ARGUMENT.match(inside, at)
        if argument is None:
            raise IgsrError(
                f"{path}: args.model cannot be parsed at {inside[at : at + 40]!r}; use the "
                "published checkpoint"
            )
        arguments[argument[1]] = _parsed_value(argument[2])
        at = argument.end()
    return arguments


def _parsed_value(text: str) -> Any:
    if text[0] in "([":
        return tuple(_parsed_value(item) for item in re.findall(_SCALAR, text[1:-1]))
    if text[0] in "'\"":
        return text[1:-1]
    for number in (int, float):
        with contextlib.suppress(ValueError):
            return number(text)
    return text


def _checked_config(arguments: Mapping[str, Any], source: Path) -> NetworkConfig:
    for name in ("pos_embed", "img_size", "head_type", *_SIZES):
        if name not in arguments:
            raise IgsrError(f"{source} does not give {name}; use a published checkpoint")
    for name, implemented in _IMPLEMENTED.items():
        value = arguments.get(name, implemented)
        value = tuple(value) if isinstance(value, list) else value
        if value != implemented:
            raise IgsrError(
                f"{source}: {name} is {value!r}, but only {implemented!r} is implemented; use a "
                "published checkpoint"
            )
    size = arguments["img_size"]
    if isinstance(size, (list, tuple)) and len(size) == 2 and all(type(n) is int for n in size):
        size = max(size)
    sizes = {ours: arguments[theirs] for theirs, ours in _SIZES.items()}
    try:
        return NetworkConfig(image_size=size, head=arguments["head_type"], **sizes)
    except IgsrError as error:
        raise IgsrError(f"{source}: {error}") from error
