"""``python -m igsr_lab study poses``: cameras of an estimator compared with given ones."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import scenes
from PIL import Image

from igsr.cameras import registry
from igsr.cameras.estimate import Estimate


@pytest.fixture
def data(tmp_path, monkeypatch):
    """A capture and a folder of photos; the estimator turns the first camera upside down."""
    ring = scenes.capture(views=6, size=40)
    first = ring.views[0].camera
    turned = replace(first, viewmat=np.diag([-1.0, -1.0, 1.0, 1.0]) @ first.viewmat)
    scenes.write_capture(tmp_path / "ring", ring)
    (tmp_path / "plain").mkdir()
    for index in range(3):
        Image.fromarray(ring.views[index].image).save(tmp_path / "plain" / f"{index}.png")

    def estimator(photos, *, seed, progress=None):
        nothing = [None] * len(photos)
        cameras = [turned, *(view.camera for view in ring.views[1 : len(photos)])]
        return Estimate(cameras, None, nothing, nothing, [])

    entry = registry.Entry(lambda: estimator, lambda options: True)
    monkeypatch.setitem(registry.ESTIMATORS, "colmap", entry)
    return tmp_path


def test_the_table_has_registered_photos_and_errors(data, lab_here):
    study = ["study", "poses", data, "--out", data / "out", "--scene", "ring", "--scene", "plain"]
    done = lab_here(*study)
    assert done.returncode == 0, done.stderr
    assert "1 of 2: ring seed 0: 6 of 6 registered" in done.stderr
    # Five of the fifteen pairs have the camera that is upside down.
    assert "| ring | 0 | 6 | 6 | 0.667 |" in done.stdout
    assert "| plain | 0 | 3 | 3 | - |" in done.stdout
    report = json.loads((data / "out/study.json").read_text())
    assert report["protocol"] == {"name": "poses", "estimator": "colmap", "seeds": 1}


def test_wrong_options_are_errors(data, lab_here):
    study = ["study", "poses", data, "--out", data / "out"]
    other = lab_here(*study, "--views", "3")
    assert other.returncode == 2
    assert "No such option: --views" in other.stderr
    unknown = lab_here(*study, "--estimator", "magic")
    assert unknown.returncode == 1
    assert "estimator must be" in unknown.stderr
