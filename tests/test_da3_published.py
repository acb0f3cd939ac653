"""Depth Anything 3, compared with results of the published code for random weights.

These are megabytes, so IGSR_DA3_FIXTURES names their folder. ``-s`` prints all differences.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from da3_networks import hashed_network
from PIL import Image
from safetensors import safe_open

from igsr.cameras.da3.backbone import SMALL, NetworkConfig
from igsr.cameras.da3.cameras import decode_pose
from igsr.cameras.da3.checkpoint import read_weights
from igsr.cameras.da3.network import Da3Network
from igsr.cameras.da3.prediction import network_input, resampled, resampling_of

FOLDER = Path(os.environ["IGSR_DA3_FIXTURES"])

#: Maximum differences of activations and cameras, of predictions, and of focal lengths.
ACTIVATION, PREDICTION, PIXELS = 2e-5, 5e-5, 1e-3
OUTPUTS = {
    "pose_encoding": ("pose", ACTIVATION),
    "depth": ("depth", PREDICTION),
    "confidence": ("depth_conf", PREDICTION),
}


def check(what, found, wanted, bound):
    found, wanted = np.asarray(found, np.float64), np.asarray(wanted, np.float64)
    assert found.shape == wanted.shape, what
    off = float(np.abs(found - wanted).max())
    print(f"{what:45} allowed {bound:7.1e} found {off:7.1e}")
    assert off <= bound, what


def stored(name):
    with np.load(FOLDER / name) as file:
        return dict(file)


@pytest.fixture(scope="module")
def network():
    sizes = json.loads((FOLDER / "tiny/config.json").read_text())["sizes"]
    config = NetworkConfig(
        sizes["embed_dim"], sizes["num_heads"], sizes["features"], tuple(sizes["out_channels"])
    )
    path = FOLDER / "tiny/model.safetensors"
    with safe_open(path, framework="pt") as file:
        shapes = {key: tuple(file.get_slice(key).get_shape()) for key in file.keys()}  # noqa: SIM118
        weights, unknown = read_weights(path, file, shapes, config)
    assert unknown == []
    network = Da3Network(config).eval()
    network.load_state_dict(weights)
    return network.requires_grad_(False)


def predicted(network, pixels, **arguments):
    """Predictions of all views, stacked by name."""
    views = network.predict(list(pixels), **arguments)
    return {name: torch.stack([getattr(view, name) for view in views]) for name in OUTPUTS}


@pytest.mark.parametrize("views", [1, 2, 3, 5])
def test_predictions_and_cameras(network, views):
    wanted = stored(f"tiny_views{views}.npz")
    pixels = torch.from_numpy(wanted["pixels"])
    found = predicted(network, pixels)
    for name, (key, bound) in OUTPUTS.items():
        check(f"out.{key}", found[name], wanted[f"out.{key}"], bound)
    w2c, K = decode_pose(found["pose_encoding"], 42, 70)
    check("decoder.extrinsics", w2c, wanted["decoder.extrinsics"], ACTIVATION)
    check("decoder.intrinsics", K, wanted["decoder.intrinsics"], PIXELS)
    for rule in ("first", "middle", "saddle_balanced", "saddle_sim_range"):
        if f"{rule}.pose" in wanted:
            # igsr implements the default rule, for which it chooses the view itself.
            chosen = rule == "saddle_balanced"
            index = None if chosen else int(wanted[f"{rule}.reference"])
            other = predicted(network, pixels, reference=index)
            check(f"{rule}.pose", other["pose_encoding"], wanted[f"{rule}.pose"], ACTIVATION)
            means = other["depth"].mean(dim=(1, 2))
            check(f"{rule}.depth_mean", means, wanted[f"{rule}.depth_mean"], PREDICTION)


@pytest.mark.parametrize("case", ["a", "b"])
def test_small_at_full_size(case):
    wanted, network = stored("small_hashed.npz"), hashed_network(SMALL)
    found = predicted(network, torch.from_numpy(wanted[f"{case}.pixels"]))
    for name, (key, bound) in OUTPUTS.items():
        check(f"SMALL {case}.{key}", found[name], wanted[f"{case}.{key}"], bound)


def test_cameras_of_encodings():
    wanted = stored("poses.npz")
    height, width = int(wanted["height"]), int(wanted["width"])
    w2c, K = decode_pose(wanted["encoding"], height, width)
    check("extrinsics", w2c, wanted["extrinsics"], 1e-5)
    np.testing.assert_allclose(K, wanted["intrinsics"], rtol=1e-6)


@pytest.mark.parametrize("name", ["a", "b"])
def test_photos(name):
    wanted = stored("preprocessing.npz")
    image = np.asarray(Image.open(FOLDER / f"photo_{name}.png").convert("RGB"))
    key = f"{name}.upper_bound_resize"
    resampling = resampling_of(image.shape[1], image.shape[0], int(wanted["resolution"]))
    levels = resampled(image, resampling).astype(float)
    check(f"{key}.levels", levels, wanted[f"{key}.levels"], 1)
    mean = np.abs(levels - wanted[f"{key}.levels"]).mean()
    check(f"{key}.levels, mean", mean, 0.0, 0.02)
    # One gray level, in units of the channel's standard deviation.
    pixels = network_input(image, resampling)
    check(f"{key}.pixels", pixels, wanted[f"{key}.pixels"], 1.01 / 255 / 0.224)


def test_sizes():
    for line in (FOLDER / "sizes_504.tsv").read_text().splitlines()[1:]:
        width, height, size, *_ = line.split("\t")
        found = resampling_of(int(width), int(height))
        assert f"{found.width}x{found.height}" == size, line
