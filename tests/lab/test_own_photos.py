"""Study ``own_photos``: folders of photos from cameras to scores, kept runs, differences."""

import json
from dataclasses import replace

import numpy as np
import pytest
import scenes
from feature_files import squeezenet_file
from PIL import Image

import igsr
from igsr.cameras import find
from igsr.cameras.estimate import Estimate
from igsr.capture import Capture
from igsr_lab.study import Study, own_photos, own_photos_study
from igsr_lab.study.own_photos_report import differences
from igsr_lab.study.own_photos_study import photo_scenes

BALL = scenes.splats(30)
#: Options of a study that takes no time.
QUICK = {"holdout": 4, "steps": 20}


@pytest.fixture(scope="module")
def made():
    return scenes.capture(views=8, size=40, scene=BALL)


@pytest.fixture
def calls(made, monkeypatch):
    """Runs in this process, with an estimator that places all photos except the last."""
    monkeypatch.setattr(own_photos_study, "in_a_process", lambda work, *given: work(*given))
    calls = []

    def known(photos, options, seed, progress):
        calls.append(len(photos))
        if len(photos) < 5:
            raise igsr.IgsrError("No cameras found: too few matches.")
        cameras = [view.camera for view in made.views[: len(photos) - 1]] + [None]
        nothing = [None] * len(photos)
        return Estimate(cameras, None, nothing, nothing, ["one was not placed"])

    monkeypatch.setattr(find, "auto_estimate", known)
    return calls


def write_photos(folder, views):
    folder.mkdir(parents=True)
    for k, view in enumerate(views):
        Image.fromarray(view.image).save(folder / f"{k:02d}.png")


@pytest.fixture
def data(made, tmp_path):
    write_photos(tmp_path / "data/ball/images", made.views)
    write_photos(tmp_path / "data/few", made.views[:3])
    (tmp_path / "data/text").mkdir()
    (tmp_path / "data/text/notes.txt").write_text("no photo")
    return tmp_path / "data"


def test_folders_of_photos_are_fitted_and_scored(calls, data, tmp_path):
    features = tmp_path / "features.npz"
    squeezenet_file(features)
    seen = []
    study = Study(data, tmp_path / "out", seeds=1, on_run=lambda done, total, row: seen.append(row))
    options = {"compare": "3dgs", "features": features, "left_half": True, **QUICK}
    report = own_photos(study, **options)
    assert calls == [8, 3]
    before, after = report["runs"]
    assert (before["preset"], after["preset"]) == ("3dgs", "default")
    assert (after["photos"], after["placed"], after["train_photos"]) == (8, 7, 5)
    assert [row["name"] for row in after["views"]] == ["00.png", "04.png"]
    held_out = ("psnr", "ssim", "flip", "perceptual", "psnr_refined", "lh_psnr", "lh_ssim")
    for name in (*held_out, "train_psnr", "train_ssim"):
        assert np.isfinite(after[name])
    assert after["psnr"] == pytest.approx(np.mean([row["psnr"] for row in after["views"]]))
    assert after["fit_size"] == after["score_size"] == [40, 40]
    assert list(after["parts"]) == ["cameras", "decode", "fit", "score"]
    assert after["seconds"] == pytest.approx(
        sum(part["seconds"] for part in after["parts"].values()), abs=0.01
    )
    assert after["limit"]["sentence"]
    assert igsr.Splats.load(tmp_path / "out/splats/ball-default-seed0-cpu.ply")
    for preset in ("default", "3dgs"):
        sheet = Image.open(tmp_path / f"out/sheets/ball-{preset}.png")
        assert sheet.height > 2 * 40
    assert report == json.loads((tmp_path / "out/study.json").read_text())
    table = (tmp_path / "out/study.md").read_text()
    assert "| ball | 7 of 8 | default |" in table
    assert "## default minus 3dgs" in table
    assert "* few: No cameras found: too few matches." in table
    assert (tmp_path / "out/study.png").stat().st_size > 1000

    # Finished runs are kept; another size keeps the cameras.
    count = len(seen)
    assert own_photos(study, **options) == report
    assert len(seen) == count
    own_photos(study, scenes=("ball",), max_size=30, **QUICK)
    assert len(calls) == 2
    assert seen[count:] == [seen[-1]]
    assert seen[-1]["fit_size"] == seen[-1]["score_size"] == [30, 30]


def test_known_cameras_are_used_only_if_asked_for(calls, made, tmp_path):
    views = [
        replace(view, name=view.name.replace("photos/", "images/"), split="train")
        for view in made.views
    ]
    scenes.write_capture(tmp_path / "data/ball", Capture(made.path, views))
    study = Study(tmp_path / "data", tmp_path / "a", seeds=1)
    (row,) = own_photos(study, known_cameras=True, **QUICK)["runs"]
    assert calls == []
    assert list(row["parts"]) == ["decode", "fit", "score"]
    assert row["placed"] == row["photos"] == 8
    (row,) = own_photos(replace(study, out=tmp_path / "b"), **QUICK)["runs"]
    assert calls == [8]
    assert row["placed"] == 7


def test_photos_are_scored_at_one_size_and_fitted_ones_with_moved_cameras(calls, data, tmp_path):
    study = Study(data, tmp_path / "out", seeds=1)
    options = {"preset": "instantsplat", "max_size": 20, "score_size": 30, **QUICK, "steps": 60}
    (row,) = own_photos(study, scenes=("ball",), **options)["runs"]
    assert (row["fit_size"], row["score_size"]) == ([20, 20], [30, 30])
    assert row["train_psnr"] > row["psnr"]


def row(scene, preset, seed, values, **more):
    views = [{"name": str(k), "psnr": value, "ms_ssim": None} for k, value in enumerate(values)]
    whole = dict.fromkeys(("train_psnr", "train_ssim", "splats", "seconds", "cpu_seconds"), 10.0)
    return {"scene": scene, "preset": preset, "seed": seed, "views": views, **whole, **more}


def test_differences_are_paired_by_photo_and_seed():
    rows = [
        row("a", "old", 1, [20.0, 30.0]),
        row("a", "new", 1, [22.0, 31.0], splats=30),
        row("a", "old", 0, [20.0, 30.0]),
        row("a", "new", 0, [23.0, 34.0], splats=20),
        row("b", "old", 0, [10.0]),
        row("b", "new", 0, [9.0]),
        row("b", "old", 1, [10.0]),
        row("b", "new", 1, [9.0]),
    ]
    found = differences(rows, "old", "new")
    # By photo, over seeds: 2.5 and 2.5; by seed, over photos: 3.5 and 1.5.
    a = found["scenes"]["a"]["psnr"]
    assert a == {"mean": 2.5, "error": 0.0, "seeds": pytest.approx(np.sqrt(2.0))}
    assert found["scenes"]["b"]["psnr"] == {"mean": -1.0, "error": None, "seeds": 0.0}
    assert found["mean"]["psnr"] == {"mean": 0.75, "error": pytest.approx(1.75)}
    assert found["scenes"]["a"]["splats"]["mean"] == 15.0
    assert "ms_ssim" not in found["mean"], "no photo has it"


def test_folders_with_photos_are_scenes(data, tmp_path):
    assert photo_scenes(data) == (data, ["ball", "few"])
    assert photo_scenes(data, ["few"]) == (data, ["few"])
    assert photo_scenes(data / "ball") == (data, ["ball"])
    assert photo_scenes(data.parent, ["data/few"]) == (data.parent, ["data/few"])
    for folder, names, message in (
        (tmp_path / "nowhere", None, "does not exist"),
        (data / "text", None, "holds no photos and no folder with photos"),
        (data, ["text"], "text holds no photos; name another --scene"),
        (data, ["few", "few/"], "few/ is named twice"),
    ):
        with pytest.raises(igsr.IgsrError, match=message):
            photo_scenes(folder, names)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_size": 0}, "max_size must be at least 1, not 0"),
        ({"score_size": -1}, "score_size must be at least 1"),
        ({"steps": 0}, "steps must be at least 1"),
        ({"holdout": 1}, "holdout must be at least 2"),
        ({"preset": "best"}, "preset must be one of"),
        ({"compare": "best"}, "preset must be one of"),
        ({"compare": "default"}, "compare is 'default', as preset"),
        ({"features": "missing.npz"}, "missing.npz"),
    ],
)
def test_bad_arguments_are_refused_before_cameras_are_sought(calls, data, options, message):
    with pytest.raises(igsr.IgsrError, match=message):
        own_photos(Study(data, data.parent / "out"), **options)
    # A study does not write into a scene.
    with pytest.raises(igsr.IgsrError, match="name another --out"):
        own_photos(Study(data / "few", data / "few/out"), **QUICK)
    assert not (data / "few/out").exists()
    assert calls == []
