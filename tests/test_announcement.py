"""The announcement of a run, and its estimate of the time."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from PIL import Image

from igsr.cameras.colmap import aliked
from igsr.cameras.colmap.estimator import camera_seconds
from igsr.capture.load import Overview, look_at
from igsr.fitting import announcement, settings_for, time_estimate
from igsr.fitting.time_estimate import TYPICAL, StepTime, fit_seconds, other_seconds, work_done

#: A step that takes a microsecond per pixel.
PER_PIXEL = StepTime(0.0, 1e-6, 0.0)


def test_the_time_of_a_fit_is_that_of_its_steps():
    settings = settings_for(8, steps=1000, max_splats=1000, coarse_to_fine=False)
    assert fit_seconds(settings, 400, 300, PER_PIXEL) == pytest.approx(120.0)
    assert fit_seconds(settings, 400, 300, StepTime(0.01, 0.0, 0.0)) == pytest.approx(10.0)
    # Half of the maximum number of splats at first, and all from half of the steps on.
    splats = fit_seconds(settings, 400, 300, StepTime(0.0, 0.0, 1e-3)) / 1000 / 1e-3
    assert 0.8 * 1000 < splats < 0.95 * 1000
    late = replace(settings, first_step=750)
    assert fit_seconds(late, 400, 300, PER_PIXEL) == pytest.approx(30.0)
    coarse = replace(settings, coarse_to_fine=True)
    # Three tenths of the steps: half at a quarter, half at half of the sides.
    expected = 120.0 * (0.7 + 0.15 / 4 + 0.15 / 16)
    assert fit_seconds(coarse, 400, 300, PER_PIXEL) == pytest.approx(expected, rel=0.02)


def test_progress_is_a_fraction_of_the_work():
    settings = settings_for(100)
    parts = [work_done(settings, 800, 600, step) for step in range(0, settings.steps + 1, 100)]
    assert (parts[0], parts[-1]) == (0.0, 1.0)
    assert (np.diff(parts) > 0.0).all()
    # The first three tenths of the steps are a tenth of the work: small photos, few splats.
    assert work_done(settings, 800, 600, round(0.3 * settings.steps)) < 0.2
    late = replace(settings, first_step=settings.steps - 100)
    assert work_done(late, 800, 600, settings.steps - 100) == 0.0
    assert work_done(late, 800, 600, settings.steps - 50) == pytest.approx(0.5, abs=0.03)


def test_steps_are_timed(monkeypatch):
    step = time_estimate.timed_steps("cpu")
    # On a busy machine, more pixels or splats can take less time.
    assert min(step.fixed, step.per_pixel, step.per_splat) >= 0.0
    assert max(step.fixed, step.per_pixel, step.per_splat) > 0.0

    def timed(backend, side, splats, *rest):
        return 1e-3 + 2e-9 * side**2 + 3e-7 * splats

    monkeypatch.setattr(time_estimate, "_timed_step", timed)
    step = time_estimate.timed_steps("cpu")
    assert (step.fixed, step.per_pixel, step.per_splat) == pytest.approx((1e-3, 2e-9, 3e-7))


def test_time_of_depth_maps_and_scores():
    assert other_seconds(0, 0, 1e6) == 0.0
    assert other_seconds(8, 0, 1e6) < other_seconds(24, 0, 1e6) == other_seconds(100, 0, 1e6)
    assert other_seconds(0, 10, 2e6) == pytest.approx(2.0 * other_seconds(0, 10, 1e6))
    # A machine with steps of half the time needs half the time for the rest.
    fast = StepTime(TYPICAL.fixed / 2.0, TYPICAL.per_pixel / 2.0, TYPICAL.per_splat / 2.0)
    assert time_estimate.slowdown(TYPICAL, alpha=False) == 1.0
    assert time_estimate.slowdown(fast, alpha=False) == pytest.approx(0.5)
    assert time_estimate.slowdown(fast, alpha=True) > 0.5
    assert other_seconds(8, 10, 1e6, 0.5) == pytest.approx(0.5 * other_seconds(8, 10, 1e6))


def test_cameras_take_longer_for_more_and_larger_photos():
    small = camera_seconds([(400, 300)] * 10)
    assert 0.0 < small < camera_seconds([(1600, 1200)] * 10) < camera_seconds([(1600, 1200)] * 40)
    assert camera_seconds([(4000, 3000)] * 10) == camera_seconds([(1600, 1200)] * 10)


def test_the_trained_matcher_takes_longer(with_aliked):
    sizes = [(1600, 1200)] * 10
    learned = camera_seconds(sizes)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(aliked, "is_available", lambda: False)
        assert camera_seconds(sizes) < 0.5 * learned


def overview(sizes, **fields):
    usual = {"path": Path("photos"), "has_cameras": True, "train": len(sizes), "channels": 3}
    return Overview(sizes=sizes, **{**usual, "masked": False, **fields})


@pytest.fixture
def announced(monkeypatch):
    """The three sentences of a run whose steps take a known time."""
    monkeypatch.setattr(announcement, "timed_steps", lambda backend, degree, alpha: PER_PIXEL)

    def sentences(seen, **options):
        usual = {"holdout": None, "max_size": 1000, "quality": "normal", "backend": "cpu"}
        usual |= {"given": {"steps": 600}, "cameras_known": seen.has_cameras}
        return announcement.announcement(seen, **{**usual, **options})

    return sentences


def test_photos_work_and_time_are_announced(announced):
    sizes = [(1558, 1039)] * 24 + [(1039, 1558)]
    seen = overview(sizes, has_cameras=False, masked=True)
    photos, work, time = announced(seen, holdout=8)
    assert photos == (
        "Found 25 photos of 1558x1039 to 1039x1558, 4 of them held out, without cameras."
    )
    assert work.startswith("Finds the cameras, then fits at 1000x667: up to ")
    assert work.endswith(" splats, 600 steps.")
    assert "of it for cameras" in time
    posed = replace(seen, has_cameras=True)
    photos, work, time = announced(posed)
    assert photos.endswith("1039x1558.")
    assert work.startswith("Fits at 1000x667")
    assert "cameras" not in time
    # 600 steps of 667 000 pixels, three tenths of them on smaller photos; depth maps and scores
    # take long, too, on such a slow machine.
    assert "about 15 min" in time
    assert "at most about" in announced(posed, rounds=4)[2]


@pytest.mark.parametrize(("holdout", "steps"), [(None, 2500), (2, 1750)])
def test_held_out_photos_do_not_count(announced, holdout, steps):
    seen = overview([(300, 200)] * (100 if holdout is None else 20))
    assert announced(seen, holdout=holdout, given={})[1].endswith(f"{steps} steps.")


def test_detailed_photos_have_more_splats(announced, tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (200, 304, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "0.png")
    seen = overview([(304, 200)] * 8)
    plain, detailed = (announced(replace(seen, plain=p))[1] for p in ([], [tmp_path / "0.png"]))
    assert "up to 18240 splats" in plain
    assert f"up to {round(0.5 * 304 * 200)} splats" in detailed


def test_look_at_lists_the_files_of_photos(tmp_path):
    path = scenes.write_capture(tmp_path, scenes.capture(views=3, size=32))
    for folder in (path, path / "photos"):
        names = sorted(file.name for file in look_at(folder).plain)
        assert names == ["00.png", "01.png", "02.png"]


def test_photos_without_depth_maps_take_less(announced):
    seen = overview([(200, 200)] * 30)

    def time(changed, **options):
        return announced(changed, given={"steps": 10, **options})[2]

    assert "about 2 min" in time(seen)
    # A slow GPU does not say how fast the CPU is, which computes depth maps and scores.
    assert "about 15 s" in announced(seen, given={"steps": 10}, backend="gpu")[2]
    assert "about 10 s" in time(replace(seen, channels=4))
    assert "about 5 s" in time(replace(seen, depths=True))
    assert "about 5 s" in time(seen, start="points")
