"""``report.html`` of a refinement in a browser: its script runs, cameras and pictures appear."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from refinements import refine, truthful

import igsr
from igsr.refinement.html_page import write_page
from igsr.refinement.report import report_of
from igsr.refinement.results import HeldOutView, Refined, Round, Stop, StopReason
from igsr.refinement.settings import RefineSettings

#: Colors of the cameras of photos and of added views.
PHOTOS, ADDED = (59, 125, 216), (224, 138, 30)


def cameras_drawn(browser, page):
    """The drawing of the cameras, int [H, W, 3]."""
    browser.load(page)
    size = browser.run("[canvas.height, canvas.width, 4]")
    data = "canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data"
    return np.array(browser.run(f"Array.from({data})"), np.uint8).reshape(size).astype(int)[..., :3]


def near(pixels, color):
    return int((np.abs(pixels - color).max(axis=-1) < 40).sum())


def test_the_page_draws_the_cameras(browser, helped):
    pixels = cameras_drawn(browser, helped[1] / "report.html")
    for color in (PHOTOS, ADDED):
        assert near(pixels, color) > 100


def test_held_out_photos_are_compared_with_a_slider(browser, few_photos, tmp_path):
    (done,) = refine(few_photos, 1, truthful, steps=30, out=tmp_path).rounds
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
    """A round with these gains of held-out photos, dB."""
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
def test_the_verdict_compares_the_gain_with_its_error(gains, verdict):
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
    report["photos"]["not_placed"] = ["<i>lost</i>.png"]
    write_page(tmp_path / "report.html", refined, report)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "alert(" in page
    for unsafe in ('"photo"', "a<b>", "<i>", "<script>alert"):
        assert unsafe not in page
    assert "a&lt;b&gt;&amp;c" in page
    assert "&lt;i&gt;lost&lt;/i&gt;.png" in page
    assert "there is no novel view near the photos" in page
