"""The runs of the app: a folder each, in which ``igsr refine`` runs as its own process.

A run's folder holds ``photos/``, ``app.json`` (its settings and state), ``log.txt`` (output of the
command) and the files of ``igsr refine``. The command continues if the app ends.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from igsr._internal.folder_lock import LOCK_FILE, try_lock
from igsr._internal.input_files import read_file, read_json
from igsr._internal.json_file import write_json
from igsr.errors import IgsrError, printable
from igsr.rendering.run_folder import REPORT, run_progress

STATE = "app.json"
LOG = "log.txt"
PHOTOS = "photos"
QUEUED, RUNNING, STOPPED, FAILED, DONE = "queued", "running", "stopped", "failed", "done"
STATES = (QUEUED, RUNNING, STOPPED, FAILED, DONE)
QUALITIES = ("draft", "normal", "high")
#: Names of runs: the time of their creation and random letters.
_NAME = re.compile(r"[0-9]{8}-[0-9]{6}-[0-9a-f]{6}")
MAX_LOG_BYTES = 1 << 20
#: Exit codes of ``igsr`` after SIGINT and SIGTERM; on Windows, the signal.
_INTERRUPTED = (130, 143, -signal.SIGINT, -signal.SIGTERM, signal.SIGTERM)
#: Progress from which the time left is estimated.
_MIN_FRACTION = 0.02
_POLL_S = 0.5


@dataclass(frozen=True)
class Run:
    """A run as ``app.json`` stores it.

    Attributes:
        name: of its folder.
        quality: of ``igsr refine``.
        photos: number of photos and videos; 0 uses the example photos.
        holdout: as ``igsr refine``.
        allow_missing: as ``igsr refine``.
        seed: as ``igsr refine``.
        state: ``QUEUED``, ``RUNNING``, ``STOPPED``, ``FAILED`` or ``DONE``.
        message: why it failed or stopped.
    """

    name: str
    quality: str = "normal"
    photos: int = 0
    holdout: int | None = None
    allow_missing: bool = False
    seed: int = 0
    state: str = QUEUED
    message: str = ""

    def words(self, folder: Path, *, resumes: bool) -> list[str]:
        """Return the command that makes the scene in ``folder``."""
        photos = [str(folder / PHOTOS)] if self.photos else ["--example"]
        words = ["refine", *photos, "--out", str(folder), "--quality", self.quality]
        words += ["--seed", str(self.seed)]
        if self.holdout:
            words += ["--holdout", str(self.holdout)]
        if self.allow_missing:
            words.append("--allow-missing")
        return [*words, "--resume"] if resumes else words


@dataclass
class _Process:
    process: subprocess.Popen[bytes]
    #: Time and fraction of the first and the last progress.
    first: tuple[float, float] = (0.0, 0.0)
    last: tuple[float, float] = (0.0, 0.0)


class Runs:
    """All runs in a folder, and a queue that executes them one at a time."""

    def __init__(self, root: Path) -> None:
        """Use a folder, which is created.

        Raises:
            OSError: it cannot be created.
        """
        root.mkdir(parents=True, exist_ok=True)
        self.root = root.resolve()
        self._lock = threading.RLock()
        self._queue: list[str] = []
        self._current: dict[str, _Process] = {}
        self._is_closed = threading.Event()
        self._worker = threading.Thread(target=self._work, daemon=True)
        self._worker.start()

    def close(self) -> None:
        """End the run that this app started; it keeps its checkpoint."""
        self._is_closed.set()
        with self._lock:
            self._queue.clear()
            processes = [current.process for current in self._current.values()]
        for process in processes:
            process.terminate()
        self._worker.join()

    def names(self) -> list[str]:
        """Return the names of all runs, the newest first."""
        found = (
            entry.name for entry in os.scandir(self.root) if entry.is_dir(follow_symlinks=False)
        )
        return sorted(filter(_NAME.fullmatch, found), reverse=True)

    def folder(self, name: str) -> Path:
        """Return the folder of a run.

        Raises:
            IgsrError: the run does not exist.
        """
        folder = self.root / name
        if not _NAME.fullmatch(name) or folder.is_symlink() or not folder.is_dir():
            raise IgsrError("This run does not exist; choose one from the list.")
        return folder

    def create(self, files: Mapping[str, Path], run: Run | None = None) -> Run:
        """Copy photos and videos into a new folder and queue the run.

        Args:
            files: by their names in the run; none uses the example photos.
            run: its settings; name and number of photos are set here.

        Raises:
            OSError: a file cannot be copied, for example because the disk is full. Nothing is left.
        """
        name = f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}"
        run = replace(run or Run(name), name=name, photos=len(files))
        folder = self.root / name
        try:
            (folder / PHOTOS).mkdir(parents=True)
            for file_name, file in files.items():
                target = folder / PHOTOS / file_name
                target.parent.mkdir(exist_ok=True)
                shutil.copyfile(file, target)
            self._store(run)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        self.start(name)
        return run

    def get(self, name: str) -> Run:
        """Return a run in its present state.

        Raises:
            IgsrError: the run does not exist.
        """
        with self._lock:
            folder = self.folder(name)
            run = self._stored(name)
            if run.state == QUEUED and name not in self._queue:
                # Its app has ended, or the disk was full.
                return replace(run, state=STOPPED, message="Not started.")
            if run.state == RUNNING and name not in self._current and not _holder(folder):
                # Its app was killed, and the command has ended since.
                if _is_finished(folder):
                    return replace(run, state=DONE)
                return replace(run, state=STOPPED, message="It was interrupted.")
            return run

    def start(self, name: str) -> None:
        """Queue a run, to start it or to continue it from its checkpoint."""
        with self._lock:
            run = self.get(name)
            if run.state == RUNNING or name in self._queue:
                return
            self._store(replace(run, state=QUEUED, message=""))
            self._queue.append(name)

    def stop(self, name: str) -> None:
        """End a run, which keeps its checkpoint, or remove it from the queue."""
        with self._lock:
            folder = self.folder(name)
            if name in self._queue:
                self._queue.remove(name)
                self._store(replace(self._stored(name), state=STOPPED, message="Not started."))
            elif process := self._process(name, folder):
                with contextlib.suppress(OSError):  # it has ended, or the disk is full
                    os.kill(process, signal.SIGTERM)
                    self._store(replace(self._stored(name), message="Stopping."))

    def delete(self, name: str) -> None:
        """Delete a run that is not running, with its photos."""
        with self._lock:
            folder = self.folder(name)
            if self.get(name).state in (RUNNING, QUEUED):
                raise IgsrError("The run goes on; stop it first.")
            shutil.rmtree(folder)

    def log(self, name: str) -> list[str]:
        """Return the lines that the command printed."""
        try:
            text = read_file(self.folder(name) / LOG, MAX_LOG_BYTES).decode(errors="replace")
        except (OSError, IgsrError):  # deleted meanwhile
            return []
        return [printable(line) for line in text.splitlines() if line.strip()]

    def progress(self, name: str) -> tuple[str, float, float | None]:
        """Return a running run's stage, the fraction that is done, and seconds left, if known."""
        progress = run_progress(self.folder(name)) or {"text": "Starting.", "done": 0.0}
        text, done = progress["text"], progress["done"]
        with self._lock:
            current = self._current.get(name)
        if current is None or done == 0.0:
            return text, done, None
        if done != current.last[1]:
            current.last = time.monotonic(), done
            current.first = current.first if current.first[1] else current.last
        seconds, since = (b - a for a, b in zip(current.first, current.last, strict=True))
        return text, done, seconds * (1.0 - done) / since if since > _MIN_FRACTION else None

    def _process(self, name: str, folder: Path) -> int | None:
        current = self._current.get(name)
        return _holder(folder) if current is None else current.process.pid

    def _stored(self, name: str) -> Run:
        try:
            values = read_json(self.folder(name) / STATE)
            run = Run(**{key: values[key] for key in asdict(Run(name)) if key in values})
            if run.name == name and run.quality in QUALITIES and run.state in STATES:
                return run
        except (OSError, ValueError, TypeError, KeyError):
            pass
        return Run(name, state=FAILED, message=f"{STATE} cannot be read.")

    def _store(self, run: Run) -> None:
        write_json(self.root / run.name / STATE, asdict(run))

    def _work(self) -> None:
        while not self._is_closed.wait(_POLL_S):
            with self._lock:
                # A run of an app that was killed may still go on.
                if not self._queue or any(_holder(self.root / name) for name in self.names()):
                    continue
                name = self._queue.pop(0)
                try:
                    current = self._launch(name)
                except (OSError, IgsrError) as error:
                    self._end(name, FAILED, str(error))
                    continue
                self._current[name] = current
            code = current.process.wait()
            with self._lock:
                del self._current[name]
                if code == 0:
                    self._end(name, DONE, "")
                elif code in _INTERRUPTED:
                    self._end(name, STOPPED, "Continue uses its checkpoint.")
                elif code < 0:
                    self._end(name, FAILED, "It was killed; the memory may be too small.")
                else:
                    self._end(name, FAILED, (self.log(name) or [f"Exit status {code}."])[-1])

    def _launch(self, name: str) -> _Process:
        run = self._stored(name)
        folder = self.folder(name)
        resumes = (folder / LOG).exists()
        self._store(replace(run, state=RUNNING, message=""))
        command = [sys.executable, "-m", "igsr.cli", *run.words(folder, resumes=resumes)]
        (folder / LOG).unlink(missing_ok=True)  # it may be a link
        with (folder / LOG).open("xb") as log:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                # Ctrl-C in the terminal of the app ends the app, which ends the run.
                start_new_session=True,
                env={**os.environ, "PYTHONSAFEPATH": "1"},
            )
        return _Process(process)

    def _end(self, name: str, state: str, message: str) -> None:
        with contextlib.suppress(OSError, IgsrError):  # deleted meanwhile, or the disk is full
            self._store(replace(self._stored(name), state=state, message=message))


def _is_finished(folder: Path) -> bool:
    """Whether the last start of a run wrote its final report."""
    try:
        report = folder / REPORT
        is_new = report.stat().st_mtime_ns >= (folder / STATE).stat().st_mtime_ns
        return is_new and read_json(report)["stop_reason"] is not None
    except (OSError, ValueError, TypeError, KeyError):
        return False


def _holder(folder: Path) -> int | None:
    """The process that writes to a run's folder, or None."""
    try:
        file = os.open(folder / LOCK_FILE, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
    except OSError:
        return None
    try:
        if try_lock(file) is not False:
            return None
        words = os.read(file, 200).decode(errors="replace").split()
    finally:
        os.close(file)
    is_here = len(words) == 4 and words[3] == socket.gethostname() and words[1].isdecimal()
    return int(words[1]) if is_here else None
