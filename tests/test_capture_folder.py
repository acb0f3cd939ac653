"""Folders and files that load_capture reads or refuses."""

from __future__ import annotations

import pytest
from capture_files import assert_refused, photo, save, write_colmap, write_transforms

from igsr.capture import load_capture
from igsr.capture.load import look_at


def test_transforms_come_before_a_colmap_model_and_may_be_named_as_a_file(tmp_path):
    write_colmap(tmp_path)
    assert load_capture(tmp_path).points is not None
    write_transforms(tmp_path, 2)
    capture = load_capture(tmp_path)
    assert len(capture.views) == 2
    assert load_capture(str(tmp_path / "transforms.json")) == capture


@pytest.mark.parametrize("write", [write_colmap, write_transforms])
def test_images_folder_next_to_cameras(write, tmp_path):
    write(tmp_path)
    views = load_capture(tmp_path / "images").views
    assert [view.name for view in views] == ["images/0.png", "images/1.png", "images/2.png"]


def test_no_cameras(tmp_path):
    assert_refused("no images and no cameras", load_capture, tmp_path)
    path = save(tmp_path / "images/a.png", photo())
    assert_refused("images folder but no cameras", load_capture, tmp_path)
    assert_refused("1 images but no cameras; put a COLMAP model", load_capture, tmp_path / "images")
    assert_refused(r"a\.png is no capture", load_capture, path)


def test_path_that_does_not_exist(tmp_path):
    for name in ("missing", "a\0b", "a" * 5000):
        assert_refused("does not exist", load_capture, tmp_path / name)
        assert_refused("give a folder of photos, a video or a capture", look_at, tmp_path / name)


def test_fits_ask_for_photos_if_a_folder_has_none(tmp_path):
    assert_refused("holds no photos", look_at, tmp_path)
