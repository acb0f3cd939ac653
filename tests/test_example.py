"""The example capture that igsr brings along, and ``--example``."""

from __future__ import annotations

import json

import numpy as np
import pytest
import scenes

import igsr
from igsr import _core
from igsr.capture.example import write_example
from igsr.cli.refine import _some_photos


def test_it_is_the_eight_photos_that_refine_takes_of_the_capture_in_the_repository(
    tmp_path, example_path
):
    written = igsr.load_capture(write_example(tmp_path / "example"))
    expected = _some_photos(igsr.load_capture(example_path), 8)
    assert len(written.train_views) == len(written.test_views) == 8
    for one, other in zip(written.views, expected.views, strict=True):
        assert one.name == other.name
        assert one.split == other.split
        np.testing.assert_array_equal(one.camera.viewmat, other.camera.viewmat)
        np.testing.assert_array_equal(one.camera.K, other.camera.K)
        np.testing.assert_array_equal(one.image, other.image)


def test_it_is_small():
    assert sum(map(len, _core.example_files().values())) < 1_000_000


def test_files_that_are_there_stay_and_damaged_ones_are_mended(tmp_path):
    folder = write_example(tmp_path / "example")
    photo = folder / "train" / "002.png"
    whole = photo.read_bytes()
    kept = folder / "test" / "000.png"
    before = kept.stat().st_mtime_ns
    photo.write_bytes(whole[:100])
    write_example(folder)
    assert photo.read_bytes() == whole
    assert kept.stat().st_mtime_ns == before


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "example").write_text("a file")
    with pytest.raises(igsr.IgsrError, match=r"Cannot write .*example"):
        write_example(tmp_path / "example")


@pytest.mark.parametrize("command", ["fit", "refine"])
def test_photos_or_the_example_must_be_given_and_not_both(tmp_path, igsr_here, command):
    argument = "CAPTURE" if command == "fit" else "PHOTOS"
    none = igsr_here(command, "--out", tmp_path / "out")
    assert none.returncode == 1
    assert none.stderr.strip() == (
        f"{argument} is missing; name a folder of photos, or give --example."
    )
    both = igsr_here(command, "photos", "--example", "--out", tmp_path / "out")
    assert both.returncode == 1
    assert "photos or --example" in both.stderr
    assert not (tmp_path / "out").exists()


def test_a_fit_of_the_example_is_run_again_from_its_report_and_scored_again(tmp_path, igsr_here):
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


def test_other_photos_are_still_fitted(tmp_path, igsr_here):
    capture = scenes.write_capture(tmp_path / "capture", scenes.capture(views=3, size=32))
    options = ["--steps", "2", "--backend", "cpu", "--no-html", "--json"]
    result = igsr_here("fit", capture, "--out", tmp_path / "out", *options)
    assert result.returncode == 0, result.stderr
    assert not (tmp_path / "out" / "example").exists()
