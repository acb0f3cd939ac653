"""Folders and files that load_capture reads or refuses."""

from __future__ import annotations

import pytest
from capture_files import assert_refused, photo, save, write_colmap, write_transforms

from igsr.capture import load_capture


def test_file_and_folder_are_the_same_capture(tmp_path):
    write_transforms(tmp_path)
    assert load_capture(str(tmp_path / "transforms.json")) == load_capture(tmp_path)


def test_transforms_come_before_a_colmap_model(tmp_path):
    write_colmap(tmp_path)
    assert load_capture(tmp_path).points is not None
    write_transforms(tmp_path, 2)
    assert len(load_capture(tmp_path).views) == 2


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


@pytest.mark.parametrize("name", ["missing", "a\0b", "a" * 5000])
def test_path_that_does_not_exist(name, tmp_path):
    assert_refused("does not exist", load_capture, tmp_path / name)
