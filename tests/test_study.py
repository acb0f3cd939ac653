"""``igsr study``: the protocol's views, rows that survive, sums that are right."""

from __future__ import annotations

import json

import numpy as np
import pytest
import scenes

import igsr
from igsr.capture import Capture
from igsr.presets import preset_settings
from igsr.study import blender, blender8
from igsr.study.blender import VIEW_IDS, Fit, run_fit, with_train_views
from igsr.study.summary import summarized


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder with one scene of 100 train and 2 test views of 16 x 16 pixels."""
    folder = tmp_path_factory.mktemp("data")
    made = scenes.capture(views=102, size=16, alpha=True, scene=scenes.splats(count=10))
    for split, views in (("train", made.views[:100]), ("test", made.views[100:])):
        scenes.write_capture(folder / "ball", Capture(made.path, views))
        (folder / "ball/transforms.json").rename(folder / f"ball/transforms_{split}.json")
    return folder


def test_the_protocols_views_are_fitted(data):
    capture = igsr.load_capture(data / "ball")
    chosen = with_train_views(capture, VIEW_IDS["75"])
    names = [view.name for view in chosen.train_views]
    assert names == [f"photos/{i:02d}.png" for i in (26, 86, 2, 55, 75, 93, 16, 73)]
    assert len(chosen.test_views) == 2
    few = Capture(capture.path, capture.views[:50])
    with pytest.raises(igsr.IgsrError, match="needs number 93"):
        with_train_views(few, VIEW_IDS["75"])


def test_a_study_is_written_and_goes_on_where_it_stopped(data, tmp_path, monkeypatch):
    done = []

    def quick(folder, one):
        done.append(one)
        if len(done) == 3:
            raise igsr.IgsrError("out of patience")
        return {
            **vars(one),
            "psnr": 20.0 + one.seed + (one.preset == "default"),
            "ssim": 0.9,
            "flip": 0.1,
            "splats": 10,
            "seconds": 1.0,
            "protocol": {"views": 2},
        }

    monkeypatch.setattr(blender, "run_fit", quick)
    options = {"scenes": ("ball",), "views": ("75",), "seeds": 2}
    with pytest.raises(igsr.IgsrError, match="out of patience"):
        blender8(data, tmp_path / "out", **options)
    assert len(list((tmp_path / "out/runs").iterdir())) == 2
    report = blender8(data, tmp_path / "out", **options)
    assert len(done) == 5, "two were not done again"
    assert report["runs"][0]["settings"] == preset_settings("default", 8)
    assert report == json.loads((tmp_path / "out/study.json").read_text())
    assert report["mean"]["default"]["psnr"] == 21.5
    assert report["mean"]["default"]["psnr_spread"] == pytest.approx(np.sqrt(0.5))
    assert report["scenes"]["ball"]["3dgs"]["psnr"] == 20.5
    table = (tmp_path / "out/study.md").read_text()
    assert "| mean | default | 21.50 ± 0.71 |" in table
    assert (tmp_path / "out/study.png").stat().st_size > 1000

    # A preset that has changed since is fitted again.
    file = tmp_path / "out/runs/ball-views75-default-seed0-cpu.json"
    row = json.loads(file.read_text())
    row["settings"]["steps"] += 1
    file.write_text(json.dumps(row))
    assert blender8(data, tmp_path / "out", **options) == report
    assert len(done) == 6


def test_a_real_fit_of_the_study(data, monkeypatch):
    from igsr import presets

    short = presets.Preset(30, 300, 0, "fixed", 0.2, True, "auto")
    monkeypatch.setattr(presets, "_FEW", short)
    row = run_fit(str(data), Fit("ball", "76", "default", 1, "cpu"))
    assert row["psnr"] > 10.0
    assert row["splats"] <= 300
    assert row["protocol"]["views"] == 2
    assert row["protocol"]["background"] == [1.0, 1.0, 1.0]


def test_spread_is_over_seeds_not_scenes():
    rows = [
        {"seed": seed, "psnr": psnr, "ssim": 1.0, "flip": 0.0, "splats": 1, "seconds": 1.0}
        for seed, psnr in [(0, 10.0), (0, 30.0), (1, 12.0), (1, 32.0)]
    ]
    summary = summarized(rows)
    assert summary["psnr"] == 21.0
    assert summary["psnr_spread"] == pytest.approx(np.sqrt(2.0))
    assert summarized(rows[:1])["psnr_spread"] is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scenes": ("nothing",)}, "nothing holds no transforms_train.json"),
        ({"scenes": ("ball",), "views": ("77",)}, "views must be of 75, 76"),
        ({"scenes": ("ball",), "presets": ("best",)}, "preset must be one of"),
        ({"scenes": ("ball",), "seeds": 0}, "at least 1"),
    ],
)
def test_bad_arguments(data, tmp_path, options, message):
    with pytest.raises(igsr.IgsrError, match=message):
        blender8(data, tmp_path, **options)
