"""The page of ``igsr view --web`` in a browser: follows a run and compares models."""

import json
import time

import numpy as np
import pytest
import scene_pages
from PIL import Image
from scene_pages import MEAN, check_pictures, drawn, model, named, picture, three_cameras
from web_views import served

import igsr
from igsr._internal.event import Event
from igsr.capture.write_transforms import write_cameras
from igsr.fitting.followed_run import FollowedRun
from igsr.rendering import scene_page
from igsr.rendering.scene_page import PageModel, write_scene_page

BLACK = (0.0, 0.0, 0.0)
#: Three models that look different.
ROUNDS = [model(0, 300), model(1), model(2, 500)]
#: Position and direction of the view in the world.
WORLD = """(({ main, viewpoint }) => {
  const { position, forward } = viewpoint.between(main.scene, { origin: [0, 0, 0], unit: 1 });
  return [...position, ...forward];
})(window.igsr.viewer)"""


@pytest.fixture(autouse=True)
def left(browser):
    """Leave the page when its server ends."""
    yield
    browser.leave()


def wait_for(browser, expression, seconds=20.0):
    """Wait until JavaScript is true."""
    end = time.monotonic() + seconds
    while not browser.run(expression):
        assert time.monotonic() < end, f"not within {seconds} s: {expression}"
        time.sleep(0.05)


def write_round(folder, number):
    """Write the files of a refinement after a round."""
    rounds = [{"splats": 300, "test": {"psnr": 20.0 + k}} for k in range(number)]
    ROUNDS[number].save(folder / "rounds" / str(number) / "scene.ply")
    rounds.append({"splats": 300, "test": {"psnr": 20.0 + number}})
    (folder / "report.json").write_text(json.dumps({"rounds": rounds}))


def texts(browser, selector):
    return browser.run(
        f"[...document.querySelectorAll('{selector}')].map((one) => one.textContent)"
    )


def choose(browser, id, value):
    browser.run(
        f"document.getElementById('{id}').value = '{value}';"
        f"document.getElementById('{id}').dispatchEvent(new Event('change'))"
    )


def test_the_page_shows_new_rounds_without_a_reload(browser, tmp_path):
    photo = np.zeros((144, 160, 3), np.uint8)
    views = [igsr.View("a.png", camera, "train", photo) for camera in three_cameras()]
    with served(tmp_path) as server:
        browser.open(server.url)
        message = browser.run("document.getElementById('message').textContent")
        assert message.startswith("There is no model yet")
        write_cameras(tmp_path / "cameras.json", views)
        for number in range(3):
            write_round(tmp_path, number)
            wait_for(browser, f"window.igsr.models.mainEntry?.id === 'round-{number}'")
            wait_for(browser, f"window.igsr.viewer.main?.scene.count === {len(ROUNDS[number])}")
            if number == 0:
                wait_for(browser, "window.igsr.viewer.camera === 0")
                browser.drag((300, 200), (360, 220), "left")
                before = browser.run(WORLD)
            wait_for(browser, f"document.getElementById('scores').rows.length === {number + 2}")
        assert browser.run(WORLD) == pytest.approx(before, abs=1e-6), "the view stays"
        assert browser.run("document.getElementById('loading').hidden")
        assert texts(browser, "#shown option") == [
            "Show the newest",
            "first fit, 20.00 dB",
            "round 1, 21.00 dB",
            "round 2, 22.00 dB",
        ]
        assert texts(browser, "#scores tr:last-child td")[:2] == ["round 2", "22.00"]
        check_pictures(browser, ROUNDS[2], three_cameras()[1:2], BLACK)
        choose(browser, "shown", "round-0")
        wait_for(browser, "window.igsr.viewer.main.scene.count === 300")
        check_pictures(browser, ROUNDS[0], three_cameras()[1:2], BLACK)
        # A new run replaces the file of a round.
        ROUNDS[1].save(tmp_path / "rounds" / "0" / "scene.ply")
        wait_for(browser, "window.igsr.viewer.main.scene.count === 400")
        kept = browser.run("[...window.igsr.models.kept.values()].map((one) => one.scene.count)")
        assert sorted(kept) == [400, 400, 500], "replaced models are freed"
        assert browser.problems == []
        own = server.url.rsplit("/", 2)[0]
        assert all(url.startswith((own, f"blob:{own}", "data:")) for url in browser.requests)
        assert browser.run("fetch('https://example.org/').then(() => false, () => true)")


def test_two_rounds_at_a_divider(browser, tmp_path):
    models = [PageModel(f"round {k}", splats) for k, splats in enumerate(ROUNDS)]
    write_scene_page(tmp_path / "scene.html", models, named(three_cameras()), BLACK)
    browser.open(tmp_path / "scene.html")
    assert browser.run("window.igsr.error") is None
    assert browser.run("document.getElementById('divider').hidden")
    choose(browser, "beside", "0")
    wait_for(browser, "window.igsr.viewer.other?.scene.count === 300")
    assert texts(browser, "#divider span") == ["round 0", "round 2"]
    camera = three_cameras()[0]
    for left in (0, 1):
        choose(browser, "beside", left)
        wait_for(browser, f"window.igsr.viewer.other?.scene.count === {len(ROUNDS[left])}")
        for part in (0.5, 0.25):
            browser.run(f"window.igsr.viewer.divider = {part}")
            seen, at = drawn(browser, camera), round(160 * part)
            one, other = (picture(ROUNDS[k], camera, BLACK) for k in (left, 2))
            assert np.abs(one - other).mean() > 5 * MEAN
            assert np.abs(seen[:, :at] - one[:, :at]).mean() <= MEAN
            assert np.abs(seen[:, at:] - other[:, at:]).mean() <= MEAN
    before = browser.run("window.igsr.state()")
    browser.run("window.igsr.viewer.fixedSize = null; document.getElementById('divider').focus()")
    browser.key("ArrowRight", "ArrowRight")
    assert browser.run("window.igsr.viewer.divider") == pytest.approx(0.27)
    x = 0.27 * 640
    browser.drag((x, 200), (480, 200), "left")
    assert browser.run("window.igsr.viewer.divider") == pytest.approx(0.75, abs=0.01)
    after = browser.run("window.igsr.state()")
    assert after["position"] == pytest.approx(before["position"]), "the camera stays"
    choose(browser, "beside", "")
    wait_for(browser, "window.igsr.viewer.other === null")
    assert browser.run("document.getElementById('divider').hidden")
    assert browser.problems == []


def test_a_photo_is_aligned_with_its_render(browser, tmp_path):
    camera = three_cameras()[0]
    photo = picture(ROUNDS[1], camera, BLACK).astype(np.uint8)
    capture = igsr.Capture(tmp_path, [igsr.View("a/b.png", camera, "test", photo)])
    followed = FollowedRun(tmp_path)
    followed.show(capture, BLACK)
    followed(Event("fit", part=0.5))
    ROUNDS[1].save(tmp_path / "scene.ply")
    screens = {}
    with served(tmp_path) as server:
        browser.open(server.url)
        wait_for(browser, "window.igsr.viewer.camera === 0")
        assert browser.run("document.getElementById('run').textContent") == "fit"
        assert browser.run("document.getElementById('done').value") == 0.5
        choose(browser, "beside", "photo")
        wait_for(browser, "!document.getElementById('photo').hidden")
        browser.run("window.igsr.viewer.settled()")
        for part in (0, 1):
            browser.run(
                "for (const id of ['status', 'panel', 'divider'])"
                " document.getElementById(id).style.visibility = 'hidden';"
                f"document.getElementById('shown').blur(); window.igsr.divider.move({part})"
            )
            browser.screenshot(tmp_path / f"{part}.png")
            screen = Image.open(tmp_path / f"{part}.png").convert("RGB")
            screens[part] = np.asarray(screen).astype(int)
        assert browser.problems == []
    # The picture is 533 pixels wide in the window of 640 x 480: 3.3 for one of the photo's.
    middle = np.s_[20:-20, 80:-80]
    exact = np.abs(screens[1] - screens[0])[middle].mean()
    assert np.abs(screens[1]).mean() > 10
    for shift in ((0, 2), (0, -2), (2, 0), (-2, 0)):
        shifted = np.roll(screens[1], shift, (0, 1))
        assert exact < 0.8 * np.abs(shifted - screens[0])[middle].mean()


def test_a_damaged_file_is_an_error_and_the_shown_model_stays(browser, tmp_path):
    scene = tmp_path / "scene.ply"
    ROUNDS[0].save(scene)
    with served(scene) as server:
        browser.open(server.url)
        wait_for(browser, "window.igsr.viewer.main !== null")
        scene.write_bytes(b"no splats")
        wait_for(browser, "!document.getElementById('loading').hidden")
        message = browser.run("document.getElementById('message').textContent")
        assert message.startswith("The model cannot be read: ")
        assert "scene.ply" in message
        assert browser.run("window.igsr.viewer.main.scene.count") == 300
        ROUNDS[1].save(scene)
        wait_for(browser, "window.igsr.viewer.main.scene.count === 400")
        wait_for(browser, "document.getElementById('loading').hidden")
    wait_for(browser, "document.getElementById('run').textContent.includes('does not answer')")
    assert browser.run("window.igsr.viewer.main.scene.count") == 400


def test_names_are_escaped(browser, tmp_path):
    name = "<img src=x onerror='window.broken = true'>"
    (tmp_path / name).mkdir()
    FollowedRun(tmp_path / name)(Event(name, part=0.1))
    ROUNDS[0].save(tmp_path / name / "scene.ply")
    with served(tmp_path / name) as server:
        browser.open(server.url)
        wait_for(browser, "window.igsr.viewer.main !== null")
        assert browser.run("document.getElementById('run').textContent") == name
        assert browser.run("window.broken") is None
        assert browser.problems == []


def test_large_pages_show_the_last_model_alone(monkeypatch):
    models = [PageModel(str(k), splats) for k, splats in enumerate(ROUNDS)]
    assert scene_page.compared(models) == models
    monkeypatch.setattr(scene_page, "MAX_COMPARED_SPLATS", 1199)
    assert scene_page.compared(models) == models[-1:]


def test_a_refinement_shows_itself_in_a_notebook(browser, helped, tmp_path):
    refined, out, _ = helped
    page = tmp_path / "book.html"
    for text in (refined.show(300)._repr_html_(), (out / "report.html").read_text("utf-8")):
        page.write_text(scene_pages.WAIT + text, encoding="utf-8")
        browser.open(page)
        assert browser.problems == []
        assert browser.run("frames[0].igsr.error") is None
        labels = browser.run("frames[0].igsr.models.source.entries.map(({label}) => label)")
        assert labels == ["first fit", "round 1", "round 2"]
        assert browser.run("frames[0].igsr.viewer.other.scene.count") == len(refined.first)
        others = [url for url in browser.requests if not url.startswith(("blob:", "data:"))]
        assert others in ([page.as_uri()], [page.as_uri(), "about:srcdoc"])
    camera = refined.capture.train_views[0].camera
    assert browser.run("frames[0].igsr.viewer.camera") == 0
    assert browser.run("frames[0].igsr.viewer.lens.width") == camera.width
    with pytest.raises(igsr.IgsrError, match="height"):
        refined.show(0)
