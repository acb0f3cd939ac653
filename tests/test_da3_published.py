"""Depth Anything 3 against numbers that the published code gave for random weights.

They are megabytes, so they are not here: IGSR_DA3_FIXTURES names the folder. ``-s`` prints how far
off each number is.
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

from igsr.pose.da3 import preprocessing
from igsr.pose.da3.cameras import cameras_of_rays, decode_pose, encode_pose, normalized_viewmats
from igsr.pose.da3.checkpoint import read_weights
from igsr.pose.da3.config import SMALL, NetworkConfig
from igsr.pose.da3.network import Da3Network
from igsr.pose.da3.reference_view import REFERENCES

FOLDER = Path(os.environ["IGSR_DA3_FIXTURES"])

#: Largest differences that are allowed; activations and cameras, predictions, focal lengths.
ACTIVATION, PREDICTION, PIXELS = 2e-5, 5e-5, 1e-3
OUTPUTS = {
    "pose_encoding": ("pose", ACTIVATION),
    "depth": ("depth", PREDICTION),
    "confidence": ("depth_conf", PREDICTION),
    "rays": ("ray", PREDICTION),
    "ray_confidence": ("ray_conf", PREDICTION),
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


def watched(network, names):
    """What modules give, by name, while the network runs; and handles that end it."""
    given = {name: [] for name in names}

    def keep(name):
        def hook(module, inputs, output):
            given[name] += [one.clone() for one in (output if type(output) is list else [output])]

        return hook

    modules = dict(network.named_modules())
    handles = [modules[path].register_forward_hook(keep(name)) for name, path in names.items()]
    return given, handles


@pytest.mark.parametrize("views", [1, 2, 3, 5])
def test_activations_and_predictions(network, views):
    wanted = stored(f"tiny_views{views}.npz")
    blocks = {f"in.block{n}": f"backbone.pretrained.blocks.{n}" for n in (0, 3, *range(4, 12))}
    parts = ("layer1_rn", "layer4_rn", "output_conv1", "refinenet1_aux")
    parts += tuple(f"refinenet{n}" for n in (1, 2, 3, 4))
    head = {f"in.head.{part}": f"head.scratch.{part}" for part in parts}
    head["in.head.output_conv1_aux3"] = "head.scratch.output_conv1_aux.3"
    given, handles = watched(network, {**blocks, **head})
    embedded = []
    handles.append(
        network.backbone.pretrained.patch_embed["proj"].register_forward_hook(
            lambda module, inputs, output: embedded.append(output[0].flatten(1).mT)
        )
    )
    features = []
    handles.append(
        network.backbone.register_forward_hook(lambda m, i, output: features.extend(output))
    )
    pixels = torch.from_numpy(wanted["pixels"])
    found = network(pixels)
    for handle in handles:
        handle.remove()
    backbone = network.backbone.pretrained
    tokens = [backbone.embedded(view, backbone.positions(3, 5)) for view in pixels]
    check("in.patches", torch.stack(embedded), wanted["in.patches"], ACTIVATION)
    check("in.tokens", torch.stack(tokens), wanted["in.tokens"], ACTIVATION)
    for name, values in given.items():
        if name in wanted:
            joined = torch.cat(values) if name in head else torch.stack(values)
            check(name, joined, wanted[name], ACTIVATION)
    for block, level in ((5, 0), (11, 3)):
        patches = torch.stack([one.levels[level] for one in features])
        check(f"feature{block}.patches", patches, wanted[f"feature{block}.patches"], ACTIVATION)
    # Blocks have the reference view first; what they give of a view's first token is in the order
    # given.
    reference = int(wanted.get("saddle_balanced.reference", 0))
    order = [reference, *(n for n in range(views) if n != reference)]
    for block in (5, 7, 9):
        ends = [torch.stack(given[f"in.block{n}"])[:, 0] for n in (block - 1, block)]
        tokens = torch.cat(ends, dim=1)[np.argsort(order)]
        check(f"feature{block}.token", tokens, wanted[f"feature{block}.token"], ACTIVATION)
    tokens = torch.stack([one.token for one in features])
    check("feature11.token", tokens, wanted["feature11.token"], ACTIVATION)
    for name, (key, bound) in OUTPUTS.items():
        check(f"out.{key}", getattr(found, name), wanted[f"out.{key}"], bound)
    w2c, K = decode_pose(found.pose_encoding, 42, 70)
    check("decoder.extrinsics", w2c, wanted["decoder.extrinsics"], ACTIVATION)
    check("decoder.intrinsics", K, wanted["decoder.intrinsics"], PIXELS)
    # Random weights give rays that no camera has: 1e-6 more moves these cameras by 1e-4.
    w2c, K = cameras_of_rays(
        found.rays, found.ray_confidence, 42, 70, wanted["rays.samples"], "official"
    )
    check("rays.extrinsics", w2c, wanted["rays.extrinsics"], 2e-3)
    largest = np.abs(wanted["rays.intrinsics"]).max()
    check("rays.intrinsics", K / largest, wanted["rays.intrinsics"] / largest, 2e-3)
    for reference in REFERENCES:
        if f"{reference}.pose" in wanted:
            other = network(pixels, reference)
            check(f"{reference}.pose", other.pose_encoding, wanted[f"{reference}.pose"], ACTIVATION)
            means = other.depth.mean(dim=(1, 2))
            check(f"{reference}.depth_mean", means, wanted[f"{reference}.depth_mean"], PREDICTION)


def test_given_cameras(network):
    wanted = stored("tiny_cameras3.npz")
    viewmats, intrinsics = wanted["viewmats"], wanted["intrinsics"]
    normalized = normalized_viewmats(viewmats)
    check("normalized_viewmats", normalized, wanted["normalized_viewmats"], ACTIVATION)
    encoding = encode_pose(normalized, intrinsics, [(42, 70)] * 3)
    check("encoding", encoding, wanted["encoding"], ACTIVATION)
    check("tokens", network.cam_enc(encoding.float()), wanted["tokens"], ACTIVATION)
    found = network(
        torch.from_numpy(wanted["pixels"]),
        viewmats=torch.from_numpy(viewmats),
        intrinsics=torch.from_numpy(intrinsics),
    )
    for name, (key, bound) in OUTPUTS.items():
        check(f"out.{key}", getattr(found, name), wanted[f"out.{key}"], bound)


@pytest.mark.parametrize("case", ["a", "b"])
def test_small_at_full_size(case):
    wanted, network = stored("small_hashed.npz"), hashed_network(SMALL)
    found = network(torch.from_numpy(wanted[f"{case}.pixels"]))
    for name, (key, bound) in OUTPUTS.items():
        value = getattr(found, name)
        value = value[:, ::4, ::4] if key.startswith("ray") else value
        check(f"SMALL {case}.{key}", value, wanted[f"{case}.{key}"], bound)


def test_cameras_of_encodings():
    wanted = stored("poses.npz")
    height, width = int(wanted["height"]), int(wanted["width"])
    w2c, K = decode_pose(wanted["encoding"], height, width)
    check("extrinsics", w2c, wanted["extrinsics"], 1e-5)
    np.testing.assert_allclose(K, wanted["intrinsics"], rtol=1e-6)
    again = encode_pose(w2c[4:], K[4:], [(height, width)] * (len(K) - 4))
    check("encoding_again", again, wanted["encoding_again"], 1e-5)


@pytest.mark.parametrize("case", ["clean", "noisy", "off"])
def test_cameras_of_rays(case):
    wanted = stored("rays.npz")
    size = int(wanted["height"]), int(wanted["width"])
    one = {name.removeprefix(f"{case}."): value for name, value in wanted.items()}
    kinds = (
        {"official": "official"} if case == "noisy" else {"official": "official", "free": "true"}
    )
    for decomposition, name in kinds.items():
        w2c, K = cameras_of_rays(
            one["rays"], one["confidence"], *size, one["samples"], decomposition
        )
        check(f"{case} {name}_extrinsics", w2c, one[f"{name}_extrinsics"], 1e-4)
        check(f"{case} {name}_intrinsics", K, one[f"{name}_intrinsics"], 5e-3)


def test_photos():
    wanted = stored("preprocessing.npz")
    resolution = int(wanted["resolution"])
    images = {
        name: np.asarray(Image.open(FOLDER / f"photo_{name}.png").convert("RGB")) for name in "ab"
    }
    for name, image in images.items():
        for method in preprocessing.METHODS:
            key = f"{name}.{method}"
            resampling = preprocessing.resampling_of(
                image.shape[1], image.shape[0], resolution, method
            )
            levels = preprocessing.grey_levels(image, resampling).astype(float)
            check(f"{key}.levels", levels, wanted[f"{key}.levels"], 1)
            mean = np.abs(levels - wanted[f"{key}.levels"]).mean()
            check(f"{key}.levels, mean", mean, 0.0, 0.02)
            K = resampling.intrinsics(wanted[f"{name}.K"])
            check(f"{key}.K", K, wanted[f"{key}.K"], 1e-4)
    method = preprocessing.METHODS[0]
    pixels, K = preprocessing.network_inputs(
        list(images.values()), resolution, method, [wanted["a.K"], wanted["b.K"]]
    )
    levels = pixels.transpose(0, 2, 3, 1) * preprocessing.DEVIATION + preprocessing.MEAN
    check("both.levels", np.rint(255 * levels), wanted[f"both.{method}.levels"], 1)
    check("both.K", K, wanted[f"both.{method}.K"], 1e-4)


def test_sizes():
    for line in (FOLDER / "sizes_504.tsv").read_text().splitlines()[1:]:
        width, height, *sizes = line.split("\t")
        for method, size in zip(preprocessing.METHODS, sizes, strict=True):
            found = preprocessing.resampling_of(int(width), int(height), 504, method)
            assert f"{found.width}x{found.height}" == size, (line, method)
