"""``report.html`` of a refinement in a browser: its script runs, cameras and pictures appear."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import scenes

import igsr
from igsr.refinement.html_page import write_page
from igsr.refinement.report import report_of
from igsr.refinement.results import Refined, Stop, StopReason
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
