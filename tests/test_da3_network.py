"""The network of Depth Anything 3, compared with a slow implementation in float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from da3_networks import TINY, hashed_network, hashed_pixels
from da3_slow import SlowDa3

from igsr.cameras.da3.backbone import BASE, SMALL, reference_view
from igsr.cameras.da3.network import Da3Network

FIELDS = ("depth", "confidence", "pose_encoding")
#: The float32 network reached 2e-6 of the largest value; half precision is off by 1e-3.
CLOSE = 2e-5


@pytest.fixture(scope="module")
def network():
    return hashed_network()


@pytest.fixture(scope="module")
def slow(network):
    return SlowDa3(network.state_dict(), TINY.heads)


def check(predictions, wanted):
    for view, slow_view in zip(predictions, wanted, strict=True):
        for name, value in zip(FIELDS, slow_view, strict=True):
            found = getattr(view, name).numpy()
            assert found.shape == value.shape, name
            np.testing.assert_allclose(found, value, atol=CLOSE * np.abs(value).max(), rtol=0)


@pytest.mark.parametrize(("views", "height", "width"), [(1, 42, 70), (2, 70, 42), (3, 56, 56)])
def test_predictions_as_in_the_slow_network(network, slow, views, height, width):
    pixels = hashed_pixels(f"{views}", views, height, width)
    reference = views // 2 if views > 2 else 0
    wanted = slow(list(pixels.numpy()), reference)
    check(network.predict(list(pixels), reference=reference), wanted)


def test_views_may_differ_in_size(network, slow):
    views = [hashed_pixels(f"{n}", 1, *size)[0] for n, size in enumerate([(42, 70), (70, 42)])]
    views.append(hashed_pixels("2", 1, 42, 28)[0])
    check(network.predict(views, reference=0), slow([view.numpy() for view in views]))


def test_stored_positions_are_used_for_518_pixels(network, slow):
    pixels = hashed_pixels("square", 1, 518, 518)
    backbone = network.backbone["pretrained"]
    tokens = backbone.embedded(pixels[0], backbone.positions(37, 37))
    np.testing.assert_allclose(tokens.numpy(), slow.embedded(pixels[0].numpy(), 37, 37), atol=1e-5)


def test_the_order_of_views_does_not_matter(network):
    pixels = hashed_pixels("order", 5, 42, 56)
    order = [3, 0, 4, 1, 2]
    one, other = network.predict(pixels), network.predict(pixels[order])
    for name in FIELDS:
        value = torch.stack([getattr(one[n], name) for n in order])
        found = torch.stack([getattr(view, name) for view in other])
        close = CLOSE * float(value.abs().max())
        torch.testing.assert_close(found, value, atol=close, rtol=0.0)


def test_half_precision_is_close_and_predictions_are_float32(network):
    # As on CUDA devices: blocks run in half precision.
    views = list(hashed_pixels("half", 3, 42, 56))
    exact = network.predict(views, reference=0)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        near = network.predict(views, reference=0)
    for one, other in zip(exact, near, strict=True):
        for name in FIELDS:
            value, found = getattr(one, name), getattr(other, name)
            assert found.dtype == torch.float32
            off = float((found - value).abs().max() / value.abs().max())
            assert 1e-6 < off < 0.05, (name, off)


def test_published_sizes_have_their_number_of_parameters():
    # Of the published ones without the camera encoder and the ray head.
    small = 34_299_463 - 7_178_496 - (635_559 + 305_589)
    base = 135_366_599 - 28_660_224 - (2_520_071 + 1_163_349)
    for config, count in ((SMALL, small), (BASE, base)):
        with torch.device("meta"):
            network = Da3Network(config)
        assert sum(value.numel() for value in network.parameters()) == count


def test_the_reference_view_is_the_most_average_one():
    tokens = torch.eye(4)[[0, 0, 1, 2]] + 0.5
    tokens[1] *= 1.5
    similarity = torch.nn.functional.cosine_similarity(tokens[:, None], tokens[None], dim=-1)
    similarity -= torch.eye(4)
    measures = [
        similarity.sum(1) / 3,
        tokens.norm(dim=1),
        (tokens / tokens.norm(dim=1)[:, None]).var(1),
    ]
    off = sum(((m - m.min()) / (m.max() - m.min() + 1e-8) - 0.5).abs() for m in measures)
    assert reference_view(tokens) == int(off.argmin())


@pytest.mark.parametrize(("count", "chosen"), [(1, False), (2, False), (3, True)])
def test_the_reference_is_chosen_from_three_views_on(network, monkeypatch, count, chosen):
    seen = []
    monkeypatch.setattr(
        "igsr.cameras.da3.backbone.reference_view", lambda tokens: seen.append(tokens.shape) or 1
    )
    network.predict(list(hashed_pixels("choice", count, 28, 28)))
    assert seen == [(count, TINY.embed_dim)] * chosen
