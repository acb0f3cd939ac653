"""Runs that are kept one by one, and repeated if anything that they depend on changed."""

import time
from pathlib import Path

import pytest

import igsr
from igsr_lab.resumable_jobs import Run, finished_runs, folder_hash


def work(data, what):
    """Write a file and return a row; "fails" fails while "slow" is running."""
    if what == "fails":
        time.sleep(0.5)
        raise igsr.IgsrError("this one fails.")
    if what == "slow":
        time.sleep(2.0)
    Path(data, what).write_text("made")
    return {"what": what}


def test_other_runs_are_kept_when_one_fails(tmp_path):
    runs = [Run(name, name, {}) for name in ("fails", "slow", "never")]
    with pytest.raises(igsr.IgsrError, match="this one fails"):
        finished_runs(tmp_path / "runs", runs, work, str(tmp_path), 2, None)
    assert (tmp_path / "runs/slow.json").is_file()
    assert not (tmp_path / "runs/fails.json").exists()


def test_a_run_is_repeated_if_its_file_scene_or_settings_changed(tmp_path):
    photo = tmp_path / "scene" / "photo.png"
    photo.parent.mkdir()
    photo.write_bytes(b"first")
    done = []

    def rows(scene="scene", steps=3):
        runs = [Run("quick", "quick", {"steps": steps}, tmp_path / "quick", scene=scene)]
        return finished_runs(
            tmp_path / "runs", runs, work, str(tmp_path), 1, lambda *row: done.append(row)
        )

    (row,) = rows()
    assert row["settings"] == {"steps": 3, "data": folder_hash(photo.parent)}
    assert rows() == [row]
    assert len(done) == 1
    (tmp_path / "quick").unlink()
    assert rows() == [row]
    assert len(done) == 2
    assert (tmp_path / "quick").is_file()
    photo.write_bytes(b"second")
    assert rows() != [row]
    assert len(done) == 3
    assert rows(scene=None)[0]["settings"] == {"steps": 3}
    assert rows(scene=None, steps=4)[0]["settings"] == {"steps": 4}
    assert len(done) == 5
