"""Read and write point clouds as .ply files, which nerfstudio's ``ply_file_path`` names."""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path

import numpy as np

from igsr._internal.input_files import read_file
from igsr.capture.types import Points
from igsr.errors import IgsrError

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_COLORS = ("red", "green", "blue")
_MAX_HEADER_BYTES = 1 << 16


def read_point_cloud(path: Path) -> Points | None:
    """Read positions, colors and confidences; other properties and elements are ignored.

    Points without colors become gray. Confidences are ignored unless all are positive.

    Args:
        path: the ``.ply`` file, ASCII or binary.

    Returns:
        The points, or None if there are none.

    Raises:
        IgsrError: the file is missing, is not a .ply of points, is truncated, or has a point that
            is not finite.
    """
    try:
        data = read_file(path)
    except OSError as error:
        raise IgsrError(
            f"{path} is missing or cannot be read ({error.strerror}); put the point cloud there"
        ) from error
    end = re.search(rb"end_header\r?\n", data[:_MAX_HEADER_BYTES])
    damaged = IgsrError(f"{path} is no .ply of points or is damaged; export it again")
    lines = data[: end.start()].decode("ascii", "replace").split("\n") if end else [""]
    if end is None or lines[0].strip() != "ply":
        raise damaged
    body = memoryview(data)[end.end() :]
    order, count, properties = "", -1, {}
    for line in lines[1:]:
        words = line.split()
        if words[:1] == ["format"] and len(words) == 3 and words[1] in _ORDERS:
            order = words[1]
        elif words[:1] == ["element"]:
            # Elements after the points are not read.
            if count >= 0:
                break
            if len(words) != 3 or words[1] != "vertex" or not words[2].isdecimal():
                raise damaged
            count = int(words[2]) if len(words[2]) < 19 else 10**18
        elif words[:1] == ["property"]:
            if len(words) != 3 or words[1] not in _TYPES or words[2] in properties:
                raise damaged
            properties[words[2]] = _ORDERS.get(order, "=") + _TYPES[words[1]]
    if not order or count < 0 or not {"x", "y", "z"} <= properties.keys():
        raise damaged
    if count == 0:
        return None
    dtype = np.dtype(list(properties.items()))
    # The shortest text of a value is a digit and a space; the last one may lack the space.
    least = count * 2 * len(properties) - 1 if order == "ascii" else count * dtype.itemsize
    if len(body) < least:
        raise IgsrError(f"{path} is truncated: it announces {count} points; copy it again")
    if order == "ascii":
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # of empty lines
                values = np.loadtxt(
                    io.BytesIO(body),
                    usecols=range(len(properties)),
                    max_rows=count,
                    comments=None,
                    ndmin=2,
                ).reshape(count, len(properties))
        except (ValueError, UserWarning) as error:
            raise damaged from error
        columns = dict(zip(properties, values.T, strict=True))
    else:
        table = np.frombuffer(body, dtype=dtype, count=count)
        columns = {name: table[name] for name in properties}
    xyz = np.stack([columns[name] for name in "xyz"], axis=1).astype(np.float64)
    if not np.isfinite(xyz).all():
        raise IgsrError(f"{path} has a point that is not finite; remove it")
    rgb = np.full((count, 3), 128, dtype=np.uint8)
    if set(_COLORS) <= set(columns):
        colors = np.stack([columns[name] for name in _COLORS], axis=1)
        if order != "ascii" and columns["red"].dtype.kind == "f":
            colors = colors * 255.0
        rgb = np.clip(np.nan_to_num(colors), 0, 255).astype(np.uint8)
    confidence = columns.get("confidence")
    if confidence is not None and not (np.isfinite(confidence) & (confidence > 0.0)).all():
        confidence = None
    return Points(xyz, rgb, confidence)


def write_point_cloud(path: Path, points: Points) -> None:
    """Write a binary .ply: positions in float64, colors and, if known, confidences."""
    columns = [(name, "double", points.xyz[:, axis]) for axis, name in enumerate("xyz")]
    columns += [(name, "uchar", points.rgb[:, axis]) for axis, name in enumerate(_COLORS)]
    if points.confidence is not None:
        columns.append(("confidence", "double", points.confidence))
    table = np.zeros(
        len(points.xyz), dtype=[(name, f"<{_TYPES[kind]}") for name, kind, _ in columns]
    )
    for name, _, values in columns:
        table[name] = values
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(table)}",
        *(f"property {kind} {name}" for name, kind, _ in columns),
        "end_header",
    ]
    path.write_bytes("\n".join(header).encode() + b"\n" + table.tobytes())
