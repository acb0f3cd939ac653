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

from igsr._internal.available_memory import available_memory
from igsr._internal.input_files import MAX_JSON_VALUES, open_file, parse_json

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
#: Bytes that are read at once: zipfile would hold an array twice.
_PIECE = 1 << 20
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def stored_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """The arrays of a file that ``np.savez`` wrote: numbers, not compressed, by name.

    Raises:
        OSError, ValueError, ...: ``DAMAGE``; the file is damaged, of another kind or larger than
            the available memory.
    """
    with open_file(path) as file, zipfile.ZipFile(file) as archive:
        size, free = sum(member.file_size for member in archive.infolist()), available_memory()
        if size > free:
            raise ValueError(f"it has {size} bytes, but {free} bytes of memory are free")
        return {
            member.filename.removesuffix(".npy"): _read_member(archive, member)
            for member in archive.infolist()
        }


def stored_array(path: Path, most: int) -> npt.NDArray[Any]:
    """The array of a file that ``np.save`` wrote: at most ``most`` numbers.

    Raises:
        OSError, ValueError, ...: ``DAMAGE``; the file is damaged, of another kind or too large.
    """
    with open_file(path) as file:
        return _read_array(file, path.stat().st_size, most)


def stored_json(array: npt.NDArray[Any], most: int = MAX_JSON_VALUES) -> Any:
    """Parse an array of JSON text of at most ``most`` values; raises as ``parse_json``."""
    if array.nbytes > 32 * most:
        raise ValueError(f"its JSON has more than {32 * most} bytes")
    return parse_json(array.tobytes(), most)


def _read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> npt.NDArray[Any]:
    if member.compress_type != zipfile.ZIP_STORED or not member.filename.endswith(".npy"):
        raise ValueError(f"{member.filename} is not a stored array")
    with archive.open(member) as file:
        return _read_array(file, member.file_size)


def _read_array(file: IO[bytes], size: int, most: int | None = None) -> npt.NDArray[Any]:
    """The array in an open file of ``size`` bytes, of at most ``most`` numbers."""
    try:
        read_header = _HEADERS[np.lib.format.read_magic(file)]
        shape, fortran, dtype = read_header(file)
    except Exception as error:  # numpy parses it as Python, whose parser runs out of memory
        raise ValueError("it has an array without a valid header") from error
    if dtype.hasobject or dtype.kind not in "biuf":
        raise ValueError("it holds no numbers")
    count = math.prod(shape)  # Python integers: a hostile shape cannot overflow
    if most is not None and count > most:
        raise ValueError(f"it has more than the limit of {most} numbers; make it smaller")
    length = count * dtype.itemsize
    if length != size - file.tell():
        raise ValueError("it has an array of another size than its header says")
    data = np.empty(length, np.uint8)
    for begin in range(0, length, _PIECE):
        # Unlike an array, a memoryview refuses a piece of another length.
        data.data[begin : begin + _PIECE] = file.read(_PIECE)
    return data.view(dtype).reshape(shape, order="F" if fortran else "C")
