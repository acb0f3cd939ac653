"""Checkpoints of DUSt3R: found, read as the untrusted files that they are, and checked by key.

Two containers hold the same weights: what ``torch.save`` wrote, with the sizes as the text of a
constructor call, and safetensors with the sizes in a ``config.json`` beside it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from igsr.errors import IgsrError
from igsr.pose.dust3r.network import Dust3rNetwork, NetworkConfig
from igsr.pose.huggingface_cache import cached_snapshots

#: Names a checkpoint that is to be used wherever it lies.
VARIABLE = "IGSR_DUST3R"
#: The published models, the best first.
PUBLISHED = (
    "DUSt3R_ViTLarge_BaseDecoder_512_dpt",
    "DUSt3R_ViTLarge_BaseDecoder_512_linear",
    "DUSt3R_ViTLarge_BaseDecoder_224_linear",
)
LICENCE = (
    "The weights of DUSt3R are under CC BY-NC-SA 4.0, which forbids commercial use of them and of "
    "what they give, and come with the terms of the data sets that they were trained on "
    "(https://github.com/naver/dust3r)."
)

#: Sizes under the names that checkpoints have for them.
_SIZES = {
    "enc_embed_dim": "encoder_dim",
    "enc_depth": "encoder_depth",
    "enc_num_heads": "encoder_heads",
    "dec_embed_dim": "decoder_dim",
    "dec_depth": "decoder_depth",
    "dec_num_heads": "decoder_heads",
}
#: What would change the meaning of the weights, and the one meaning that is implemented.
_MEANINGS = {
    "pos_embed": "RoPE100",
    "output_mode": "pts3d",
    "depth_mode": ("exp", float("-inf"), float("inf")),
    "conf_mode": ("exp", 1.0, float("inf")),
}
_CALL = re.compile(r"\s*(\w+)\s*\((.*)\)\s*", re.DOTALL)
_SCALAR = r"""'[^']*'|"[^"]*"|[-+\w.]+"""
_ARGUMENT = re.compile(rf"\s*(\w+)\s*=\s*({_SCALAR}|[(\[][^()\[\]]*[)\]])\s*(?:,|$)", re.DOTALL)
#: Letters that a constructor call or a config.json may have.
_LONGEST_TEXT = 10_000
#: Unknown keys that a warning names.
_NAMED = 20

# Training needs the token that stands for hidden patches; layer_rn repeats layer1_rn to layer4_rn.
_UNNEEDED = re.compile(r"mask_token|downstream_head[12]\.dpt\.scratch\.layer_rn\.[0-3]\.weight")

_licence_shown = False


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A checked checkpoint.

    Attributes:
        config: the sizes it says it has.
        weights: float32, exactly the keys and shapes of a ``Dust3rNetwork`` of these sizes.
        unknown: keys of the file that no part of the network has, sorted; they were ignored.
    """

    config: NetworkConfig
    weights: dict[str, Tensor]
    unknown: list[str]


def find_checkpoint(named: str | Path | None = None) -> Path | None:
    """Where a checkpoint lies: the named file, else what IGSR_DUST3R names, else a cached one.

    The caches are those of ``torch.hub`` (``checkpoints/NAME.pth``) and of huggingface_hub
    (``models--naver--NAME``), looked through for the published names; nothing is downloaded.

    Args:
        named: a file, or None.

    Raises:
        IgsrError: the named file, or the one that IGSR_DUST3R names, is no file.
    """
    for source, value in (("checkpoint", named), (VARIABLE, os.environ.get(VARIABLE))):
        if value:
            path = Path(value).expanduser()
            if not _is_file(path):
                raise IgsrError(
                    f"{source} names {str(path)!r}, which is no file; name a DUSt3R checkpoint, "
                    "or none to do without"
                )
            return path
    hub = Path(torch.hub.get_dir()) / "checkpoints"
    for name in PUBLISHED:
        cached = [one / "model.safetensors" for one in cached_snapshots(f"naver/{name}")]
        for path in (hub / f"{name}.pth", *cached):
            if _is_file(path):
                return path
    return None


def load_network(path: Path, device: str | None = None) -> Dust3rNetwork:
    """A network with a checkpoint's weights, ready to predict.

    The licence of the weights is told once per process, and keys that were ignored each time, as
    warnings.

    Args:
        path: a ``.pth`` file as torch.save writes it, or ``.safetensors`` beside ``config.json``.
        device: where it is to run, such as "cpu" or "cuda:1"; by default "cuda" where there is one.

    Raises:
        IgsrError: as ``load_checkpoint``, or the device cannot be used.
    """
    global _licence_shown
    checkpoint = load_checkpoint(path)
    if not _licence_shown:
        warnings.warn(LICENCE, stacklevel=2)
        _licence_shown = True
    if checkpoint.unknown:
        named = ", ".join(checkpoint.unknown[:_NAMED])
        more = len(checkpoint.unknown) - _NAMED
        warnings.warn(
            f"{path} has keys that no DUSt3R network has, which were ignored: {named}"
            + (f" and {more} more." if more > 0 else "."),
            stacklevel=2,
        )
    network = _without_weights(checkpoint.config)
    network.load_state_dict(checkpoint.weights, assign=True)
    network.requires_grad_(False)
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return network.to(device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).strip().splitlines() or ["no reason given"]
        raise IgsrError(
            f"device {device!r} cannot hold the network ({reason[0]}); give 'cpu'"
        ) from error


def load_checkpoint(path: Path) -> Checkpoint:
    """A checkpoint's sizes and weights; nothing in the file is run or evaluated.

    Float32 weights stay in the file until they are read (the file is mapped into memory).

    Args:
        path: as for ``load_network``.

    Raises:
        IgsrError: the file is missing, damaged, holds anything but tensors and text, is of another
            network, or lacks a key or has it in another shape; the sentence names what.
    """
    path = Path(path)
    if not _is_file(path):
        raise IgsrError(f"{path} is no file; name a DUSt3R checkpoint")
    if path.suffix == ".safetensors":
        config, stored = _read_safetensors(path)
    else:
        config, stored = _read_torch(path)
    if not all(isinstance(key, str) for key in stored):
        raise IgsrError(f"{path} has keys that are no text; use the published checkpoint")
    wanted = _without_weights(config).state_dict()
    weights = {key: _weight(path, stored, key, tensor.shape) for key, tensor in wanted.items()}
    unknown = sorted(k for k in stored if k not in wanted and not _UNNEEDED.fullmatch(k))
    return Checkpoint(config, weights, unknown)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name that no file can have
        return False


def _without_weights(config: NetworkConfig) -> Dust3rNetwork:
    with torch.device("meta"):
        return Dust3rNetwork(config).eval()


@contextlib.contextmanager
def _safe(name: type) -> Iterator[None]:
    """Let torch's restricted reader make one more class for a while.

    torch's own context manager takes a class off the list at the end that was on it before.
    """
    if name in torch.serialization.get_safe_globals():
        yield
        return
    with torch.serialization.safe_globals([name]):
        yield


def _read_torch(path: Path) -> tuple[NetworkConfig, dict[str, Any]]:
    damaged = f"{path} is damaged or no checkpoint of torch.save; download it again"
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            held = sum(member.file_size for member in members)
            # Compressed members could ask for far more memory than the file has bytes.
            if any(m.compress_type != zipfile.ZIP_STORED for m in members) or (
                held > path.stat().st_size
            ):
                raise IgsrError(damaged)
        with _safe(argparse.Namespace):
            content = torch.load(path, map_location="cpu", mmap=True, weights_only=True)
    except IgsrError:
        raise
    # Whatever zipfile, pickle's restricted reader and torch raise on what they were not made for.
    except Exception as error:
        refused = re.search(r"(?:GLOBAL|class|function) ([\w.]+)", str(error))
        if "nsupported" in str(error) and refused:
            raise IgsrError(
                f"{path} asks for {refused[1]}, which is more than tensors and settings, so it was "
                "not read; use the published checkpoint"
            ) from error
        raise IgsrError(damaged) from error
    stored = content.get("model") if isinstance(content, dict) else None
    if not isinstance(stored, dict):
        raise IgsrError(f"{path} has no weights under 'model'; name a checkpoint of DUSt3R")
    settings = content.get("args")
    call = getattr(settings, "model", None) if isinstance(settings, argparse.Namespace) else None
    if not isinstance(call, str):
        raise IgsrError(
            f"{path} has no text under 'args.model' that says the network's sizes; name a "
            "checkpoint of DUSt3R"
        )
    return _config(_parsed_call(call, path), path), stored


def _read_safetensors(path: Path) -> tuple[NetworkConfig, dict[str, Any]]:
    beside = path.parent / "config.json"
    try:
        if beside.stat().st_size > _LONGEST_TEXT:
            raise ValueError("it is too long")
        arguments = json.loads(beside.read_bytes())
        if not isinstance(arguments, dict):
            raise ValueError("it is no object")
    except FileNotFoundError as error:
        raise IgsrError(
            f"{beside} does not exist, and only it says the sizes of {path.name}; download it too"
        ) from error
    except (OSError, ValueError, RecursionError) as error:
        raise IgsrError(f"{beside} cannot be read ({error}); download it again") from error
    config = _config(arguments, beside)
    try:
        stored = load_file(path)
    except Exception as error:  # the library's own exception is not all that it raises
        raise IgsrError(f"{path} is damaged or no safetensors; download it again") from error
    return config, stored


def _parsed_call(call: str, path: Path) -> dict[str, Any]:
    """The keyword arguments of a constructor call, as text, numbers and tuples of them."""
    match = _CALL.fullmatch(call) if len(call) <= _LONGEST_TEXT else None
    if match is None:
        raise IgsrError(f"{path}: its args.model is no constructor call; name a DUSt3R checkpoint")
    name, inside = match.groups()
    if name != "AsymmetricCroCo3DStereo":
        raise IgsrError(f"{path} is a checkpoint of {name}; name one of DUSt3R")
    arguments, at = {}, 0
    while inside[at:].strip():
        argument = _ARGUMENT.match(inside, at)
        if argument is None:
            raise IgsrError(
                f"{path}: its args.model cannot be understood at {inside[at : at + 40]!r}; use the "
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
        try:
            return number(text)
        except ValueError:
            continue
    return text


def _config(arguments: Mapping[str, Any], source: Path) -> NetworkConfig:
    for name in ("pos_embed", "img_size", "head_type", *_SIZES):
        if name not in arguments:
            raise IgsrError(f"{source} does not say {name}; use a published checkpoint")
    for name, wanted in _MEANINGS.items():
        given = arguments.get(name, wanted)
        given = tuple(given) if isinstance(given, list) else given
        if given != wanted:
            raise IgsrError(
                f"{source}: its {name} is {given!r} where only {wanted!r} is implemented; use a "
                "published checkpoint"
            )
    sides = arguments["img_size"]
    image_size = max(sides) if _is_size(sides) else sides
    sizes = {ours: arguments[theirs] for theirs, ours in _SIZES.items()}
    try:
        return NetworkConfig(image_size=image_size, head=arguments["head_type"], **sizes)
    except IgsrError as error:
        raise IgsrError(f"{source}: its {error}") from error


def _is_size(sides: Any) -> bool:
    return (
        isinstance(sides, (list, tuple))
        and len(sides) == 2
        and all(type(side) is int for side in sides)
    )


def _weight(path: Path, stored: Mapping[str, Any], key: str, shape: torch.Size) -> Tensor:
    """A stored tensor as float32, refused if it is none or has another shape."""
    value = stored.get(key)
    repeated = re.fullmatch(r"(.*\.scratch\.)layer([1-4])_rn\.weight", key)
    if value is None and repeated:
        value = stored.get(f"{repeated[1]}layer_rn.{int(repeated[2]) - 1}.weight")
    if value is None:
        raise IgsrError(f"{path} has no {key}; it is incomplete or of another network")
    if (
        not isinstance(value, Tensor)
        or value.layout != torch.strided
        or value.device.type != "cpu"
        or not value.is_floating_point()
    ):
        raise IgsrError(f"{path}: its {key} is no array of floats; use the published checkpoint")
    if value.shape != shape:
        raise IgsrError(
            f"{path}: its {key} has shape {list(value.shape)} where {list(shape)} belongs; it is "
            "damaged or of another network"
        )
    return value.detach().to(torch.float32).contiguous()
