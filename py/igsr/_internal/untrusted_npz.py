"""Read .npz files that may be damaged or hostile."""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

#: Exceptions of zipfile, numpy and json for damaged files. RuntimeError: encrypted members, an
#: unknown zip version or nested members; syntax errors: invalid array headers; TypeError: an array
#: without an archive.
DAMAGE = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    OverflowError,
    RuntimeError,
    SyntaxError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)


def stored_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """The arrays of a file that ``np.savez`` wrote: numbers, not compressed, by name.

    Raises:
        OSError, ValueError, ...: ``DAMAGE``; the file is damaged or of another kind.
    """
    with zipfile.ZipFile(path) as archive:
        return {
            member.filename.removesuffix(".npy"): _read_member(archive, member)
            for member in archive.infolist()
        }


def _read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> npt.NDArray[Any]:
    if member.compress_type != zipfile.ZIP_STORED or not member.filename.endswith(".npy"):
        raise ValueError(f"{member.filename} is not a stored array")
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"{member.filename} is of an unknown array version")
        read_header = (
            np.lib.format.read_array_header_1_0
            if version == (1, 0)
            else np.lib.format.read_array_header_2_0
        )
        shape, fortran, dtype = read_header(file)
        if dtype.hasobject or fortran or dtype.kind not in "biuf":
            raise ValueError(f"{member.filename} is not a plain array of numbers")
        count = 1
        for size in shape:  # Python integers: a hostile shape cannot overflow
            count *= size
        # One byte more than promised, so that a longer member shows as well as a shorter one.
        data = file.read(min(member.file_size, count * dtype.itemsize) + 1)
        if len(data) != count * dtype.itemsize:
            raise ValueError(f"{member.filename} has another size than its header says")
    return np.frombuffer(bytearray(data), dtype=dtype).reshape(shape)
