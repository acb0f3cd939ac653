"""Checkpoints of Depth Anything 3: found, checked by key and shape, refused by name."""

from __future__ import annotations

import json

import pytest
import torch
from da3_networks import TINY, hashed_network, hashed_weight
from safetensors.torch import save_file

from igsr.cameras.checkpoint_search import find_checkpoint
from igsr.cameras.da3.backbone import BASE, SMALL
from igsr.cameras.da3.checkpoint import SIZES, load_checkpoint, load_network, size_of
from igsr.errors import IgsrError

BACKBONE = "backbone__pretrained__"


@pytest.fixture(autouse=True)
def tiny_as_small(monkeypatch):
    # The published sizes would be hundreds of megabytes on disk.
    monkeypatch.setitem(SIZES, "da3-small", TINY)
    monkeypatch.delenv("IGSR_DA3", raising=False)


def published_weights():
    """Weights as in the published file, with parts that igsr does not use."""
    weights = {f"model.{key}": t for key, t in hashed_network().state_dict().items()}
    for key in (
        "cam_enc.trunk_norm.bias",
        "head.scratch.refinenet1_aux.out_conv.bias",
        "head.scratch.output_conv2_aux.0.2.weight",
    ):
        weights[f"model.{key}"] = torch.zeros(7)
    return weights


def saved(folder, **changes):
    """Save weights with changes (None removes a key); double underscores stand for dots."""
    weights = published_weights()
    for key, value in changes.items():
        key = "model." + key.replace("__", ".")
        weights.pop(key, None)
        if value is not None:
            weights[key] = value
    save_file(weights, folder / "model.safetensors")
    return folder / "model.safetensors"


@pytest.fixture
def folder(tmp_path):
    saved(tmp_path)
    (tmp_path / "config.json").write_text('{"model_name": "da3-small"}')
    return tmp_path


def test_a_loaded_network_has_the_weights_of_the_file(folder, recwarn):
    before = torch.serialization.get_safe_globals(), torch.get_rng_state()
    network = load_network(folder, "cpu")
    assert not recwarn.list
    for key, value in network.state_dict().items():
        assert torch.equal(value, hashed_weight(key, value.shape)), key
    assert torch.serialization.get_safe_globals() == before[0]
    assert torch.equal(torch.get_rng_state(), before[1])


def test_half_precision_becomes_float32_and_shapes_give_the_size(folder):
    (folder / "config.json").unlink()
    weights = {key: value.to(torch.bfloat16) for key, value in published_weights().items()}
    save_file(weights, folder / "model.safetensors")
    found = load_checkpoint(folder)
    assert found.config == TINY
    assert {value.dtype for value in found.weights.values()} == {torch.float32}


def test_ignored_keys_are_listed(folder):
    path = saved(folder, head__sky__weight=torch.zeros(2), more=torch.zeros(1))
    with pytest.warns(UserWarning, match=r"were ignored: model\.head\.sky\.weight, model\.more"):
        load_network(path, "cpu")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        (f"{BACKBONE}norm__bias", None, r"has no model\.backbone\.pretrained\.norm\.b"),
        (
            f"{BACKBONE}camera_token",
            torch.zeros(1, 1, 32),
            r"_token has shape \[1, 1, 32\] instead of",
        ),
        (
            "head__norm__weight",
            torch.zeros(64).int(),
            r"head\.norm\.weight is not an array of floats",
        ),
        ("head__norm__weight", torch.full((64,), torch.nan), r"head\.norm\.weight .* not finite"),
        (f"{BACKBONE}blocks__12__norm1__weight", torch.zeros(32), "larger model .* non-commercial"),
    ],
)
def test_damaged_and_other_files_are_refused_by_name(folder, key, value, message):
    with pytest.raises(IgsrError, match=message):
        load_checkpoint(saved(folder, **{key: value}))


def test_files_that_are_not_checkpoints(folder, tmp_path):
    path = folder / "model.safetensors"
    whole = path.read_bytes()
    for content in (b"", b"<!doctype html><title>404</title>", whole[:5000], b"\xff" * 200):
        path.write_bytes(content)
        with pytest.raises(IgsrError, match="damaged or not safetensors"):
            load_checkpoint(path)
    with pytest.raises(IgsrError, match="does not exist"):
        load_checkpoint(tmp_path / "none.safetensors")
    other = tmp_path / "weights.pth"
    other.write_bytes(b"x")
    with pytest.raises(IgsrError, match=r"not a \.safetensors file"):
        load_checkpoint(other)
    (folder / "config.json").unlink()
    save_file({"a": torch.zeros(1)}, path)
    with pytest.raises(IgsrError, match="not a checkpoint of Depth Anything 3 SMALL or BASE"):
        load_checkpoint(path)


@pytest.mark.parametrize("content", ["{", "[]", "null", "[" * 100_000, " " * 200_000])
def test_a_config_that_cannot_be_read(folder, content):
    (folder / "config.json").write_text(content)
    with pytest.raises(IgsrError, match=r"config\.json cannot be read"):
        load_checkpoint(folder)


def published_config(name, config, net):
    """A config.json in the layout of the published ones."""
    dim = config.embed_dim

    def part(cls, **sizes):
        return {"__object__": {"path": "os", "name": cls, "args": "as_params"}, **sizes}

    blocks = {"alt_start": 4, "qknorm_start": 4, "rope_start": 4, "cat_token": True}
    head = {"output_dim": 2, "features": config.features, "out_channels": [*config.out_channels]}
    return {
        "model_name": name,
        "config": {
            "net": part("DinoV2", name=net, out_layers=[5, 7, 9, 11], **blocks),
            "head": part("DualDPT", dim_in=2 * dim, **head),
            "cam_dec": part("CameraDec", dim_in=2 * dim),
        },
    }


def test_sizes_of_the_published_configs():
    big = published_config("da3-base", BASE, "vitb")
    small = published_config("da3-small", SMALL, "vits")
    SIZES["da3-small"] = SMALL  # the fixture restores it
    assert size_of(big, "c") == "da3-base"
    assert size_of(small, "c") == "da3-small"
    assert size_of({"config": big["config"]}, "c") == "da3-base"
    assert size_of({"model_name": "da3-base"}, "c") == "da3-base"


@pytest.mark.parametrize(
    ("part", "entry", "value"),
    [
        ("net", "out_layers", [5, 7, 9, 10]),
        ("net", "alt_start", 8),
        ("net", "cat_token", False),
        ("net", "name", "vitl"),
        ("head", "features", 256),
        ("head", "out_channels", [96, 192, 384, 1024]),
        ("cam_dec", "dim_in", 3072),
        ("cam_dec", "__object__", {"path": "os", "name": "system", "args": "ls"}),
    ],
)
def test_a_number_of_another_network_is_refused_by_name(part, entry, value):
    content = published_config("da3-base", BASE, "vitb")
    content["config"][part][entry] = value
    with pytest.raises(IgsrError, match=rf"c: {part}\.{entry}.* is .* instead of"):
        size_of(content, "c")


@pytest.mark.parametrize(
    "content",
    [
        {},
        {"model_name": "da3-large"},
        {"model_name": ["da3-base"]},
        {"config": 3},
        {"config": {}},
        {"config": {"net": {"name": {}}}},
        {"model_name": "da3-small", "config": published_config("", BASE, "vitb")["config"]},
    ],
)
def test_configs_that_describe_no_network(content):
    with pytest.raises(IgsrError, match=r"^c"):
        size_of(json.loads(json.dumps(content)), "c")


def test_where_checkpoints_are_searched(folder, tmp_path, monkeypatch):
    cache = tmp_path / "hub"
    monkeypatch.setenv("HF_HUB_CACHE", str(cache))
    assert find_checkpoint("da3") is None
    files = {}
    for size in ("SMALL", "BASE"):
        model = cache / f"models--depth-anything--DA3-{size}"
        for revision in ("aaaa", "bbbb"):
            files[size, revision] = model / "snapshots" / revision / "model.safetensors"
            files[size, revision].parent.mkdir(parents=True)
        (model / "refs").mkdir()
        (model / "refs" / "main").write_text("bbbb\n")
    for file in (("SMALL", "aaaa"), ("SMALL", "bbbb"), ("BASE", "aaaa")):
        files[file].touch()
        assert find_checkpoint("da3") == files[file]
    monkeypatch.setenv("IGSR_DA3", str(folder))
    assert find_checkpoint("da3") == folder / "model.safetensors"
    assert find_checkpoint("da3", files["SMALL", "aaaa"]) == files["SMALL", "aaaa"]
    for missing in (tmp_path / "none", tmp_path / "a\0b", cache):
        with pytest.raises(IgsrError, match="checkpoint names"):
            find_checkpoint("da3", missing)
    monkeypatch.setenv("IGSR_DA3", str(tmp_path / "none"))
    with pytest.raises(IgsrError, match="IGSR_DA3 names"):
        find_checkpoint("da3")


def test_a_missing_device(folder):
    with pytest.raises(IgsrError, match="device 'cuda:93' cannot hold the network"):
        load_network(folder, "cuda:93")
