"""Frames of a video that become photos: by the camera's path and by sharpness."""

from __future__ import annotations

import av
import numpy as np
import pytest
from test_photo_folder import write_video

from igsr.capture import video_frames
from igsr.capture.photo_folder import read_photos
from igsr.capture.video_frames import MIN_FRAMES, CameraPath, evenly_sharp, sharpest_frames
from igsr.errors import IgsrError

HEIGHT, WIDTH = 136, video_frames.MOTION_SIDE_PX
STEP = video_frames.STEP_PART * WIDTH


def smooth(height, width, seed=0):
    """A texture whose details are some pixels large, uint8."""
    noise = np.random.default_rng(seed).normal(size=(height, width))
    reach = np.fft.rfftfreq(width)[None] ** 2 + np.fft.fftfreq(height)[:, None] ** 2
    blurred = np.fft.irfft2(np.fft.rfft2(noise) * np.exp(-reach / 0.02), s=(height, width))
    return np.clip(128.0 + 40.0 * blurred / blurred.std(), 0, 255).astype(np.uint8)


WALL = smooth(HEIGHT, 1200)


def pan(places):
    """Gray frames of a camera that pans along a wall to ``places``, in pixels."""
    return [WALL[:, round(x) : round(x) + WIDTH] for x in places]


def path_of(frames):
    path = CameraPath()
    return np.array([path.add(frame) for frame in frames])


# ---- the path ----------------------------------------------------------------------------------


@pytest.mark.parametrize("frames", [40, 160, 600])
def test_the_length_of_a_pan_does_not_depend_on_its_speed(frames):
    path = path_of(pan(np.linspace(0, 360, frames)))
    assert path[0] == 0.0
    assert (np.diff(path) >= 0.0).all()
    assert path[-1] == pytest.approx(360 / STEP, rel=0.05)


def test_a_stop_adds_nothing_in_spite_of_noise():
    noise = np.random.default_rng(0).normal(scale=5.0, size=(60, HEIGHT, WIDTH))
    noisy = np.clip(pan([100])[0] + noise, 0, 255).astype(np.uint8)
    assert path_of(noisy)[-1] < 0.05


def test_a_cut_is_a_step_and_blank_frames_are_none():
    other, blank = smooth(HEIGHT, WIDTH, seed=1), np.full((HEIGHT, WIDTH), 200, np.uint8)
    assert path_of([*pan([0, 0]), other, other]).tolist() == [0.0, 0.0, 1.0, 1.0]
    assert path_of([blank] * 3).tolist() == [0.0, 0.0, 0.0]
    assert path_of([blank, *pan([0, 0]), blank]).tolist() == [0.0, 1.0, 1.0, 2.0]


# ---- the choice --------------------------------------------------------------------------------


def test_frames_are_spread_over_the_path_not_over_time():
    parts = np.linspace(0, 10, 20), np.full(200, 10.0), np.linspace(10, 30, 90)
    stop_and_go = np.concatenate(parts)
    chosen = evenly_sharp(stop_and_go, np.ones(310), max_frames=100)
    assert len(chosen) == 30
    assert np.abs(np.diff(stop_and_go[chosen]) - 1.0).max() < 0.6
    assert len(evenly_sharp(stop_and_go, np.ones(310), max_frames=7)) == 7


def test_the_sharpest_frame_in_the_middle_of_a_span_is_taken():
    sharpness = np.ones(400)
    sharpness[[29, 45, 79]] = 2.0  # the middle of span 1 and of span 2; the edge of span 3
    chosen = evenly_sharp(np.arange(400) / 20.0, sharpness, max_frames=100)
    assert len(chosen) == 20
    assert set(chosen) & {29, 45, 79} == {29, 45}


@pytest.mark.parametrize("count", [1, 5, 12, 300])
def test_a_still_video_is_divided_by_time(count):
    chosen = evenly_sharp(np.zeros(count), np.ones(count), max_frames=100)
    assert len(chosen) == min(count, MIN_FRAMES)
    if count == 300:
        assert np.ptp(np.diff(chosen)) <= 1


def test_a_jump_leaves_spans_without_a_frame_empty():
    chosen = evenly_sharp(np.array([0.0, 1.0, 2.0, 30.0, 31.0]), np.ones(5), max_frames=100)
    assert chosen == sorted(set(chosen))
    assert {0, 1, 2} & set(chosen)
    assert {3, 4} & set(chosen)


# ---- files -------------------------------------------------------------------------------------


def write(path, frames):
    write_video(path, [np.repeat(frame[..., None], 3, axis=2) for frame in frames])


def test_photos_of_a_stop_and_go_video(tmp_path):
    places = np.concatenate([np.linspace(0, 150, 30), np.full(80, 150), np.linspace(150, 300, 60)])
    write(tmp_path / "walk.mp4", pan(places))
    chosen = [index for index, _ in sharpest_frames(tmp_path / "walk.mp4", 100)]
    assert len(chosen) == pytest.approx(300 / STEP, abs=2)
    assert sum(32 < index < 108 for index in chosen) <= 1
    names = [photo.name for photo in read_photos(tmp_path)]
    assert names == [f"walk.mp4/{index:06d}.png" for index in chosen]


def test_hdr_video_is_refused_by_name(tmp_path, monkeypatch):
    write(tmp_path / "walk.mp4", pan(range(4)))
    with av.open(str(tmp_path / "walk.mp4")) as container:
        plain = int(next(container.decode(video=0)).color_trc)
    assert plain not in video_frames.HDR
    monkeypatch.setattr(video_frames, "HDR", {plain: "HLG"})
    with pytest.raises(IgsrError, match=r"walk\.mp4 is HDR video \(HLG\); save it as SDR"):
        read_photos(tmp_path)
