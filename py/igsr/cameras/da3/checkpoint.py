"""Read and check checkpoints of Depth Anything 3, which are untrusted files.

A checkpoint is a safetensors file, which holds only arrays and text, with a ``config.json`` next to
it that gives the size. Without that file, the shapes give the size. Nothing in them is run.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from torch import Tensor

from igsr.cameras.checkpoint_search import WEIGHTS, exists
from igsr.cameras.da3.backbone import BASE, FIRST_GLOBAL, OUTPUT_BLOCKS, SMALL, NetworkConfig
from igsr.cameras.da3.network import Da3Network
from igsr.cameras.networks import (
    Checkpoint,
    checked_weight,
    config_of,
    with_weights,
    without_weights,
)
from igsr.errors import IgsrError

#: License of the published models.
LICENSE = "Apache-2.0"
#: The implemented sizes, by the names of the published models.
SIZES = {"da3-small": SMALL, "da3-base": BASE}

#: Prefix of all keys.
_PREFIX = "model."
#: The same sizes, by the names of the backbone in a config.json.
_NET_NAMES = {"vits": "da3-small", "vitb": "da3-base"}
#: Parts that are not implemented: rays, and the encoder of known cameras.
_UNUSED = re.compile(r"head\.scratch\.\w+_aux\..*|cam_enc\..*")
#: Keys of the larger models.
_LARGER = re.compile(
    r"(da3|da3_metric|gs_head|gs_adapter)\..*|backbone\.pretrained\.blocks\.1[2-9]\..*"
)


def load_network(path: str | Path, device: str | None = None) -> Da3Network:
    """Load a network to a device, by default "cuda" if available, else "cpu".

    Raises:
        IgsrError: as ``load_checkpoint``, or the device cannot be used.
    """
    return with_weights(Da3Network, load_checkpoint(path), path, device)


def load_checkpoint(path: str | Path) -> Checkpoint[NetworkConfig]:
    """Read and check a safetensors file, or a folder with ``model.safetensors``.

    Raises:
        IgsrError: the file is missing, damaged or of another network, or lacks a key or has it in
            another shape.
    """
    path = Path(path)
    path = path / WEIGHTS if exists(path, folder=True) else path
    if not exists(path):
        raise IgsrError(f"{path} does not exist; name a checkpoint of Depth Anything 3")
    if path.suffix != ".safetensors":
        raise IgsrError(
            f"{path} is not a .safetensors file, the only format of Depth Anything 3; name its "
            f"{WEIGHTS}"
        )
    described = config_of(path)
    name = None if described is None else size_of(described, str(path.parent / "config.json"))
    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            # Shapes are checked before any array is read.
            shapes = {key: tuple(file.get_slice(key).get_shape()) for key in file.keys()}  # noqa: SIM118
            if any(_LARGER.fullmatch(key.removeprefix(_PREFIX)) for key in shapes):
                raise IgsrError(
                    f"{path} is a checkpoint of a larger model of Depth Anything 3; those are not "
                    "implemented, and most are for non-commercial use; name one of DA3-SMALL or "
                    "DA3-BASE"
                )
            name = name or _size_of_shapes(path, shapes)
            weights, unknown = read_weights(path, file, shapes, SIZES[name])
    except IgsrError:
        raise
    except Exception as error:  # the library raises more than its own exception
        raise IgsrError(f"{path} is damaged or not safetensors; download it again") from error
    return Checkpoint(SIZES[name], weights, unknown)


def read_weights(
    path: Path, file: Any, shapes: Mapping[str, tuple[int, ...]], config: NetworkConfig
) -> tuple[dict[str, Tensor], list[str]]:
    """Read the weights of a network from an open file, and list the keys that it does not have."""
    weights, used = {}, set()
    for key, tensor in without_weights(Da3Network, config).state_dict().items():
        stored = _PREFIX + key
        weights[key] = _weight(path, file, shapes, stored, tuple(tensor.shape))
        used.add(stored)
    unknown = [
        key
        for key in shapes
        if key not in used and not _UNUSED.fullmatch(key.removeprefix(_PREFIX))
    ]
    return weights, sorted(unknown)


def _weight(
    path: Path,
    file: Any,
    shapes: Mapping[str, tuple[int, ...]],
    key: str,
    shape: tuple[int, ...],
) -> Tensor:
    if key not in shapes:
        raise IgsrError(f"{path} has no {key}; it is incomplete or of another network")
    if shapes[key] != shape:
        raise IgsrError(
            f"{path}: {key} has shape {list(shapes[key])} instead of {list(shape)}; the file is "
            "damaged or of another network"
        )
    value = checked_weight(path, key, file.get_tensor(key), shape)
    if not bool(torch.isfinite(value).all()):
        raise IgsrError(f"{path}: {key} has values that are not finite; download it again")
    return value


def _size_of_shapes(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> str:
    token = shapes.get(f"{_PREFIX}backbone.pretrained.cls_token", ())
    for name, config in SIZES.items():
        if len(token) == 3 and token[2] == config.embed_dim:
            return name
    raise IgsrError(
        f"{path} is not a checkpoint of Depth Anything 3 SMALL or BASE; name one of them, or put "
        "its config.json next to it"
    )


def size_of(content: Mapping[str, Any], source: str) -> str:
    """The name, one of ``SIZES``, of the network that a ``config.json`` describes.

    The file names Python classes, which are compared and not imported.

    Raises:
        IgsrError: the content is incomplete, or a name or number belongs to another network.
    """

    def check(name: str, value: Any, matches: bool, wanted: str) -> None:
        if not matches:
            raise IgsrError(
                f"{source}: {name} is {value!r} instead of {wanted}; only DA3-SMALL and DA3-BASE "
                "are implemented, so name a checkpoint of one of them"
            )

    def part(name: str) -> Mapping[str, Any]:
        described = parts.get(name)
        if not isinstance(described, Mapping):
            raise IgsrError(f"{source} does not describe {name}; download it again")
        return described

    named = content.get("model_name")
    known = named is None or (isinstance(named, str) and named in SIZES)
    check("model_name", named, known, " or ".join(SIZES))
    parts: Any = content.get("config")
    if parts is None and named is not None:
        return str(named)
    if not isinstance(parts, Mapping):
        raise IgsrError(f"{source} has no network under 'config'; download it again")
    net = part("net").get("name")
    check("net.name", net, isinstance(net, str) and net in _NET_NAMES, " or ".join(_NET_NAMES))
    size = _NET_NAMES[str(net)]
    check("net.name", net, named in (None, size), f"the one for {named}")
    for name, (class_name, numbers) in _described(SIZES[size]).items():
        described = part(name)
        declared = described.get("__object__", {})
        declared = declared.get("name") if isinstance(declared, Mapping) else declared
        check(f"{name}.__object__.name", declared, declared in (None, class_name), class_name)
        for field, wanted in numbers.items():
            value = described.get(field, wanted)
            check(f"{name}.{field}", value, value == wanted, repr(wanted))
    return size


def _described(config: NetworkConfig) -> dict[str, tuple[str, dict[str, Any]]]:
    """Class name and numbers of each part of a network, as in a ``config.json``."""
    dim = config.embed_dim
    return {
        "net": (
            "DinoV2",
            {
                "out_layers": list(OUTPUT_BLOCKS),
                "alt_start": FIRST_GLOBAL,
                "qknorm_start": FIRST_GLOBAL,
                "rope_start": FIRST_GLOBAL,
                "cat_token": True,
            },
        ),
        "head": (
            "DualDPT",
            {
                "dim_in": 2 * dim,
                "output_dim": 2,
                "features": config.features,
                "out_channels": list(config.out_channels),
            },
        ),
        "cam_dec": ("CameraDec", {"dim_in": 2 * dim}),
    }
