"""Read files that a user or another file names: they may be pipes, devices or too large."""

from __future__ import annotations

import errno
import json
import os
import stat
from pathlib import Path
from typing import Any, BinaryIO

#: Limits of a file that is read whole, and of a JSON file: its values take up to 100 bytes each in
#: memory.
MAX_BYTES = 4 << 30
MAX_JSON_BYTES = 32 << 20
MAX_JSON_VALUES = 1 << 20


def open_file(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file for reading.

    Raises:
        OSError: it cannot be opened, or is a pipe, a socket or a device, which may never end.
    """
    return open(path, "rb", opener=_open_regular)


def _open_regular(path: str, flags: int) -> int:
    # Opening a pipe waits for its writer, except on Windows, which has no pipes in folders.
    file = os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise OSError(errno.EINVAL, "it is a folder, a pipe or a device, not a file", path)
    return file


def read_file(path: str | os.PathLike[str], limit: int = MAX_BYTES) -> bytes:
    """Read a regular file of at most ``limit`` bytes.

    Raises:
        OSError: as ``open_file``, or the file is larger.
    """
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > limit:
            reason = f"it has {size} bytes, more than the limit of {limit}"
            raise OSError(errno.EFBIG, reason, str(path))
        return file.read(size)


def read_json(path: Path, limit: int = MAX_JSON_BYTES, most: int = MAX_JSON_VALUES) -> Any:
    """Read a JSON file; raises as ``read_file`` and ``parse_json``."""
    return parse_json(read_file(path, limit), most)


def parse_json(content: bytes, most: int = MAX_JSON_VALUES) -> Any:
    """Parse JSON of at most ``most`` values.

    Raises:
        OSError: it has more values.
        ValueError: it is not JSON or nests too deeply.
    """
    # Each value but the first follows one of these.
    if sum(map(content.count, (b",", b"[", b"{"))) > most:
        reason = f"it has more than {most} values"
        raise OSError(errno.EFBIG, reason)
    try:
        return json.loads(content)
    except RecursionError as error:
        raise ValueError("it nests too deeply") from error
