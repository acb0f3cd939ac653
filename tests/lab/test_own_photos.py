"""The study ``own-photos``: folders of photos end to end, kept runs, paired differences."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import scenes
from feature_files import squeezenet_file
from PIL import Image

import igsr
from igsr.capture import Capture
from igsr.pose import registry
from igsr.pose.estimate import Estimate
from igsr_lab.study import own_photo_folders as study
from igsr_lab.study import own_photos_runs as runs
from igsr_lab.study.own_photos_tables import differences
from igsr_lab.study.photo_scenes import photo_scenes

BALL = scenes.splats(30)
#: Options of a study that is over at once.
QUICK = {"seeds": 1, "holdout": 4, "steps": 20}


@pytest.fixture(scope="module")
def made():
    return scenes.capture(views=8, size=40, scene=BALL)


@pytest.fixture
def here(made, monkeypatch):
    """Runs in this process, with an estimator that knows the cameras of all photos but the last."""
    monkeypatch.setattr(study, "in_a_process", lambda work, *given: work(*given))
    calls = []

    def known(photos, *, seed=0, progress=None):
        calls.append(len(photos))
        if len(photos) < 5:
            raise igsr.IgsrError("No cameras found: too few matches.")
        cameras = [view.camera for view in made.views[: len(photos) - 1]] + [None]
        nothing = [None] * len(photos)
        return Estimate(cameras, None, nothing, nothing, ["one was not placed"])

    entry = registry.Entry(lambda: known, lambda options: True)
    for name in registry.ESTIMATORS:
        monkeypatch.setitem(registry.ESTIMATORS, name, entry)
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


def test_folders_of_photos_end_to_end(here, data, tmp_path):
    squeezenet_file(tmp_path / "features.npz")
    told = []
    report = study.own_photos(
        data,
        tmp_path / "out",
        compare="3dgs",
        features=tmp_path / "features.npz",
        left_half=True,
        on_run=lambda done, total, row: told.append(row),
        **QUICK,
    )
    assert here == [8, 3]
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

    # Nothing is done again; another option of the fits leaves the cameras as they are.
    count = len(told)
    again = study.own_photos(
        data, tmp_path / "out", compare="3dgs", features=tmp_path / "features.npz",
        left_half=True, **QUICK, on_run=lambda done, total, row: told.append(row),
    )  # fmt: skip
    assert again == report
    assert len(told) == count
    study.own_photos(data, tmp_path / "out", scenes=("ball",), max_size=30, **QUICK,
                     on_run=lambda done, total, row: told.append(row))  # fmt: skip
    assert len(here) == 2
    assert told[count:] == [told[-1]]
    assert told[-1]["fit_size"] == told[-1]["score_size"] == [30, 30]


def test_photos_are_scored_at_one_size_whatever_was_fitted(here, data, tmp_path):
    (row,) = study.own_photos(
        data, tmp_path / "out", scenes=("ball",), max_size=20, score_size=32, **QUICK
    )["runs"]
    assert (row["fit_size"], row["score_size"]) == ([20, 20], [32, 32])


def test_known_cameras_are_used_only_where_asked_for(here, made, tmp_path):
    everything = [replace(view, split="train") for view in made.views]
    scenes.write_capture(tmp_path / "data/ball", Capture(made.path, everything))
    folder = next(path for path in (tmp_path / "data/ball").iterdir() if path.is_dir())
    if folder.name != "images":
        folder.rename(folder.with_name("images"))
        cameras = tmp_path / "data/ball/transforms.json"
        cameras.write_text(cameras.read_text().replace(f"{folder.name}/", "images/"))
    (row,) = study.own_photos(tmp_path / "data", tmp_path / "a", known_cameras=True, **QUICK)[
        "runs"
    ]
    assert here == []
    assert list(row["parts"]) == ["decode", "fit", "score"]
    assert row["placed"] == row["photos"] == 8
    (row,) = study.own_photos(tmp_path / "data", tmp_path / "b", **QUICK)["runs"]
    assert here == [8]
    assert row["placed"] == 7


def test_moved_cameras_are_those_that_fitted_photos_are_scored_with(here, data, tmp_path):
    options = {**QUICK, "steps": 60}
    (row,) = study.own_photos(
        data, tmp_path / "out", scenes=("ball",), preset="instantsplat", score_size=30, **options
    )["runs"]
    assert row["train_psnr"] > row["psnr"]


def test_cameras_at_another_size_see_the_same(made):
    view = made.views[0]
    smaller = replace(view.camera, K=np.diag([0.5, 0.5, 1.0]) @ view.camera.K, width=20, height=20)
    assert runs._with_camera(view, smaller).camera == view.camera


def row(scene, preset, seed, values, **more):
    views = [{"name": str(k), "psnr": value, "ms_ssim": None} for k, value in enumerate(values)]
    whole = {"train_psnr": 1.0, "train_ssim": 1.0, "splats": 10, "seconds": 1.0, "cpu_seconds": 1.0}
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


def test_which_folders_are_scenes(data, made, tmp_path):
    assert photo_scenes(data) == (data, ["ball", "few"])
    assert photo_scenes(data, ["few"]) == (data, ["few"])
    assert photo_scenes(data / "ball") == (data, ["ball"])
    assert photo_scenes(data.parent, ["data/few"]) == (data.parent, ["data/few"])
    for where, names, message in (
        (tmp_path / "nowhere", None, "does not exist"),
        (data / "text", None, "holds no photos and no folder with photos"),
        (data, ["text"], "text holds no photos; name another --scene"),
        (data, ["few", "few/"], "few/ is named twice"),
    ):
        with pytest.raises(igsr.IgsrError, match=message):
            photo_scenes(where, names)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seeds": 0}, "seeds must be at least 1, not 0"),
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
def test_what_cannot_be_used_is_told_before_anything_slow(here, data, tmp_path, options, message):
    with pytest.raises(igsr.IgsrError, match=message):
        study.own_photos(data, tmp_path / "out", **options)
    assert here == []


def test_a_study_does_not_write_into_a_scene(here, data):
    with pytest.raises(igsr.IgsrError, match="name another --out"):
        study.own_photos(data / "few", data / "few/out", **QUICK)
    assert not (data / "few/out").exists()


def test_a_process_that_dies_is_a_sentence():
    import os

    from igsr._internal.worker_processes import in_a_process

    assert in_a_process(os.getpid) != os.getpid()
    with pytest.raises(igsr.IgsrError, match="may have run out of memory"):
        in_a_process(os._exit, 9)
