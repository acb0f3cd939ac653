"""``scene.html``, as ``igsr convert`` and ``igsr fit`` write it."""

import numpy as np
import pytest
import scenes
from scene_pages import check_pictures, model, three_cameras

import igsr
from igsr.capture.write_transforms import write_cameras
from igsr.rendering.run_folder import background_beside, cameras_beside


def test_non_finite_splats_are_left_out(browser, tmp_path, igsr_here):
    splats = model(2)
    splats.means[3, 1] = splats.sh[40, 5, 0] = np.nan
    splats.scales[17, 0], splats.opacities[90] = np.inf, np.nan
    splats.save(tmp_path / "scene.ply")
    words = ["convert", tmp_path / "scene.ply", tmp_path / "scene.html"]
    done = igsr_here(*words, "--background", "0.2,0.4,0.6")
    assert done.returncode == 0, done.stderr
    browser.open(tmp_path / "scene.html")
    assert browser.run("window.igsr.viewer.scene.count") == 396
    check_pictures(browser, splats, three_cameras())


def test_convert_finds_cameras_and_background(browser, tmp_path, igsr_here):
    def convert(*words):
        return igsr_here("convert", tmp_path / "scene.ply", *words)

    made = scenes.capture(views=3, size=40)
    splats = model()
    splats.save(tmp_path / "scene.ply")
    write_cameras(tmp_path / "cameras.json", made.views)
    (tmp_path / "report.json").write_text('{"protocol": {"background": [1, 1, 1]}}')
    assert convert(tmp_path / "page.html").returncode == 0
    browser.open(tmp_path / "page.html")
    names = browser.run("[...document.getElementById('cameras').options].map((one) => one.text)")
    assert names == ["free view", *(view.name for view in made.views)]
    check_pictures(browser, splats, [made.views[1].camera], (1.0, 1.0, 1.0))

    elsewhere = tmp_path / "elsewhere" / "page.html"
    words = ["--cameras", scenes.write_capture(tmp_path / "capture", made)]
    assert convert(elsewhere, *words, "--background", "0,0.5,0").returncode == 0
    page = elsewhere.read_text(encoding="utf-8")
    assert '"background": [0.0, 0.5, 0.0]' in page
    assert made.views[2].name in page
    spz = convert(tmp_path / "a.spz", "--cameras", "x")
    assert spz.returncode == 1
    assert "--cameras is for pages" in spz.stderr
    (tmp_path / "cameras.json").write_text('{"camera_model": "PINHOLE", "frames": [{}]}')
    without = convert(tmp_path / "page.html")
    assert without.returncode == 0
    assert "the page has no cameras" in without.stderr


@pytest.mark.parametrize(
    ("report", "background"),
    [
        ('{"protocol": {"background": [1, 0, 0.5]}}', (1.0, 0.0, 0.5)),
        ('{"test": {"protocol": {"background": [0, 1, 0]}}}', (0.0, 1.0, 0.0)),
        ('{"test": null}', None),
        ('{"protocol": {"background": [2, 0, 0]}}', None),
        ('{"protocol": 3}', None),
        ("[]", None),
        ("{", None),
    ],
)
def test_the_background_comes_from_the_report(tmp_path, report, background):
    (tmp_path / "report.json").write_text(report)
    assert background_beside(tmp_path / "scene.ply") == background


@pytest.mark.parametrize("place", ["", "rounds/0", "checkpoints"])
def test_cameras_and_background_come_from_the_run_of_the_scene(tmp_path, place):
    made = scenes.capture(views=2, size=16)
    write_cameras(tmp_path / "cameras.json", made.views)
    (tmp_path / "report.json").write_text('{"protocol": {"background": [1, 0, 1]}}')
    scene = tmp_path / place / "scene.ply"
    assert background_beside(scene) == (1.0, 0.0, 1.0)
    assert [one.name for one in cameras_beside(scene)] == [view.name for view in made.views]
    elsewhere = tmp_path / "else" / "scene.ply"
    assert background_beside(elsewhere) is None
    assert cameras_beside(elsewhere) == []


def test_a_fit_writes_a_page(browser, tmp_path, igsr_here):
    made = scenes.capture(views=5, size=24)
    capture, out = scenes.write_capture(tmp_path / "capture", made), tmp_path / "out"
    done = igsr_here("fit", capture, "--out", out, "--steps", "4", "--backend", "cpu")
    assert done.returncode == 0, done.stderr
    assert "scene.html" in done.stdout
    browser.open(out / "scene.html")
    assert browser.run("window.igsr.error") is None
    assert browser.run("window.igsr.viewer.scene.cameras.length") == len(made.views)
    assert "<iframe srcdoc=" in (out / "report.html").read_text(encoding="utf-8")
    splats = igsr.Splats.load(out / "scene.ply")
    check_pictures(browser, splats, [made.views[0].camera], (0.0, 0.0, 0.0))


def test_a_fit_warns_if_its_page_cannot_be_written(tmp_path):
    (tmp_path / "scene.html").mkdir()
    with pytest.warns(UserWarning, match=r"scene\.html is not written: Cannot write"):
        igsr.fit(scenes.capture(views=3, size=16), 1, out=tmp_path, backend="cpu")
    assert (tmp_path / "scene.ply").is_file()
