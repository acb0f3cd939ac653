"""Checkpoints of Depth Anything 3: found, checked by key and shape, refused by name."""

from __future__ import annotations

import json
import re

import pytest
import torch
from da3_networks import TINY, hashed_network, hashed_weight
from safetensors.torch import save_file

from igsr.errors import IgsrError
from igsr.pose.da3 import checkpoint as module
from igsr.pose.da3.checkpoint import VARIABLE, find_checkpoint, load_checkpoint, load_network
from igsr.pose.da3.config import BASE, SIZES, SMALL, size_of

NORM = "model.head.scratch.output_conv2_aux.{}.2.{}"


@pytest.fixture(autouse=True)
def tiny_in_place_of_small(monkeypatch):
    # The published sizes would be hundreds of megabytes on disk.
    monkeypatch.setitem(SIZES, "da3-small", TINY)
    monkeypatch.setitem(module._WIDTHS, TINY.embed_dim, "da3-small")
    monkeypatch.delenv(VARIABLE, raising=False)


def published_keys():
    """Weights as the hub's file has them: the shared norm once, under its first name."""
    weights = {f"model.{key}": t for key, t in hashed_network().state_dict().items()}
    for part in ("weight", "bias"):
        weights[NORM.format(0, part)] = weights.pop(NORM.format(3, part))
    for level in range(3):
        weights[f"model.head.scratch.output_conv1_aux.{level}.0.weight"] = torch.zeros(8, 16, 3, 3)
        weights[f"model.head.scratch.output_conv2_aux.{level}.5.bias"] = torch.zeros(7)
    return weights


@pytest.fixture
def folder(tmp_path):
    save_file(published_keys(), tmp_path / "model.safetensors")
    (tmp_path / "config.json").write_text('{"model_name": "da3-small"}')
    return tmp_path


def changed(folder, **changes):
    """The file with keys replaced (by None: removed); double underscores stand for dots."""
    weights = published_keys()
    for key, value in changes.items():
        key = "model." + key.replace("__", ".")
        weights.pop(key, None)
        if value is not None:
            weights[key] = value
    save_file(weights, folder / "model.safetensors")
    return folder / "model.safetensors"


def test_a_loaded_network_has_the_files_weights_and_the_shared_norm(folder, recwarn):
    network = load_network(folder, "cpu")
    assert not recwarn.list
    for key, value in network.state_dict().items():
        assert torch.equal(value, hashed_weight(key, value.shape)), key
    norm = network.head.scratch["output_conv2_aux"]["3"][2]
    assert not torch.equal(norm.weight, torch.ones(32))


def test_a_file_that_has_the_norm_under_the_name_that_is_used(folder):
    weights = published_keys()
    used = {part: weights.pop(NORM.format(0, part)) for part in ("weight", "bias")}
    weights |= {NORM.format(3, part): value for part, value in used.items()}
    save_file(weights, folder / "model.safetensors")
    found = load_checkpoint(folder).weights
    assert torch.equal(found["head.scratch.output_conv2_aux.3.2.weight"], used["weight"])
    # Both names are well if they agree.
    weights |= {NORM.format(0, part): value.clone() for part, value in used.items()}
    save_file(weights, folder / "model.safetensors")
    assert load_checkpoint(folder).unknown == []
    weights[NORM.format(0, "bias")] += 1e-3
    save_file(weights, folder / "model.safetensors")
    with pytest.raises(IgsrError, match=r"aux\.3\.2\.bias and .*aux\.0\.2\.bias differ"):
        load_checkpoint(folder)


def test_a_file_alone_tells_its_size_by_its_shapes(folder):
    (folder / "config.json").unlink()
    assert load_checkpoint(folder / "model.safetensors").name == "da3-small"


def test_half_precision_becomes_float32(folder):
    weights = {key: value.to(torch.bfloat16) for key, value in published_keys().items()}
    save_file(weights, folder / "model.safetensors")
    found = load_checkpoint(folder).weights
    assert {value.dtype for value in found.values()} == {torch.float32}


def test_loading_leaves_torchs_safe_globals_and_generator(folder):
    before = torch.serialization.get_safe_globals(), torch.get_rng_state()
    load_network(folder, "cpu")
    assert torch.serialization.get_safe_globals() == before[0]
    assert torch.equal(torch.get_rng_state(), before[1])


def test_keys_without_a_use_are_listed(folder):
    path = changed(folder, head__sky__weight=torch.zeros(2), more=torch.zeros(1))
    with pytest.warns(UserWarning, match=r"no use for.*: model\.head\.sky\.weight, model\.more"):
        load_network(path, "cpu")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"backbone__pretrained__norm__bias": None},
            r"has no model\.backbone\.pretrained\.norm\.b",
        ),
        ({"head__scratch__output_conv2_aux__0__2__weight": None}, r"has no .*aux\.0\.2\.weight"),
        (
            {"backbone__pretrained__camera_token": torch.zeros(1, 1, 32)},
            r"camera_token has shape \[1, 1, 32\] where \[1, 2, 32\] belongs",
        ),
        (
            {"head__norm__weight": torch.zeros(64, dtype=torch.int32)},
            r"head\.norm\.weight is no array of floats",
        ),
        (
            {"head__norm__weight": torch.full((64,), torch.nan)},
            r"head\.norm\.weight holds numbers that are not finite",
        ),
        (
            {"backbone__pretrained__blocks__12__norm1__weight": torch.zeros(32)},
            "larger model .* non-commercial",
        ),
    ],
)
def test_a_damaged_or_another_file_is_refused_by_name(folder, changes, message):
    path = changed(folder, **changes)
    with pytest.raises(IgsrError, match=message):
        load_checkpoint(path)


def test_what_is_no_checkpoint(folder, tmp_path):
    path = folder / "model.safetensors"
    whole = path.read_bytes()
    for content in (b"", b"<!doctype html><title>404</title>", whole[:5000], b"\xff" * 200):
        path.write_bytes(content)
        with pytest.raises(IgsrError, match="damaged or no safetensors"):
            load_checkpoint(path)
    with pytest.raises(IgsrError, match="is no file"):
        load_checkpoint(tmp_path / "none.safetensors")
    other = tmp_path / "weights.pth"
    other.write_bytes(b"x")
    with pytest.raises(IgsrError, match=r"no \.safetensors file"):
        load_checkpoint(other)
    (folder / "config.json").unlink()
    save_file({"a": torch.zeros(1)}, path)
    with pytest.raises(IgsrError, match="no checkpoint of Depth Anything 3 SMALL or BASE"):
        load_checkpoint(path)


def test_a_config_beside_it_that_cannot_be_read(folder):
    for content in ("{", "[" * 100_000, " " * 200_000):
        (folder / "config.json").write_text(content)
        with pytest.raises(IgsrError, match=r"config\.json cannot be read"):
            load_checkpoint(folder)


def hub_config(name, config, net):
    """A config.json in the layout of the hub's."""
    dim = config.embed_dim

    def part(cls, **sizes):
        return {"__object__": {"path": "os", "name": cls, "args": "as_params"}, **sizes}

    return {
        "model_name": name,
        "config": {
            "net": part(
                "DinoV2",
                name=net,
                out_layers=[5, 7, 9, 11],
                alt_start=4,
                qknorm_start=4,
                rope_start=4,
                cat_token=True,
            ),
            "head": part(
                "DualDPT",
                dim_in=2 * dim,
                output_dim=2,
                features=config.features,
                out_channels=list(config.out_channels),
            ),
            "cam_enc": part("CameraEnc", dim_out=dim),
            "cam_dec": part("CameraDec", dim_in=2 * dim),
        },
    }


def test_sizes_by_the_hubs_configuration():
    big, small = hub_config("da3-base", BASE, "vitb"), hub_config("da3-small", SMALL, "vits")
    SIZES["da3-small"] = SMALL  # the fixture takes it back
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
        ("cam_enc", "dim_out", 1024),
        ("cam_dec", "dim_in", 3072),
        ("cam_dec", "__object__", {"path": "os", "name": "system", "args": "ls"}),
    ],
)
def test_a_number_of_another_network_is_refused_by_name(part, entry, value):
    content = hub_config("da3-base", BASE, "vitb")
    content["config"][part][entry] = value
    with pytest.raises(IgsrError, match=rf"c: its {part}\.{entry}.* is .* belongs"):
        size_of(content, "c")


@pytest.mark.parametrize(
    "content",
    [
        [],
        {},
        {"model_name": "da3-large"},
        {"model_name": ["da3-base"]},
        {"config": 3},
        {"config": {}},
        {"config": {"net": {"name": {}}}},
        {"model_name": "da3-small", "config": hub_config("", BASE, "vitb")["config"]},
    ],
)
def test_a_configuration_that_is_none(content):
    with pytest.raises(IgsrError, match=r"^c"):
        size_of(json.loads(json.dumps(content)), "c")


def test_where_checkpoints_are_looked_for(folder, tmp_path, monkeypatch):
    cache = tmp_path / "hub"
    monkeypatch.setenv("HF_HUB_CACHE", str(cache))
    assert find_checkpoint() is None
    files = {}
    for size in ("SMALL", "BASE"):
        model = cache / f"models--depth-anything--DA3-{size}"
        for revision in ("aaaa", "bbbb"):
            files[size, revision] = model / "snapshots" / revision / "model.safetensors"
            files[size, revision].parent.mkdir(parents=True)
        (model / "refs").mkdir()
        (model / "refs" / "main").write_text("bbbb\n")
    files["SMALL", "aaaa"].touch()
    assert find_checkpoint() == files["SMALL", "aaaa"]
    files["SMALL", "bbbb"].touch()
    assert find_checkpoint() == files["SMALL", "bbbb"]
    files["BASE", "aaaa"].touch()
    assert find_checkpoint() == files["BASE", "aaaa"]
    monkeypatch.setenv(VARIABLE, str(folder))
    assert find_checkpoint() == folder / "model.safetensors"
    assert find_checkpoint(files["SMALL", "aaaa"]) == files["SMALL", "aaaa"]
    for missing in (tmp_path / "none", tmp_path / "a\0b", cache):
        with pytest.raises(IgsrError, match=re.escape("checkpoint names")):
            find_checkpoint(missing)
    monkeypatch.setenv(VARIABLE, str(tmp_path / "none"))
    with pytest.raises(IgsrError, match="IGSR_DA3 names"):
        find_checkpoint()


def test_a_device_that_is_not_there(folder):
    with pytest.raises(IgsrError, match="device 'cuda:93' cannot hold the network"):
        load_network(folder, "cuda:93")
