"""Write a file, or a folder of files, whole or not at all.

A file that someone may be reading, or may need after a crash, is never opened for writing: the
new content goes to a temporary name in the same folder and takes the old name in one rename.
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
    """Give a temporary path to write to; on success it replaces ``path``, on failure it goes.

    The temporary file keeps the suffix of ``path`` (image and video writers choose their format
    by it) and lies beside it, because a rename is only atomic within one file system.

    Args:
        path: where the finished file shall lie. Its folder is made if it is missing.

    Yields:
        The path to write to.

    Raises:
        IgsrError: the folder cannot be made or the file not be written (disk full, no
            permission); what lay at ``path`` before is still there.
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
        # mkstemp makes files private; a result is as readable as any other new file.
        os.chmod(temporary, 0o666 & ~_umask())
        with open(temporary, "rb") as written:
            # Without this a power cut can leave the new name with no content.
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
    """Give a temporary folder to fill; on success it takes the name ``path``, on failure it goes.

    Args:
        path: where the finished folder shall lie; it must not be there or be empty.
        replace: a folder that is there, whatever it holds, is replaced at the end.

    Yields:
        The folder to fill; it lies beside ``path``.

    Raises:
        IgsrError: ``path`` is there and holds something, or the folder cannot be made or filled.
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
    """Remove what writing into a folder left when it was killed; what cannot be removed stays."""
    for path in folder.glob(".*.unfinished*"):
        with contextlib.suppress(OSError):
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def check_folder(path: str | os.PathLike[str], *, replace: bool = False) -> None:
    """Find out before long work whether ``atomic_folder`` will take a path.

    Raises:
        IgsrError: the path is a file, or a folder that holds something and is not to be replaced.
    """
    target = Path(path)
    try:
        if target.exists() and not target.is_dir():
            raise IgsrError(f"Cannot write {target}: it is a file.")
        if not replace and target.is_dir() and any(target.iterdir()):
            raise IgsrError(f"{target} holds something already; name a new folder.")
    except OSError as error:
        raise IgsrError(f"Cannot write {target}: {error.strerror or error}.") from error


def check_writable(path: str | os.PathLike[str]) -> None:
    """Find out before long work whether ``atomic_write(path)`` will be able to make its file.

    Raises:
        IgsrError: the folder cannot be made or takes no new file, or ``path`` is a folder.
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
    """The process's umask (it can only be read by setting it)."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
