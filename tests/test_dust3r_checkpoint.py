"""Checkpoints of DUSt3R: found, loaded, and refused with a message."""

from __future__ import annotations

import argparse
import json
import warnings
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from dust3r_networks import SMALL, empty_network, hashed_image, hashed_network
from safetensors.torch import save_file

import igsr.cameras.dust3r.checkpoint
from igsr.cameras.checkpoint_search import find_checkpoint
from igsr.cameras.dust3r.checkpoint import load_checkpoint, load_network
from igsr.errors import IgsrError


def sizes_of(config):
    return {
        "enc_embed_dim": config.encoder_dim,
        "enc_depth": config.encoder_depth,
        "enc_num_heads": config.encoder_heads,
        "dec_embed_dim": config.decoder_dim,
        "dec_depth": config.decoder_depth,
        "dec_num_heads": config.decoder_heads,
    }


def call_of(config, **changes):
    """The constructor call as published checkpoints have it."""
    arguments = {
        "pos_embed": "'RoPE100'",
        "patch_embed_cls": "'ManyAR_PatchEmbed'",
        "img_size": f"({config.image_size}, {config.image_size})",
        "head_type": f"'{config.head}'",
        "output_mode": "'pts3d'",
        "depth_mode": "('exp', -inf, inf)",
        "conf_mode": "('exp', 1, inf)",
        "landscape_only": "False",
        **sizes_of(config),
        **changes,
    }
    inside = ", ".join(f"{key}={value}" for key, value in arguments.items() if value is not None)
    return f"AsymmetricCroCo3DStereo({inside})"


def small_weights():
    return dict(hashed_network(SMALL).state_dict())


def saved(path, weights=None, call=None, **more):
    settings = argparse.Namespace(model=call or call_of(SMALL), lr=1e-4, epochs=100, resume=None)
    content = {"args": settings, "model": small_weights() if weights is None else weights}
    torch.save({**content, **more}, path)
    return path


def refusal(path):
    """The message that a checkpoint is refused with."""
    with pytest.raises(IgsrError) as caught:
        load_checkpoint(path)
    message = str(caught.value)
    assert str(path.parent) in message
    assert "\n" not in message
    return message


def test_a_loaded_network_is_the_saved_one(tmp_path, monkeypatch):
    weights = small_weights()
    path = saved(tmp_path / "a.pth", {**weights, "mask_token": torch.zeros(1, 1, 8)})
    checkpoint = load_checkpoint(path)
    assert checkpoint.config == SMALL
    assert checkpoint.unknown == []
    assert list(checkpoint.weights) == list(weights)
    monkeypatch.setattr(igsr.cameras.dust3r.checkpoint, "_license_shown", False)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        network = load_network(path, "cpu")
        load_network(path, "cpu")
    # The license is shown once.
    assert ["CC BY-NC-SA 4.0" in str(warning.message) for warning in caught] == [True]
    assert not network.training
    image = hashed_image("img1", 48, 64)
    expected = hashed_network(SMALL).encode(image).features
    assert torch.equal(network.encode(image).features, expected)


def test_safetensors_with_a_config(tmp_path):
    path = tmp_path / "model.safetensors"
    save_file({key: t.half() for key, t in small_weights().items()}, path)
    assert "config.json" in refusal(path)
    config = {
        "pos_embed": "RoPE100",
        "img_size": [64, 64],
        "head_type": "linear",
        "depth_mode": ["exp", float("-inf"), float("inf")],
        "conf_mode": ["exp", 1, float("inf")],
        **sizes_of(SMALL),
    }
    (tmp_path / "config.json").write_text(json.dumps(config))
    checkpoint = load_checkpoint(path)
    assert checkpoint.config == SMALL
    for key, weight in small_weights().items():
        assert checkpoint.weights[key].dtype == torch.float32
        assert torch.equal(checkpoint.weights[key], weight.half().float())
    path.write_bytes(path.read_bytes()[:-10])
    assert "damaged" in refusal(path)
    for text in ("[]", '{"enc_depth": 1}', json.dumps({**config, "dec_depth": 1e9})):
        (tmp_path / "config.json").write_text(text)
        assert "config.json" in refusal(path)


def test_weights_under_a_second_name(tmp_path):
    config = replace(SMALL, head="dpt")
    # Expanded tensors keep the file small.
    weights = {
        key: torch.zeros(1).expand(t.shape) for key, t in empty_network(config).state_dict().items()
    }
    first = "downstream_head1.dpt.scratch."
    weights[first + "layer_rn.1.weight"] = weights.pop(first + "layer2_rn.weight") + 1.0
    path = saved(tmp_path / "a.pth", weights, call_of(config))
    checkpoint = load_checkpoint(path)
    assert checkpoint.unknown == []
    assert checkpoint.weights[first + "layer2_rn.weight"].eq(1.0).all()
    del weights[first + "layer3_rn.weight"]
    assert f"has no {first}layer3_rn.weight" in refusal(saved(path, weights, call_of(config)))


@pytest.mark.filterwarnings("ignore:Validating sparse tensor")
def test_missing_keys_and_wrong_shapes_are_refused_by_name(tmp_path):
    path, key = tmp_path / "a.pth", "dec_blocks2.1.cross_attn.projk.weight"
    weights = small_weights()
    without = {k: v for k, v in weights.items() if k != key}
    assert f"has no {key}" in refusal(saved(path, without))
    for value in (
        torch.zeros(8, 9),
        torch.zeros(64),
        torch.zeros(1).expand(10**6, 10**6),
        torch.zeros(8, 8, dtype=torch.int32),
        torch.zeros(8, 8, dtype=torch.complex64),
        torch.zeros(8, 8).to_sparse(),
        torch.zeros(8, 8, device="meta"),
        "text",
        None,
    ):
        assert key in refusal(saved(path, {**weights, key: value}))


def test_unknown_keys_are_listed(tmp_path, monkeypatch):
    monkeypatch.setattr(igsr.cameras.dust3r.checkpoint, "_license_shown", True)
    more = {f"downstream_head1.act_{n}_postprocess.weight": torch.zeros(3) for n in range(30)}
    path = saved(tmp_path / "a.pth", {**small_weights(), **more, 7: torch.zeros(1)})
    assert "that are not text" in refusal(path)
    path = saved(path, {**small_weights(), **more})
    assert load_checkpoint(path).unknown == sorted(more)
    with pytest.warns(UserWarning, match=r"act_0_postprocess.weight, .* and 10 more\."):
        load_network(path, "cpu")


class Order:
    """Runs code when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return exec, (f"open({str(self.path)!r}, 'w')",)


def test_hostile_checkpoints_run_nothing(tmp_path):
    path, mark = tmp_path / "a.pth", tmp_path / "mark"
    assert "exec" in refusal(saved(path, Order(mark)))
    assert "exec" in refusal(saved(path, optimizer=Order(mark)))
    assert "exec" in refusal(saved(path, {**small_weights(), "extra": Order(mark)}))
    order = f"__import__('pathlib').Path({str(mark)!r}).touch()"
    for call in (order, f"AsymmetricCroCo3DStereo({order})", call_of(SMALL, enc_depth=order)):
        refusal(saved(path, call=call))
    assert not mark.exists()


@pytest.mark.parametrize(
    ("call", "named"),
    [
        ("", "args.model"),
        ("AsymmetricCroCo3DStereo", "args.model"),
        ("(" * 100_000, "args.model"),
        ("AsymmetricMASt3R(enc_depth=24)", "AsymmetricMASt3R"),
        ("AsymmetricCroCo3DStereo(24)", "24"),
        ("AsymmetricCroCo3DStereo()", "pos_embed"),
        (call_of(SMALL, pos_embed="'cosine'"), "pos_embed"),
        (call_of(SMALL, depth_mode="('linear', -inf, inf)"), "depth_mode"),
        (call_of(SMALL, conf_mode="('exp', 0, inf)"), "conf_mode"),
        (call_of(SMALL, output_mode="'pts3d+desc24'"), "output_mode"),
        (call_of(SMALL, head_type="'catmlp+dpt'"), "head"),
        (call_of(SMALL, img_size="(512, 'a')"), "image_size"),
        (call_of(SMALL, enc_depth=None), "enc_depth"),
        (call_of(SMALL, enc_depth="1" * 5000), "encoder_depth"),
        (call_of(SMALL, dec_embed_dim=-8), "decoder_dim"),
        (call_of(SMALL, dec_num_heads="1.0"), "decoder_heads"),
    ],
)
def test_calls_that_describe_no_network(tmp_path, call, named):
    settings = argparse.Namespace(model=call)
    path = tmp_path / "a.pth"
    torch.save({"args": settings, "model": {}}, path)
    assert named in refusal(path)


def test_files_that_are_not_checkpoints(tmp_path):
    path = tmp_path / "a.pth"
    refusal(path)
    refusal(tmp_path)
    content = torch.load(saved(path), weights_only=False)
    torch.save(content, path, _use_new_zipfile_serialization=False)
    assert "damaged" in refusal(path)
    for wrong in ([], {"model": 3}, {"model": {}}, {"model": {}, "args": {"model": "x"}}, 3):
        torch.save(wrong, path)
        refusal(path)
    torch.save({"model": {}, "args": argparse.Namespace(model=3)}, path)
    assert "args.model" in refusal(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", b"\0" * 10**6)
    assert "damaged" in refusal(path)
    for data in (b"", b"PK\5\6" + b"\0" * 18, b"no zip at all" * 10):
        path.write_bytes(data)
        refusal(path)


def test_damaged_checkpoints_load_or_are_refused(tmp_path):
    path = saved(tmp_path / "a.pth")
    whole = path.read_bytes()
    random = np.random.default_rng(0)
    refused = 0
    for trial in range(40):
        data = bytearray(whole)
        # Most of the file is weights; its pickle is at the front, the directory at the end.
        at = (random.integers(6000), -random.integers(1, 6000), random.integers(len(data)))
        if trial % 4 == 3:
            del data[at[2] :]
        else:
            data[at[trial % 3]] ^= 1 << random.integers(8)
        path.write_bytes(data)
        try:
            load_checkpoint(path)
        except IgsrError as error:
            assert str(path) in str(error)
            refused += 1
    assert refused > 12


def test_where_checkpoints_are_searched(tmp_path, monkeypatch):
    # How Hugging Face's cache is searched is tested for Depth Anything 3.
    for name in ("IGSR_DUST3R", "HF_HUB_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))
    small, large = (f"DUSt3R_ViTLarge_BaseDecoder_{kind}" for kind in ("224_linear", "512_dpt"))
    # From the last choice to the first.
    for name, is_checkpoint in (
        ("torch/hub/checkpoints/other.pth", False),
        (f"torch/hub/checkpoints/{small}.pth", True),
        (f"hf/hub/models--naver--{large}/snapshots/bbb/model.safetensors", True),
        (f"torch/hub/checkpoints/{large}.pth", True),
    ):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        assert find_checkpoint("dust3r") == (path if is_checkpoint else None)
    monkeypatch.setenv("IGSR_DUST3R", str(tmp_path / "gone.pth"))
    with pytest.raises(IgsrError, match=r"IGSR_DUST3R names .*gone\.pth"):
        find_checkpoint("dust3r")


@pytest.mark.parametrize("before", [[], [argparse.Namespace, zipfile.ZipInfo]])
def test_torchs_safe_globals_are_restored(tmp_path, before):
    path = saved(tmp_path / "a.pth")
    with torch.serialization.safe_globals(before):
        wanted = set(torch.serialization.get_safe_globals())
        assert wanted >= set(before)
        load_checkpoint(path)
        path.write_bytes(path.read_bytes()[:-100])
        refusal(path)
        assert set(torch.serialization.get_safe_globals()) == wanted
