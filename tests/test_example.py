"""The example photos that come with igsr, and ``--example``."""

from __future__ import annotations

import json

import numpy as np
import pytest
import scenes

import igsr
from igsr import _core
from igsr.capture.example import write_example

FIT = ["--steps", "4", "--backend", "cpu", "--json"]


def test_it_has_eight_photos_of_the_capture_in_the_repository(tmp_path, example_path):
    written = igsr.load_capture(write_example(tmp_path / "example"))
    whole = igsr.load_capture(example_path)
    assert len(written.train_views) == len(written.test_views) == 8
    by_name = {view.name: view for view in whole.views}
    for view in written.views:
        expected = by_name[view.name]
        assert view.split == expected.split
        np.testing.assert_array_equal(view.camera.viewmat, expected.camera.viewmat)
        np.testing.assert_array_equal(view.camera.K, expected.camera.K)
        np.testing.assert_array_equal(view.image, expected.image)
    names = [view.name for view in whole.train_views]
    gaps = np.diff([names.index(view.name) for view in written.train_views])
    assert gaps.min() >= len(names) // 8, "evenly spaced"
    assert sum(map(len, _core.example_files().values())) < 1_000_000


def test_damaged_files_are_replaced_and_others_stay(tmp_path):
    folder = write_example(tmp_path / "example")
    photo = folder / "train" / "002.png"
    whole = photo.read_bytes()
    other = folder / "test" / "000.png"
    before = other.stat().st_mtime_ns
    photo.write_bytes(whole[:100])
    write_example(folder)
    assert photo.read_bytes() == whole
    assert other.stat().st_mtime_ns == before


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "example").write_text("a file")
    with pytest.raises(igsr.IgsrError, match=r"Cannot write .*example"):
        write_example(tmp_path / "example")


@pytest.mark.parametrize("command", ["fit", "refine"])
def test_either_photos_or_the_example_must_be_given(tmp_path, igsr_here, command):
    none = igsr_here(command, "--out", tmp_path / "out")
    assert none.returncode == 1
    assert none.stderr == "PHOTOS is missing; name a folder of photos, or give --example.\n"
    both = igsr_here(command, "photos", "--example", "--out", tmp_path / "out")
    assert both.returncode == 1
    assert "photos or --example" in both.stderr
    assert not (tmp_path / "out").exists()


def test_a_fit_of_the_example_can_be_scored_again(tmp_path, igsr_here):
    first = igsr_here("fit", "--example", "--out", tmp_path, *FIT)
    assert first.returncode == 0, first.stderr
    report = json.loads(first.stdout)
    assert report["settings"]["capture"] == str(tmp_path / "example")
    files = [tmp_path / "scene.ply", tmp_path / "example"]
    scores = igsr_here("eval", *files, "--backend", "cpu", "--json")
    assert json.loads(scores.stdout)["psnr"] == pytest.approx(report["psnr"])


def test_other_photos_are_fitted_without_the_example(tmp_path, igsr_here):
    capture = scenes.write_capture(tmp_path / "capture", scenes.capture(views=3, size=32))
    result = igsr_here("fit", capture, "--out", tmp_path / "out", *FIT)
    assert result.returncode == 0, result.stderr
    assert not (tmp_path / "out" / "example").exists()
