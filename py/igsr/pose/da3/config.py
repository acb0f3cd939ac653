"""Sizes of Depth Anything 3 and of what is trained here, and the ``config.json`` of a checkpoint.

Nothing in the file is imported or run: it names Python classes, of which only the names are read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from igsr.errors import IgsrError

#: Pixels of a token's side.
PATCH = 14
#: Pixels of the longer side of photos as the published sizes see them.
RESOLUTION = 504
#: Tokens along a side of the stored position embedding: photos of 518 pixels.
POSITIONS = 37
#: Blocks of the backbone, and the first of those that have rotary positions, normalised queries and
#: keys, the camera token, and in every second block attention over all views.
DEPTH, ALTERNATES = 12, 4
#: Blocks whose output the head and the camera decoder are given.
TAKEN = (5, 7, 9, 11)
#: Blocks of the camera encoder.
CAMERA_DEPTH = 4

#: What SMALL and BASE have in common, under the names that ``config.json`` has for it.
_SHARED_NET = {
    "out_layers": list(TAKEN),
    "alt_start": ALTERNATES,
    "qknorm_start": ALTERNATES,
    "rope_start": ALTERNATES,
    "cat_token": True,
}
_CLASSES = {"net": "DinoV2", "head": "DualDPT", "cam_enc": "CameraEnc", "cam_dec": "CameraDec"}


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of a network.

    Attributes:
        embed_dim: channels of the backbone.
        heads: attention heads of the backbone.
        features: channels in which the head joins its levels.
        out_channels: channels of the head's four levels, the finest first.
        camera_heads: attention heads of the camera encoder.

    Raises:
        IgsrError: a size is no whole number of at least 1, or does not divide into heads; or the
            resolution is no multiple of 14 from 14 to 2016.
    """

    embed_dim: int
    heads: int
    features: int
    out_channels: tuple[int, int, int, int]
    camera_heads: int = 16

    def __post_init__(self) -> None:
        """Check the sizes."""
        sizes = {name: getattr(self, name) for name in ("embed_dim", "heads", "features")}
        sizes |= {"camera_heads": self.camera_heads}
        sizes |= {f"out_channels[{i}]": size for i, size in enumerate(self.out_channels)}
        for name, value in sizes.items():
            if type(value) is not int or value < 1:
                raise IgsrError(f"{name} is {value!r}; give a whole number of at least 1")
        if len(self.out_channels) != 4 or any(size % 4 for size in self.out_channels):
            raise IgsrError(
                f"out_channels is {self.out_channels}; give four multiples of four, one per level"
            )
        if self.features % 8:
            raise IgsrError(f"features is {self.features}; give a multiple of eight")
        # Two axes, and two numbers turned together in each.
        if self.embed_dim % (4 * self.heads) or self.embed_dim % self.camera_heads:
            raise IgsrError(
                f"embed_dim is {self.embed_dim}, heads {self.heads} and camera_heads "
                f"{self.camera_heads}; give a multiple of four channels to each of the heads"
            )


SMALL = NetworkConfig(embed_dim=384, heads=6, features=64, out_channels=(48, 96, 192, 384))
BASE = NetworkConfig(embed_dim=768, heads=12, features=128, out_channels=(96, 192, 384, 768))
#: The sizes that are implemented, under the names that checkpoints give themselves.
SIZES = {"da3-small": SMALL, "da3-base": BASE}
#: And under the names that the backbone has in a ``config.json``.
_NET_NAMES = {"vits": "da3-small", "vitb": "da3-base"}


def size_of(content: Any, source: str) -> str:
    """The name, one of ``SIZES``, of the network that a ``config.json`` describes.

    Args:
        content: the file's content as JSON reads it.
        source: the file's name, for messages.

    Raises:
        IgsrError: the content is no such configuration, or a name or number in it is that of
            another network; the message names which.
    """
    if not isinstance(content, Mapping):
        raise IgsrError(f"{source} holds no object; download it again")
    named = content.get("model_name")
    if named is not None and (not isinstance(named, str) or named not in SIZES):
        raise IgsrError(_another(source, "model_name", named, " or ".join(SIZES)))
    parts = content.get("config")
    if parts is None:
        if named is None:
            raise IgsrError(f"{source} has neither model_name nor config; download it again")
        return named
    if not isinstance(parts, Mapping):
        raise IgsrError(f"{source}: its config is no object; download it again")
    net = _part(parts, "net", source)
    size = _NET_NAMES.get(_text(net.get("name")))
    if size is None:
        wanted = " or ".join(_NET_NAMES)
        raise IgsrError(_another(source, "net.name", net.get("name"), wanted))
    if named not in (None, size):
        raise IgsrError(_another(source, "net.name", net.get("name"), f"that of {named}"))
    for part, numbers in _wanted(SIZES[size]).items():
        if part == "cam_enc" and part not in parts:
            continue  # of no use without cameras
        given = _part(parts, part, source)
        for name, value in numbers.items():
            found = given.get(name, value)
            if found != value:
                raise IgsrError(_another(source, f"{part}.{name}", found, repr(value)))
    return size


def _wanted(config: NetworkConfig) -> dict[str, dict[str, Any]]:
    dim = config.embed_dim
    return {
        "net": dict(_SHARED_NET),
        "head": {
            "dim_in": 2 * dim,
            "output_dim": 2,
            "features": config.features,
            "out_channels": list(config.out_channels),
        },
        "cam_enc": {"dim_out": dim},
        "cam_dec": {"dim_in": 2 * dim},
    }


def _part(parts: Mapping[str, Any], name: str, source: str) -> Mapping[str, Any]:
    given = parts.get(name)
    if not isinstance(given, Mapping):
        raise IgsrError(f"{source} does not describe {name}; download it again")
    described = given.get("__object__", {})
    found = described.get("name") if isinstance(described, Mapping) else described
    if found is not None and found != _CLASSES[name]:
        raise IgsrError(_another(source, f"{name}.__object__.name", found, _CLASSES[name]))
    return given


def _text(value: Any) -> str:
    return value if isinstance(value, str) else ""


def _another(source: str, name: str, found: Any, wanted: str) -> str:
    return (
        f"{source}: its {name} is {found!r} where {wanted} belongs; only DA3-SMALL, DA3-BASE and "
        "what igsr trains are implemented, so name a checkpoint of one of them"
    )
