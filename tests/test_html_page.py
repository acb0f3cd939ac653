"""``report.html`` in a real browser: its script runs, its pictures and cameras are drawn."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes

import igsr
from igsr.refinement.html_page import write_page
from igsr.refinement.report import report_of
from igsr.refinement.results import HeldOutView, Refined, Round, Stop, StopReason
from igsr.refinement.settings import RefineSettings

#: As the page's script draws photos' cameras and those of added views.
PHOTOS, ADDED = (59, 125, 216), (224, 138, 30)


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    out = tmp_path_factory.mktemp("refined")
    capture = scenes.capture(views=12, size=40, alpha=True)

    def sure(buffers, photos):
        picture = np.clip(buffers.color + 0.05, 0.0, 1.0)
        return picture, np.full(picture.shape[:2], 0.95, np.float32)

    igsr.refine(capture, 1, steps=30, backend="cpu", denoiser=sure, out=out, cross_validate=False)
    return out / "report.html"


def cameras_drawn(browser, page):
    """The picture of the cameras, [H, W, 3]; the rest of the page has their colors, too."""
    browser.load(page)
    size = browser.run("[canvas.height, canvas.width, 4]")
    data = "canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data"
    return np.array(browser.run(f"Array.from({data})"), np.uint8).reshape(size).astype(int)[..., :3]


def near(pixels, color):
    return int((np.abs(pixels - color).max(axis=-1) < 40).sum())


def test_a_browser_draws_the_cameras(browser, report, tmp_path):
    pixels = cameras_drawn(browser, report)
    for color in (PHOTOS, ADDED):
        assert near(pixels, color) > 100
    broken = tmp_path / "broken.html"
    broken.write_text(report.read_text().replace("function draw()", "function other()"))
    without = cameras_drawn(browser, broken)
    for color in (PHOTOS, ADDED):
        assert near(without, color) == 0


def test_held_out_photos_have_a_slider(browser, tmp_path):
    capture = scenes.capture(views=8, size=40, alpha=True)

    def sure(buffers, photos):
        picture = np.clip(buffers.color + 0.05, 0.0, 1.0)
        return picture, np.full(picture.shape[:2], 0.95, np.float32)

    refined = igsr.refine(capture, 1, steps=30, backend="cpu", denoiser=sure, out=tmp_path)
    (done,) = refined.rounds
    assert len(done.held_out) == 3
    assert done.verdict.startswith("3 held-out photos change by ")
    report = json.loads((tmp_path / "report.json").read_text())
    rows = report["rounds"][1]["cross_validation"]["held_out"]
    assert [row["name"] for row in rows] == [view.name for view in done.held_out]
    assert np.mean([row["psnr_after"] for row in rows]) == pytest.approx(
        done.validation_after["psnr"]
    )
    browser.load(tmp_path / "report.html")
    sliders = "document.querySelectorAll('.slider')"
    assert browser.run(f"{sliders}.length") == 3
    shown = "[...document.querySelectorAll('.slider img')].map(one => one.naturalWidth)"
    assert browser.run(shown) == [40] * 6
    over = f"{sliders}[1].querySelector('.over')"
    assert browser.run(f"getComputedStyle({over}).clipPath") == "inset(0px 0px 0px 50%)"
    moved = f"(() => {{ const bar = {sliders}[1].querySelector('input'); bar.value = 20; "
    moved += "bar.dispatchEvent(new Event('input')); "
    moved += f"return getComputedStyle({over}).clipPath; }})()"
    assert browser.run(moved) == "inset(0px 0px 0px 20%)"


def held_out(gains):
    """A round whose held-out photos gained so many dB."""
    picture = np.zeros((2, 2, 3), np.uint8)
    views = [HeldOutView(f"{g}", picture, picture, picture, 20.0, 20.0 + g) for g in gains]
    return Round([], [], {}, {}, True, None, None, views)


@pytest.mark.parametrize(
    ("gains", "verdict"),
    [
        ([], ""),
        ([0.5, 0.6], "2 held-out photos are too few to tell gain from chance."),
        ([0.5, 0.6, 0.4], "3 held-out photos change by +0.50 ± 0.06 dB: more than chance."),
        ([0.5, -0.6, 0.4], "3 held-out photos change by +0.10 ± 0.35 dB: it may be chance."),
        ([-0.5, -0.6, -0.4], "3 held-out photos change by -0.50 ± 0.06 dB: more than chance."),
        ([0.5, 0.6, float("inf")], ""),
    ],
)
def test_gains_within_chance_are_reported(gains, verdict):
    assert held_out(gains).verdict == verdict


def test_text_is_escaped(tmp_path):
    name = '"><script>alert("photo")</script>\udcff.png'
    made = scenes.capture(views=4, size=16)
    views = [replace(view, name=f"{k}{name}") for k, view in enumerate(made.views)]
    capture = igsr.Capture(Path("a<b>&c"), views)
    splats = scenes.splats()
    stop = Stop(StopReason.NO_NOVEL_VIEW)
    refined = Refined(splats, splats, None, capture, [], stop, [], {"fit": 1.0})
    report = report_of(refined, RefineSettings(backend="cpu"))
    report["not_registered"] = ["<i>lost</i>.png"]
    write_page(tmp_path / "report.html", refined, report)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "alert(" in page
    for unsafe in ('"photo"', "a<b>", "<i>", "<script>alert"):
        assert unsafe not in page
    assert "a&lt;b&gt;&amp;c" in page
    assert "&lt;i&gt;lost&lt;/i&gt;.png" in page
    assert "there is no novel view near the photos" in page
