"""A lock on a folder, so that two runs do not write into it at once.

The operating system releases the lock when the process ends, even if it is killed. Runs on file
systems without locks are not locked.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path

from igsr.errors import IgsrError

LOCK_FILE = ".igsr.lock"
#: Not through a link, whose target would be overwritten; reading a pipe does not wait.
_FLAGS = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
#: The locked byte on Windows, which does not let other processes read locked bytes.
_LOCKED_BYTE = 1 << 20


@contextlib.contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Hold a folder. It is created for that, and removed again if it stays empty.

    Raises:
        IgsrError: another process, which the message names, or another thread holds it.
    """
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = _locked(folder / LOCK_FILE)
    except OSError:  # The first write of the run fails, too, with a better message.
        file = None
    try:
        yield
    finally:
        if file is not None:
            with contextlib.suppress(OSError):
                os.unlink(folder / LOCK_FILE)
            os.close(file)
        with contextlib.suppress(OSError):
            for place in missing:
                place.rmdir()


def _locked(path: Path) -> int | None:
    """The open lock file; None if locks do not work there."""
    while True:
        file = os.open(path, _FLAGS, 0o666)
        try:
            is_free = try_lock(file)
            if is_free is None:
                os.unlink(path)
                os.close(file)
                return None
            if not is_free:
                holder = os.read(file, 200).decode(errors="replace").strip()
                raise IgsrError(
                    f"Another igsr ({holder}) writes to {path.parent}; wait until it ends, or "
                    "choose another folder."
                )
            # The last holder may have deleted the file since it was opened.
            if path.exists() and os.path.samestat(os.fstat(file), path.stat()):
                os.ftruncate(file, 0)
                os.write(file, f"process {os.getpid()} on {socket.gethostname()}".encode())
                return file
            os.close(file)
        except BaseException:
            with contextlib.suppress(OSError):
                os.close(file)
            raise


def try_lock(file: int) -> bool | None:
    """Whether an open file could be locked; None if locks do not work there."""
    try:
        import fcntl
    except ImportError:
        return _try_lock_on_windows(file)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _try_lock_on_windows(file: int) -> bool:
    import msvcrt

    os.lseek(file, _LOCKED_BYTE, os.SEEK_SET)
    try:
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        return True
    except OSError:
        return False
    finally:
        os.lseek(file, 0, os.SEEK_SET)
