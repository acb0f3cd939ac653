"""``report.html`` in a real browser: its script runs, its pictures and cameras are drawn."""

from __future__ import annotations

import shutil
import subprocess

import numpy as np
import pytest
import scenes
from PIL import Image

import igsr

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
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
    browser = next((name for name in BROWSERS if shutil.which(name)), None)
    assert browser, "no browser to open the page with: install chromium, as make test does"
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    command += ["--window-size=1200,3000", f"--user-data-dir={picture.parent / 'profile'}"]
    command += [f"--screenshot={picture}", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert picture.is_file(), done.stderr
    return np.asarray(Image.open(picture).convert("RGB")).astype(int)


def near(pixels, color):
    return int((np.abs(pixels - color).max(axis=-1) < 40).sum())


def test_a_browser_shows_it(report, tmp_path):
    pixels = shown(report, tmp_path / "page.png")
    assert near(pixels, PHOTOS) > 100
    assert near(pixels, ADDED) > 100
    broken = tmp_path / "broken.html"
    broken.write_text(report.read_text().replace("function draw()", "function other()"))
    pixels = shown(broken, tmp_path / "broken.png")
    assert near(pixels, PHOTOS) < 100, "else the test would pass without the script"
