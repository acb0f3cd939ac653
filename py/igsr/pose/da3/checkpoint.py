"""Checkpoints of Depth Anything 3: found, read as the untrusted files they are, checked by key.

A checkpoint is a safetensors file, which holds arrays and text and nothing that could be run, with
a ``config.json`` beside it that says the size. A file alone tells its size by its shapes.
"""

from __future__ import annotations

import json
import os
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from torch import Tensor

from igsr.errors import IgsrError
from igsr.pose.da3.config import SIZES, NetworkConfig, size_of
from igsr.pose.da3.head import RAY_LEVEL, SHARED_NORM
from igsr.pose.da3.network import Da3Network
from igsr.pose.huggingface_cache import cached_snapshots

#: Names a checkpoint that is to be used wherever it lies.
VARIABLE = "IGSR_DA3"
#: The published models, as huggingface names them, the better first.
PUBLISHED = ("depth-anything/DA3-BASE", "depth-anything/DA3-SMALL")
#: Of the published models, and what is said of one that was trained by igsr.
LICENCE = "Apache-2.0"
#: The file in a folder of a checkpoint.
WEIGHTS, CONFIG = "model.safetensors", "config.json"
#: What all keys begin with.
PREFIX = "model."

#: Bytes that a config.json may have.
_LONGEST_TEXT = 100_000
#: Unknown keys that a warning names.
_NAMED = 20

#: Outputs at other levels than the one that is used, of which only training has need.
_UNNEEDED = re.compile(r"head\.scratch\.output_conv[12]_aux\.[012]\..*")
#: What the larger models have, and the two of the smaller ones do not.
_LARGER = re.compile(
    r"(da3|da3_metric|gs_head|gs_adapter)\..*|backbone\.pretrained\.blocks\.1[2-9]\..*"
)
_WIDTHS = {config.embed_dim: name for name, config in SIZES.items()}


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A checked checkpoint.

    Attributes:
        name: one of ``SIZES``.
        config: its sizes.
        weights: float32, exactly the keys and shapes of a ``Da3Network`` of that size.
        unknown: keys of the file that no part of the network has, sorted; they were ignored.
    """

    name: str
    config: NetworkConfig
    weights: dict[str, Tensor]
    unknown: list[str]


def stated(config: NetworkConfig) -> dict[str, str]:
    """The "name" of a network of one of the ``SIZES``, and the "licence" of its weights."""
    name = next(name for name, size in SIZES.items() if size == config)
    return {"name": name, "licence": LICENCE}


def find_checkpoint(named: str | Path | None = None) -> Path | None:
    """Where a checkpoint lies: the named one, else what IGSR_DA3 names, else a cached one.

    The cache is huggingface_hub's, looked through for BASE, then SMALL; nothing is downloaded.

    Args:
        named: a safetensors file, a folder that holds ``model.safetensors``, or None.

    Returns:
        The safetensors file.

    Raises:
        IgsrError: what is named, here or by IGSR_DA3, is no such file or folder.
    """
    for source, value in (("checkpoint", named), (VARIABLE, os.environ.get(VARIABLE))):
        if value:
            path = Path(value).expanduser()
            path = path / WEIGHTS if _is(path, Path.is_dir) else path
            if not _is(path, Path.is_file):
                raise IgsrError(
                    f"{source} names {str(path)!r}, which is no file; name a checkpoint of Depth "
                    "Anything 3, or get one by 'igsr weights fetch'"
                )
            return path
    for model in PUBLISHED:
        for folder in cached_snapshots(model):
            if _is(folder / WEIGHTS, Path.is_file):
                return folder / WEIGHTS
    return None


def load_network(path: str | Path, device: str | None = None) -> Da3Network:
    """A network with a checkpoint's weights, ready to predict.

    Keys that were ignored are listed in a warning.

    Args:
        path: a safetensors file, or the folder that it lies in as ``model.safetensors``.
        device: where it is to run, such as "cpu" or "cuda:1"; by default "cuda" where there is one.

    Raises:
        IgsrError: as ``load_checkpoint``, or the device cannot be used.
    """
    checkpoint = load_checkpoint(path)
    if checkpoint.unknown:
        named = ", ".join(checkpoint.unknown[:_NAMED])
        more = len(checkpoint.unknown) - _NAMED
        warnings.warn(
            f"{path} has keys that Depth Anything 3 has no use for, which were ignored: {named}"
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


def load_checkpoint(path: str | Path) -> Checkpoint:
    """A checkpoint's size and weights; nothing in its files is run or imported.

    Args:
        path: as for ``load_network``.

    Raises:
        IgsrError: the file is missing, damaged or of another network, or lacks a key or has it in
            another shape; the message names what.
    """
    path = Path(path)
    path = path / WEIGHTS if _is(path, Path.is_dir) else path
    if not _is(path, Path.is_file):
        raise IgsrError(
            f"{path} is no file; name a checkpoint of Depth Anything 3, or the folder that holds "
            f"its {WEIGHTS}"
        )
    if path.suffix != ".safetensors":
        raise IgsrError(
            f"{path} is no .safetensors file, the only kind that Depth Anything 3 comes in; name "
            f"its {WEIGHTS}"
        )
    beside = _size_beside(path)
    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            # Keys are read by shape before anything is read whole.
            shapes = {key: tuple(file.get_slice(key).get_shape()) for key in file.keys()}  # noqa: SIM118
            name = beside or _size_of_shapes(path, shapes)
            _check_larger(path, shapes)
            config = SIZES[name]
            weights, unknown = read_weights(path, file, shapes, config)
    except IgsrError:
        raise
    except Exception as error:  # the library's own exception is not all that it raises
        raise IgsrError(f"{path} is damaged or no safetensors; download it again") from error
    return Checkpoint(name, config, weights, unknown)


def read_weights(
    path: Path, file: Any, shapes: dict[str, tuple[int, ...]], config: NetworkConfig
) -> tuple[dict[str, Tensor], list[str]]:
    """The weights of a network of given sizes, and the keys that it has no use for.

    Args:
        path: for messages.
        file: an open safetensors file.
        shapes: per key of the file.
        config: the sizes.

    Raises:
        IgsrError: as ``load_checkpoint``.
    """
    wanted = _without_weights(config).state_dict()
    weights, used = {}, set()
    for key, tensor in wanted.items():
        stored = _stored_keys(key, shapes)
        values = [_weight(path, file, shapes, one, tuple(tensor.shape)) for one in stored]
        if any(not torch.equal(values[0], value) for value in values[1:]):
            raise IgsrError(
                f"{path}: its {stored[0]} and {stored[1]} differ, and the network has one norm for "
                "both; it is damaged or of another network"
            )
        weights[key] = values[0]
        used.update(stored)
    unknown = [key for key in shapes if key not in used and not _UNNEEDED.fullmatch(_short(key))]
    return weights, sorted(unknown)


def _stored_keys(key: str, shapes: dict[str, tuple[int, ...]]) -> list[str]:
    """The keys of the file that hold a weight; there is one more for the shared norm.

    safetensors keeps a tensor that has several names once, under the first of them.
    """
    used, first = (f"head.{SHARED_NORM.format(level)}." for level in (RAY_LEVEL, 0))
    if not key.startswith(used):
        return [PREFIX + key]
    both = [PREFIX + key, PREFIX + key.replace(used, first)]
    return [one for one in both if one in shapes] or both[1:]


def _weight(
    path: Path,
    file: Any,
    shapes: dict[str, tuple[int, ...]],
    key: str,
    shape: tuple[int, ...],
) -> Tensor:
    """A stored tensor as float32, refused if it is none or has another shape."""
    if key not in shapes:
        raise IgsrError(f"{path} has no {key}; it is incomplete or of another network")
    if shapes[key] != shape:
        raise IgsrError(
            f"{path}: its {key} has shape {list(shapes[key])} where {list(shape)} belongs; it is "
            "damaged or of another network"
        )
    value: Tensor = file.get_tensor(key)
    if not value.is_floating_point():
        raise IgsrError(f"{path}: its {key} is no array of floats; use the published checkpoint")
    value = value.to(torch.float32).contiguous()
    if not bool(torch.isfinite(value).all()):
        raise IgsrError(f"{path}: its {key} holds numbers that are not finite; download it again")
    return value


def _size_beside(path: Path) -> str | None:
    """Name by the ``config.json`` beside a checkpoint; None where there is none."""
    beside = path.parent / CONFIG
    try:
        if not beside.exists():
            return None
        if beside.stat().st_size > _LONGEST_TEXT:
            raise ValueError("it is too long")
        content = json.loads(beside.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise IgsrError(f"{beside} cannot be read ({error}); download it again") from error
    return size_of(content, str(beside))


def _size_of_shapes(path: Path, shapes: dict[str, tuple[int, ...]]) -> str:
    _check_larger(path, shapes)
    token = shapes.get(f"{PREFIX}backbone.pretrained.cls_token", ())
    if len(token) == 3 and token[2] in _WIDTHS:
        return _WIDTHS[token[2]]
    raise IgsrError(
        f"{path} is no checkpoint of Depth Anything 3 SMALL or BASE; name one of them, or put its "
        f"{CONFIG} beside it"
    )


def _check_larger(path: Path, shapes: dict[str, tuple[int, ...]]) -> None:
    if any(_LARGER.fullmatch(_short(key)) for key in shapes):
        raise IgsrError(
            f"{path} is a checkpoint of a larger model of Depth Anything 3, most of which are for "
            "non-commercial use and none of which is implemented; name one of DA3-SMALL or DA3-BASE"
        )


def _short(key: str) -> str:
    return key.removeprefix(PREFIX)


def _without_weights(config: NetworkConfig) -> Da3Network:
    with torch.device("meta"):
        return Da3Network(config).eval()


def _is(path: Path, kind: Any) -> bool:
    try:
        return bool(kind(path))
    except (OSError, ValueError):  # a name that no file can have
        return False
