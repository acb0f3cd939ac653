"""DUSt3R from photos to pointmaps: crops, pairs and predictions."""

from __future__ import annotations

import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch
from dust3r_networks import SMALL, hashed_network

from igsr.cameras.dust3r import prediction
from igsr.cameras.dust3r.estimator import MAX_COMPLETE_PHOTOS, default_graph, pair_graph
from igsr.cameras.dust3r.prediction import DustPredictor, crop_of, network_input
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError


def photo(width, height, name="a.jpg", seed=0, mask=None, channels=3):
    random = np.random.default_rng(seed)
    # Coarse blocks, so that photos differ after they are resized too.
    blocks = random.integers(0, 256, (7, 7, channels), dtype=np.uint8)
    rows, columns = np.arange(height) * 7 // height, np.arange(width) * 7 // width
    return Photo(name, blocks[rows][:, columns], mask, None, None)


# ---- crops ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "image_size", "expected"),
    [
        ((1024, 768), 512, (512, 384)),
        ((768, 1024), 512, (384, 512)),
        ((960, 540), 512, (512, 288)),
        ((640, 427), 512, (512, 336)),  # 342 rows; six are cut off
        ((500, 333), 512, (512, 336)),
        ((512, 32), 512, (512, 32)),
        ((700, 700), 512, (512, 384)),
        ((700, 699), 512, (512, 496)),  # 511 rows
        ((701, 700), 512, (512, 496)),
        ((64, 64), 64, (64, 48)),
        ((1023, 768), 224, (224, 224)),
        ((100, 333), 224, (224, 224)),
        ((50, 50), 224, (224, 224)),
    ],
)
def test_crops(size, image_size, expected):
    taken = photo(*size)
    crop = crop_of(taken, image_size)
    assert (crop.width, crop.height) == expected
    pixels = network_input(taken, crop)
    assert pixels.shape == (3, crop.height, crop.width)
    assert pixels.dtype == np.float32
    assert np.abs(pixels).max() <= 1.0
    # Both sides lose the same, up to an odd pixel.
    assert 0 <= crop.resized_width - crop.width - 2 * crop.left <= 1
    assert 0 <= crop.resized_height - crop.height - 2 * crop.top <= 1


@pytest.mark.parametrize("image_size", [512, 224])
@pytest.mark.parametrize("size", [(1600, 1200), (300, 451), (700, 700), (1000, 333), (511, 512)])
def test_a_spot_is_found_at_its_place(size, image_size):
    width, height = size
    center = np.array([0.54 * width, 0.47 * height])
    row, column = np.indices((height, width)) + 0.5
    radius = 0.02 * min(size)
    near = (column - center[0]) ** 2 + (row - center[1]) ** 2
    image = np.repeat(np.rint(250 * np.exp(-near / (2 * radius**2)))[..., None], 3, axis=2)
    taken = Photo("spot.png", image.astype(np.uint8), None, None, None)
    crop = crop_of(taken, image_size)
    seen = network_input(taken, crop)[0] + 1.0
    for columns, rows in (
        (range(crop.width), range(crop.height)),
        (range(2, crop.width, 3), range(1, crop.height, 3)),
    ):
        sampled = seen[np.ix_(rows, columns)]
        grid = crop.grid(columns, rows)
        assert sampled.shape == (grid.height, grid.width)
        row, column = np.indices(sampled.shape) + 0.5
        found = np.array([(column * sampled).sum(), (row * sampled).sum()]) / sampled.sum()
        found = found * [grid.scale_x, grid.scale_y] + [grid.offset_x, grid.offset_y]
        # Wrong pixel centers would cost half a pixel of the network.
        assert np.abs(found - center).max() < 0.05 * width / crop.resized_width


def test_transparent_and_masked_pixels():
    taken = photo(100, 60, channels=4)
    taken.image[..., 3] = 255
    taken.image[:, :50, 3] = 0
    crop = crop_of(taken, 64)
    seen = network_input(taken, crop)
    assert (seen[:, :, :20] == 1.0).all()
    other = Photo("b.png", taken.image.copy())
    other.image[:, :50, :3] = 7
    assert np.array_equal(network_input(other, crop), seen)
    half = Photo("c.png", np.full((30, 40, 4), 128, dtype=np.uint8))
    inside = network_input(half, crop_of(half, 64))
    np.testing.assert_allclose((inside + 1) * 127.5, (128 * 128 + 255 * 127) / 255, atol=0.6)
    mask = np.zeros((60, 100), dtype=bool)
    mask[:30] = True
    masked = Photo("d.png", taken.image, mask, None, None)
    grid = crop.grid(range(crop.width), range(crop.height))
    shown = grid.usable(masked)
    assert shown[:10, 40:].all()
    assert not shown[:, :30].any()
    assert not shown[20:].any()


@pytest.mark.parametrize(
    ("taken", "named"),
    [
        (photo(1000, 30), "too narrow"),
        (photo(30, 1000), "too narrow"),
        (Photo("a.jpg", np.zeros((40, 40), np.uint8), None, None, None), "image is uint8"),
        (Photo("a.jpg", np.zeros((40, 40, 3)), None, None, None), "image is float64"),
        (photo(40, 30, mask=np.ones((40, 30), bool)), "mask"),
    ],
)
def test_unusable_photos(taken, named):
    with pytest.raises(IgsrError, match=rf"^a\.jpg.*{named}"):
        crop_of(taken, 512)


# ---- pairs ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "photos", "expected"),
    [
        ("complete", 2, {(0, 1)}),
        ("complete", 4, {(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)}),
        ("swin-1", 4, {(0, 1), (1, 2), (2, 3), (0, 3)}),
        ("swin-1-noncyclic", 4, {(0, 1), (1, 2), (2, 3)}),
        ("swin-2-noncyclic", 4, {(0, 1), (1, 2), (2, 3), (0, 2), (1, 3)}),
        ("logwin-2", 5, {(0, 1), (1, 2), (2, 3), (3, 4), (0, 4), (0, 2), (1, 3), (2, 4), (0, 3),
                         (1, 4)}),
        ("logwin-3-noncyclic", 6, {(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (0, 2), (1, 3), (2, 4),
                                   (3, 5), (0, 4), (1, 5)}),
        ("oneref", 3, {(0, 1), (0, 2)}),
        ("oneref-1", 4, {(0, 1), (1, 2), (1, 3)}),
    ],
)  # fmt: skip
def test_pair_graphs(kind, photos, expected):
    pairs = pair_graph(kind, photos)
    assert len(pairs) == len(set(pairs)) == 2 * len(expected)
    assert {pair for pair in pairs if pair[0] < pair[1]} == expected
    assert {(j, i) for i, j in pairs} == set(pairs)
    # Both orders of a pair are adjacent, and pairs are sorted.
    assert [tuple(sorted(pair)) for pair in pairs] == sorted(2 * sorted(expected))


def test_large_windows_and_default_ones():
    for kind in ("swin-6", "swin-999999999"):
        assert pair_graph(kind, 7) == pair_graph("complete", 7)
    assert pair_graph("logwin-999999999-noncyclic", 7) == pair_graph("logwin-3-noncyclic", 7)
    for kind in ("swin", "logwin"):
        assert pair_graph(kind, 20) == pair_graph(f"{kind}-3", 20)


@pytest.mark.parametrize(
    "photos", [2, 3, 15, MAX_COMPLETE_PHOTOS, MAX_COMPLETE_PHOTOS + 1, 50, 500]
)
def test_the_default_graph_joins_all_and_grows_slowly(photos):
    pairs = pair_graph(default_graph(photos), photos)
    assert len(pairs) <= 20 * photos
    reached = {0}
    for i, j in 2 * pairs:
        if i in reached:
            reached.add(j)
    assert reached == set(range(photos))


def test_invalid_graphs():
    swins = ("swin-x", "swin--1", "swin-0", "logwin-0")
    for kind in ("all", "complete-3", *swins, "oneref-5", "oneref-0-noncyclic", ""):
        with pytest.raises(IgsrError, match=kind or "''"):
            pair_graph(kind, 5)
    for kind, photos in (("complete", 1), ("swin-3", 0)):
        with pytest.raises(IgsrError, match="at least two photos"):
            pair_graph(kind, photos)


# ---- prediction ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("side", "longest", "stride", "samples"),
    [
        (512, 128, 5, 102),
        (384, 128, 3, 128),
        (224, 128, 3, 74),
        (64, 128, 1, 64),
        (512, 40, 13, 40),
        (16, 15, 3, 6),
        (16, 2, 7, 2),
    ],
)
def test_samples_are_symmetric(monkeypatch, side, longest, stride, samples):
    monkeypatch.setattr(prediction, "MAX_GRID_SIDE", longest)
    assert prediction.stride_for(side) == stride
    pixels = prediction.grid_samples(side, stride)
    assert len(pixels) == samples <= longest
    assert pixels[0] == side - 1 - pixels[-1] >= 0


@pytest.fixture(scope="module")
def network():
    return hashed_network(SMALL)


@pytest.fixture(scope="module")
def photos():
    sizes = {"wide.jpg": (80, 60), "tall.jpg": (60, 80), "2.jpg": (128, 96), "flat.jpg": (90, 40)}
    return [photo(*size, name, seed) for seed, (name, size) in enumerate(sizes.items())]


def directly(network, first, second):
    """The network's maps of two photos."""
    with torch.inference_mode():
        tokens = [
            network.encode(torch.from_numpy(network_input(one, crop_of(one, 64))[None]))
            for one in (first, second)
        ]
        return network.decode(*tokens)


@pytest.mark.parametrize("order", [1, -1])
def test_predictions_in_the_order_of_pairs(network, photos, order):
    pairs = pair_graph("complete", 4)[::order]
    steps = []
    grids, predictions = DustPredictor(network)(photos, pairs, lambda *step: steps.append(step))
    assert [(p.first, p.second) for p in predictions] == pairs
    assert steps[-1] == ("pairs", 12, 12)
    assert [step[1] for step in steps] == sorted({step[1] for step in steps})
    assert [(grid.height, grid.width) for grid in grids] == [(48, 64), (64, 48), (48, 64), (16, 64)]
    for found in predictions:
        first, second = directly(network, photos[found.first], photos[found.second])
        for side, maps in (("first", first), ("second", second)):
            for what in ("points", "confidence"):
                got, wanted = getattr(found, f"{side}_{what}"), getattr(maps, what)
                assert got.dtype == np.float32
                np.testing.assert_allclose(got, wanted[0], rtol=1e-4, atol=1e-5)


def test_the_dense_map_is_the_most_confident_one(monkeypatch, network, photos):
    monkeypatch.setattr(prediction, "MAX_GRID_SIDE", 20)
    pairs = [(0, 1), (1, 0), (0, 2), (2, 3), (2, 0)]
    grids, predictions = DustPredictor(network)(photos, pairs)
    scores = [
        np.prod([m.confidence.double().mean() for m in directly(network, photos[i], photos[j])])
        for i, j in pairs
    ]
    for i, grid in enumerate(grids[:3]):
        own = grid.dense
        of_photo = [n for n, pair in enumerate(pairs) if pair[0] == i]
        sampled = predictions[max(of_photo, key=lambda n: scores[n])]
        samples = np.ix_(own.rows, own.columns)
        assert np.array_equal(own.depth[samples], sampled.first_points[..., 2])
        assert np.array_equal(own.confidence[samples], sampled.first_confidence)
        assert sampled.first_points.shape == (grid.height, grid.width, 3)
        assert max(grid.height, grid.width) <= 20
        whole = own.grid.photo_pixels().reshape(own.grid.height, own.grid.width, 2)
        np.testing.assert_allclose(grid.photo_pixels(), whole[samples].reshape(-1, 2))
    assert grids[3].dense is None


def test_each_photo_is_encoded_once_and_forgotten_after_its_last_pair(photos):
    network = hashed_network(SMALL)
    encode, tokens, kept = network.encode, [], []

    def watched(images):
        result = encode(images)
        tokens.append(weakref.ref(result))
        return result

    network.encode = watched

    def progress(*step):
        kept.append(sum(token() is not None for token in tokens))

    DustPredictor(network)(photos, [(0, 1), (1, 2), (2, 3)], progress)
    assert len(tokens) == 4
    assert kept == [1, 1, 0]


def test_masked_pixels_have_no_confidence(network, photos):
    mask = np.ones((60, 80), dtype=bool)
    mask[:, 40:] = False
    masked = [replace(photos[0], mask=mask), photos[1]]
    grids, (found, back) = DustPredictor(network)(masked, [(0, 1), (1, 0)])
    _, (whole, _) = DustPredictor(network)(photos[:2], [(0, 1), (1, 0)])
    for confidence in (found.first_confidence, back.second_confidence, grids[0].dense.confidence):
        assert (confidence[:, 32:] == 1.0).all()
        assert (confidence[:, :32] > 1.0).all()
    assert np.array_equal(found.first_confidence[:, :32], whole.first_confidence[:, :32])
    assert np.array_equal(found.first_points, whole.first_points)


def test_predictions_that_are_not_finite(photos):
    network = hashed_network(SMALL)
    assert DustPredictor(network)(photos, [])[1] == []
    with torch.no_grad():
        network.downstream_head2.proj.bias[5] = torch.nan
    with pytest.raises(IgsrError, match=r"predictions for wide\.jpg and tall\.jpg are not finite"):
        DustPredictor(network)(photos, [(0, 1)])


def test_predictions_keep_no_larger_arrays(monkeypatch, network, photos):
    monkeypatch.setattr(prediction, "MAX_GRID_SIDE", 20)
    grids, predictions = DustPredictor(network)(photos, pair_graph("complete", 4))
    arrays = [a for p in predictions for a in vars(p).values() if isinstance(a, np.ndarray)]
    arrays += [array for grid in grids for array in (grid.dense.depth, grid.dense.confidence)]
    assert all(array.base is None for array in arrays)
