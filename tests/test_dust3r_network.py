"""The network of DUSt3R, compared with results of the published code."""

from __future__ import annotations

import re
import zlib

import numpy as np
import pytest
import torch
from dust3r_networks import TINY, empty_network, hashed_image, hashed_network, hashed_weight

from igsr.cameras.dust3r.network import NetworkConfig, Tokens
from igsr.cameras.networks import rotary_tables, rotated
from igsr.errors import IgsrError

DPT_512 = NetworkConfig()
LINEAR_224 = NetworkConfig(image_size=224, head="linear")

# Results of the published code on a CPU in float32 for hashed weights and images. Per photo: the
# points of pixels [0, 0], [17, 23] and [-1, -1]; the confidences of the first two, the mean
# confidence, and the mean of the points' absolute coordinates.
PUBLISHED = {
    "tiny 48x64": """
        -0.249664 0.174529 -0.447155 0.135235 0.300403 -0.929644 0.167667 -0.339734 -0.309013
        2.115853 2.190502 2.199717 0.352676
        0.057351 0.009556 -0.019629 0.293726 -0.393400 0.384738 -0.018332 0.117320 0.115644
        2.114115 2.373576 2.320486 0.364823
    """,
    "tiny 80x64": """
        -0.424878 0.329214 -0.460434 0.327055 0.347348 -0.526320 -0.154253 -0.109746 -0.223963
        2.286034 3.198071 2.931238 0.318515
        0.110786 0.020256 0.009611 0.740944 -0.100913 0.523102 0.172458 0.404681 0.311979
        2.141476 2.154589 2.123953 0.495530
    """,
    "full 48x64": """
        -0.289025 0.148629 -0.237600 -1.374604 0.510203 -1.244115 0.005157 -0.021403 -0.107551
        2.166019 1.547613 1.593149 0.724208
        0.017755 -0.106788 0.042931 0.444980 0.296279 1.014575 0.005428 0.247726 0.293526
        2.087512 1.747810 1.869440 0.541455
    """,
}


@pytest.fixture(scope="module")
def tiny():
    return hashed_network(TINY)


def outputs(network, height, width):
    with torch.inference_mode():
        images = [hashed_image(name, height, width) for name in ("img1", "img2")]
        return network.decode(*(network.encode(image) for image in images))


def max_difference(maps, published):
    found = []
    for photo in maps:
        xyz, confidence = photo.points[0], photo.confidence[0]
        found += [*xyz[0, 0], *xyz[17, 23], *xyz[-1, -1], confidence[0, 0], confidence[17, 23]]
        found += [confidence.mean(), xyz.abs().mean()]
    return np.abs(np.array(found) - np.array(published.split(), float)).max()


def test_the_hash_of_the_published_numbers():
    weight = hashed_weight("enc_blocks.0.attn.qkv.weight", (3072, 1024))
    np.testing.assert_allclose(weight[0, :3], [0.0386911, -0.0073013, -0.0093392], atol=1e-7)
    image = hashed_image("img1", 48, 64)
    np.testing.assert_allclose(image[0, 0, 0, :3], [-0.1029372, 0.8551975, 0.6753914], atol=1e-7)


# 80 rows are five tokens: the coarsest level is cropped.
@pytest.mark.parametrize(("height", "width"), [(48, 64), (80, 64)])
def test_parity_tiny(tiny, height, width):
    maps = outputs(tiny, height, width)
    assert max_difference(maps, PUBLISHED[f"tiny {height}x{width}"]) <= 1e-5


@pytest.mark.long
def test_parity_full_size():
    maps = outputs(hashed_network(DPT_512), 48, 64)
    assert max_difference(maps, PUBLISHED["full 48x64"]) <= 1e-5


def key_lines(config):
    """The keys and shapes of a published checkpoint, from the keys of the network."""
    shapes = {key: tuple(t.shape) for key, t in empty_network(config).state_dict().items()}
    # Two kinds of keys that the network does not use.
    shapes["mask_token"] = (1, 1, config.decoder_dim)
    for key in list(shapes):
        level = re.fullmatch(r"(.*\.scratch\.)layer(\d)_rn\.weight", key)
        if level:
            shapes[f"{level[1]}layer_rn.{int(level[2]) - 1}.weight"] = shapes[key]
    return sorted(f"{key}\t{'x'.join(map(str, shape))}" for key, shape in shapes.items())


# Checksums of the key lists of the published models.
@pytest.mark.parametrize(
    ("config", "keys", "checksum", "parameters"),
    [(DPT_512, 1009, 3494443566, 571_171_208), (LINEAR_224, 877, 1285370070, 532_342_784)],
)
def test_keys_and_shapes_of_the_published_checkpoints(config, keys, checksum, parameters):
    lines = key_lines(config)
    assert len(lines) == keys
    assert zlib.crc32("\n".join(lines).encode()) == checksum
    mask_token = config.decoder_dim
    assert sum(p.numel() for p in empty_network(config).parameters()) == parameters - mask_token


def test_rotary_products_depend_on_the_difference_of_positions():
    random = torch.Generator().manual_seed(0)
    q, k = torch.randn(2, 1, 1, 1, 24, generator=random)
    tables = rotary_tables(torch.cartesian_prod(torch.arange(40), torch.arange(50)), 24)

    def turned(x, row, column):
        return rotated(x, tuple(table[[row * 50 + column]] for table in tables))

    def product(at, other):
        return float((turned(q, *at) * turned(k, *other)).sum())

    assert product((3, 7), (10, 2)) == pytest.approx(product((23, 37), (30, 32)), abs=1e-4)
    assert abs(product((3, 7), (10, 2)) - product((7, 3), (2, 10))) > 1e-2
    assert torch.equal(turned(q, 0, 0), q)
    # Half precision keeps its type, and the angles of distant tokens differ.
    half = turned(q.to(torch.bfloat16), 39, 49)
    assert half.dtype == torch.bfloat16
    assert (half.float() - turned(q, 39, 49)).abs().max() < 0.03


def test_photos_of_different_shapes_and_batches(tiny):
    with torch.inference_mode():
        tall = tiny.encode(hashed_image("tall", 80, 48))
        wide = tiny.encode(hashed_image("wide", 48, 64))
        first, second = tiny.decode(tall, wide)
        assert first.points.shape == (1, 80, 48, 3)
        assert second.points.shape == (1, 48, 64, 3)
        assert second.confidence.shape == (1, 48, 64)
        assert (torch.cat([first.confidence.ravel(), second.confidence.ravel()]) > 1.0).all()
        # A batch gives the same as its photos one by one.
        other = tiny.encode(hashed_image("other", 80, 48))
        both = Tokens(torch.cat([tall.features, other.features]), 5, 3)
        twice = Tokens(torch.cat([wide.features, wide.features]), 3, 4)
        batch = tiny.decode(both, twice)[1]
        alone = tiny.decode(other, wide)[1]
    assert (batch.points[0] - second.points[0]).abs().max() < 1e-5
    assert (batch.points[1] - alone.points[0]).abs().max() < 1e-5
    assert (batch.points[0] - batch.points[1]).abs().max() > 1e-3


def test_heads_run_in_float32(tiny):
    whole = outputs(tiny, 48, 64)
    seen = []
    hooks = [
        head.register_forward_pre_hook(
            lambda module, args: seen.append(
                ({level.features.dtype for level in args[0]}, torch.is_autocast_enabled("cpu"))
            )
        )
        for head in (tiny.downstream_head1, tiny.downstream_head2)
    ]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        half = outputs(tiny, 48, 64)
    for hook in hooks:
        hook.remove()
    assert seen == [({torch.float32}, False)] * 2
    for maps, exact in zip(half, whole, strict=True):
        assert maps.points.dtype == torch.float32
        error = (maps.points - exact.points).abs().mean() / exact.points.abs().mean()
        assert 1e-5 < error < 0.05


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"head": "mlp"}, "head"),
        ({"encoder_depth": 0}, "encoder_depth"),
        ({"decoder_depth": 10**9}, "decoder_depth"),
        ({"image_size": 512.0}, "image_size"),
        ({"encoder_dim": 1000}, "encoder_heads"),
        ({"decoder_heads": 5}, "decoder_heads"),
    ],
)
def test_invalid_sizes(change, named):
    with pytest.raises(IgsrError, match=named):
        NetworkConfig(**change)
