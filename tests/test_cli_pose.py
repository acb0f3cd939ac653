"""``igsr pose``, ``igsr convert`` of captures, and ``igsr fit`` of photos without cameras."""

import json

import numpy as np
import pytest
import scenes
from PIL import Image

import igsr
from igsr.cameras import registry
from igsr.cameras.cameras_file import read_cameras_file
from igsr.cameras.estimate import Estimate
from igsr.capture import memory_check
from igsr.capture.undistort import Lens
from igsr.geometry.pose_errors import pose_accuracy

MADE = scenes.capture(views=6, size=40)
FIT = ["--steps", "30", "--max-splats", "200", "--sh-degree", "0", "--backend", "cpu", "--json"]
ONE_STEP = ["--steps", "1", *FIT[2:]]


def assert_fails(result, *words):
    """Assert that a command ended with one sentence on stderr that contains the words."""
    assert result.returncode == 1, result.stderr
    assert len(result.stderr.splitlines()) == 1, result.stderr
    for word in words:
        assert str(word) in result.stderr
    assert result.stdout == ""


@pytest.fixture
def photos(tmp_path):
    """A folder of six photos without cameras."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for number, view in enumerate(MADE.views):
        Image.fromarray(view.image).save(folder / f"{number:02d}.png")
    return folder


@pytest.fixture
def given(tmp_path):
    """The same photos with their cameras."""
    return scenes.write_capture(tmp_path / "given", MADE)


@pytest.fixture
def only(monkeypatch):
    """Replace COLMAP by a function that estimates cameras of photos without a network."""

    def replace(estimate):
        def estimator(photos, *, seed, progress):
            progress("features", len(photos), len(photos))
            return estimate(photos)

        entry = registry.Entry(lambda: estimator, lambda options: True)
        monkeypatch.setitem(registry.ESTIMATORS, "colmap", entry)
        for network in registry.NETWORKS:
            missing = registry.Entry(lambda: None, lambda options: False)
            monkeypatch.setitem(registry.ESTIMATORS, network, missing)

    return replace


def estimate_of(cameras, points=None, warnings=(), lenses=()):
    """An estimate without depths."""
    nothing = [None] * len(cameras)
    return Estimate(cameras, points, nothing, nothing, list(warnings), list(lenses))


@pytest.fixture
def calls(only):
    """Photos of each call of an estimator that places all but the third."""
    calls = []

    def estimate(photos):
        calls.append([photo.name for photo in photos])
        cameras = [view.camera for view in MADE.views[: len(photos)]]
        cameras[2] = None
        points = igsr.Points(np.eye(3), np.full((3, 3), 9, np.uint8), np.array([1.0, 2.0, 3.0]))
        return estimate_of(cameras, points, [f"Not placed: {photos[2].name}."])

    only(estimate)
    return calls


PLACED = [0, 1, 3, 4, 5]


def test_pose_writes_a_colmap_capture_and_a_plot(photos, calls, tmp_path, igsr_here):
    out = tmp_path / "posed"
    result = igsr_here("pose", photos, "--out", out, "--plot", "--json")
    assert result.returncode == 0, result.stderr
    assert result.stderr == "Not placed: 02.png.\n"
    report = json.loads(result.stdout)
    assert report["estimator"] == "auto"
    assert (report["photos"], report["not_placed"]) == (6, ["02.png"])
    assert [camera["name"] for camera in report["cameras"]] == [f"{i:02d}.png" for i in PLACED]
    np.testing.assert_allclose(report["cameras"][0]["center"], MADE.views[0].camera.center)
    assert sorted(path.name for path in out.iterdir()) == ["images", "poses.png", "sparse"]
    capture = igsr.load_capture(out)
    assert [view.name for view in capture.views] == [f"images/{i:02d}.png" for i in PLACED]
    for view, i in zip(capture.views, PLACED, strict=True):
        np.testing.assert_allclose(view.camera.viewmat, MADE.views[i].camera.viewmat, atol=1e-9)
        np.testing.assert_array_equal(view.image, MADE.views[i].image)
    np.testing.assert_allclose(capture.points.confidence, [1.0, 2.0, 3.0])
    with Image.open(out / "poses.png") as plot:
        colors = {color for _, color in plot.convert("RGB").getcolors(1 << 20)}
    assert len(colors) > 50, "five cameras of different colors"
    again = igsr_here("pose", photos, "--out", tmp_path / "plain")
    assert "5 of 6 photos placed by auto" in again.stdout
    assert_fails(igsr_here("pose", photos, "--out", out), out, "is not empty")
    assert len(calls) == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], ["nowhere"]),
        (["{photos}/00.png"], ["2 photos", "00.png"]),
        (["{photos}", "--estimator", "colmap", "--checkpoint", "x"], ["checkpoint", "colmap"]),
        (["{photos}", "--estimator", "colmap", "--graph", "swin-3"], ["graph", "colmap"]),
        (["{photos}", "--estimator", "magic"], ["magic", "colmap or dust3r or da3"]),
        (["{photos}", "--out", "{photos}/00.png"], ["it is a file"]),
        (["{given}"], ["has cameras; fit it directly", "--estimator"]),
    ],
)
def test_wrong_arguments_of_pose(photos, given, calls, tmp_path, igsr_here, words, message):
    words = [word.format(photos=photos, given=given) for word in words]
    out = [] if "--out" in words else ["--out", tmp_path / "out"]
    assert_fails(igsr_here("pose", *words, *out), *message)
    assert calls == []


def test_a_damaged_photo_is_left_out(photos, calls, tmp_path, igsr_here):
    (photos / "03.png").write_bytes(b"no photo")
    result = igsr_here("pose", photos, "--out", tmp_path / "out")
    assert result.returncode == 0
    assert "One of 6 photos is left out" in result.stderr
    assert "03.png" in result.stderr
    assert calls == [["00.png", "01.png", "02.png", "04.png", "05.png"]]


def test_no_cameras_at_all_are_an_error(photos, only, tmp_path, igsr_here):
    only(lambda photos: estimate_of([None] * len(photos)))
    result = igsr_here("pose", photos, "--out", tmp_path / "out")
    assert_fails(result, "No cameras found", "6 photos")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("form", ["colmap", "colmap-text", "transforms"])
def test_convert_writes_a_capture_in_another_format(given, tmp_path, igsr_here, form):
    out = tmp_path / "out"
    result = igsr_here("convert", given, out, "--to", form, "--json")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert report == {"capture": str(given), "target": str(out), "to": form, "views": 6}
    cameras = [view.camera for view in igsr.load_capture(out).views]
    errors = pose_accuracy(cameras, [view.camera for view in MADE.views])
    assert errors["ATE"] < 1e-9
    assert_fails(igsr_here("convert", given, out, "--to", form), "is not empty")


def test_fit_finds_cameras_once_and_keeps_them(photos, calls, tmp_path, igsr_here):
    out = tmp_path / "fitted"
    fit = ["fit", photos, "--out", out, "--holdout", "4", *FIT]
    first = igsr_here(*fit)
    assert first.returncode == 0, first.stderr
    assert first.stderr == "Not placed: 02.png.\n"
    report = json.loads(first.stdout)
    assert [row["name"] for row in report["views"]] == ["00.png", "05.png"]
    # Held-out photos are scored with refined cameras, too: found ones have errors.
    assert report["refined"]["psnr"] > report["psnr"]
    scene = (out / "scene.ply").read_bytes()
    shown = fit[:-1]
    for options in (["--resume"], []):
        again = igsr_here(*shown, *options)
        assert again.returncode == 0
        message = f"Using the cameras in {out / 'cameras.npz'}; delete it to find them again."
        assert message in again.stderr
        assert (out / "scene.ply").read_bytes() == scene
    assert len(calls) == 1


@pytest.mark.filterwarnings("ignore:Not placed")
def test_found_cameras_serve_photos_of_any_size(photos, calls, tmp_path):
    sizes = []
    for size in (None, 30, 20, 99):
        result = igsr.fit(photos, 1, out=tmp_path / "out", max_size=size, backend="cpu")
        views = result.capture.views
        sizes.append(views[0].camera.width)
        for view, i in zip(views, PLACED, strict=True):
            true = MADE.views[i].camera
            scale = view.camera.width / true.width
            np.testing.assert_allclose(view.camera.K[:2], scale * true.K[:2], rtol=1e-15)
            np.testing.assert_allclose(view.camera.viewmat, true.viewmat, atol=1e-9)
        np.testing.assert_array_equal(result.capture.points.confidence, [1.0, 2.0, 3.0])
    assert sizes == [40, 30, 20, 40]
    np.testing.assert_array_equal(views[0].image, MADE.views[0].image)
    assert len(calls) == 1


def test_cameras_of_other_photos_or_settings_are_found_again(photos, calls, tmp_path, igsr_here):
    out = tmp_path / "fitted"
    fit = ["fit", photos, "--out", out, *ONE_STEP]
    assert igsr_here(*fit).returncode == 0
    fit += ["--seed", "1"]
    assert igsr_here(*fit).returncode == 0
    assert len(calls) == 2, "another seed may give other cameras"
    damaged = out / "cameras.npz"
    damaged.write_bytes(damaged.read_bytes()[:200])
    assert_fails(igsr_here(*fit, "--resume"), damaged, "cannot be read", "delete")
    assert igsr_here(*fit).returncode == 0
    assert len(calls) == 3
    Image.new("RGB", (40, 40)).save(photos / "01.png")
    assert_fails(igsr_here(*fit, "--resume"), "have changed since")
    assert igsr_here(*fit).returncode == 0
    assert len(calls) == 4
    assert read_cameras_file(damaged).photos["01.png"] == (photos / "01.png").stat().st_size


@pytest.mark.filterwarnings("ignore:2 of 6")
@pytest.mark.parametrize("command", ["fit", "refine"])
def test_a_run_with_few_placed_photos_stops_with_advice(photos, only, tmp_path, igsr_here, command):
    calls = []

    def two(photos):
        calls.append(len(photos))
        placed = [view.camera for view in MADE.views[:2]]
        return estimate_of([*placed, *[None] * (len(photos) - 2)], None, ["2 of 6 are registered."])

    only(two)
    out = tmp_path / "out"
    words = [command, photos, "--out", out, "--steps", "1", "--backend", "cpu"]
    words += ["--rounds", "0"] if command == "refine" else []
    for _ in range(2):
        stopped = igsr_here(*words)
        assert stopped.returncode == 1
        last = stopped.stderr.splitlines()[-1]
        assert last.startswith(
            "Only 2 of 6 photos could be placed; not placed: 02.png, 03.png, 04.png, 05"
        )
        assert "--allow-missing" in last
        assert "dust3r" not in last, "its weights are missing"
        assert not (out / "scene.ply").exists()
    assert igsr_here(*words, "--allow-missing").returncode == 0
    assert (out / "scene.ply").exists()
    assert calls == [6], "cameras are found once"
    with pytest.raises(igsr.IgsrError, match="allow_missing=True"):
        igsr.refine(photos, 0, steps=1, backend="cpu")
    assert igsr_here("pose", photos, "--out", tmp_path / "posed").returncode == 0
    assert len(igsr.load_capture(tmp_path / "posed").views) == 2


@pytest.mark.parametrize("command", ["fit", "refine"])
def test_arguments_are_checked_before_cameras_are_sought(
    photos, given, calls, tmp_path, igsr_here, command
):
    out = ["--out", tmp_path / "out"]
    for path in (photos, given):
        for name, number in (("max-size", "0"), ("max-size", "-5"), ("holdout", "1")):
            refused = igsr_here(command, path, *out, f"--{name}", number)
            assert_fails(refused, f"{name.replace('-', '_')} is {number}")
        if command == "fit":
            hull = igsr_here("fit", path, *out, "--start", "hull", "--steps", "1")
            assert_fails(hull, "without alpha", "start hull")
        typo = igsr_here(command, path, *out, "--max-size", "big")
        assert (typo.returncode, "--max-size" in typo.stderr) == (2, True)
    for number in range(1, 6):
        (photos / f"0{number}.png").unlink()
    assert_fails(igsr_here(command, photos, *out, "--holdout", "2"), "one photo only")
    assert calls == []


@pytest.mark.parametrize("command", ["fit", "refine"])
def test_too_little_memory_is_an_error_before_any_work(
    photos, given, calls, tmp_path, igsr_here, monkeypatch, command
):
    monkeypatch.setattr(memory_check, "LIBRARY_BYTES", 0)
    monkeypatch.setattr(memory_check, "SPLAT_BYTES", 0)
    monkeypatch.setattr(memory_check, "SIZE_STEP_PX", 10)
    monkeypatch.setattr(memory_check, "available_memory", lambda: 400_000)
    for path in (photos, given):
        result = igsr_here(command, path, "--out", tmp_path / "out")
        assert_fails(result, "The 6 photos of 40x40 would need", "are free: give --max-size 20")
    assert calls == []
    assert not (tmp_path / "out").exists()


def test_an_estimator_is_for_photos_without_cameras(photos, given, calls, tmp_path, igsr_here):
    options = ["--out", tmp_path / "out", "--estimator", "colmap", *FIT]
    assert_fails(igsr_here("fit", given, *options), "has cameras", "estimator")
    assert_fails(igsr_here("info", photos), "6 images but no cameras", "igsr pose")
    assert_fails(igsr_here("info", given, "--max-size", "0"), "max_size is 0")
    info = json.loads(igsr_here("info", given, "--max-size", "20", "--json").stdout)
    assert info["sizes"] == ["20x20"]
    assert calls == []


def test_pose_undoes_lens_distortion(photos, only, tmp_path, igsr_here):
    cameras = [view.camera for view in MADE.views]
    only(lambda photos: estimate_of(cameras, lenses=[Lens(False, (0.3,))] * len(photos)))
    out = tmp_path / "out"
    assert igsr_here("pose", photos, "--out", out).returncode == 0
    views = igsr.load_capture(out).views
    assert (out / "masks/00.png.png").is_file()
    assert 0.5 < views[0].mask.mean() < 1.0
    assert not np.array_equal(views[0].image, MADE.views[0].image)
