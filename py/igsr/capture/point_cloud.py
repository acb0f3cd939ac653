"""Point clouds in .ply files, as nerfstudio's ``ply_file_path`` names them, read and written."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from igsr.capture.types import Points
from igsr.errors import IgsrError

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


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
        data = path.read_bytes()
    except (OSError, ValueError) as error:
        raise IgsrError(
            f"{path} is missing or cannot be read; put the point cloud there"
        ) from error
    header, end, rest = data.partition(b"end_header\n")
    if not end:
        header, end, rest = data.partition(b"end_header\r\n")
    damaged = IgsrError(f"{path} is no .ply of points or is damaged; export it again")
    lines = header.decode("ascii", "replace").split("\n")
    if not end or lines[0].strip() != "ply":
        raise damaged
    order, count, properties = "", -1, []
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
            if len(words) != 3 or words[1] not in _TYPES:
                raise damaged
            properties.append((words[2], _ORDERS.get(order, "=") + _TYPES[words[1]]))
    names = [name for name, _ in properties]
    if not order or count < 0 or len(set(names)) != len(names) or not {"x", "y", "z"} <= set(names):
        raise damaged
    dtype = np.dtype(properties)
    # The shortest text of a value is a digit and a space.
    if len(rest) + 1 < count * (2 * len(names) if order == "ascii" else dtype.itemsize):
        raise IgsrError(f"{path} is truncated: it announces {count} points; copy it again")
    if order == "ascii":
        rows = rest.decode("ascii", "replace").split("\n")[:count]
        try:
            table = np.array([row.split()[: len(names)] for row in rows], dtype=np.float64)
            table = table.reshape(count, len(names))
        except ValueError as error:
            raise damaged from error
        columns = {name: table[:, index] for index, name in enumerate(names)}
    else:
        if len(rest) < count * dtype.itemsize:
            raise IgsrError(f"{path} is truncated: it announces {count} points; copy it again")
        structured = np.frombuffer(rest, dtype=dtype, count=count)
        columns = {name: structured[name] for name in names}
    if count == 0:
        return None
    xyz = np.stack([columns[name] for name in "xyz"], axis=1).astype(np.float64)
    if not np.isfinite(xyz).all():
        raise IgsrError(f"{path} has a point that is not finite; remove it")
    rgb = np.full((count, 3), 128, dtype=np.uint8)
    if {"red", "green", "blue"} <= set(names):
        colors = np.stack([columns[name] for name in ("red", "green", "blue")], axis=1)
        kinds = dict(properties)
        if order != "ascii" and kinds["red"][1] == "f":
            colors = colors * 255.0
        rgb = np.clip(np.nan_to_num(colors), 0, 255).astype(np.uint8)
    confidence = columns.get("confidence")
    if confidence is not None and not (np.isfinite(confidence) & (confidence > 0.0)).all():
        confidence = None
    return Points(xyz, rgb, confidence)


def write_point_cloud(path: Path, points: Points) -> None:
    """Write a binary .ply: positions in float64, colors and, if known, confidences."""
    layout = [*((name, "<f8") for name in "xyz"), *((c, "u1") for c in ("red", "green", "blue"))]
    if points.confidence is not None:
        layout.append(("confidence", "<f8"))
    table = np.zeros(len(points.xyz), dtype=np.dtype(layout))
    for column, name in enumerate("xyz"):
        table[name] = points.xyz[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        table[name] = points.rgb[:, column]
    if points.confidence is not None:
        table["confidence"] = points.confidence
    kinds = {"<f8": "double", "u1": "uchar"}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(table)}",
        *(f"property {kinds[kind]} {name}" for name, kind in layout),
        "end_header",
    ]
    path.write_bytes("\n".join(header).encode() + b"\n" + table.tobytes())
