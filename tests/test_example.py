"""The example capture that igsr contains, the photos it comes from, and ``--example``."""

from __future__ import annotations

import json

import numpy as np
import pytest
import scenes

import igsr
from igsr import _core
from igsr.capture.example import write_example
from igsr.cli.refine import _some_photos

# Position of the glazed marble in examples/make_capture.py, the only teal object in the scene.
MARBLE = np.array([0.82, -0.22, 0.085])


@pytest.fixture(scope="module")
def capture(example_path):
    return igsr.load_capture(example_path)


def test_it_has_the_eight_photos_that_refine_takes_of_the_source(tmp_path, capture):
    written = igsr.load_capture(write_example(tmp_path / "example"))
    expected = _some_photos(capture, 8)
    assert len(written.train_views) == len(written.test_views) == 8
    assert written.views == expected.views
    assert sum(map(len, _core.example_files().values())) < 1_000_000


def test_complete_files_are_kept_and_damaged_ones_replaced(tmp_path):
    folder = write_example(tmp_path / "example")
    damaged, kept = folder / "train" / "002.png", folder / "test" / "000.png"
    whole, before = damaged.read_bytes(), kept.stat().st_mtime_ns
    damaged.write_bytes(whole[:100])
    write_example(folder)
    assert damaged.read_bytes() == whole
    assert kept.stat().st_mtime_ns == before


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "example").write_text("a file")
    with pytest.raises(igsr.IgsrError, match=r"Cannot write .*example"):
        write_example(tmp_path / "example")


@pytest.mark.parametrize(("command", "argument"), [("fit", "CAPTURE"), ("refine", "PHOTOS")])
def test_photos_or_the_example_must_be_given_and_not_both(tmp_path, igsr_here, command, argument):
    neither = igsr_here(command, "--out", tmp_path / "out")
    both = igsr_here(command, "photos", "--example", "--out", tmp_path / "out")
    assert neither.returncode == both.returncode == 1
    assert neither.stderr.strip() == (
        f"{argument} is missing; name a folder of photos, or give --example."
    )
    assert "photos or --example" in both.stderr
    assert not (tmp_path / "out").exists()


def test_a_fit_of_the_example_can_be_repeated_and_scored(tmp_path, igsr_here):
    options = ["--steps", "4", "--backend", "cpu", "--no-html", "--json"]
    first = igsr_here("fit", "--example", "--out", tmp_path / "a", *options)
    assert first.returncode == 0, first.stderr
    report = json.loads(first.stdout)
    assert report["settings"]["capture"] == str(tmp_path / "a" / "example")
    # The report names its photos, too.
    recorded = ["--config", tmp_path / "a" / "report.json"]
    again = igsr_here("fit", *recorded, "--out", tmp_path / "b", "--no-html", "--json")
    assert again.returncode == 0, again.stderr
    assert json.loads(again.stdout)["psnr"] == report["psnr"]
    of_first = [tmp_path / "a" / "scene.ply", tmp_path / "a" / "example"]
    scored = igsr_here("eval", *of_first, "--backend", "cpu", "--json")
    assert json.loads(scored.stdout)["psnr"] == pytest.approx(report["psnr"])


def test_a_fit_of_other_photos_writes_no_example(tmp_path, igsr_here):
    capture = scenes.write_capture(tmp_path / "capture", scenes.capture(views=3, size=32))
    options = ["--steps", "2", "--backend", "cpu", "--no-html", "--json"]
    result = igsr_here("fit", capture, "--out", tmp_path / "out", *options)
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
    for view in capture.train_views[20:]:  # from above, where nothing occludes the marble
        in_camera = view.camera.viewmat[:3, :3] @ MARBLE + view.camera.viewmat[:3, 3]
        projected = view.camera.K @ in_camera
        red, green, blue, alpha = np.moveaxis(view.image.astype(int), -1, 0)
        teal = (green - red > 30) & (abs(green - blue) < 35) & (alpha == 255)
        rows, columns = np.nonzero(teal)
        assert len(rows) > 40
        seen = np.array([np.median(columns), np.median(rows)]) + 0.5
        # Its lit side is better visible than its shaded side.
        assert np.linalg.norm(seen - projected[:2] / projected[2]) < 3.0, view.name
