"""Two runs into one folder."""

import os
import signal
import subprocess
import sys
import threading

import pytest
import scenes

import igsr
from igsr._internal.folder_lock import LOCK_FILE, folder_lock, try_lock
from igsr.errors import IgsrError

HOLD = """
import sys, time
from pathlib import Path
from igsr._internal.folder_lock import folder_lock
with folder_lock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""
OPTIONS = {"steps": 2, "max_splats": 100, "backend": "cpu"}


@pytest.fixture
def holder(tmp_path):
    """A process that holds the folder ``out``."""
    out = tmp_path / "out"
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(out)], stdout=subprocess.PIPE
    ) as process:
        assert process.stdout.readline() == b"held\n"
        yield out, process
        process.kill()


def test_another_process_is_named(holder):
    out, process = holder
    message = rf"Another igsr \(process {process.pid} on .*\) writes to .*out; wait until it ends"
    for run in (igsr.fit, igsr.refine):
        with pytest.raises(IgsrError, match=message):
            run(scenes.capture(), out=out, steps=2, backend="cpu")
    assert [path.name for path in out.iterdir()] == [LOCK_FILE]


def test_a_killed_process_holds_nothing(holder):
    out, process = holder
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert (out / LOCK_FILE).is_file()
    igsr.fit(scenes.capture(), out=out, **OPTIONS)
    assert (out / "scene.ply").is_file()
    assert not (out / LOCK_FILE).exists()


@pytest.mark.skipif(sys.platform == "win32", reason="no pipes in folders")
def test_a_link_or_a_held_pipe_is_no_lock(tmp_path):
    (tmp_path / "precious").write_text("kept")
    (tmp_path / LOCK_FILE).symlink_to(tmp_path / "precious")
    with folder_lock(tmp_path):
        assert (tmp_path / "precious").read_text() == "kept"
    (tmp_path / LOCK_FILE).unlink()
    os.mkfifo(tmp_path / LOCK_FILE)
    with open(tmp_path / LOCK_FILE, "r+b", buffering=0) as pipe:
        assert try_lock(pipe.fileno())
        signal.alarm(10)  # ends the test if it waits for the pipe
        with folder_lock(tmp_path):
            signal.alarm(0)


def test_threads_take_turns(tmp_path):
    refused = []
    inside, ended = threading.Event(), threading.Event()

    def hold():
        with folder_lock(tmp_path):
            inside.set()
            ended.wait(10)

    thread = threading.Thread(target=hold)
    thread.start()
    inside.wait(10)
    with pytest.raises(IgsrError, match=f"process {os.getpid()} on"), folder_lock(tmp_path):
        refused.append(False)
    ended.set()
    thread.join()
    with folder_lock(tmp_path):
        assert (tmp_path / LOCK_FILE).is_file()
    assert not refused
    assert not list(tmp_path.iterdir())


def test_folders_that_stay_empty_are_removed(tmp_path):
    with pytest.raises(IgsrError, match="steps"):
        igsr.fit(scenes.capture(), out=tmp_path / "a" / "b", **(OPTIONS | {"steps": 0}))
    assert not list(tmp_path.iterdir())


def test_a_file_system_without_locks(tmp_path, monkeypatch):
    monkeypatch.setattr("igsr._internal.folder_lock.try_lock", lambda file: None)
    with folder_lock(tmp_path), folder_lock(tmp_path):
        pass
