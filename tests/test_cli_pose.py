"""``igsr pose``, ``igsr export``, and ``igsr fit`` of photos without cameras."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import scenes
from PIL import Image

import igsr
from igsr.capture.undistort import Lens
from igsr.geometry.pose_errors import pose_accuracy
from igsr.pose import registry
from igsr.pose.estimate import Estimate

MADE = scenes.capture(views=6, size=40)
FIT = ["--steps", "30", "--max-splats", "200", "--sh-degree", "0", "--backend", "cpu", "--json"]


def refused(result, *words):
    assert result.returncode == 1
    assert len(result.stderr.splitlines()) == 1, result.stderr
    for word in words:
        assert str(word) in result.stderr
    assert result.stdout == ""


@pytest.fixture
def photos(tmp_path):
    """A plain folder of photos."""
    for view in MADE.views:
        path = tmp_path / "photos" / f"{view.name[-6:-4]}.png"
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(view.image).save(path)
    return tmp_path / "photos"


@pytest.fixture
def calls(monkeypatch):
    """An estimator in COLMAP's place that knows the cameras; its calls."""
    calls = []

    def make():
        def run(photos, *, seed=0, progress=None):
            calls.append([photo.name for photo in photos])
            progress("features", len(photos), len(photos))
            cameras = [view.camera for view in MADE.views[: len(photos)]]
            cameras[2] = None
            nothing = [None] * len(photos)
            points = igsr.Points(np.eye(3), np.full((3, 3), 9, np.uint8), np.array([1.0, 2.0, 3.0]))
            sentence = f"Not placed: {photos[2].name}."
            return Estimate(cameras, points, nothing, nothing, [sentence])

        return run

    for network in ("dust3r", "da3"):
        never = registry.Entry(make, lambda options: False)
        monkeypatch.setitem(registry.ESTIMATORS, network, never)
    monkeypatch.setitem(registry.ESTIMATORS, "colmap", registry.Entry(make, lambda options: True))
    return calls


def test_pose_writes_a_colmap_capture_and_a_plot(photos, calls, tmp_path, igsr_here):
    out = tmp_path / "posed"
    result = igsr_here("pose", photos, "--out", out, "--plot", "--json")
    assert result.returncode == 0, result.stderr
    assert result.stderr == "Not placed: 02.png.\n"
    report = json.loads(result.stdout)
    assert report["estimator"] == "colmap"
    assert (report["photos"], report["not_placed"]) == (6, ["02.png"])
    assert [camera["name"] for camera in report["cameras"]] == [
        f"{i:02d}.png" for i in (0, 1, 3, 4, 5)
    ]
    assert sorted(path.name for path in out.iterdir()) == ["images", "poses.png", "sparse"]
    capture = igsr.load_capture(out)
    assert [view.name for view in capture.views] == [f"images/{i:02d}.png" for i in (0, 1, 3, 4, 5)]
    for view, i in zip(capture.views, (0, 1, 3, 4, 5), strict=True):
        np.testing.assert_allclose(view.camera.viewmat, MADE.views[i].camera.viewmat, atol=1e-9)
        np.testing.assert_array_equal(view.image, MADE.views[i].image)
    np.testing.assert_allclose(capture.points.confidence, [1.0, 2.0, 3.0])
    with Image.open(out / "poses.png") as plot:
        colors = {color for _, color in plot.convert("RGB").getcolors(1 << 20)}
    assert len(colors) > 50  # five cameras, each of its own colour
    again = igsr_here("pose", photos, "--out", tmp_path / "plain")
    assert "5 of 6 photos registered by colmap" in again.stdout
    refused(igsr_here("pose", photos, "--out", out), out, "is not empty")
    assert len(calls) == 2


def test_mistakes_of_pose(photos, calls, tmp_path, igsr_here):
    out = tmp_path / "out"
    refused(igsr_here("pose", tmp_path / "nowhere", "--out", out), "nowhere")
    refused(igsr_here("pose", photos / "00.png", "--out", out), "2 photos at least", "00.png")
    refused(igsr_here("pose", photos, "--out", out, "--checkpoint", "x"), "checkpoint", "colmap")
    refused(igsr_here("pose", photos, "--out", out, "--graph", "swin-3"), "graph", "colmap")
    refused(
        igsr_here("pose", photos, "--out", out, "--estimator", "magic"),
        "magic",
        "dust3r or da3 or colmap",
    )
    refused(igsr_here("pose", photos, "--out", photos / "00.png"), "it is a file")
    given = scenes.write_capture(tmp_path / "given", MADE)
    refused(igsr_here("pose", given, "--out", out), "has cameras already", "--estimator")
    (photos / "03.png").write_bytes(b"no photo")
    result = igsr_here("pose", photos, "--out", out)
    assert result.returncode == 0
    assert "One of 6 photos is left out" in result.stderr
    assert "03.png" in result.stderr
    assert calls == [["00.png", "01.png", "02.png", "04.png", "05.png"]]


def test_nothing_placed_is_a_sentence(photos, tmp_path, igsr_here, monkeypatch):
    def make():
        def run(photos, *, seed=0, progress=None):
            nothing = [None] * len(photos)
            return Estimate(nothing, None, nothing, nothing, [])

        return run

    monkeypatch.setitem(registry.ESTIMATORS, "colmap", registry.Entry(make, lambda options: True))
    refused(
        igsr_here("pose", photos, "--out", tmp_path / "out", "--estimator", "colmap"),
        "No cameras found", "6 photos",
    )  # fmt: skip
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("form", ["colmap", "colmap-text", "transforms"])
def test_export(tmp_path, igsr_here, form):
    given = scenes.write_capture(tmp_path / "given", MADE)
    out = tmp_path / "out"
    result = igsr_here("export", given, "--format", form, "--out", out, "--json")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout) == {"out": str(out), "format": form, "views": 6}
    cameras = [view.camera for view in igsr.load_capture(out).views]
    exact = pose_accuracy(cameras, [view.camera for view in MADE.views])
    assert exact["ATE"] < 1e-9
    refused(igsr_here("export", given, "--format", form, "--out", out), "is not empty")


def test_fit_finds_cameras_once_and_keeps_them(photos, calls, tmp_path, igsr_here):
    out = tmp_path / "fitted"
    fit = ["fit", photos, "--out", out, "--holdout", "4", *FIT]
    first = igsr_here(*fit)
    assert first.returncode == 0, first.stderr
    assert "Not placed: 02.png." in first.stderr
    assert f"Cameras of 5 of 6 photos were found by colmap and are kept in {out}" in first.stderr
    report = json.loads(first.stdout)
    assert [row["name"] for row in report["views"]] == ["images/00.png", "images/05.png"]
    # Cameras that were found may be wrong for the photos held out as well.
    assert report["refined"]["psnr"] > report["psnr"]
    scene = (out / "scene.ply").read_bytes()
    resumed = igsr_here(*fit, "--resume")
    assert "The cameras found before are used" in resumed.stderr
    assert len(calls) == 1
    assert (out / "scene.ply").read_bytes() == scene
    again = igsr_here(*fit)  # a new fit, over what was there
    assert again.returncode == 0
    assert f"are used, from {out / 'capture'}; delete it to find them anew" in again.stderr
    assert len(calls) == 1
    assert (out / "scene.ply").read_bytes() == scene
    scored = igsr_here("eval", out / "scene.ply", out / "capture", "--holdout", "4", "--json")
    assert json.loads(scored.stdout)["psnr"] == report["psnr"]


def test_found_cameras_serve_any_size(photos, calls, tmp_path, igsr_here):
    out = tmp_path / "fitted"
    fit = ["fit", photos, "--out", out, "--steps", "1", *FIT[2:]]
    sizes = []
    for size in ([], ["--max-size", "30"], ["--max-size", "20"], ["--max-size", "99"]):
        result = igsr_here(*fit, *size)
        assert result.returncode == 0, result.stderr
        if size:
            assert json.loads(result.stdout)["settings"]["max_size"] == int(size[1])
        capture = igsr.load_capture(out / "capture")
        sizes.append(capture.views[0].camera.width)
        for view, i in zip(capture.views, (0, 1, 3, 4, 5), strict=True):
            true = MADE.views[i].camera
            scale = view.camera.width / true.width
            np.testing.assert_allclose(view.camera.K[:2], scale * true.K[:2], rtol=1e-15)
            np.testing.assert_allclose(view.camera.viewmat, true.viewmat, atol=1e-9)
        np.testing.assert_array_equal(capture.points.confidence, [1.0, 2.0, 3.0])
    assert sizes == [40, 30, 20, 40]
    np.testing.assert_array_equal(capture.views[0].image, MADE.views[0].image)
    assert len(calls) == 1, "cameras are found once"


def test_other_photos_and_options_are_looked_at_anew(photos, calls, tmp_path, igsr_here):
    out = tmp_path / "fitted"
    fit = ["fit", photos, "--out", out, "--steps", "1", *FIT[2:]]
    assert igsr_here(*fit).returncode == 0
    assert igsr_here(*fit, "--seed", "1").returncode == 0
    assert len(calls) == 2, "another seed may find other cameras"
    damaged = out / "capture/found.npz"
    damaged.write_bytes(damaged.read_bytes()[:200])
    refused(igsr_here(*fit, "--seed", "1", "--resume"), damaged, "cannot be read", "delete")
    assert igsr_here(*fit, "--seed", "1").returncode == 0
    assert len(calls) == 3
    Image.new("RGB", (40, 40)).save(photos / "01.png")
    refused(igsr_here(*fit, "--seed", "1", "--resume"), "cameras of other photos")
    assert igsr_here(*fit, "--seed", "1").returncode == 0
    assert len(calls) == 4
    assert not igsr.load_capture(out / "capture").views[1].image.any()


@pytest.mark.parametrize("command", ["fit", "refine"])
def test_few_placed_photos_stop_with_advice(photos, tmp_path, igsr_here, monkeypatch, command):
    calls = []

    def make():
        def run(photos, *, seed=0, progress=None):
            calls.append(len(photos))
            cameras = [MADE.views[0].camera, MADE.views[1].camera, *[None] * (len(photos) - 2)]
            nothing = [None] * len(photos)
            return Estimate(cameras, None, nothing, nothing, ["2 of 6 photos are registered."])

        return run

    for network in ("dust3r", "da3"):
        never = registry.Entry(make, lambda options: False)
        monkeypatch.setitem(registry.ESTIMATORS, network, never)
    monkeypatch.setitem(registry.ESTIMATORS, "colmap", registry.Entry(make, lambda options: True))
    out = tmp_path / "out"
    arguments = [command, photos, "--out", out, "--steps", "1", "--backend", "cpu"]
    arguments += ["--rounds", "0"] if command == "refine" else []
    for attempt in range(2):
        stopped = igsr_here(*arguments)
        assert stopped.returncode == 1
        last = stopped.stderr.splitlines()[-1]
        assert last.startswith("Only 2 of 6 photos could be placed, not 02.png, 03.png, 04.png, 05")
        assert "--allow-missing" in last
        assert "dust3r" not in last, "there is no checkpoint"
        assert not (out / "scene.ply").exists(), attempt
    assert igsr_here(*arguments, "--allow-missing").returncode == 0
    assert (out / "scene.ply").exists()
    assert calls == [6], "going on costs no search"
    with pytest.raises(igsr.IgsrError, match="allow_missing=True"):
        igsr.refine(photos, 0, steps=1, backend="cpu")
    posed = igsr_here("pose", photos, "--out", tmp_path / "posed")
    assert posed.returncode == 0
    assert len(igsr.load_capture(tmp_path / "posed").views) == 2


def test_photos_are_checked_before_cameras_are_looked_for(photos, calls, tmp_path, igsr_here):
    out = ["--out", tmp_path / "out"]
    given = scenes.write_capture(tmp_path / "given", MADE)
    for path in (photos, given):
        for command in ("fit", "refine"):
            refused(igsr_here(command, path, *out, "--max-size", "0"), "max_size is 0")
            refused(igsr_here(command, path, *out, "--max-size", "-5"), "max_size is -5")
            refused(igsr_here(command, path, *out, "--holdout", "1"), "holdout is 1")
        refused(igsr_here("refine", path, *out, "--photos", "99"), "from 1 to 6", path)
        refused(igsr_here("refine", path, *out, "--photos", "5", "--holdout", "3"), "from 1 to 4")
        hull = ["--start", "hull", "--steps", "1"]
        for shown in ([], ["--json"]):
            refused(igsr_here("fit", path, *out, *hull, *shown), "without alpha", "--start hull")
        typo = igsr_here("fit", path, *out, "--max-size", "big")
        assert (typo.returncode, "--max-size" in typo.stderr) == (2, True)
    refused(igsr_here("info", given, "--max-size", "0"), "max_size is 0")
    info = json.loads(igsr_here("info", given, "--max-size", "20", "--json").stdout)
    assert info["sizes"] == ["20x20"]
    for name in range(1, 6):
        (photos / f"0{name}.png").unlink()
    refused(igsr_here("fit", photos, *out, "--holdout", "2"), "one photo only")
    assert calls == []


def test_a_video_has_no_more_photos_than_frames(calls, tmp_path, igsr_here):
    from test_photo_folder import film, write_video

    write_video(tmp_path / "clip.mp4", film(30, set()))
    command = ["refine", tmp_path / "clip.mp4", "--out", tmp_path / "out", "--frames", "10"]
    refused(igsr_here(*command, "--photos", "11"), "--photos must be from 1 to 10")
    assert calls == []


@pytest.mark.parametrize("command", ["fit", "refine"])
def test_little_memory_is_told_before_any_work(
    photos, calls, tmp_path, igsr_here, monkeypatch, command
):
    from igsr.capture import memory_check

    given = scenes.write_capture(tmp_path / "given", MADE)
    monkeypatch.setattr(memory_check, "LIBRARY_BYTES", 0)
    monkeypatch.setattr(memory_check, "SPLAT_BYTES", 0)
    monkeypatch.setattr(memory_check, "SIZE_STEP_PX", 10)
    monkeypatch.setattr(memory_check, "available_memory", lambda: 400_000)
    for path in (photos, given):
        result = igsr_here(command, path, "--out", tmp_path / "out")
        refused(result, "The 6 photos of 40x40 would need", "are free: give --max-size 20")
    assert calls == []
    assert not (tmp_path / "out").exists()


def test_mistakes_of_fit_without_cameras(photos, calls, tmp_path, igsr_here):
    given = scenes.write_capture(tmp_path / "given", MADE)
    out = tmp_path / "out"
    refused(igsr_here("fit", given, "--out", out, "--estimator", "colmap", *FIT), "--estimator")
    refused(igsr_here("eval", "scene.ply", photos), "scene.ply")
    inside = out / "capture" / "photos"
    inside.parent.mkdir(parents=True)
    photos.rename(inside)
    refused(igsr_here("fit", inside, "--out", out, *FIT), "lies where the fit would write")
    assert len(list(inside.iterdir())) == 6
    assert calls == []


def test_captures_without_cameras_are_told_of_pose(photos, igsr_here):
    refused(igsr_here("info", photos), "6 images but no cameras", "igsr pose")


def test_lenses_are_undone(monkeypatch, photos, tmp_path, igsr_here):
    def make():
        def run(photos, *, seed=0, progress=None):
            nothing = [None] * len(photos)
            cameras = [view.camera for view in MADE.views]
            lenses = [Lens(False, (0.3,))] * len(photos)
            return Estimate(list(cameras), None, nothing, nothing, [], lenses)

        return run

    monkeypatch.setitem(registry.ESTIMATORS, "colmap", registry.Entry(make, lambda options: True))
    out = tmp_path / "out"
    assert igsr_here("pose", photos, "--out", out, "--estimator", "colmap").returncode == 0
    views = igsr.load_capture(out).views
    assert (out / "masks/00.png.png").is_file()
    assert 0.5 < views[0].mask.mean() < 1.0
    assert not np.array_equal(views[0].image, MADE.views[0].image)


def test_study_of_poses(tmp_path, lab_here, calls, monkeypatch):
    turned = replace(
        MADE.views[0].camera, viewmat=np.diag([-1.0, -1.0, 1.0, 1.0]) @ MADE.views[0].camera.viewmat
    )
    scenes.write_capture(tmp_path / "ring", MADE)
    (tmp_path / "plain").mkdir()
    for index in range(3):
        Image.fromarray(MADE.views[index].image).save(tmp_path / "plain" / f"{index}.png")

    def make():
        def run(photos, *, seed=0, progress=None):
            nothing = [None] * len(photos)
            cameras = [turned, *(view.camera for view in MADE.views[1 : len(photos)])]
            return Estimate(cameras, None, nothing, nothing, [])

        return run

    monkeypatch.setitem(registry.ESTIMATORS, "colmap", registry.Entry(make, lambda options: True))
    study = ["study", "poses", tmp_path, "--out", tmp_path / "out", "--scene", "ring"]
    done = lab_here(*study, "--scene", "plain")
    assert done.returncode == 0, done.stderr
    assert "1 of 2: ring seed 0: 6 of 6 registered" in done.stderr
    # Five of fifteen pairs have the camera that stands on its head.
    assert "| ring | 0 | 6 | 6 | 0.667 |" in done.stdout
    assert "| plain | 0 | 3 | 3 | - |" in done.stdout
    report = json.loads((tmp_path / "out/study.json").read_text())
    assert report["protocol"] == {"name": "poses", "estimator": "colmap", "seeds": 1}
    foreign = lab_here(*study, "--views", "3")
    assert foreign.returncode == 2
    assert "No such option: --views" in foreign.stderr
    refused(lab_here(*study, "--estimator", "magic"), "estimator must be")
