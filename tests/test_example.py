"""The example photos that come with igsr, the capture they are from, and ``--example``."""

from __future__ import annotations

import json

import numpy as np
import pytest
import scenes
from capture_files import assert_refused

import igsr
from igsr import _core
from igsr.capture.example import write_example

#: Position of the glazed marble in examples/make_capture.py, the only teal object in the scene.
MARBLE = np.array([0.82, -0.22, 0.085])
FIT = ["--steps", "4", "--backend", "cpu", "--json"]


@pytest.fixture(scope="module")
def capture(example_path):
    return igsr.load_capture(example_path)


def test_it_has_eight_photos_of_the_source(tmp_path, capture):
    written = igsr.load_capture(write_example(tmp_path / "example"))
    assert len(written.train_views) == len(written.test_views) == 8
    by_name = {view.name: view for view in capture.views}
    assert all(view == by_name[view.name] for view in written.views)
    names = [view.name for view in capture.train_views]
    gaps = np.diff([names.index(view.name) for view in written.train_views])
    assert gaps.min() >= len(names) // 8, "evenly spaced"
    assert sum(map(len, _core.example_files().values())) < 1_000_000


def test_damaged_files_are_replaced_and_others_stay(tmp_path):
    (tmp_path / "file").write_text("a file")
    assert_refused(r"Cannot write .*file", write_example, tmp_path / "file")
    folder = write_example(tmp_path / "example")
    photo = folder / "train" / "002.png"
    whole = photo.read_bytes()
    other = folder / "test" / "000.png"
    before = other.stat().st_mtime_ns
    photo.write_bytes(whole[:100])
    write_example(folder)
    assert photo.read_bytes() == whole
    assert other.stat().st_mtime_ns == before


@pytest.mark.parametrize("command", ["fit", "refine"])
def test_either_photos_or_the_example_must_be_given(tmp_path, igsr_here, command):
    none = igsr_here(command, "--out", tmp_path / "out")
    assert none.stderr == "PHOTOS is missing; name a folder of photos, or give --example.\n"
    both = igsr_here(command, "photos", "--example", "--out", tmp_path / "out")
    assert "photos or --example" in both.stderr
    assert none.returncode == both.returncode == 1
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


def test_size_and_splits_of_the_source(capture, example_path):
    assert len(capture.train_views) == 40
    assert len(capture.test_views) == 8
    for view in capture.views:
        assert view.image.shape == (view.camera.height, view.camera.width, 4)
        seen = view.image[..., 3] > 0
        assert 0.1 < seen.mean() < 0.6
        # The object is whole in every photo, and transparent pixels are black.
        assert seen[1:-1, 1:-1].sum() == seen.sum()
        assert (view.image[~seen] == 0).all()
    size = sum(file.stat().st_size for file in example_path.rglob("*") if file.is_file())
    assert size <= 3_000_000


def test_cameras_of_the_source_agree_with_its_photos(capture):
    for view in capture.train_views[20:]:  # from above: nothing occludes the marble
        in_camera = view.camera.viewmat[:3, :3] @ MARBLE + view.camera.viewmat[:3, 3]
        projected = view.camera.K @ in_camera
        red, green, blue, alpha = np.moveaxis(view.image.astype(int), -1, 0)
        teal = (green - red > 30) & (abs(green - blue) < 35) & (alpha == 255)
        rows, columns = np.nonzero(teal)
        assert len(rows) > 40
        seen = np.array([np.median(columns), np.median(rows)]) + 0.5
        # Its lit side is better visible than its shaded side.
        assert np.linalg.norm(seen - projected[:2] / projected[2]) < 3.0, view.name
