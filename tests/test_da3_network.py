"""The network of Depth Anything 3 against a slow one in float64, and what it must not depend on."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from da3_networks import TINY, hashed_network, hashed_pixels
from da3_slow import SlowDa3

from igsr.errors import IgsrError
from igsr.pose.da3.backbone import Backbone
from igsr.pose.da3.cameras import encode_pose, normalized_viewmats
from igsr.pose.da3.config import BASE, SMALL, NetworkConfig
from igsr.pose.da3.network import Da3Network
from igsr.pose.da3.reference_view import reference_view
from igsr.pose.transformer_layers import rotary_tables, rotated

FIELDS = ("depth", "confidence", "rays", "ray_confidence", "pose_encoding")
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
def test_predictions_are_those_of_the_slow_network(network, slow, views, height, width):
    pixels = hashed_pixels(f"{views}", views, height, width)
    wanted = slow(list(pixels.numpy()), views // 2 if views > 2 else 0)
    check(network.predict(list(pixels), "middle"), wanted)


def test_views_of_several_sizes_go_through_one_pass(network, slow):
    views = [hashed_pixels(f"{n}", 1, *size)[0] for n, size in enumerate([(42, 70), (70, 42)])]
    views.append(hashed_pixels("2", 1, 42, 28)[0])
    check(network.predict(views, "first"), slow([view.numpy() for view in views]))


def test_given_cameras_are_those_of_the_slow_network(network, slow):
    pixels = hashed_pixels("cameras", 3, 42, 70)
    viewmats = np.tile(np.eye(4), (3, 1, 1))
    for n in (1, 2):
        cos, sin = np.cos(0.3 * n), np.sin(0.3 * n)
        viewmats[n, :3, :3] = [[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]
        viewmats[n, :3, 3] = [0.5 * n, -0.2, 3.0]
    intrinsics = np.tile(np.diag([80.0, 75.0, 1.0]), (3, 1, 1))
    found = network.predict(
        list(pixels), viewmats=torch.from_numpy(viewmats), intrinsics=torch.from_numpy(intrinsics)
    )
    encodings = encode_pose(normalized_viewmats(viewmats), intrinsics, [(42, 70)] * 3)
    check(found, slow(list(pixels.numpy()), encodings=encodings.numpy()))


def test_stored_positions_are_taken_as_they_are_for_518_pixels(network, slow):
    pixels = hashed_pixels("square", 1, 518, 518)
    backbone = network.backbone.pretrained
    tokens = backbone.embedded(pixels[0], backbone.positions(37, 37))
    np.testing.assert_allclose(tokens.numpy(), slow.embedded(pixels[0].numpy(), 37, 37), atol=1e-5)


def test_views_in_another_order_give_the_same_in_that_order(network):
    pixels = hashed_pixels("order", 5, 42, 56)
    order = [3, 0, 4, 1, 2]
    one, other = network(pixels), network(pixels[order])
    for name in FIELDS:
        value = getattr(one, name)[order]
        close = CLOSE * float(value.abs().max())
        torch.testing.assert_close(getattr(other, name), value, atol=close, rtol=0.0)


def test_without_rays_the_rest_is_the_same(network):
    views = list(hashed_pixels("rays", 2, 42, 56))
    with_rays, without = network.predict(views), network.predict(views, rays=False)
    for one, other in zip(with_rays, without, strict=True):
        assert other.rays is None
        assert other.ray_confidence is None
        assert torch.equal(one.depth, other.depth)
        assert torch.equal(one.pose_encoding, other.pose_encoding)


def test_half_precision_is_near_and_predictions_stay_float32(network):
    # As on CUDA devices, where blocks run in half precision.
    views = list(hashed_pixels("half", 3, 42, 56))
    cameras = {
        "viewmats": torch.eye(4).repeat(3, 1, 1),
        "intrinsics": torch.diag(torch.tensor([60.0, 60.0, 1.0])).repeat(3, 1, 1),
    }
    for given in ({}, cameras):
        exact = network.predict(views, "first", **given)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            near = network.predict(views, "first", **given)
        for one, other in zip(exact, near, strict=True):
            for name in FIELDS:
                value, found = getattr(one, name), getattr(other, name)
                assert found.dtype == torch.float32
                off = float((found - value).abs().max() / value.abs().max())
                assert 1e-6 < off < 0.05, (name, off)


def test_published_sizes_have_their_number_of_parameters():
    # Distinct parameters less the levels of the ray head that only training needs.
    for config, count in ((SMALL, 34_299_463 - 305_589), (BASE, 135_366_599 - 1_163_349)):
        with torch.device("meta"):
            network = Da3Network(config)
        assert sum(value.numel() for value in network.parameters()) == count


def test_only_the_distance_between_places_turns_queries_against_keys():
    # Rotary positions: the product of a query and a key depends on their difference alone.
    places = torch.tensor([[2, 5], [4, 1], [12, 9], [14, 5]])
    q, k = torch.randn(2, 1, 1, 16, generator=torch.Generator().manual_seed(0)).double()
    cosine, sine = rotary_tables(places, 16)
    turned = [rotated(x.expand(1, 4, 16), (cosine, sine)) for x in (q, k)]
    products = (turned[0] @ turned[1].mT)[0]
    assert products[0, 1] == pytest.approx(float(products[2, 3]), rel=1e-5)
    assert products[0, 1] != pytest.approx(float(products[0, 2]), rel=1e-2)


def test_reference_view_by_each_rule():
    tokens = torch.eye(4)[[0, 0, 1, 2]] + 0.5
    tokens[1] *= 1.5
    assert reference_view(tokens, "first") == 0
    assert reference_view(tokens, "middle") == 2
    # Views 0 and 1 show the same, so their similarities range widest; the first of equals.
    assert reference_view(tokens, "saddle_sim_range") == 0
    similarity = torch.nn.functional.cosine_similarity(tokens[:, None], tokens[None], dim=-1)
    similarity -= torch.eye(4)
    measures = [
        similarity.sum(1) / 3,
        tokens.norm(dim=1),
        (tokens / tokens.norm(dim=1)[:, None]).var(1),
    ]
    off = sum(((m - m.min()) / (m.max() - m.min() + 1e-8) - 0.5).abs() for m in measures)
    assert reference_view(tokens) == int(off.argmin())


def test_the_reference_is_chosen_where_three_views_are_and_first_of_two(network):
    seen = []

    def choose(tokens):
        seen.append(tuple(tokens.shape))
        return 1

    backbone: Backbone = network.backbone
    for count in (1, 2, 3):
        backbone(list(hashed_pixels("choice", count, 28, 28)), choose)
    assert seen == [(3, TINY.embed_dim)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reference": "last"}, "reference is 'last'"),
        ({"viewmats": torch.eye(4)[None]}, "give both or neither"),
        (
            {"viewmats": torch.eye(4)[None], "intrinsics": torch.eye(3)[None]},
            r"viewmats has shape \[1, 4, 4\]; give \[2, 4, 4\]",
        ),
    ],
)
def test_arguments_that_cannot_be_used(network, change, message):
    with pytest.raises(IgsrError, match=message):
        network(hashed_pixels("bad", 2, 28, 28), **change)


def test_views_that_cannot_be_used(network):
    with pytest.raises(IgsrError, match="views is empty"):
        network.predict([])
    with pytest.raises(IgsrError, match=r"view 1 has shape \[3, 28, 30\]"):
        network.predict([torch.zeros(3, 28, 28), torch.zeros(3, 28, 30)])


@pytest.mark.parametrize(
    "change",
    [
        {"embed_dim": 36},
        {"heads": 0},
        {"features": 12},
        {"out_channels": (8, 12, 16, 22)},
        {"camera_heads": 5},
    ],
)
def test_sizes_that_cannot_be_used(change):
    with pytest.raises(IgsrError, match=next(iter(change))):
        NetworkConfig(**{**vars(TINY), **change})
