"""``igsr view`` with a display: starts splat-view with cameras that it can read."""

import importlib.metadata
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scenes
from PIL import Image
from typer.testing import CliRunner

import igsr
from igsr.capture import Capture, View
from igsr.capture.write_colmap import write_colmap
from igsr.capture.write_transforms import write_cameras
from igsr.cli import app
from igsr.cli.view import write_for_viewer

#: Stands in for splat-view: copies its arguments and the folder of --cameras, which is temporary,
#: next to itself, and exits with status 3.
STAND_IN = f"""#!{sys.executable}
import json, pathlib, shutil, sys
own = pathlib.Path(__file__).parent
(own / "words").write_text(json.dumps(sys.argv[1:]))
shutil.rmtree(own / "kept", ignore_errors=True)
if "--cameras" in sys.argv:
    cameras = pathlib.Path(sys.argv[sys.argv.index("--cameras") + 1])
    shutil.copytree(cameras.parent, own / "kept", ignore=shutil.ignore_patterns("capture"))
sys.exit(3)
"""

#: A file that the viewer's own tests read.
VIEWERS_FILE = Path(__file__).parents[1] / "crates" / "splat_view" / "tests" / "cameras.json"


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    if os.name == "nt":
        pytest.skip("the stand-in is a script with a #! line")
    folder = tmp_path / "bin"
    folder.mkdir()
    program = folder / "splat-view"
    program.write_text(STAND_IN)
    program.chmod(0o755)
    monkeypatch.setattr("igsr.cli.view.PROGRAM", (str(program),))
    monkeypatch.setenv("DISPLAY", ":none")
    return folder


def view(*arguments):
    return CliRunner().invoke(app, ["view", *map(str, arguments)])


def words(stand_in):
    return json.loads((stand_in / "words").read_text())


def kept_cameras(stand_in):
    return json.loads((stand_in / "kept" / "cameras.json").read_text())


def test_scenes_options_and_the_exit_status_are_passed_on(stand_in):
    given = ["a dir", "--camera", "3", "b.ply", "--near", "0.5"]
    result = view(*given)
    assert words(stand_in) == given
    assert result.output == ""
    assert result.exit_code == 3


@pytest.mark.parametrize("layout", ["transforms", "colmap"])
def test_cameras_and_photos_of_any_capture_are_passed_on(tmp_path, stand_in, layout):
    path = scenes.write_capture(tmp_path / "transforms", scenes.capture(views=3, size=40))
    if layout == "colmap":
        write_colmap(igsr.load_capture(path), tmp_path / "colmap")
        path = tmp_path / "colmap"
    result = view("scene.ply", "--cameras", path, "--fov", "40")
    assert result.exit_code == 3, result.output
    assert str(path) in result.stderr
    *given, option, file = words(stand_in)
    assert given == ["scene.ply", "--fov", "40"]
    assert option == "--cameras"
    assert not Path(file).exists()
    cameras = kept_cameras(stand_in)
    loaded = igsr.load_capture(path)
    assert cameras["camera_model"] == "PINHOLE"
    assert len(cameras["frames"]) == len(loaded.views) == 3
    for frame, one in zip(cameras["frames"], loaded.views, strict=True):
        assert (frame["w"], frame["h"]) == (one.camera.width, one.camera.height)
        pose = np.linalg.inv(np.array(frame["transform_matrix"]) * [1, -1, -1, 1])
        np.testing.assert_allclose(pose, one.camera.viewmat, atol=1e-9)
        photo = np.asarray(Image.open(stand_in / "kept" / frame["file_path"]))
        np.testing.assert_array_equal(photo, one.image)


def test_large_photos_are_passed_on_at_a_smaller_size(tmp_path):
    camera = scenes.ring_camera(0.0)
    large = igsr.Camera(camera.viewmat, camera.K, 1700, 850)
    one = View("../a.jpg", large, "train", np.zeros((850, 1700, 3), np.uint8))
    write_for_viewer(Capture(tmp_path, [one]), tmp_path / "out")
    (frame,) = json.loads((tmp_path / "out" / "cameras.json").read_text())["frames"]
    assert (frame["w"], frame["h"]) == (1700, 850)
    assert Image.open(tmp_path / "out" / frame["file_path"]).size == (1600, 800)
    # Names do not lead out of the folder.
    assert sorted(tmp_path.iterdir()) == [tmp_path / "out"]


def test_cameras_in_the_folder_of_a_scene_are_found(tmp_path, stand_in):
    out = scenes.write_capture(tmp_path / "out", scenes.capture(views=2, size=16))
    for scene in (out, out / "scene.ply"):
        view(scene)
        assert words(stand_in)[:2] == [str(scene), "--cameras"]
        assert len(kept_cameras(stand_in)["frames"]) == 2
    # The viewer finds and reads a cameras.json itself.
    (out / "cameras.json").write_text("{}")
    view(out)
    assert words(stand_in) == [str(out)]
    for named in (out, out / "cameras.json"):
        view("other.ply", "--cameras", named)
        assert words(stand_in) == ["other.ply", "--cameras", str(out / "cameras.json")]


def test_a_capture_that_cannot_be_read_is_an_error_only_if_it_was_named(tmp_path, stand_in):
    broken = tmp_path / "out"
    broken.mkdir()
    (broken / "transforms.json").write_text("{")
    found = view(broken)
    assert words(stand_in) == [str(broken)]
    assert "transforms.json is not valid JSON" in found.stderr
    assert "no cameras are shown" in found.stderr
    (stand_in / "words").unlink()
    for named, reason in ((broken, "transforms.json is not valid JSON"), ("nowhere", "nowhere")):
        result = view("scene.ply", "--cameras", named)
        assert result.exit_code == 1
        assert reason in result.stderr.splitlines()[-1]
    assert not (stand_in / "words").exists()


def test_igsr_writes_the_cameras_file_of_the_viewers_tests(tmp_path):
    (frame,) = json.loads(VIEWERS_FILE.read_text())["frames"]
    viewmat = np.linalg.inv(np.array(frame["transform_matrix"]) * [1, -1, -1, 1])
    K = np.array([[110.0, 0.0, 60.0], [0.0, 100.0, 35.0], [0.0, 0.0, 1.0]])
    camera = igsr.Camera(viewmat, K, 120, 80)
    photo = np.zeros((80, 120, 3), np.uint8)
    write_cameras(tmp_path / "cameras.json", [View("images/a.png", camera, "train", photo)])
    written = json.loads((tmp_path / "cameras.json").read_text())
    matrix = written["frames"][0].pop("transform_matrix")
    np.testing.assert_allclose(matrix, frame.pop("transform_matrix"), atol=1e-12)
    assert written == {"camera_model": "PINHOLE", "frames": [frame]}


def module(*words, **options):
    command = [sys.executable, "-m", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, **options)


def test_the_viewer_imports_no_module_from_the_current_folder(tmp_path):
    scenes.splats().save(tmp_path / "scene.ply")
    (tmp_path / "igsr.py").write_text("raise SystemExit('the folder was searched for modules')")
    environment = {**os.environ, "PYTHONSAFEPATH": "1"}
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        environment.pop(name, None)
    options = ["--screenshot", "seen.png", "--size", "40x30", "--backend", "cpu"]
    words = ["igsr.cli", "view", "scene.ply", *options]
    result = module(*words, cwd=tmp_path, env=environment)
    assert result.returncode == 0, result.stderr
    assert Image.open(tmp_path / "seen.png").size == (40, 30)


def test_the_package_has_the_program_splat_view():
    found = importlib.metadata.entry_points(group="console_scripts", name="splat-view")
    assert [entry.value for entry in found] == ["igsr.rendering.window:main"]
    for words, status, text in (
        (["--version"], 0, f"splat-view {igsr.__version__}"),
        (["--nonsense"], 1, "--nonsense"),
    ):
        result = module("igsr.rendering.window", *words)
        assert result.returncode == status
        assert text in result.stdout + result.stderr
