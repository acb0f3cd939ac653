"""A network that has learned nothing."""

from __future__ import annotations

import torch
from torch import nn

from igsr.pose.da3.config import NetworkConfig
from igsr.pose.da3.head import RAY_LEVEL
from igsr.pose.da3.network import Da3Network

#: Standard deviation of tokens and position embedding.
DEVIATION = 0.02
#: Fields of view to begin with, radians: a ReLU behind them lets none through that are negative.
FIELD_OF_VIEW = 1.0


def initial_network(config: NetworkConfig, seed: int) -> Da3Network:
    """A network with random weights, the same for a seed.

    torch's own for all layers; rays look ahead and cameras have a usual field of view.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = Da3Network(config)
        transformer = network.backbone.pretrained
        for tokens in (transformer.cls_token, transformer.camera_token, transformer.pos_embed):
            nn.init.trunc_normal_(tokens, std=DEVIATION)
    with torch.no_grad():
        fields = network.cam_dec.get_parameter("fc_fov.0.bias")
        fields.fill_(FIELD_OF_VIEW)
        rays = network.head.get_parameter(f"scratch.output_conv2_aux.{RAY_LEVEL}.5.bias")
        rays[2] = 1.0
    return network
