"""The network of DUSt3R: parity with the published model, and checkpoints nobody can trust."""

from __future__ import annotations

import zlib
from math import prod

import numpy as np
import pytest
import torch

from igsr.errors import IgsrError
from igsr.pose.dust3r.network import Dust3rNetwork, NetworkConfig, rotary_tables, rotated

DPT_512 = NetworkConfig()
LINEAR_512 = NetworkConfig(head="linear")
LINEAR_224 = NetworkConfig(image_size=224, head="linear")
# Heads of 32 and of 24 channels: other sizes of the rotary halves than the published 64.
TINY = NetworkConfig(
    encoder_dim=64, encoder_depth=2, encoder_heads=2, decoder_dim=48, decoder_heads=2
)

BLOCK = 1 << 13


def hashed(key, count):
    """Numbers in [-0.5, 0.5) that any program can make from a key: murmur3's finaliser of j."""
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
    """The test weight of a key: norms near 1, layers that keep the size of what they are given."""
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


# What the published code gives on a CPU in float32 for hashed weights and images, to six decimals:
# per photo the points of pixels [0, 0], [17, 23] and [-1, -1], the confidences of the first two
# and their mean, and the mean of the points' absolute coordinates.
PUBLISHED = {
    "tiny 48x64": (
        (
            [
                (-0.249664, 0.174529, -0.447155),
                (0.135235, 0.300403, -0.929644),
                (0.167667, -0.339734, -0.309013),
            ],
            (2.115853, 2.190502, 2.199717),
            0.352676,
        ),
        (
            [
                (0.057351, 0.009556, -0.019629),
                (0.293726, -0.393400, 0.384738),
                (-0.018332, 0.117320, 0.115644),
            ],
            (2.114115, 2.373576, 2.320486),
            0.364823,
        ),
    ),
    "tiny 80x64": (
        (
            [
                (-0.424878, 0.329214, -0.460434),
                (0.327055, 0.347348, -0.526320),
                (-0.154253, -0.109746, -0.223963),
            ],
            (2.286034, 3.198071, 2.931238),
            0.318515,
        ),
        (
            [
                (0.110786, 0.020256, 0.009611),
                (0.740944, -0.100913, 0.523102),
                (0.172458, 0.404681, 0.311979),
            ],
            (2.141476, 2.154589, 2.123953),
            0.495530,
        ),
    ),
    "full 48x64": (
        (
            [
                (-0.289025, 0.148629, -0.237600),
                (-1.374604, 0.510203, -1.244115),
                (0.005157, -0.021403, -0.107551),
            ],
            (2.166019, 1.547613, 1.593149),
            0.724208,
        ),
        (
            [
                (0.017755, -0.106788, 0.042931),
                (0.444980, 0.296279, 1.014575),
                (0.005428, 0.247726, 0.293526),
            ],
            (2.087512, 1.747810, 1.869440),
            0.541455,
        ),
    ),
}


@pytest.fixture(scope="module")
def tiny():
    return hashed_network(TINY)


def outputs(network, height, width):
    with torch.inference_mode():
        images = [hashed_image(name, height, width) for name in ("img1", "img2")]
        return network.decode(*(network.encode(image) for image in images))


def worst(maps, published):
    """The largest difference from the published numbers."""
    found, wanted = [], []
    for got, (points, confidences, mean) in zip(maps, published, strict=True):
        xyz, confidence = got.points[0], got.confidence[0]
        found += [*xyz[0, 0], *xyz[17, 23], *xyz[-1, -1], confidence[0, 0], confidence[17, 23]]
        found += [confidence.mean(), xyz.abs().mean()]
        wanted += [*np.ravel(points), *confidences, mean]
    return np.abs(np.array(found) - wanted).max()


def test_the_hash_is_the_one_that_the_published_numbers_were_made_with():
    weight = hashed_weight("enc_blocks.0.attn.qkv.weight", (3072, 1024))
    np.testing.assert_allclose(weight[0, :3], [0.0386911, -0.0073013, -0.0093392], atol=1e-7)
    image = hashed_image("img1", 48, 64)
    np.testing.assert_allclose(image[0, 0, 0, :3], [-0.1029372, 0.8551975, 0.6753914], atol=1e-7)


# 80 rows are five tokens: the coarsest level is cropped.
@pytest.mark.parametrize(("height", "width"), [(48, 64), (80, 64)])
def test_parity_tiny(tiny, height, width):
    maps = outputs(tiny, height, width)
    assert worst(maps, PUBLISHED[f"tiny {height}x{width}"]) <= 1e-5


def test_parity_full_size():
    maps = outputs(hashed_network(DPT_512), 48, 64)
    assert worst(maps, PUBLISHED["full 48x64"]) <= 1e-5
