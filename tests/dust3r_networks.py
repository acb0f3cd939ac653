"""DUSt3R networks with computed weights, so that tests need no files."""

from __future__ import annotations

import zlib
from math import prod

import numpy as np
import torch

from igsr.cameras.dust3r.network import Dust3rNetwork, NetworkConfig

# Heads of 32 and of 24 channels: other sizes of the rotary halves than the published 64.
TINY = NetworkConfig(
    encoder_dim=64, encoder_depth=2, encoder_heads=2, decoder_dim=48, decoder_heads=2
)
# Without the DPT head a network is small.
SMALL = NetworkConfig(
    image_size=64,
    head="linear",
    encoder_dim=16,
    encoder_depth=1,
    encoder_heads=2,
    decoder_dim=8,
    decoder_depth=2,
    decoder_heads=1,
)

BLOCK = 1 << 13


def hashed(key, count):
    """Numbers in [-0.5, 0.5) from a key, reproducible in any language: murmur3's finalizer of j."""
    values = np.empty(count, dtype=np.float32)
    for start in range(0, count, BLOCK):
        stop = min(start + BLOCK, count)
        x = np.arange(start + 1, stop + 1, dtype=np.uint32)
        x *= np.uint32(0x9E3779B1)
        x += np.uint32(zlib.crc32(key.encode()))
        x ^= x >> np.uint32(16)
        x *= np.uint32(0x85EBCA6B)
        x ^= x >> np.uint32(13)
        x *= np.uint32(0xC2B2AE35)
        x ^= x >> np.uint32(16)
        values[start:stop] = x / 2.0**32 - 0.5
    return values


def hashed_weight(key, shape):
    """The test weight of a key: norms near 1, layers that keep the size of their input."""
    u = hashed(key, prod(shape))
    if len(shape) == 1:
        u *= np.float32(0.2)
        if "norm" in key and key.endswith("weight"):
            u += np.float32(1.0)
    else:
        u *= np.float32((12.0 / prod(shape[1:])) ** 0.5)
        if key.endswith("head.4.weight"):
            u *= np.float32(0.1)
    return torch.from_numpy(u.reshape(shape))


def empty_network(config):
    with torch.device("meta"):
        return Dust3rNetwork(config).eval()


def hashed_network(config):
    network = empty_network(config)
    weights = {key: hashed_weight(key, t.shape) for key, t in network.state_dict().items()}
    network.load_state_dict(weights, assign=True)
    return network


def hashed_image(name, height, width):
    return torch.from_numpy(2.0 * hashed(name, 3 * height * width).reshape(1, 3, height, width))
