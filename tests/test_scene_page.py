"""``scene.html`` in a real browser: pictures as the renderer's, mouse, touch and keys."""

import base64
import json
import re
import time

import numpy as np
import pytest
import scene_pages
import scenes
from scene_pages import BACKGROUND, MEAN, check_pictures, drawn, model, named, opened, three_cameras

import igsr
from igsr.rendering import scene_model
from igsr.rendering.renders import render
from igsr.rendering.scene_page import PageCamera, scene_page, write_scene_page

MESSAGE = "document.getElementById('message').textContent"


@pytest.mark.parametrize("degree", range(5))
def test_pictures_match_the_renderer(browser, tmp_path, degree):
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
    for camera, same in zip(three_cameras(size), three_cameras(), strict=True):
        expected = scene_pages.picture(model(), same, BACKGROUND)
        assert np.abs(drawn(browser, camera) - expected).mean() <= MEAN


def test_far_splats_do_not_reduce_precision(browser, tmp_path):
    splats = model()
    splats.means += np.float32(50.0)
    splats.means[7], splats.means[8, 2] = 1e30, 1e5
    notes = write_scene_page(tmp_path / "scene.html", splats, (), BACKGROUND)
    assert notes == ["2 splats farther than 1000 radii of the scene are left out."]
    browser.open(tmp_path / "scene.html")
    check_pictures(browser, splats, three_cameras(origin=(50.0, 50.0, 50.0)))


@pytest.mark.parametrize("count", [400, 3000])
def test_large_models_share_harmonics(browser, tmp_path, monkeypatch, count):
    monkeypatch.setattr(scene_model, "PALETTE_FROM", 300)
    splats = model(3, count, antialiased=True)
    # Real models have rows that are alike; white noise has none.
    random = np.random.default_rng(0)
    alike = splats.sh[random.integers(0, 100, count), 1:]
    splats.sh[:, 1:] = alike + random.normal(scale=0.005, size=alike.shape).astype(np.float32)
    opened(browser, tmp_path / "scene.html", splats)
    check_pictures(browser, splats, three_cameras())


def test_thirty_thousand_splats_take_two_megabytes(tmp_path):
    splats = model(3, 30_000)
    # As coefficients of real models are spread, or wider: INRIA's test model has 0.028 on average.
    noise = np.random.default_rng(0).laplace(scale=0.05, size=splats.sh[:, 1:].shape)
    splats.sh[:, 1:] = noise.astype(np.float32)
    write_scene_page(tmp_path / "scene.html", splats)
    assert (tmp_path / "scene.html").stat().st_size <= 2e6


def test_the_same_model_makes_the_same_page():
    assert scene_page(model()) == scene_page(model())


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


def test_the_page_makes_no_requests(browser, tmp_path):
    path = opened(browser, tmp_path / "scene.html", model(), named(three_cameras()))
    assert browser.problems == []
    # The worker is made of the page's own text.
    others = [url for url in browser.requests if not url.startswith(("blob:", "data:"))]
    assert others == [path.as_uri()]
    page = path.read_text(encoding="utf-8")
    assert not re.search(r"(?:https?:)?//[\w.-]+\.\w", page)
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', page)[1]
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in policy
    assert browser.run("fetch('https://example.org/').then(() => false, () => true)")


def test_mouse_and_keys_move_the_camera(browser, tmp_path):
    opened(browser, tmp_path / "scene.html", model(), named(three_cameras()))

    def state():
        browser.run("window.igsr.viewer.settled()")
        return browser.run("window.igsr.state()")

    first = state()
    assert first["camera"] == 0
    browser.drag((300, 200), (360, 220), "left")
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

    browser.drag((300, 200), (340, 200), "right")
    panned = state()
    assert panned["forward"] == pytest.approx(zoomed["forward"])
    assert np.linalg.norm(np.subtract(panned["position"], zoomed["position"])) > 0.01

    # A key walks with the page's frames, which may be slow to come. Nothing settles until it is up.
    browser.key("w", "KeyW")
    end = time.monotonic() + 60
    walked = np.zeros(3)
    while np.linalg.norm(walked) <= 0.01:
        assert time.monotonic() < end, "the key moves nothing"
        time.sleep(0.05)
        now = browser.run("window.igsr.state()")["position"]
        walked = np.subtract(now, panned["position"])
    browser.key("w", "KeyW", "keyUp")
    walked = np.subtract(state()["position"], panned["position"])
    assert np.dot(walked, panned["forward"]) > 0.01
    assert np.dot(walked, panned["forward"]) == pytest.approx(np.linalg.norm(walked), rel=1e-6)

    browser.key("]", "BracketRight")
    assert state()["camera"] == 0
    browser.run("document.getElementById('next').click()")
    assert state()["camera"] == 1
    second = three_cameras()[1].center - browser.run("window.igsr.viewer.scene.origin")
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


def test_an_empty_model_gives_a_message(browser, tmp_path):
    shapes = ((0, 3), (0, 4), (0, 3), (0,), (0, 1, 3))
    empty = igsr.Splats(*(np.zeros(shape, np.float32) for shape in shapes))
    write_scene_page(tmp_path / "scene.html", empty)
    browser.open(tmp_path / "scene.html")
    assert browser.run(MESSAGE) == "The scene has no splats."
    assert browser.problems == []


@pytest.mark.parametrize("damage", ["cut", "byte", "base64", "other", "count"])
def test_a_damaged_page_gives_a_message(browser, tmp_path, damage):
    page, _ = scene_page(model())
    text = re.search(r'id="model-0">([^<]+)<', page)[1]
    packed = bytearray(base64.b64decode(text))
    packed[len(packed) // 2] ^= 0xFF
    old, new = {
        "cut": (text, text[: len(text) // 2 // 4 * 4]),
        "byte": (text, base64.b64encode(packed).decode()),
        "base64": (text, "?" + text[1:]),
        "other": (text, base64.b64encode(b"no splats at all").decode()),
        "count": ('"count": 400', '"count": 399'),
    }[damage]
    (tmp_path / "scene.html").write_text(page.replace(old, new), encoding="utf-8")
    browser.open(tmp_path / "scene.html")
    assert browser.run(MESSAGE).startswith("The model in this page cannot be read: it")
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


def test_names_cannot_inject_scripts(browser, tmp_path):
    name = '</script><script>window.broken = true</script>"\udcff@CSP@.png'
    cameras = [PageCamera(name, three_cameras()[0])]
    write_scene_page(tmp_path / "scene.html", model(), cameras, title=name)
    browser.open(tmp_path / "scene.html")
    assert browser.problems == []
    assert browser.run("window.igsr.error") is None
    assert browser.run("window.broken") is None
    assert "</script>" in browser.run("document.getElementById('cameras').options[1].text")


SCRIPT = "</script><script>alert(1)</script>"


def with_comments(path):
    """Script in the comments of a .ply."""
    lines = f"comment {SCRIPT}\nobj_info {SCRIPT}\ncomment origin {SCRIPT}\nelement vertex"
    path.write_bytes(path.read_bytes().replace(b"element vertex", lines.encode(), 1))


def with_names(path):
    """Script in all names of a .gltf."""
    document = json.loads(path.read_text())
    document["asset"] |= {"generator": SCRIPT, "copyright": SCRIPT}
    for parts in document.values():
        for part in parts if isinstance(parts, list) else []:
            if isinstance(part, dict):
                part |= {"name": SCRIPT, "extras": {SCRIPT: SCRIPT}}
    path.write_text(json.dumps(document))


@pytest.mark.parametrize(("ending", "change"), [(".ply", with_comments), (".gltf", with_names)])
def test_texts_of_splat_files_are_not_in_the_page(tmp_path, ending, change):
    path = tmp_path / f"scene{ending}"
    model().save(path)
    expected = scene_page(igsr.Splats.load(path))
    change(path)
    assert SCRIPT.encode() in path.read_bytes()
    assert scene_page(igsr.Splats.load(path)) == expected


@pytest.mark.parametrize("background", [(0.0, 0.0), (0.0, 0.0, 1.5), (0.0, 0.0, float("nan"))])
def test_a_wrong_background_is_refused(tmp_path, background):
    with pytest.raises(igsr.IgsrError, match="background must be three numbers"):
        write_scene_page(tmp_path / "scene.html", model(), background=background)
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_a_million_splats(browser, tmp_path):
    splats = model(0, 1_000_000)
    splats.scales -= 2.0
    path = tmp_path / "scene.html"
    write_scene_page(path, splats, named(three_cameras()), BACKGROUND)
    assert path.stat().st_size <= 20e6
    started = time.monotonic()
    # A software renderer on a busy machine takes minutes.
    browser.open(path, 600.0)
    assert browser.run("window.igsr.error") is None
    camera = three_cameras()[1]
    drawn(browser, camera, 600.0)
    # The second picture: the browser has drawn the page's first by then.
    print(f"{path.stat().st_size / 1e6:.1f} MB, drawn after {time.monotonic() - started:.1f} s")
    expected = scene_pages.picture(splats, camera, BACKGROUND)
    assert np.abs(drawn(browser, camera, 600.0) - expected).mean() <= MEAN
