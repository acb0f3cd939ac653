"""Networks of Depth Anything 3 with computed weights, so that tests need no files."""

from __future__ import annotations

import re
from math import prod

import torch
from dust3r_networks import hashed

from igsr.cameras.da3.backbone import NetworkConfig
from igsr.cameras.da3.network import Da3Network

#: Twelve blocks as in the published sizes, with few channels.
TINY = NetworkConfig(embed_dim=32, heads=2, features=16, out_channels=(8, 12, 16, 24))


def hashed_weight(key, shape):
    """The test weight of a key, of a size that keeps activations and cameras in bounds."""
    u = hashed(key, prod(shape)).astype("float64")
    if key.endswith(".gamma"):
        u = 0.4 + 0.4 * u
    elif key.endswith(("cls_token", "camera_token", "pos_embed")):
        pass
    elif len(shape) == 1:
        u *= 0.2
        is_norm = "norm" in key
        u += float((is_norm and key.endswith("weight")) or key == "cam_dec.fc_fov.0.bias")
    else:
        gathered = re.search(r"resize_layers\.[01]\.", key)
        u *= (12.0 / (shape[0] if gathered else prod(shape[1:]))) ** 0.5
        if key.startswith("cam_dec.fc_"):
            u *= 0.3
        if key.endswith("output_conv2.2.weight"):
            u *= 0.5
    return torch.from_numpy(u.reshape(shape)).float()


def hashed_network(config=TINY):
    with torch.device("meta"):
        network = Da3Network(config).eval()
    weights = {key: hashed_weight(key, t.shape) for key, t in network.state_dict().items()}
    network.load_state_dict(weights, assign=True)
    return network.requires_grad_(False)


def hashed_pixels(name, views, height, width):
    """float32 [S, 3, H, W], in the range of normalized pixels."""
    values = hashed(name, views * 3 * height * width)
    return torch.from_numpy(4.0 * values.reshape(views, 3, height, width))
