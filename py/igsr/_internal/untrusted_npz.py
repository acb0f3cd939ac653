"""Read .npz and .npy files that may be damaged or hostile."""

from __future__ import annotations

import math
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from igsr._internal.input_files import open_file

#: Exceptions of zipfile, numpy and json for damaged files. RuntimeError: encrypted members, an
#: unknown zip version or nested members; syntax errors: invalid array headers, by numpy's own
#: reader; TypeError: an array without an archive.
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
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def stored_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """The arrays of a file that ``np.savez`` wrote: numbers, not compressed, by name.

    Raises:
        OSError, ValueError, ...: ``DAMAGE``; the file is damaged or of another kind.
    """
    with open_file(path) as file, zipfile.ZipFile(file) as archive:
        return {
            member.filename.removesuffix(".npy"): _read_member(archive, member)
            for member in archive.infolist()
        }


def stored_array(path: Path) -> npt.NDArray[Any]:
    """The array of a file that ``np.save`` wrote: numbers.

    Raises:
        OSError, ValueError, ...: ``DAMAGE``; the file is damaged or of another kind.
    """
    with open_file(path) as file:
        return _read_array(file, path.stat().st_size)


def _read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> npt.NDArray[Any]:
    if member.compress_type != zipfile.ZIP_STORED or not member.filename.endswith(".npy"):
        raise ValueError(f"{member.filename} is not a stored array")
    with archive.open(member) as file:
        return _read_array(file, member.file_size)


def _read_array(file: IO[bytes], size: int) -> npt.NDArray[Any]:
    """The array in an open file of ``size`` bytes."""
    try:
        read_header = _HEADERS[np.lib.format.read_magic(file)]
        shape, fortran, dtype = read_header(file)
    except Exception as error:  # numpy parses it as Python, whose parser runs out of memory
        raise ValueError("it has an array without a valid header") from error
    if dtype.hasobject or dtype.kind not in "biuf":
        raise ValueError("it holds no numbers")
    count = math.prod(shape)  # Python integers: a hostile shape cannot overflow
    # One byte more than promised, so that a longer array shows as well as a shorter one.
    data = file.read(min(size, count * dtype.itemsize) + 1)
    if len(data) != count * dtype.itemsize:
        raise ValueError("it has an array of another size than its header says")
    array = np.frombuffer(bytearray(data), dtype=dtype)
    return array.reshape(shape, order="F" if fortran else "C")
