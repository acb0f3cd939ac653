"""``scene.html`` in a real browser: it draws what the renderer draws, and heeds hand and keys."""

from __future__ import annotations

import base64
import json
import re
import time

import numpy as np
import pytest
import scenes
from browser import Browser
from typer.testing import CliRunner

import igsr
from igsr.cli import app
from igsr.cli.scene_page_option import write_page
from igsr.geometry.camera_paths import look_at
from igsr.rendering.renders import render
from igsr.rendering.scene_page import PageCamera, scene_page, write_scene_page

#: Largest mean difference to the renderer's picture, in 255ths.
MEAN = 1.0
BACKGROUND = (0.2, 0.4, 0.6)
SIZE = (640, 480)
PICTURE = """
window.igsr.picture(%s, %s).then((pixels) => {
  let text = "";
  for (let i = 0; i < pixels.length; i += 32768) {
    text += String.fromCharCode(...pixels.subarray(i, i + 32768));
  }
  return btoa(text);
})"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("profile"), SIZE) as opened:
        yield opened


def model(degree=1, count=400, antialiased=False, size=1.0, origin=(0.0, 0.0, 0.0)):
    """Splats whose spherical harmonics a .spz holds without clipping."""
    made = scenes.splats(count, degree, seed=degree, origin=origin)
    made.sh[:, 1:] = np.clip(0.3 * made.sh[:, 1:], -0.9, 0.9)
    made.means *= size
    made.scales += np.float32(np.log(size) - 1.0)
    made.antialiased = antialiased
    return made


def three_cameras(size=1.0, origin=(0.0, 0.0, 0.0)):
    """From above, below and the side, so that no basis function stays small."""
    middle = np.asarray(origin, dtype=float)
    K = np.array([[240.0, 0.0, 76.0], [0.0, 250.0, 83.0], [0.0, 0.0, 1.0]])
    places = ((0.6, -1.9, -2.2), (2.1, 1.6, 1.4), (-2.8, -0.3, 0.9))
    return [
        igsr.Camera(
            look_at(middle + size * np.array(place), middle, np.array([0.0, -1.0, 0.0])),
            K,
            160,
            144,
        )
        for place in places
    ]


def named(cameras):
    return [PageCamera(f"photo {k}", camera) for k, camera in enumerate(cameras)]


def convert(*words):
    return CliRunner().invoke(app, ["convert", *map(str, words)])


def opened(browser, path, splats, cameras=(), background=BACKGROUND):
    write_scene_page(path, splats, cameras, background)
    browser.open(path)
    assert browser.run("window.igsr.error") is None
    return path


def drawn(browser, camera, timeout=60.0):
    """What the page draws for a camera, uint8 [H, W, 3]."""
    K = camera.K
    lens = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], camera.width, camera.height]
    rows = camera.viewmat[:3].ravel().tolist()
    text = browser.run(PICTURE % (json.dumps(rows), json.dumps([float(n) for n in lens])), timeout)
    pixels = np.frombuffer(base64.b64decode(text), np.uint8)
    return pixels.reshape(camera.height, camera.width, 4)[::-1, :, :3].astype(int)


def check_pictures(browser, splats, cameras):
    for camera in cameras:
        expected = render(splats, camera, BACKGROUND, backend="cpu").to_uint8().astype(int)
        assert expected.std() > 20, "the scene is not in the picture"
        assert np.abs(drawn(browser, camera) - expected).mean() <= MEAN


# ---- pictures ----------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", range(5))
def test_pictures_are_the_renderers(browser, tmp_path, degree):
    splats = model(degree)
    opened(browser, tmp_path / "scene.html", splats)
    check_pictures(browser, splats, three_cameras())


def test_antialiased_splats_far_from_zero(browser, tmp_path):
    origin = (5e5, -4e6, 300.0)
    splats = model(antialiased=True, origin=origin)
    opened(browser, tmp_path / "scene.html", splats)
    # From so far that the blur is as large as the splats.
    check_pictures(browser, splats, [scenes.ring_camera(0.5, 64, 9.0, origin)])
    check_pictures(browser, splats, three_cameras(origin=origin))


@pytest.mark.parametrize("size", [1e-5, 1e4])
def test_scenes_in_any_unit(browser, tmp_path, size):
    splats = model(size=size)
    opened(browser, tmp_path / "scene.html", splats)
    # The renderer's near plane is 0.01 in any unit; it draws the same scene in another one.
    enlarged = model(size=1.0)
    for camera, same in zip(three_cameras(size), three_cameras(), strict=True):
        expected = render(enlarged, same, BACKGROUND, backend="cpu").to_uint8().astype(int)
        assert np.abs(drawn(browser, camera) - expected).mean() <= MEAN


def test_splats_that_are_not_finite_are_left_out(browser, tmp_path):
    splats = model(2)
    splats.means[3, 1] = splats.sh[40, 5, 0] = np.nan
    splats.scales[17, 0], splats.opacities[90] = np.inf, np.nan
    splats.save(tmp_path / "scene.ply")
    assert convert(tmp_path / "scene.ply", tmp_path / "scene.html").exit_code == 0
    browser.open(tmp_path / "scene.html")
    write_scene_page(tmp_path / "scene.html", splats, (), BACKGROUND)
    browser.open(tmp_path / "scene.html")
    assert browser.run("JSON.parse(document.getElementById('scene').textContent).count") == 396
    check_pictures(browser, splats, three_cameras())


def test_splats_far_out_do_not_make_the_others_coarse(browser, tmp_path):
    splats = model()
    splats.means += np.float32(50.0)
    splats.means[7], splats.means[8, 2] = 1e30, 1e5
    notes = write_scene_page(tmp_path / "scene.html", splats, (), BACKGROUND)
    assert notes == ["2 splats farther than 1000 radii of the scene are left out."]
    browser.open(tmp_path / "scene.html")
    check_pictures(browser, splats, three_cameras(origin=(50.0, 50.0, 50.0)))


def test_depth_view_and_focus(browser, tmp_path):
    opened(browser, tmp_path / "scene.html", model(), named(three_cameras()))
    before = browser.run("window.igsr.state()")
    camera = three_cameras()[0]
    colors = drawn(browser, camera)
    browser.run("document.getElementById('depth').click()")
    depths = drawn(browser, camera)
    assert (depths.max(axis=-1) == depths.min(axis=-1)).all()
    assert (colors.max(axis=-1) - colors.min(axis=-1)).mean() > 10
    browser.run("window.igsr.viewer.focus(320, 240)")
    expected = render(model(), camera, backend="cpu").expected_depth[72, 80]
    assert browser.run("window.igsr.state()")["distance"] == pytest.approx(expected, rel=0.02)
    assert before["distance"] == pytest.approx(3.0, rel=0.1)


# ---- the page ----------------------------------------------------------------------------------


def test_it_asks_nothing_of_any_address(browser, tmp_path):
    path = opened(browser, tmp_path / "scene.html", model(), named(three_cameras()))
    assert browser.problems == []
    # The worker is made of the page's own text.
    others = [url for url in browser.requests if not url.startswith(("blob:", "data:"))]
    assert others == [path.as_uri()]
    page = path.read_text(encoding="utf-8")
    assert not re.search(r"(?:https?:)?//[\w.-]+\.\w", page)
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', page)
    assert policy is not None
    assert policy[1].startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in policy[1]
    refused = browser.run("fetch('https://example.org/').then(() => false, () => true)")
    assert refused


def test_hands_and_keys_move_the_camera(browser, tmp_path):
    opened(browser, tmp_path / "scene.html", model(), named(three_cameras()))

    def state():
        browser.run("window.igsr.viewer.settled()")
        return browser.run("window.igsr.state()")

    first = state()
    assert first["camera"] == 0
    browser.mouse("mousePressed", 300, 200, button="left", buttons=1, clickCount=1)
    browser.mouse("mouseMoved", 360, 220, button="left", buttons=1)
    browser.mouse("mouseReleased", 360, 220, button="left")
    orbited = state()
    assert orbited["camera"] == -1
    assert orbited["distance"] == pytest.approx(first["distance"])
    turned = np.dot(orbited["forward"], first["forward"])
    # 60 pixels across and 20 down, at 0.005 radians each.
    assert np.arccos(turned) == pytest.approx(np.hypot(0.3, 0.1), rel=0.05)

    browser.mouse("mouseWheel", 320, 240, deltaX=0, deltaY=-100)
    zoomed = state()
    assert zoomed["distance"] == pytest.approx(orbited["distance"] * np.exp(-0.2), rel=1e-6)
    assert zoomed["forward"] == pytest.approx(orbited["forward"])

    browser.mouse("mousePressed", 300, 200, button="right", buttons=2, clickCount=1)
    browser.mouse("mouseMoved", 340, 200, button="right", buttons=2)
    browser.mouse("mouseReleased", 340, 200, button="right")
    panned = state()
    assert panned["forward"] == pytest.approx(zoomed["forward"])
    assert np.linalg.norm(np.subtract(panned["position"], zoomed["position"])) > 0.01

    browser.key("w", "KeyW")
    time.sleep(0.3)
    browser.key("w", "KeyW", "keyUp")
    walked = np.subtract(state()["position"], panned["position"])
    assert np.dot(walked, panned["forward"]) > 0.01
    assert np.dot(walked, panned["forward"]) == pytest.approx(np.linalg.norm(walked), rel=1e-6)

    browser.key("]", "BracketRight")
    assert state()["camera"] == 0
    browser.run("document.getElementById('next').click()")
    assert state()["camera"] == 1
    second = three_cameras()[1].centre - browser.run("window.igsr.viewer.scene.origin")
    assert state()["position"] == pytest.approx(second.tolist(), abs=1e-9)
    browser.key("v", "KeyV")
    assert state()["flies"]
    browser.run("document.getElementById('mode').click()")
    browser.key("f", "KeyF")
    assert state()["camera"] == -1
    assert not state()["flies"]
    assert browser.problems == []


def test_fingers_orbit_and_pinch(browser, tmp_path):
    opened(browser, tmp_path / "scene.html", model(), named(three_cameras()))
    first = browser.run("window.igsr.state()")
    browser.touch("touchStart", [(300, 200)])
    browser.touch("touchMove", [(340, 200)])
    browser.touch("touchEnd", [])
    orbited = browser.run("window.igsr.state()")
    assert np.dot(orbited["forward"], first["forward"]) == pytest.approx(np.cos(0.2), abs=0.01)
    browser.touch("touchStart", [(300, 200), (340, 200)])
    browser.touch("touchMove", [(280, 200), (360, 200)])
    browser.touch("touchEnd", [])
    pinched = browser.run("window.igsr.state()")
    assert pinched["distance"] == pytest.approx(orbited["distance"] / 2, rel=0.01)


def test_without_cameras_it_shows_the_whole_scene(browser, tmp_path):
    splats = model()
    opened(browser, tmp_path / "scene.html", splats)
    assert browser.run("document.getElementById('photos').hidden")
    state = browser.run("window.igsr.state()")
    # The page's origin is the middle; it is seen from a little above, and up is -y.
    origin = browser.run("window.igsr.viewer.scene.origin")
    assert origin == pytest.approx(np.median(splats.means, axis=0).tolist(), abs=0.1)
    assert state["position"][1] < -0.2
    to_middle = -np.array(state["position"])
    assert np.dot(to_middle, state["forward"]) == pytest.approx(state["distance"], rel=1e-6)


def test_an_empty_model_is_said(browser, tmp_path):
    shapes = ((0, 3), (0, 4), (0, 3), (0,), (0, 1, 3))
    empty = igsr.Splats(*(np.zeros(shape, np.float32) for shape in shapes))
    write_scene_page(tmp_path / "scene.html", empty)
    browser.open(tmp_path / "scene.html")
    assert (
        browser.run("document.getElementById('message').textContent") == "The scene has no splats."
    )
    assert browser.problems == []


@pytest.mark.parametrize("damage", ["cut", "byte", "base64", "other", "count"])
def test_a_damaged_page_says_so(browser, tmp_path, damage):
    page, _ = scene_page(model())
    found = re.search(r'id="model">([^<]+)<', page)
    assert found is not None
    text = found[1]
    if damage == "count":
        page = page.replace('"count": 400', '"count": 399')
    else:
        packed = bytearray(base64.b64decode(text))
        packed[len(packed) // 2] ^= 0xFF
        damaged = {
            "cut": text[: len(text) // 2 // 4 * 4],
            "byte": base64.b64encode(packed).decode(),
            "base64": "?" + text[1:],
            "other": base64.b64encode(b"no splats at all").decode(),
        }[damage]
        page = page.replace(text, damaged)
    (tmp_path / "scene.html").write_text(page, encoding="utf-8")
    browser.open(tmp_path / "scene.html")
    message = browser.run("document.getElementById('message').textContent")
    assert message.startswith("The model in this page cannot be read: it")
    assert browser.run("getComputedStyle(document.getElementById('loading')).display") != "none"
    assert browser.problems == []


def test_without_webgl_or_a_worker(browser, tmp_path):
    page, _ = scene_page(model(), (), BACKGROUND)
    # The page's policy allows no other script, so these pages go without it.
    open_page = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page)
    for taken, error in (("HTMLCanvasElement.prototype.getContext = () => null", "WebGL 2"),
                         ("window.Worker = undefined", None)):  # fmt: skip
        changed = open_page.replace("<body>", f"<body><script>{taken}</script>")
        (tmp_path / "scene.html").write_text(changed, encoding="utf-8")
        browser.open(tmp_path / "scene.html")
        said = browser.run("window.igsr.error")
        assert said is None if error is None else error in said
    check_pictures(browser, model(), three_cameras())


def test_names_cannot_break_out(browser, tmp_path):
    name = '</script><script>window.broken = true</script>"\udcff@CSP@.png'
    cameras = [PageCamera(name, three_cameras()[0])]
    write_scene_page(tmp_path / "scene.html", model(), cameras, title=name)
    browser.open(tmp_path / "scene.html")
    assert browser.problems == []
    assert browser.run("window.igsr.error") is None
    assert browser.run("window.broken") is None
    assert "</script>" in browser.run("document.getElementById('cameras').options[1].text")


# ---- from the command line -----------------------------------------------------------------------


def test_convert_finds_cameras_and_background(browser, tmp_path):
    from igsr.capture.write_cameras import write_cameras

    made = scenes.capture(views=3, size=40)
    splats = model()
    splats.save(tmp_path / "scene.ply")
    write_cameras(tmp_path / "cameras.json", made.views)
    (tmp_path / "report.json").write_text('{"protocol": {"background": [1, 1, 1]}}')
    assert convert(tmp_path / "scene.ply", tmp_path / "page.html").exit_code == 0
    browser.open(tmp_path / "page.html")
    names = browser.run("[...document.getElementById('cameras').options].map((one) => one.text)")
    assert names == ["free view", *(view.name for view in made.views)]
    camera = made.views[1].camera
    expected = render(splats, camera, (1.0, 1.0, 1.0), backend="cpu").to_uint8()
    assert np.abs(drawn(browser, camera) - expected).mean() <= MEAN

    elsewhere = tmp_path / "elsewhere" / "page.html"
    words = ["--cameras", str(scenes.write_capture(tmp_path / "capture", made))]
    words += ["--background", "0,0.5,0"]
    assert convert(tmp_path / "scene.ply", elsewhere, *words).exit_code == 0
    page = elsewhere.read_text(encoding="utf-8")
    assert '"background": [0.0, 0.5, 0.0]' in page
    assert made.views[2].name in page

    refused = convert(tmp_path / "scene.ply", tmp_path / "a.spz", "--cameras", "x")
    assert refused.exit_code != 0
    assert "--cameras is for pages" in refused.output
    (tmp_path / "cameras.json").write_text('{"camera_model": "PINHOLE", "frames": [{}]}')
    without = convert(tmp_path / "scene.ply", tmp_path / "page.html")
    assert without.exit_code == 0
    assert "the page has no cameras" in without.output


def test_a_fit_writes_it(browser, tmp_path):
    made = scenes.capture(views=5, size=24)
    capture, out = scenes.write_capture(tmp_path / "capture", made), tmp_path / "out"
    words = ["fit", str(capture), "--out", str(out), "--steps", "4", "--backend", "cpu"]
    done = CliRunner().invoke(app, [*words, "--no-html"])
    assert done.exit_code == 0, done.output
    assert not (out / "scene.html").exists()
    done = CliRunner().invoke(app, [*words, "--resume"])
    assert done.exit_code == 0, done.output
    assert "scene.html" in done.output
    browser.open(out / "scene.html")
    assert browser.run("window.igsr.error") is None
    assert browser.run("window.igsr.viewer.scene.cameras.length") == len(made.views)
    splats, camera = igsr.Splats.load(out / "scene.ply"), made.views[0].camera
    expected = render(splats, camera, backend="cpu").to_uint8().astype(int)
    assert np.abs(drawn(browser, camera) - expected).mean() <= MEAN


def test_a_fit_outlives_a_page_that_cannot_be_written(tmp_path):
    (tmp_path / "scene.html").mkdir()
    with pytest.warns(UserWarning, match=r"scene\.html is not written: Cannot write"):
        assert not write_page(tmp_path, model(), scenes.capture(views=2, size=8))


@pytest.mark.parametrize("background", [(0.0, 0.0), (0.0, 0.0, 1.5), (0.0, 0.0, float("nan"))])
def test_a_wrong_background_is_refused(tmp_path, background):
    with pytest.raises(igsr.IgsrError, match="background must be three numbers"):
        write_scene_page(tmp_path / "scene.html", model(), background=background)
    assert not list(tmp_path.iterdir())


# ---- large models --------------------------------------------------------------------------------


@pytest.mark.long
def test_a_million_splats(browser, tmp_path):
    splats = model(0, 1_000_000)
    splats.scales -= 2.0
    path = tmp_path / "scene.html"
    write_scene_page(path, splats, named(three_cameras()), BACKGROUND)
    started = time.monotonic()
    browser.open(path, 300.0)
    print(f"{path.stat().st_size / 1e6:.1f} MB, drawn after {time.monotonic() - started:.1f} s")
    assert browser.run("window.igsr.error") is None
    camera = three_cameras()[1]
    expected = render(splats, camera, BACKGROUND, backend="cpu").to_uint8()
    assert np.abs(drawn(browser, camera, 120.0) - expected).mean() <= MEAN
