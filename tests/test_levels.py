"""Levels of detail: fewer splats that look alike from afar, in cells that viewers load."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import scenes
from PIL import Image

import igsr
from igsr.capture import Camera
from igsr.capture.types import intrinsic_matrix
from igsr.rendering.levels import level_within, write_levels
from igsr.rendering.live_models import check_viewable, live_models

NAMES = ("means", "quats", "scales", "opacities", "sh")


@pytest.fixture(scope="module")
def wall():
    """A wall of many small splats, whose color changes slowly along it."""
    x, y = np.meshgrid(np.linspace(-2.0, 2.0, 60), np.linspace(-1.5, 1.5, 45))
    means = np.stack([x.ravel(), y.ravel(), 0.1 * np.sin(x.ravel())], axis=1).astype(np.float32)
    n = len(means)
    sh = np.zeros((n, 4, 3), np.float32)
    sh[:, 0, 0], sh[:, 0, 1] = means[:, 0], np.sin(2.0 * means[:, 1])
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1))
    scales = np.tile(np.log(np.array([0.06, 0.06, 0.01], np.float32)), (n, 1))
    opacities = np.full(n, 2.5, np.float32)
    return igsr.Splats(means, quats, scales, opacities, sh, origin=np.array([5.0, 0.0, -2.0]))


@pytest.fixture(scope="module")
def levels(wall, tmp_path_factory):
    """The wall at four levels, in cells of about 700."""
    folder = tmp_path_factory.mktemp("levels")
    wall.save(folder / "scene.ply")
    return folder / "out", write_levels(folder / "scene.ply", folder / "out", 4, per_cell=700)


def seen(splats, size=64, finer=1):
    """The wall; with ``finer``, each pixel is the mean of that many squared."""
    size *= finer
    viewmat = np.eye(4)
    viewmat[:3, 3] = [0.0, 0.0, 4.0] - splats.origin
    K = intrinsic_matrix(0.9 * size, 0.9 * size, size / 2, size / 2)
    color = igsr.render(splats, Camera(viewmat, K, size, size), backend="cpu").color
    return color.reshape(size // finer, finer, size // finer, finer, 3).mean(axis=(1, 3))


@pytest.mark.parametrize("level", [1, 2, 3])
def test_coarser_levels_look_similar(wall, levels, level):
    out, written = levels
    assert written.counts[0] == len(wall)
    assert 0.2 < written.counts[level] / written.counts[level - 1] < 0.3
    fewer = level_within(out / "lod-meta.json", written.counts[level])
    assert len(fewer) == written.counts[level]
    assert np.array_equal(fewer.origin, wall.origin)
    size = 64 // 2**level  # as much further away as there are fewer
    true = seen(wall, size, finer=2**level)
    error = np.sqrt(np.mean((seen(fewer, size) - true) ** 2))
    assert error < 0.08, "it looks otherwise"
    # Leaving splats out instead looks worse.
    every = np.arange(len(wall)) % 4**level == 0
    left_out = replace(wall, **{name: getattr(wall, name)[every] for name in NAMES})
    assert error < 0.8 * np.sqrt(np.mean((seen(left_out, size) - true) ** 2))


def test_merging_keeps_a_rotated_shape(wall, tmp_path):
    """Two equal splats are merged into one of the same shape."""
    quats = np.array([[0.8, 0.2, -0.5, 0.3]] * 2, np.float32)
    two = replace(wall, quats=quats, **{n: getattr(wall, n)[[0, 0]] for n in NAMES if n != "quats"})
    scales = np.log(np.array([[0.5, 0.2, 0.05]] * 2, np.float32))
    two = replace(two, scales=scales, opacities=np.full(2, -1.0, np.float32))
    two.save(tmp_path / "two.ply")
    written = write_levels(tmp_path / "two.ply", tmp_path / "out", 2)
    assert written.counts == [2, 1]
    one = level_within(tmp_path / "out/lod-meta.json", 1)
    # Twice as opaque as one of the two, and not more.
    assert 1 / (1 + np.exp(-one.opacities[0])) == pytest.approx(2 / (1 + np.e), abs=0.01)
    single = replace(two, **{name: getattr(two, name)[:1] for name in NAMES})
    single = replace(single, opacities=one.opacities)
    assert seen(one) == pytest.approx(seen(single), abs=0.02)


def test_negative_colors_are_merged_as_black(wall, tmp_path):
    """It is drawn black: merged with a white one it is gray, not black."""
    two = replace(wall, **{name: getattr(wall, name)[[0, 0]] for name in NAMES})
    sh = np.zeros((2, 1, 3), np.float32)
    sh[0], sh[1] = 0.5 / 0.28209479, -40.0
    replace(two, sh=sh).save(tmp_path / "two.ply")
    write_levels(tmp_path / "two.ply", tmp_path / "out", 2)
    one = level_within(tmp_path / "out/lod-meta.json", 1)
    assert 0.5 + 0.28209479 * one.sh[0, 0] == pytest.approx(0.5, abs=0.01)


def test_chunks_match_an_independent_decoder(levels):
    """Positions of a chunk, decoded in numpy by the published formulas, lie in its cells' boxes."""
    out, _ = levels
    index = json.loads((out / "lod-meta.json").read_text())
    leaves, nodes = [], [index["tree"]]
    while nodes:
        node = nodes.pop()
        nodes += node.get("children", [])
        leaves += [node] if "lods" in node else []
    assert len(leaves) == 4
    checked = 0
    for leaf in leaves:
        for run in leaf["lods"].values():
            path = out / index["filenames"][run["file"]]
            means = json.loads(path.read_text())["means"]
            low, high = (np.asarray(Image.open(path.parent / f))[..., :3] for f in means["files"])
            place = (low.astype(float) + 256.0 * high).reshape(-1, 3) / 65535.0
            at = np.array(means["mins"]) + place * np.subtract(means["maxs"], means["mins"])
            at = np.sign(at) * np.expm1(np.abs(at))
            at = at[run["offset"] : run["offset"] + run["count"]]
            assert (at >= np.array(leaf["bound"]["min"]) - 1e-3).all()
            assert (at <= np.array(leaf["bound"]["max"]) + 1e-3).all()
            checked += len(at)
    assert checked == index["count"]
    # A chunk is a splat file, and the index is none.
    chunk = igsr.Splats.load(out / index["filenames"][0])
    assert 300 < len(chunk) <= 700
    assert chunk.sh_degree == 1
    with pytest.raises(igsr.IgsrError, match="levels of detail; open it with"):
        igsr.Splats.load(out / "lod-meta.json")


def test_the_page_shows_the_finest_level_that_fits(levels, monkeypatch):
    out, written = levels
    check_viewable(out)
    (found,) = live_models(out)
    assert (found.path.name, found.label) == ("lod-meta.json", "out")
    assert len(found.load()) == written.counts[0]
    (alone,) = live_models(out / "lod-meta.json")
    assert alone.load() == found.load()
    coarse = level_within(out / "lod-meta.json", written.counts[0] - 1)
    assert len(coarse) == written.counts[1]
    with pytest.raises(igsr.IgsrError, match="more levels"):
        level_within(out / "lod-meta.json", 3)


@pytest.mark.parametrize("ending", ["spz", "compressed.ply", "sog"])
def test_other_formats_have_levels_too(wall, tmp_path, ending):
    wall.save(tmp_path / f"scene.{ending}")
    written = write_levels(tmp_path / f"scene.{ending}", tmp_path / "out", 2, per_cell=700)
    assert written.counts[0] == len(wall)
    found = level_within(tmp_path / "out/lod-meta.json", len(wall))
    world = igsr.Splats.load(tmp_path / f"scene.{ending}").bounds()
    assert np.allclose(found.bounds(), world, atol=1e-3)


def test_the_convert_command_writes_levels(tmp_path):
    scenes.splats(count=50).save(tmp_path / "scene.ply")

    def run(*words):
        command = [sys.executable, "-m", "igsr.cli", "convert", str(tmp_path / "scene.ply")]
        return subprocess.run([*command, *words], capture_output=True, text=True)

    done = run(str(tmp_path / "out"), "--lod", "2")
    assert done.returncode == 0, done.stderr
    assert "level 0: 50 splats" in done.stdout
    assert (tmp_path / "out/lod-meta.json").is_file()
    again = run(str(tmp_path / "out"), "--lod", "2")
    assert again.returncode != 0
    assert "is not empty" in " ".join(again.stderr.split())
    for wrong in ("9", "0", "-1"):
        refused = run(str(tmp_path / "other"), "--lod", wrong)
        assert "from 1 to 8" in " ".join(refused.stderr.split())
    told = json.loads(run(str(tmp_path / "json"), "--lod", "1", "--json").stdout)
    assert told["counts"] == [50]
    (tmp_path / "scene.ply").write_bytes(b"ply\n")
    broken = run(str(tmp_path / "other"), "--lod", "2")
    assert broken.returncode != 0
    assert "Traceback" not in broken.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["json", "out", "scene.ply"]


def test_scenes_without_levels_are_refused(wall, tmp_path):
    none = replace(wall, **{name: getattr(wall, name)[:0] for name in NAMES})
    lost = replace(wall, means=np.full_like(wall.means, np.nan))
    for splats, per_cell, message in (
        (none, 100, "no finite splats"),
        (lost, 100, "no finite splats"),
        (wall, 0, "per_cell must be at least 1"),
    ):
        splats.save(tmp_path / "scene.ply")
        with pytest.raises(igsr.IgsrError, match=message):
            write_levels(tmp_path / "scene.ply", tmp_path / "out", 2, per_cell)
    with pytest.raises(igsr.IgsrError, match=r"none.ply: cannot be opened"):
        write_levels(tmp_path / "none.ply", tmp_path / "out", 2)
    assert not (tmp_path / "out").exists()
