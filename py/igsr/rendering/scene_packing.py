"""The bytes of a model in a scene page: a ``.spz``'s numbers, packed closer.

A ``.spz`` writes positions splat by splat, which gzip can do little with, and all of 24 bits. Here
splats go along Morton's curve, positions are differences from splat to splat with no more bits
than the scene needs, and bytes of one kind stand together. Large models share rows of spherical
harmonics, of which they have at most 65 536. The page's ``packed.js`` reads it::

    "IGSP", u32 version 1, u32 splats, u8 degree, u8 fraction bits, u8 flags (1: antialiased,
    2: rows of spherical harmonics are a palette), u8 0, u32 rows: as many as splats, or fewer,
    3 times 4 planes of zigzag differences of x, y, z,
    opacities, colours, log-scales as in a .spz, 4 planes of rotations as in a .spz of version 3,
    2 planes of rows' numbers, if there is a palette,
    rows of spherical harmonics as in a .spz.
"""

from __future__ import annotations

import gzip
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.splats import Splats

#: Models with more splats share rows of spherical harmonics.
PALETTE_FROM = 100_000
#: Rows that two bytes can number.
PALETTE_MOST = 1 << 16
#: Steps of positions in a radius of the scene: a few hundredths of a pixel in a close view.
STEPS_IN_RADIUS = 1 << 16
MAGIC = b"IGSP"
FLAG_ANTIALIASED = 1
FLAG_PALETTE = 2
SPZ_HEADER = 16

Bytes = npt.NDArray[np.uint8]


def packed_model(splats: Splats, radius: float) -> tuple[bytes, int, list[str]]:
    """Pack splats.

    Args:
        splats: the model; its ``origin`` is zero.
        radius: of the scene, in the splats' units.

    Returns:
        The bytes, how many splats they hold (those that are not finite are left out), and a message
        for each thing that they cannot hold.

    Raises:
        IgsrError: a position is beyond what a ``.spz`` holds.
    """
    notes: list[str] = []
    palette: Splats | None = None
    numbers = np.zeros(0, np.uint16)
    degree = splats.sh_degree
    if degree > 0 and len(splats) > PALETTE_FROM:
        # The writer of .sog finds the palette; what it reads back has equal rows.
        splats, notes = _through_sog(splats)
        degree = splats.sh_degree
        palette, numbers = _palette(splats)
        splats = replace(splats, sh=np.ascontiguousarray(splats.sh[:, :1]))
    header, arrays, more = _spz_arrays(splats)
    positions, opacities, colors, scales, rotations, rows = arrays
    count = len(opacities)
    if palette is not None:
        _, (*_, rows), clipped = _spz_arrays(palette)
        more += clipped
    fraction = int(header[13])
    fixed, dropped = _coarser(_integers(positions), fraction, radius)
    order = _core.morton_order(np.ascontiguousarray(fixed, np.float32))
    if palette is None:
        rows = rows[order]
    else:
        numbers = numbers[order]
    head = MAGIC + np.array([1, count], "<u4").tobytes()
    flags = (int(header[14]) & FLAG_ANTIALIASED) | (0 if palette is None else FLAG_PALETTE)
    head += bytes([degree, fraction - dropped, flags, 0])
    head += np.array([len(rows)], "<u4").tobytes()
    parts = [
        _planes(_zigzag(np.diff(fixed[order], axis=0, prepend=0))),
        opacities[order],
        colors[order],
        scales[order],
        _planes(rotations[order]),
        _planes(numbers.astype("<u2")[:, None].view(np.uint8)),
        rows,
    ]
    text = head + b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
    # No time of writing: the same model makes the same page.
    return gzip.compress(text, 6, mtime=0), count, notes + more


def _through_sog(splats: Splats) -> tuple[Splats, list[str]]:
    with tempfile.TemporaryDirectory(prefix="igsr-page-") as folder:
        path = Path(folder) / "scene.sog"
        notes = splats.save(path)
        return Splats.load(path), notes


def _palette(splats: Splats) -> tuple[Splats, npt.NDArray[np.uint16]]:
    """One splat for each different row of spherical harmonics, and each splat's row.

    All else of these splats is zero, so that writing them tells nothing but of the rows.
    """
    rows = np.ascontiguousarray(splats.sh[:, 1:]).reshape(len(splats), -1)
    as_bytes = rows.view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1]))).ravel()
    _, first, numbers = np.unique(as_bytes, return_index=True, return_inverse=True)
    assert len(first) <= PALETTE_MOST
    sh = splats.sh[first]
    sh[:, 0] = 0.0
    chosen = Splats(
        means=np.zeros((len(first), 3), np.float32),
        quats=np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(first), 1)),
        scales=np.zeros((len(first), 3), np.float32),
        opacities=np.zeros(len(first), np.float32),
        sh=sh,
    )
    return chosen, numbers.astype(np.uint16)


def _spz_arrays(splats: Splats) -> tuple[bytes, list[Bytes], list[str]]:
    """Header and arrays, uint8 [N, bytes], of the ``.spz`` of splats, and its messages."""
    with tempfile.TemporaryDirectory(prefix="igsr-page-") as folder:
        path = Path(folder) / "scene.spz"
        notes = splats.save(path)
        text = gzip.decompress(path.read_bytes())
    header = text[:SPZ_HEADER]
    count, degree = int.from_bytes(header[8:12], "little"), header[12]
    arrays = []
    at = SPZ_HEADER
    for width in (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)):
        array = np.frombuffer(text, np.uint8, count * width, at)
        arrays.append(array.reshape(count, width))
        at += count * width
    return header, arrays, notes


def _integers(positions: Bytes) -> npt.NDArray[np.int64]:
    """Signed 24-bit numbers, [N, 3]."""
    low, middle, high = np.moveaxis(positions.reshape(-1, 3, 3).astype(np.int64), -1, 0)
    value = low | middle << 8 | high << 16
    return np.asarray(value - ((value >> 23) << 24))


def _coarser(
    fixed: npt.NDArray[np.int64], fraction: int, radius: float
) -> tuple[npt.NDArray[np.int64], int]:
    """Positions with no more bits than the scene needs, and how many bits went."""
    steps = radius * 2.0**fraction / STEPS_IN_RADIUS
    dropped = min(fraction, max(0, int(np.floor(np.log2(steps))) if steps > 0.0 else 0))
    return (fixed + ((1 << dropped) >> 1)) >> dropped, dropped


def _zigzag(differences: npt.NDArray[np.int64]) -> Bytes:
    """Small numbers of both signs as small numbers without: bytes [N, 12]."""
    folded = (differences << 1) ^ (differences >> 63)
    return np.ascontiguousarray(folded.astype("<u4")).view(np.uint8).reshape(-1, 12)


def _planes(rows: Bytes) -> Bytes:
    """Bytes [N, K] as [K, N]."""
    return np.ascontiguousarray(rows.T)
