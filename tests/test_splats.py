"""Splats: shapes are checked, files come back as they went, damage is refused."""

import dataclasses
import json
import os
import subprocess
import sys

import numpy as np
import pytest
import scenes

import igsr
from igsr.geometry.camera_paths import orbit
from igsr.splats import subset


@pytest.mark.parametrize("degree", range(5))
def test_saved_splats_load_with_the_same_bits(tmp_path, degree):
    splats = scenes.splats(degree=degree)
    path = tmp_path / "new folder" / "scene.ply"
    splats.save(path)
    loaded = igsr.Splats.load(path)
    for field in dataclasses.fields(splats):
        assert np.array_equal(getattr(loaded, field.name), getattr(splats, field.name)), field.name
    assert loaded.sh_degree == degree


def test_far_origin_survives_a_file(tmp_path):
    splats = scenes.splats(origin=(1e6, -2e6, 30.0))
    path = tmp_path / "scene.ply"
    splats.save(path)
    camera = scenes.ring_camera(0.4, center=splats.origin)
    before = igsr.render(splats, camera, backend="cpu").color
    after = igsr.render(igsr.Splats.load(path), camera, backend="cpu").color
    at_zero = igsr.render(scenes.splats(), scenes.ring_camera(0.4), backend="cpu").color
    assert np.array_equal(before, after)
    assert np.abs(before - at_zero).max() < 1e-3
    assert before.max() > 0.3


def test_an_empty_scene_is_valid(tmp_path):
    empty = subset(scenes.splats(), slice(0))
    assert empty.bounds() is None
    empty.save(tmp_path / "empty.ply")
    assert len(igsr.Splats.load(tmp_path / "empty.ply")) == 0
    picture = igsr.render(empty, scenes.ring_camera(0.0), (0.1, 0.2, 0.3), "cpu")
    assert np.allclose(picture.color, [0.1, 0.2, 0.3], atol=1e-7)
    assert not picture.expected_depth.any()


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("means", lambda a: a[:, :2]),
        ("quats", lambda a: a[:-1]),
        ("scales", lambda a: a.astype(np.float64)),
        ("opacities", lambda a: a[:, None]),
        ("sh", lambda a: a[:, :3]),
        ("sh", lambda a: a[0]),
        ("origin", lambda a: a * np.nan),
        ("means", lambda a: a.tolist()),
        ("means", lambda a: 5),
        ("means", lambda a: np.float32(5).reshape(())),
    ],
)
def test_wrong_arrays_are_named(name, change):
    arrays = vars(scenes.splats())
    with pytest.raises(ValueError, match=name):
        igsr.Splats(**{**arrays, name: change(arrays[name])})


def test_damaged_files_are_refused_by_name(tmp_path):
    path = tmp_path / "scene.ply"
    scenes.splats().save(path)
    content = path.read_bytes()
    for damaged in (
        b"",
        b"solid cube",
        content[:60],
        content[:-1],
        content.replace(b"element vertex 40", b"element vertex 4000000000"),
        content.replace(b"property float opacity", b"property float opaqueness"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(igsr.IgsrError, match=r"scene\.ply"):
            igsr.Splats.load(path)
    with pytest.raises(igsr.IgsrError, match="no splat file"):
        igsr.Splats.load(tmp_path / "none.ply")


def test_bounds_are_in_the_world_and_ignore_nonfinite_splats_as_orbits_do():
    splats = scenes.splats(origin=(10.0, 20.0, 30.0))
    splats.means[3, 1] = np.nan
    splats.means[4, 0] = np.inf
    splats.opacities[5] = np.nan
    kept = splats.finite
    assert list(np.flatnonzero(~kept)) == [3, 4, 5]
    low, high = splats.bounds()
    assert np.allclose(low, splats.means[kept].min(axis=0) + [10, 20, 30], atol=1e-5)
    assert np.allclose(high, splats.means[kept].max(axis=0) + [10, 20, 30], atol=1e-5)
    for ours, theirs in zip(orbit(splats, [], 3), orbit(subset(splats, kept), [], 3), strict=True):
        assert np.array_equal(ours.viewmat, theirs.viewmat)
    splats.means[:] = np.nan
    assert splats.bounds() is None
    with pytest.raises(igsr.IgsrError, match="no finite splats"):
        orbit(splats, [], 3)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_pipes_and_devices_are_refused_at_once(tmp_path):
    """Opening a pipe would wait for a writer."""
    os.mkfifo(tmp_path / "pipe.ply")
    os.mkfifo(tmp_path / "pipe.bin")
    buffers = [{"byteLength": 4, "uri": "pipe.bin"}]
    gltf = {"extensionsUsed": ["KHR_gaussian_splatting"], "buffers": buffers}
    (tmp_path / "scene.gltf").write_text(json.dumps({"asset": {"version": "2.0"}, **gltf}))
    code = """
import sys, igsr
for path in sys.argv[1:]:
    try:
        igsr.Splats.load(path)
    except igsr.IgsrError as error:
        print(error)
"""
    command = [sys.executable, "-c", code, "pipe.ply", "scene.gltf", "/dev/zero"]
    options = {"capture_output": True, "text": True, "timeout": 30}
    result = subprocess.run(command, cwd=tmp_path, **options)
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    for name, line in zip(("pipe.ply", "pipe.bin", "/dev/zero"), lines, strict=True):
        assert name in line
        assert "is a pipe or a device" in line
