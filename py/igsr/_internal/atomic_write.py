"""Write files and folders atomically.

New content goes to a temporary name in the same folder, which is renamed when it is complete.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from igsr._internal.folder_lock import try_lock
from igsr.errors import IgsrError

#: Name of a folder in the temporary folder that replaces it.
OLD = "old"

#: Younger folders may be in use by another computer: network file systems may lock for one only.
LEFT_AFTER_S = 3600.0


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield an empty temporary file that replaces ``path`` on success and is deleted on failure.

    It has the suffix of ``path``, by which image and video writers choose their format. An older
    file's mode is kept.

    Args:
        path: file to write. Its folder is created if it is missing.

    Raises:
        IgsrError: the file cannot be written; an older file stays.
    """
    target = _named(path)
    with _unfinished(target) as folder:
        new = folder / f"new{target.suffix}"
        new.touch()
        yield new
        with open(new, "rb") as written:
            # Without this, the file can be empty after a power failure.
            os.fsync(written.fileno())
        if target.is_file() and not target.is_symlink():
            shutil.copymode(target, new)
        os.replace(new, target)


@contextlib.contextmanager
def atomic_folder(path: str | os.PathLike[str], *, replace: bool = False) -> Iterator[Path]:
    """Yield a temporary folder that replaces ``path`` on success and is deleted on failure.

    Args:
        path: new or empty folder. Its mode is kept.
        replace: whether to replace a folder that is not empty.

    Raises:
        IgsrError: ``path`` is not empty, or the folder cannot be written.
    """
    target = Path(path)
    check_folder(target, replace=replace)
    with _unfinished(target) as folder:
        new = folder / "new"
        new.mkdir()
        yield new
        if target.exists():
            shutil.copymode(target, new)
            os.rename(target, folder / OLD)
        os.rename(new, target)


@contextlib.contextmanager
def _unfinished(target: Path) -> Iterator[Path]:
    """Yield a private folder next to ``target``, which is removed at the end.

    It is locked as long as this process lives, on systems that lock folders. Old folders of
    killed processes are removed. Rust's ``write_atomically`` uses the same names and locks.
    """
    prefix, suffix = f".{target.name}-", ".unfinished"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _remove_leftovers(target)
        while True:
            folder = Path(tempfile.mkdtemp(suffix, prefix, target.parent))
            with _lock(folder) as is_free:
                # Another writer may have removed it before it was locked.
                if is_free is not False and folder.exists():
                    try:
                        yield folder
                    finally:
                        _remove(folder, target)
                    return
    except OSError as error:
        raise IgsrError(f"Cannot write {target}: {error.strerror or error}.") from error


def _remove_leftovers(target: Path) -> None:
    # A name with a further "-" belongs to a target with a longer name.
    name = re.compile(rf"\.{re.escape(target.name)}-[^-]*\.unfinished")
    oldest = time.time() - LEFT_AFTER_S
    # Another writer may remove them, too; some folders can be written to but not listed.
    with contextlib.suppress(OSError), os.scandir(target.parent) as entries:
        for entry in entries:
            if name.fullmatch(entry.name) and entry.stat(follow_symlinks=False).st_mtime < oldest:
                with _lock(Path(entry.path)) as is_free:
                    if is_free:
                        _remove(Path(entry.path), target)


def _remove(unfinished: Path, target: Path) -> None:
    """Remove a folder of ``_unfinished``; an interrupted replacement of ``target`` is undone."""
    if (unfinished / OLD).exists() and not target.exists():
        os.rename(unfinished / OLD, target)
    shutil.rmtree(unfinished, ignore_errors=True)


@contextlib.contextmanager
def _lock(folder: Path) -> Iterator[bool | None]:
    """Try to lock a folder; yield whether it is locked now, None if folders have no locks here."""
    try:
        file = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except (OSError, AttributeError):  # Windows has no such flags
        yield None
        return
    try:
        yield try_lock(file)
    finally:
        os.close(file)


def check_folder(path: str | os.PathLike[str], *, replace: bool = False) -> None:
    """Check before long work that ``atomic_folder(path)`` will work.

    Raises:
        IgsrError: the path is a file, or a folder that is not empty.
    """
    target = _named(path)
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
    target = _named(path)
    if target.is_dir():
        raise IgsrError(f"Cannot write {target}: it is a folder.")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=target.parent):
            pass
    except OSError as error:
        raise IgsrError(f"Cannot write {target}: {error.strerror or error}.") from error


def _named(path: str | os.PathLike[str]) -> Path:
    target = Path(path)
    if not target.name:
        raise IgsrError(f"Cannot write {str(path)!r}: it is not a name; give the name to write.")
    return target
