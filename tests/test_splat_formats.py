"""Splat files in every format, from Python: agreement with decoders in numpy, and ``convert``."""

import json
import os
import re
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
import splat_decoders
from typer.testing import CliRunner

import igsr
from igsr.cli import app
from igsr.rendering.renders import render
from igsr.splats import SPLAT_ENDINGS, Splats

WRITABLE = ("ply", "compressed.ply", "splat", "spz", "sog", "glb", "gltf")
#: An optional folder of splat files from other programs.
OTHERS = os.environ.get("IGSR_FORMAT_FILES")


def unit(quats):
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    return quats * np.where(quats[:, :1] < 0, -1.0, 1.0)


def assert_agrees(path):
    """Our reader and numpy's find the same splats in a file; how many."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ours = igsr.Splats.load(path)
    theirs = splat_decoders.decode(path)
    assert len(ours) == len(theirs["means"])
    world = ours.means.astype(np.float64) + ours.origin
    scale = max(1.0, float(np.abs(world).max(initial=0.0)))
    assert np.abs(world - theirs["means"]).max(initial=0.0) <= 2e-7 * scale
    assert np.abs(ours.scales - theirs["scales"]).max(initial=0.0) <= 2e-6
    colors = 0.5 + splat_decoders.C0 * ours.sh[:, 0].astype(np.float64)
    assert np.abs(colors - theirs["colors"]).max(initial=0.0) <= 1e-6
    opacities = 1 / (1 + np.exp(-ours.opacities.astype(np.float64)))
    # Bytes of 0 and 255 are a quarter of a step off, to have a logit.
    assert np.abs(opacities - theirs["opacities"]).max(initial=0.0) <= 0.2501 / 255
    dots = np.abs((unit(ours.quats.astype(np.float64)) * unit(theirs["quats"])).sum(axis=1))
    assert dots.min(initial=1.0) >= 1 - 1e-6
    assert ours.sh[:, 1:].shape == theirs["sh"].shape
    assert np.abs(ours.sh[:, 1:] - theirs["sh"]).max(initial=0.0) <= 1e-6
    return len(ours)


@pytest.mark.parametrize("ending", [ending for ending in WRITABLE if ending != "gltf"])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_readers_agree_with_numpy_decoders(tmp_path, ending, degree):
    path = tmp_path / f"scene.{ending}"
    splats = scenes.splats(degree=degree)
    # Within the range of every format.
    splats.sh = np.clip(splats.sh, -0.99, 0.99)
    notes = splats.save(path)
    assert bool(notes) == (ending == "splat" and degree > 0)
    assert assert_agrees(path) == len(splats)


if OTHERS is not None:  # for measuring: such files are not the project's

    def test_files_of_other_programs_agree_with_numpy():
        files = [path for path in sorted(Path(OTHERS).iterdir()) if path.suffix in SPLAT_ENDINGS]
        assert files
        for path in files:
            if path.suffix == ".spz" and path.read_bytes().startswith(b"NGSP"):
                # numpy cannot unpack version 4.
                assert len(igsr.Splats.load(path)) > 0
                continue
            assert assert_agrees(path) > 0, path


def test_pictures_survive_every_format(tmp_path):
    splats = scenes.splats(degree=0)
    camera = scenes.ring_camera(0.4)
    before = igsr.render(splats, camera, backend="cpu").color
    for ending in WRITABLE:
        path = tmp_path / f"scene.{ending}"
        splats.save(path)
        after = igsr.render(igsr.Splats.load(path), camera, backend="cpu").color
        # Log-scales of .spz are off by up to 1/32, and splats of equal depth change places.
        assert np.abs(after - before).mean() < 5e-3, ending
        assert before.max() > 0.3


def test_the_antialiased_flag_survives_files(tmp_path):
    splats = scenes.splats(degree=0)
    splats.scales -= 3.0
    camera = scenes.ring_camera(0.4)
    classic = igsr.render(splats, camera, backend="cpu").color
    splats.antialiased = True
    drawn = igsr.render(splats, camera, backend="cpu").color
    assert np.abs(drawn - classic).max() > 0.05
    for ending in WRITABLE:
        path = tmp_path / f"scene.{ending}"
        notes = splats.save(path)
        assert igsr.Splats.load(path).antialiased == (ending != "splat")
        assert any("antialiased" in note for note in notes) == (ending in ("splat", "glb", "gltf"))


def test_fits_refuse_antialiased_splats():
    splats = scenes.splats(degree=0)
    splats.antialiased = True
    with pytest.raises(igsr.IgsrError, match="ntialiased"):
        igsr.compact(splats)
    with pytest.raises(igsr.IgsrError, match="ntialiased"):
        igsr.refine_cameras(splats, [], (0.0, 0.0, 0.0))


def test_convert_reports_lost_data(tmp_path):
    scene, target = tmp_path / "scene.ply", tmp_path / "new" / "scene.splat"
    splats = scenes.splats(degree=2, origin=(100.0, 0.0, 0.0))
    splats.sh = np.clip(splats.sh, -1.5, 1.5)
    splats.save(scene)
    done = CliRunner().invoke(app, ["convert", str(scene), str(target)])
    assert done.exit_code == 0, done.output
    assert "view-dependent" in done.stderr
    assert "origin" in done.stderr
    assert f"40 splats in {target}" in done.stdout
    done = CliRunner().invoke(app, ["convert", str(scene), str(target), "--json"])
    report = json.loads(done.stdout)
    assert report["splats"] == 40
    assert len(report["notes"]) == 2
    assert report["bytes"] == target.stat().st_size == 40 * 32
    told = json.loads(CliRunner().invoke(app, ["info", str(target), "--json"]).stdout)
    assert (told["splats"], told["sh_degree"], told["antialiased"]) == (40, 0, False)
    splats.means[:3] = np.nan
    splats.save(scene)
    done = CliRunner().invoke(app, ["convert", str(scene), str(target)])
    assert f"37 splats in {target}" in done.stdout
    assert "3 splats that cannot be drawn" in done.stderr


@pytest.mark.parametrize(
    ("source", "target", "word"),
    [
        ("scene.ply", "scene.ksplat", ".spz"),
        ("scene.ply", "scene.obj", ".spz"),
        ("scene.ply", "scene", ".spz"),
        ("photo.ply", "scene.spz", "photo.ply"),
        ("none.spz", "scene.spz", "none.spz"),
    ],
)
def test_convert_refuses_other_endings_and_files(tmp_path, source, target, word):
    scenes.splats(degree=0).save(tmp_path / "scene.ply")
    (tmp_path / "photo.ply").write_bytes(b"\xff\xd8\xff\xe0\x00\x10JFIF\x00" + bytes(300))
    done = CliRunner().invoke(app, ["convert", str(tmp_path / source), str(tmp_path / target)])
    assert done.exit_code == 1
    assert done.stderr.count("\n") == 1
    assert word in done.stderr
    assert not (tmp_path / target).exists()


def test_ignored_parts_of_a_file_are_warnings(tmp_path):
    path = tmp_path / "scene.gltf"
    scenes.splats(degree=0).save(path)
    document = json.loads(path.read_text())
    document["meshes"][0]["primitives"].append({"attributes": {}})
    path.write_text(json.dumps(document))
    with pytest.warns(UserWarning, match="without splats"):
        assert len(igsr.Splats.load(path)) == 40


def foreign_ply(path, *, comment="", dtype="<f4", scales=3):
    """A .ply of three splats by another program."""
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += [f"scale_{k}" for k in range(scales)] + [f"rot_{k}" for k in range(4)]
    values = np.random.default_rng(0).normal(size=(3, len(names))).astype(dtype)
    kind = {"<f4": "float", "<f8": "double"}[dtype]
    lines = ["ply", "format binary_little_endian 1.0", f"comment {comment}", "element vertex 3"]
    lines += [f"property {kind} {name}" for name in names] + ["end_header", ""]
    path.write_bytes("\n".join(lines).encode() + values.tobytes())
    return values


@pytest.mark.parametrize(
    ("comment", "antialiased"),
    [
        ("antialiased", True),
        ("antialiased 1", True),
        ("antialiased 0", False),
        ("SplatRenderMode: mip", True),
        ("SplatRenderMode: default", False),
        ("origin unknown", False),
        ("origin 1 2 inf", False),
    ],
)
def test_comments_of_other_programs(tmp_path, comment, antialiased):
    foreign_ply(tmp_path / "a.ply", comment=comment)
    splats = igsr.Splats.load(tmp_path / "a.ply")
    assert (splats.antialiased, splats.origin.tolist()) == (antialiased, [0.0, 0.0, 0.0])
    splats.save(tmp_path / "b.ply")
    assert (b"comment SplatRenderMode: mip\n" in (tmp_path / "b.ply").read_bytes()) == antialiased


def test_doubles_are_read_and_flat_splats_are_named(tmp_path):
    values = foreign_ply(tmp_path / "a.ply", dtype="<f8")
    splats = igsr.Splats.load(tmp_path / "a.ply")
    assert np.array_equal(splats.means, values[:, :3].astype(np.float32))
    assert np.array_equal(splats.quats, values[:, -4:].astype(np.float32))
    foreign_ply(tmp_path / "a.ply", scales=2)
    with pytest.raises(igsr.IgsrError, match=r"a\.ply: has flat splats of 2DGS"):
        igsr.Splats.load(tmp_path / "a.ply")


def ply_with(path, model, **columns):
    """Write a model with changed or further columns."""
    model.save(path)
    head, body = path.read_bytes().split(b"end_header\n", 1)
    names = re.findall(r"property float (\S+)", head.decode())
    rows = np.frombuffer(body, "<f4").reshape(len(model), -1)
    table = dict(zip(names, rows.T, strict=True)) | columns
    new = [name for name in columns if name not in names]
    head += b"".join(b"property float %s\n" % name.encode() for name in new)
    values = np.stack([np.broadcast_to(value, len(model)) for value in table.values()], axis=1)
    path.write_bytes(head + b"end_header\n" + values.astype("<f4").tobytes())


def test_infinite_logits_and_flat_splats_are_drawn(tmp_path, igsr_here):
    model, camera = scenes.splats(count=60), scenes.ring_camera(0.3)
    opaque = replace(model, opacities=np.full(60, 30.0, np.float32))
    flat = replace(
        model,
        scales=model.scales * np.array([1, 1, 0], np.float32) - np.array([0, 0, 30], np.float32),
    )
    for name, columns, same in (
        ("opaque.ply", {"opacity": np.inf}, opaque),
        ("flat.ply", {"scale_2": -np.inf}, flat),
    ):
        path = tmp_path / name
        ply_with(path, model, **columns)
        read = Splats.load(path)
        assert read.finite.all()
        difference = render(read, camera).color - render(same, camera).color
        assert np.abs(difference).max() < 1e-5
        done = igsr_here("convert", path, tmp_path / "out.spz")
        assert done.returncode == 0
        assert "60 splats" in done.stdout
    ply_with(tmp_path / "clear.ply", model, opacity=-np.inf)
    assert render(Splats.load(tmp_path / "clear.ply"), camera).alpha.max() == 0.0


def test_splats_that_are_not_finite_are_counted(tmp_path, igsr_here):
    model = scenes.splats(count=60)
    model.means[:3] = np.nan
    model.save(tmp_path / "scene.ply")
    done = igsr_here("render", tmp_path / "scene.ply", "--orbit", 2, "--out", tmp_path / "o.mp4")
    assert "3 of 60 splats are not finite and not drawn." in done.stderr


def test_the_filter_of_mip_splatting_is_applied(tmp_path):
    model = scenes.splats(count=60)
    ply_with(tmp_path / "mip.ply", model, filter_3D=0.1)
    with pytest.warns(UserWarning, match="3D filter of Mip-Splatting is applied"):
        read = Splats.load(tmp_path / "mip.ply")
    variances = np.exp(2.0 * model.scales.astype(np.float64))
    wider = variances + 0.1**2
    kept = np.sqrt((variances / wider).prod(axis=1))
    opacities = kept / (1.0 + np.exp(-model.opacities.astype(np.float64)))
    np.testing.assert_allclose(np.exp(2.0 * read.scales), wider, rtol=1e-5)
    np.testing.assert_allclose(1.0 / (1.0 + np.exp(-read.opacities)), opacities, rtol=1e-5)
    assert read.antialiased


def test_logarithms_of_scales_in_gltf_are_read(tmp_path):
    # As splat-transform wrote them until June 2026; the specification asks for linear scales.
    model, path = scenes.splats(count=60), tmp_path / "scene.glb"
    model.save(path)
    content = path.read_bytes()
    linear = np.exp(model.scales.astype(np.float64)).astype(np.float32)
    found = [
        o
        for o in range(0, len(content) - 12, 4)
        if np.allclose(np.frombuffer(content, "<f4", 3, o), linear[0], rtol=1e-6)
    ]
    assert len(found) == 1
    logs = np.log(np.frombuffer(content, "<f4", 180, found[0])).tobytes()
    path.write_bytes(content[: found[0]] + logs + content[found[0] + 720 :])
    with pytest.warns(UserWarning, match="its scales are logarithms"):
        read = Splats.load(path)
    np.testing.assert_allclose(read.scales, model.scales, atol=1e-5)


def test_an_unknown_required_extension_is_named(tmp_path):
    path = tmp_path / "a.gltf"
    scenes.splats().save(path)
    document = json.loads(path.read_text())
    document["extensionsRequired"] = [*document.get("extensionsRequired", []), "EXT_other"]
    path.write_text(json.dumps(document))
    with pytest.raises(igsr.IgsrError, match=r"a\.gltf: requires EXT_other, which igsr cannot"):
        igsr.Splats.load(path)


def test_another_tag_of_antialiased_splats_in_sog(tmp_path):
    scenes.splats(degree=0).save(tmp_path / "a.sog")
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files["meta.json"]) | {"model": "antialiased"}
    meta.pop("antialias", None)
    with zipfile.ZipFile(tmp_path / "b.sog", "w") as archive:
        for name, content in (files | {"meta.json": json.dumps(meta).encode()}).items():
            archive.writestr(name, content)
    assert igsr.Splats.load(tmp_path / "b.sog").antialiased
