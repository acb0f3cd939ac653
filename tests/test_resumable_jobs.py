"""Runs of a study: kept one by one, whatever becomes of the others."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

import igsr
from igsr._internal.resumable_jobs import Run, finished_runs, folder_hash


def work(data, what):
    """Write a file and return a row; "fails" fails while "slow" is under way."""
    if what == "fails":
        time.sleep(0.5)
        raise igsr.IgsrError("this one fails.")
    if what == "slow":
        time.sleep(2.0)
    Path(data, what).write_text("made")
    return {"what": what}


def test_when_a_run_fails_those_under_way_are_kept(tmp_path):
    runs = [Run(name, name, {}) for name in ("fails", "slow", "never")]
    with pytest.raises(igsr.IgsrError, match="this one fails"):
        finished_runs(tmp_path / "runs", runs, work, str(tmp_path), 2, None)
    assert (tmp_path / "runs/slow.json").is_file()
    assert not (tmp_path / "runs/fails.json").exists()


def test_a_run_without_what_it_left_is_done_again(tmp_path):
    left = tmp_path / "quick"
    (run,) = runs = [Run("quick", "quick", {"steps": 3}, left)]
    done = []

    def rows():
        return finished_runs(
            tmp_path / "runs", runs, work, str(tmp_path), 1, lambda *row: done.append(row)
        )

    first = rows()
    assert rows() == first
    assert len(done) == 1
    left.unlink()
    assert rows() == first
    assert len(done) == 2
    assert left.is_file()
    assert run.settings == {"steps": 3}


def test_a_run_whose_scene_has_changed_is_done_again(tmp_path):
    (tmp_path / "scene").mkdir()
    photo = tmp_path / "scene" / "photo.png"
    photo.write_bytes(b"first")
    done = []

    def rows(scene):
        runs = [Run("quick", "quick", {"steps": 3}, scene=scene)]
        return finished_runs(
            tmp_path / "runs", runs, work, str(tmp_path), 1, lambda *row: done.append(row)
        )

    (row,) = rows("scene")
    assert row["settings"] == {"steps": 3, "data": folder_hash(photo.parent)}
    assert rows("scene") == [row]
    assert len(done) == 1
    photo.write_bytes(b"mended")
    assert rows("scene") != [row]
    assert len(done) == 2
    assert rows(None)[0]["settings"] == {"steps": 3}
    assert len(done) == 3
