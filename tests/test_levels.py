"""Levels of detail: fewer splats that look alike from afar, in cells that viewers load."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import scenes

import igsr
from igsr.blocks.levels import write_levels
from igsr.blocks.merging import merged
from igsr.capture import Camera
from igsr.capture.types import intrinsic_matrix


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


def seen(splats, size=64):
    viewmat = np.eye(4)
    viewmat[:3, 3] = [0.0, 0.0, 4.0] - splats.origin
    K = intrinsic_matrix(0.9 * size, 0.9 * size, size / 2, size / 2)
    return igsr.render(splats, Camera(viewmat, K, size, size), backend="cpu").color


@pytest.mark.parametrize("part", [0.5, 0.25, 0.06])
def test_fewer_splats_look_alike(wall, part):
    count = round(part * len(wall))
    fewer = merged(wall, count)
    assert 0.5 * count <= len(fewer) <= count
    assert np.array_equal(fewer.origin, wall.origin)
    size = round(64 * part**0.5)  # as much further away as there are fewer
    error = np.sqrt(np.mean((seen(fewer, size) - seen(wall, size)) ** 2))
    assert error < 0.075, "it looks otherwise"
    # Leaving splats out instead looks worse.
    every = np.arange(len(wall)) % round(1 / part) == 0
    names = ("means", "quats", "scales", "opacities", "sh")
    left_out = replace(wall, **{name: getattr(wall, name)[every] for name in names})
    assert error < 0.7 * np.sqrt(np.mean((seen(left_out, size) - seen(wall, size)) ** 2))


def test_one_turned_splat_stays_as_it_is(wall):
    """Two at one place: their spread, turned as it is, is that of the one that they become."""
    quats = np.array([[0.8, 0.2, -0.5, 0.3]] * 2, np.float32)
    names = ("means", "scales", "opacities", "sh")
    two = replace(wall, quats=quats, **{name: getattr(wall, name)[[0, 0]] for name in names})
    scales = np.log(np.array([[0.5, 0.2, 0.05]] * 2, np.float32))
    two = replace(two, scales=scales, opacities=np.full(2, -1.0, np.float32))
    one = merged(two, 1)
    assert len(one) == 1
    single = replace(two, **{n: getattr(two, n)[:1] for n in ("quats", *names)})
    single = replace(single, opacities=one.opacities)
    assert seen(one) == pytest.approx(seen(single), abs=1e-4)


def test_levels_hold_all_splats_from_coarse_to_fine(wall, tmp_path):
    out = tmp_path / "levels"
    index = write_levels(wall, out, 3, cells=5)
    assert json.loads((out / "lod.json").read_text()) == index
    counts = [level["splats"] for level in index["levels"]]
    assert counts[2] == len(wall)
    assert counts[0] < counts[1] < counts[2]
    assert [len(level["cells"]) for level in index["levels"]] == [1, 1, 5]
    for level in index["levels"]:
        loaded = [igsr.Splats.load(out / cell["file"]) for cell in level["cells"]]
        assert sum(map(len, loaded)) == level["splats"]
        for cell, part in zip(level["cells"], loaded, strict=True):
            low, high = part.bounds()
            assert low == pytest.approx(cell["low"], abs=1e-4)
            assert high == pytest.approx(cell["high"], abs=1e-4)
    world = np.concatenate([part.means + part.origin for part in loaded])
    assert np.sort(world, axis=0) == pytest.approx(
        np.sort(wall.means + wall.origin, axis=0), abs=1e-5
    )


def test_the_command_writes_levels_and_says_what_it_cannot(tmp_path):
    scenes.splats(count=50).save(tmp_path / "scene.ply")

    def run(*words):
        command = [sys.executable, "-m", "igsr.cli", "convert", str(tmp_path / "scene.ply")]
        return subprocess.run([*command, *words], capture_output=True, text=True)

    done = run(str(tmp_path / "out"), "--lod", "2")
    assert done.returncode == 0, done.stderr
    assert "level 1: 50 splats in 1 cells" in done.stdout
    again = run(str(tmp_path / "out"), "--lod", "2")
    assert again.returncode != 0
    assert "holds something already" in " ".join(again.stderr.split())
    assert "from 1 to 8" in " ".join(run(str(tmp_path / "other"), "--lod", "9").stderr.split())
    assert not (tmp_path / "other").exists()


def test_scenes_without_levels_are_refused(wall, tmp_path):
    names = ("means", "quats", "scales", "opacities", "sh")
    none = replace(wall, **{name: getattr(wall, name)[:0] for name in names})
    lost = replace(wall, means=np.full_like(wall.means, np.nan))
    for splats, cells, message in (
        (none, None, "no splats"),
        (lost, None, "no finite splats"),
        (wall, 0, "cells must be from 1"),
    ):
        with pytest.raises(igsr.IgsrError, match=message):
            write_levels(splats, tmp_path / "out", 2, cells)
    with pytest.raises(igsr.IgsrError, match="at least one splat"):
        merged(wall, 0)
