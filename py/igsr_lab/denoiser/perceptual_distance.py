"""Perceptual distances: LPIPS, or distances of SqueezeNet's features if LPIPS cannot be used.

LPIPS (Zhang et al. 2018, v0.1) weights the features of a torchvision backbone by calibrated heads;
torchmetrics has the heads, torchvision downloads the backbone. The other distance compares
features of a fixed, ImageNet-trained SqueezeNet 1.0 (Iandola et al. 2016), read from a file. It has
no calibrated heads and is not LPIPS.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from igsr._internal.untrusted_npz import DAMAGE
from igsr.errors import IgsrError

#: From two pictures [B, 3, H, W] in [0, 1] to their distance [B].
Distance = Callable[[Tensor, Tensor], Tensor]

Backbone = Literal["alex", "vgg", "squeeze"]
LPIPS_BACKBONES: tuple[Backbone, ...] = get_args(Backbone)
#: Squeezed channels and expanded channels (by 1x1, and as many by 3x3) of the fire modules.
FIRES = {2: (16, 64), 3: (16, 64), 4: (32, 128), 5: (32, 128), 6: (48, 192), 7: (48, 192)}
FIRES |= {8: (64, 256), 9: (64, 256)}
_POOL_BEFORE = (2, 5, 9)
#: Layers whose features are compared.
_COMPARED = ("conv1", "fire3", "fire5", "fire7", "fire9")
#: Caffe's mean color, BGR of 255.
_MEAN_BGR = (104.0, 117.0, 123.0)
#: Minimum side of pictures, for the deepest layers.
MIN_SIDE_PX = 32


class SqueezeNetDistance(nn.Module):
    """Distance of SqueezeNet 1.0 features, normalized to unit length at each pixel.

    The mean over layers of the mean over pixels of the squared difference: 0 for equal pictures,
    0.1 to 0.6 for renders of degraded reconstructions. Differentiable, with fixed weights.

    Args:
        path: ``.npz`` with the Caffe model's arrays ("conv1.weight", "fire2/conv1x1_1.bias").
    """

    name = "squeezenet1_0 feature distance"

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Read the weights."""
        super().__init__()
        shapes = squeezenet_shapes()
        arrays = _arrays(Path(path), shapes)
        self._names = {name: name.replace("/", "_") for name in shapes}
        for name, layer in self._names.items():
            self.register_buffer(f"{layer}_weight", arrays[f"{name}.weight"])
            self.register_buffer(f"{layer}_bias", arrays[f"{name}.bias"])
        self.mean: Tensor
        self.register_buffer("mean", torch.tensor(_MEAN_BGR)[:, None, None])

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """Distance [B] of pictures [B, 3, H, W], RGB in [0, 1], sides at least 32."""
        total = first.new_zeros(len(first))
        for a, b in zip(self.features(first), self.features(second), strict=True):
            total = total + (_unit(a) - _unit(b)).square().sum(dim=1).mean(dim=(1, 2))
        return total / len(_COMPARED)

    def features(self, picture: Tensor) -> list[Tensor]:
        """Activations of the compared layers for pictures [B, 3, H, W], RGB in [0, 1]."""
        if min(picture.shape[-2:]) < MIN_SIDE_PX:
            raise IgsrError(
                f"pictures must be at least {MIN_SIDE_PX} pixels on each side for "
                f"{self.name}, not {picture.shape[-1]}x{picture.shape[-2]}"
            )
        x = 255.0 * picture.flip(1) - self.mean
        x = self._convolved("conv1", x, stride=2)
        out = [x]
        for number in FIRES:
            if number in _POOL_BEFORE:
                x = F.max_pool2d(x, 3, stride=2, ceil_mode=True)
            x = self._convolved(f"fire{number}/conv1x1_1", x)
            x = torch.cat(
                [
                    self._convolved(f"fire{number}/conv1x1_2", x),
                    self._convolved(f"fire{number}/conv3x3_2", x, padding=1),
                ],
                dim=1,
            )
            if f"fire{number}" in _COMPARED:
                out.append(x)
        return out

    def _convolved(self, name: str, x: Tensor, stride: int = 1, padding: int = 0) -> Tensor:
        layer = self._names[name]
        weight, bias = getattr(self, f"{layer}_weight"), getattr(self, f"{layer}_bias")
        return F.relu(F.conv2d(x, weight, bias, stride=stride, padding=padding))


def squeezenet_shapes() -> dict[str, tuple[int, ...]]:
    """Shapes of SqueezeNet's weights by layer."""
    shapes: dict[str, tuple[int, ...]] = {"conv1": (96, 3, 7, 7)}
    channels = 96
    for number, (squeezed, expanded) in FIRES.items():
        shapes[f"fire{number}/conv1x1_1"] = (squeezed, channels, 1, 1)
        shapes[f"fire{number}/conv1x1_2"] = (expanded, squeezed, 1, 1)
        shapes[f"fire{number}/conv3x3_2"] = (expanded, squeezed, 3, 3)
        channels = 2 * expanded
    return shapes


def _unit(features: Tensor) -> Tensor:
    return features / (features.square().sum(dim=1, keepdim=True) + 1e-10).sqrt()


def _arrays(path: Path, shapes: dict[str, tuple[int, ...]]) -> dict[str, Tensor]:
    try:
        with np.load(path, allow_pickle=False) as file:
            out = {}
            for name, shape in shapes.items():
                for part, wanted in (("weight", shape), ("bias", shape[:1])):
                    array = file[f"{name}.{part}"]
                    if array.shape != wanted or array.dtype != np.float32:
                        raise IgsrError(
                            f"{path}: {name}.{part} is {array.dtype} {list(array.shape)}, not "
                            f"float32 {list(wanted)} as in SqueezeNet 1.0"
                        )
                    out[f"{name}.{part}"] = torch.from_numpy(array)
            return out
    except FileNotFoundError as error:
        raise IgsrError(f"{path} does not exist; name a SqueezeNet 1.0 .npz file") from error
    except KeyError as error:
        raise IgsrError(f"{path} lacks {error.args[0]}; name a SqueezeNet 1.0 file") from error
    except DAMAGE as error:
        if isinstance(error, IgsrError):
            raise
        raise IgsrError(f"{path} is a damaged .npz file; copy it again") from error


def lpips_distance(backbone: Backbone) -> Distance:
    """LPIPS v0.1 with a torchvision backbone; its weights are downloaded on first use.

    Args:
        backbone: "alex", "vgg" or "squeeze".
    """
    if backbone not in LPIPS_BACKBONES:
        raise IgsrError(f"backbone must be one of {', '.join(LPIPS_BACKBONES)}, not {backbone!r}")
    try:
        # Without torchvision, torchmetrics does not define the name.
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        metric = LearnedPerceptualImagePatchSimilarity(net_type=backbone, reduction="none")
    except ImportError as error:
        raise IgsrError("LPIPS needs torchvision; pip install 'igsr[lpips]'") from error
    except OSError as error:
        raise IgsrError(
            f"the weights of LPIPS' backbone {backbone} cannot be downloaded ({error}); put them "
            "into torch's cache, or use --features FILE instead"
        ) from error
    return _Lpips(metric.net, backbone)


class _Lpips(nn.Module):
    """LPIPS of pictures [B, 3, H, W] in [0, 1]; its network takes them in [-1, 1]."""

    def __init__(self, network: nn.Module, backbone: str) -> None:
        super().__init__()
        self.name = f"LPIPS v0.1 {backbone}"
        self.network = network.eval().requires_grad_(False)

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        values: Tensor = self.network(2.0 * first - 1.0, 2.0 * second - 1.0)
        return values.reshape(len(first))


def distance_name(distance: Distance | None) -> str | None:
    """Name of a distance with a hash of its weights."""
    if distance is None:
        return None
    name = getattr(distance, "name", getattr(distance, "__name__", type(distance).__name__))
    digest = hashlib.sha256()
    if isinstance(distance, nn.Module):
        for tensor in distance.state_dict().values():
            digest.update(tensor.cpu().contiguous().numpy().data)
    return f"{name} {digest.hexdigest()[:16]}"


def picture_distance(
    distance: Distance, first: npt.NDArray[np.uint8], second: npt.NDArray[np.uint8]
) -> float:
    """Distance of two pictures, uint8 [H, W, 3]."""
    one, other = (
        torch.from_numpy(np.moveaxis(picture, -1, 0)[None].astype(np.float32) / 255.0)
        for picture in (first, second)
    )
    with torch.inference_mode():
        return float(distance(one, other))
