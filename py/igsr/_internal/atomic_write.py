"""Write files and folders atomically.

New content goes to a temporary name in the same folder, which is renamed when it is complete.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from igsr.errors import IgsrError


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path that replaces ``path`` on success and is deleted on failure.

    It has the suffix of ``path``, by which image and video writers choose their format.

    Args:
        path: file to write. Its folder is created if it is missing.

    Raises:
        IgsrError: the file cannot be written; an older file stays.
    """
    target = Path(path)
    temporary: Path | None = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            prefix=f".{target.stem}-", suffix=f".unfinished{target.suffix}", dir=target.parent
        )
        os.close(handle)
        temporary = Path(name)
        yield temporary
        # mkstemp makes files private.
        os.chmod(temporary, 0o666 & ~_umask())
        with open(temporary, "rb") as written:
            # Without this, the file can be empty after a power failure.
            os.fsync(written.fileno())
        os.replace(temporary, target)
        temporary = None
    except OSError as error:
        reason = error.strerror or str(error)
        raise IgsrError(f"Cannot write {target}: {reason}.") from error
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink()


@contextlib.contextmanager
def atomic_folder(path: str | os.PathLike[str], *, replace: bool = False) -> Iterator[Path]:
    """Yield a temporary folder that replaces ``path`` on success and is deleted on failure.

    Args:
        path: new or empty folder.
        replace: whether to replace a folder that is not empty.

    Raises:
        IgsrError: ``path`` is not empty, or the folder cannot be written.
    """
    target = Path(path)
    check_folder(target, replace=replace)
    temporary: Path | None = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(
            tempfile.mkdtemp(prefix=f".{target.name}-", suffix=".unfinished", dir=target.parent)
        )
        new, old = temporary / "new", temporary / "old"
        new.mkdir()
        yield new
        if target.exists():
            os.rename(target, old)
        os.rename(new, target)
    except OSError as error:
        reason = error.strerror or str(error)
        raise IgsrError(f"Cannot write {target}: {reason}.") from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)


def remove_unfinished(folder: Path) -> None:
    """Remove temporary files that killed processes left in a folder, as far as possible."""
    for path in folder.glob(".*.unfinished*"):
        with contextlib.suppress(OSError):
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def check_folder(path: str | os.PathLike[str], *, replace: bool = False) -> None:
    """Check before long work that ``atomic_folder(path)`` will work.

    Raises:
        IgsrError: the path is a file, or a folder that is not empty.
    """
    target = Path(path)
    try:
        if target.exists() and not target.is_dir():
            raise IgsrError(f"Cannot write {target}: it is a file.")
        if not replace and target.is_dir() and any(target.iterdir()):
            raise IgsrError(f"{target} is not empty; name a new folder.")
    except OSError as error:
        raise IgsrError(f"Cannot write {target}: {error.strerror or error}.") from error


def check_writable(path: str | os.PathLike[str]) -> None:
    """Check before long work that ``atomic_write(path)`` will work.

    Raises:
        IgsrError: the folder cannot be written to, or ``path`` is a folder.
    """
    target = Path(path)
    if target.is_dir():
        raise IgsrError(f"Cannot write {target}: it is a folder.")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=target.parent):
            pass
    except OSError as error:
        raise IgsrError(f"Cannot write {target}: {error.strerror or error}.") from error


def _umask() -> int:
    """The process's umask, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
