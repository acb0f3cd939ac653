"""``report.html`` in a real browser: its script runs, its pictures and cameras are drawn."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from browser import browser_program
from PIL import Image

import igsr
from igsr.refinement.html_page import write_page
from igsr.refinement.report import report_of
from igsr.refinement.results import Refined, Stop, StopReason
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


def shown(page, picture):
    command = [
        browser_program(),
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--hide-scrollbars",
    ]
    command += ["--window-size=1200,3000", f"--user-data-dir={picture.parent / 'profile'}"]
    command += [f"--screenshot={picture}", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert picture.is_file(), done.stderr
    return np.asarray(Image.open(picture).convert("RGB")).astype(int)


def near(pixels, color):
    return int((np.abs(pixels - color).max(axis=-1) < 40).sum())


def test_a_browser_shows_it(report, tmp_path):
    pixels = shown(report, tmp_path / "page.png")
    broken = tmp_path / "broken.html"
    broken.write_text(report.read_text().replace("function draw()", "function other()"))
    without = shown(broken, tmp_path / "broken.png")
    for color in (PHOTOS, ADDED):  # the legend has them too
        assert near(pixels, color) > near(without, color) + 100


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
