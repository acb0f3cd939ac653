"""What commands say at once: what was found, what follows, how long; and how that is estimated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from PIL import Image

from igsr.capture.overview import Overview, look_at
from igsr.cli import announcement
from igsr.cli.announcement import announce
from igsr.fitting.presets import settings_for
from igsr.fitting.time_estimate import (
    USUAL,
    StepTime,
    fit_seconds,
    other_seconds,
    timed_steps,
    times_usual,
    work_done,
)
from igsr.pose.colmap.estimator import camera_seconds

#: A step that takes a microsecond a pixel.
BY_PIXELS = StepTime(0.0, 1e-6, 0.0)


def test_a_fit_takes_what_its_steps_take():
    settings = settings_for("3dgs", 8, steps=1000, max_splats=1000)
    assert fit_seconds(settings, 400, 300, BY_PIXELS) == pytest.approx(120.0)
    assert fit_seconds(settings, 400, 300, StepTime(0.01, 0.0, 0.0)) == pytest.approx(10.0)
    # As many as there may be from half of the steps on, and half of them at first.
    splats = fit_seconds(settings, 400, 300, StepTime(0.0, 0.0, 1e-3)) / 1000 / 1e-3
    assert 0.8 * 1000 < splats < 0.95 * 1000
    late = replace(settings, first_step=750)
    assert fit_seconds(late, 400, 300, BY_PIXELS) == pytest.approx(30.0)
    coarse = replace(settings, coarse_to_fine=True)
    # Three tenths of the steps: half at a quarter, half at half of the sides.
    expected = 120.0 * (0.7 + 0.15 / 4 + 0.15 / 16)
    assert fit_seconds(coarse, 400, 300, BY_PIXELS) == pytest.approx(expected, rel=0.02)


def test_the_bar_goes_by_time_and_not_by_steps():
    settings = settings_for("default", 100)
    parts = [work_done(settings, 800, 600, step) for step in range(0, settings.steps + 1, 100)]
    assert parts[0] == 0.0
    assert parts[-1] == 1.0
    assert (np.diff(parts) > 0.0).all()
    # Reduced photos and few splats first: three tenths of the steps are a tenth of the work.
    assert work_done(settings, 800, 600, round(0.3 * settings.steps)) < 0.2
    late = replace(settings, first_step=settings.steps - 100)
    assert work_done(late, 800, 600, settings.steps - 100) == 0.0
    assert work_done(late, 800, 600, settings.steps - 50) == pytest.approx(0.5, abs=0.03)


def test_steps_are_timed():
    step = timed_steps("cpu")
    assert step.per_pixel > 0.0
    assert step.per_splat >= 0.0
    assert 1e-5 < step.of(400 * 300, 10_000) < 10.0


def test_depth_maps_and_scores_count():
    assert other_seconds(0, 0, 1e6) == 0.0
    assert other_seconds(8, 0, 1e6) < other_seconds(24, 0, 1e6) == other_seconds(100, 0, 1e6)
    assert other_seconds(0, 10, 2e6) == pytest.approx(2.0 * other_seconds(0, 10, 1e6))
    # A machine whose steps take half as long takes half as long for the rest.
    fast = StepTime(USUAL.fixed / 2.0, USUAL.per_pixel / 2.0, USUAL.per_splat / 2.0)
    assert times_usual(USUAL, alpha=False) == 1.0
    assert times_usual(fast, alpha=False) == pytest.approx(0.5)
    assert times_usual(fast, alpha=True) > 0.5
    assert other_seconds(8, 10, 1e6, 0.5) == pytest.approx(0.5 * other_seconds(8, 10, 1e6))


def test_cameras_take_longer_for_more_and_larger_photos():
    small = camera_seconds([(400, 300)] * 10)
    assert 0.0 < small < camera_seconds([(1600, 1200)] * 10) < camera_seconds([(1600, 1200)] * 40)
    assert camera_seconds([(4000, 3000)] * 10) == camera_seconds([(1600, 1200)] * 10)


def said(monkeypatch, seen, **options):
    lines = []
    monkeypatch.setattr(announcement, "print_message", lines.append)
    monkeypatch.setattr(announcement, "timed_steps", lambda backend, degree, alpha: BY_PIXELS)
    given = {
        "holdout": None,
        "max_size": 1000,
        "preset": "default",
        "quality": "normal",
        "given": {"steps": 600},
        "backend": "cpu",
        "cameras_kept": False,
        **options,
    }
    announce(seen, **given)
    assert len(lines) == 3
    return lines


def test_three_lines_say_what_is_found_done_and_how_long_it_takes(monkeypatch):
    sizes = [(1558, 1039)] * 24 + [(1039, 1558)]
    seen = Overview(Path("photos"), False, sizes, 25, 3, True, True)
    found, done, long = said(monkeypatch, seen, holdout=8)
    assert (
        found == "Found 25 photos of 1558x1039 to 1039x1558, 4 of them held out, without cameras."
    )
    assert done.startswith("Finds the cameras, then fits at 1000x667: up to ")
    assert done.endswith(" splats, 600 steps.")
    assert "of it for cameras" in long
    found, done, long = said(monkeypatch, replace(seen, has_cameras=True), cameras_kept=True)
    assert found.endswith("1039x1558.")
    assert done.startswith("Fits at 1000x667")
    assert "cameras" not in long
    # 600 steps of 667 000 pixels, of which three tenths are on smaller photos; and depth maps
    # and scores, which such a slow machine takes long for, too.
    assert "about 8 min" in long
    *_, long = said(monkeypatch, replace(seen, has_cameras=True), cameras_kept=True, rounds=4)
    assert "at most about" in long


def test_few_of_many_photos_are_counted(monkeypatch):
    seen = Overview(Path("photos"), True, [(300, 200)] * 100, 100, 3, False, True)
    given = {"steps": None}
    many = said(monkeypatch, seen, cameras_kept=True, given=given)[1]
    few = said(monkeypatch, seen, cameras_kept=True, given=given, photos=8)[1]
    assert many.endswith("2500 steps.")
    assert few.endswith("1700 steps.")


def test_detailed_photos_have_more_splats(monkeypatch, tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (200, 304, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "0.png")
    seen = Overview(Path("photos"), True, [(304, 200)] * 8, 8, 3, False, True)
    plain = said(monkeypatch, seen, cameras_kept=True)[1]
    detailed = said(monkeypatch, replace(seen, plain=[tmp_path / "0.png"]), cameras_kept=True)[1]
    most = [int(line.split("up to ")[1].split()[0]) for line in (plain, detailed)]
    assert most == [18_240, round(0.5 * 304 * 200)]


def test_the_files_of_photos_are_named(tmp_path):
    made = scenes.capture(views=3, size=32)
    scenes.write_capture(tmp_path / "capture", made)
    assert [path.name for path in look_at(tmp_path / "capture").plain] == [
        "00.png",
        "01.png",
        "02.png",
    ]
    assert sorted(look_at(tmp_path / "capture" / "photos").plain) == sorted(
        (tmp_path / "capture" / "photos").glob("*.png")
    )


def test_photos_that_need_no_depth_maps_take_less(monkeypatch):
    seen = Overview(Path("photos"), True, [(100, 100)] * 30, 30, 3, False, True)

    def seconds(changed, **given):
        given = {"steps": 10, **given}
        return said(monkeypatch, changed, cameras_kept=True, given=given)[2]

    assert "about 75 s" in seconds(seen)
    # A slow GPU says nothing of the CPU, which finds depth maps and scores.
    slow = said(monkeypatch, seen, cameras_kept=True, given={"steps": 10}, backend="gpu")[2]
    assert "about 10 s" in slow
    for without in (replace(seen, channels=4), replace(seen, depths=True)):
        assert "about 5 s" in seconds(without)
    assert "about 5 s" in seconds(seen, start="points")
