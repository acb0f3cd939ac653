"""``python -m igsr_lab study depths``: depth maps compared with true ones."""

from __future__ import annotations

import json

import numpy as np
import pytest
import scenes

from igsr.fitting.initialization.depth_maps import DepthMap
from igsr_lab.study import true_depths

SIZE = 24


@pytest.fixture
def data(tmp_path, monkeypatch):
    """Photos of a wall, whose depth maps are right at the top, then wrong, then empty."""
    made = scenes.capture(views=4, size=SIZE, arc=0.1)
    scenes.write_capture(tmp_path / "wall", made)
    (tmp_path / "wall/transforms.json").rename(tmp_path / "wall/transforms_train.json")
    for view in made.views:
        path = (tmp_path / "wall/depth" / view.name).with_suffix(".npy")
        path.parent.mkdir(parents=True, exist_ok=True)
        # z = 0 is seen by all, from at most 0.1 radians aside.
        np.save(path, np.full((SIZE, SIZE), 4.0, np.float32))

    def depth_maps(views):
        depth = np.repeat(np.float32([4.0, 4.03, 4.1, 0.0]), SIZE // 4)[:, None]
        depth = np.broadcast_to(depth, (SIZE, SIZE))
        normal = np.zeros((SIZE, SIZE, 3), np.float32)
        # One photo has no depth map.
        return [DepthMap(view, depth, normal, depth / 8.0) for view in views[1:]]

    monkeypatch.setattr(true_depths, "depth_maps", depth_maps)
    return tmp_path


def test_the_table_has_right_and_covered_fractions(data, lab_here):
    done = lab_here("study", "depths", data, "--out", data / "out", "--scene", "wall")
    assert done.returncode == 0, done.stderr
    assert "1 of 1: wall: 66.7 % right" in done.stderr
    row = json.loads((data / "out/study.json").read_text())["runs"][0]
    assert row["photos"] == 4
    assert row["right"] == pytest.approx(2 / 3)
    # Three of four photos, and three quarters of each.
    assert row["covered"] == pytest.approx(9 / 16, abs=0.05)
    assert "| wall | 4 | 0.667 |" in done.stdout
