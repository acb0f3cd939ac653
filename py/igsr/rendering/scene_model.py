"""Pack a model for a scene page: its splats relative to their center, in a compact format.

The format has the numbers of a ``.spz`` in an order that compresses better: splats along a Morton
curve, positions as differences with only the bits that the scene needs, and bytes of one kind
together. Large models share at most 65 536 rows of spherical harmonics. ``web/packed.js`` reads
it. The gzipped content is::

    "IGSP", u32 version 1, u32 splats, u8 degree, u8 fraction bits, u8 flags (1: antialiased,
    2: rows of spherical harmonics are a palette), u8 0, u32 rows: one per splat, or fewer,
    3 times 4 planes of zigzag differences of x, y, z,
    opacities, colors, log-scales as in a .spz, 4 planes of rotations as in a .spz of version 3,
    2 planes of row numbers, if there is a palette,
    rows of spherical harmonics as in a .spz.
"""

from __future__ import annotations

import gzip
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.splats import Splats

#: Range of log-scales in a .spz, and its middle.
MIN_LOG_SCALE = -10.0
MAX_LOG_SCALE = 5.9375
MIDDLE_LOG_SCALE = -2.0
#: Splats at a larger distance are left out, or positions in 24 bits would be too coarse.
MAX_DISTANCE_RADII = 1000
#: Models with more splats share rows of spherical harmonics.
PALETTE_FROM = 100_000
#: Maximum number of rows in a palette, for numbers of two bytes.
MAX_PALETTE = 1 << 16
#: Resolution of positions in the scene's radius: a few hundredths of a pixel in a close view.
STEPS_PER_RADIUS = 1 << 16
MAGIC = b"IGSP"
FLAG_ANTIALIASED = 1
FLAG_PALETTE = 2
SPZ_HEADER_BYTES = 16

Bytes = npt.NDArray[np.uint8]
Int64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class EmbeddedModel:
    """A model as embedded in a page: relative to ``origin``, lengths multiplied by ``unit``.

    Attributes:
        packed: the bytes.
        count: number of splats.
        origin: float64 [3], median of the visible splats, world units.
        unit: factor of lengths.
        radius: times ``unit``; contains 90 % of the visible splats, but is at most four times the
            radius that contains 50 %.
        near: near plane, times ``unit``.
        notes: messages about data that the format cannot hold.
    """

    packed: bytes
    count: int
    origin: npt.NDArray[np.float64]
    unit: float
    radius: float
    near: float
    notes: list[str]


def embedded_model(splats: Splats) -> EmbeddedModel:
    """Pack a model for a page.

    Splats that are not finite, or farther than ``MAX_DISTANCE_RADII``, are left out.
    """
    center, radius, near = splats.extent
    offsets = splats.means - center.astype(np.float32)
    kept = ~(np.abs(offsets).max(axis=1, initial=0.0) > MAX_DISTANCE_RADII * radius)
    unit = _unit(splats)
    moved = replace(
        splats,
        # The page adds the origin, so that positions are not rounded for it.
        origin=np.zeros(3),
        means=offsets[kept] * np.float32(unit),
        scales=splats.scales[kept] + np.float32(np.log(unit)),
        quats=splats.quats[kept],
        opacities=splats.opacities[kept],
        sh=splats.sh[kept],
    )
    packed, count, notes = _packed(moved, radius * unit)
    far = len(kept) - int(kept.sum())
    if far > 0:
        notes.append(
            f"{far} splats farther than {MAX_DISTANCE_RADII} radii of the scene are left out."
        )
    origin = splats.origin + center.astype(np.float32)
    return EmbeddedModel(packed, count, origin, unit, radius * unit, near * unit, notes)


def _unit(splats: Splats) -> float:
    """A power of two for lengths; 1 if a ``.spz`` can hold all log-scales."""
    scales = splats.scales[splats.finite]
    if len(scales) == 0:
        return 1.0
    low, high = np.quantile(scales.max(axis=1), [0.01, 0.99])
    if low >= MIN_LOG_SCALE and float(scales.max()) <= MAX_LOG_SCALE:
        return 1.0
    return float(2.0 ** np.round((MIDDLE_LOG_SCALE - 0.5 * (low + high)) / np.log(2.0)))


def _packed(splats: Splats, radius: float) -> tuple[bytes, int, list[str]]:
    """The bytes, the number of finite splats, and messages about data that was lost."""
    notes: list[str] = []
    palette: Splats | None = None
    numbers = np.zeros(0, np.uint16)
    if splats.sh_degree > 0 and len(splats) > PALETTE_FROM:
        # The writer of .sog makes the palette.
        splats, notes = _through_sog(splats)
        palette, numbers = _palette(splats)
    degree = splats.sh_degree
    if palette is not None:
        splats = replace(splats, sh=np.ascontiguousarray(splats.sh[:, :1]))
    header, arrays, more = _spz_arrays(splats)
    positions, opacities, colors, scales, rotations, rows = arrays
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
    count = len(opacities)
    flags = (int(header[14]) & FLAG_ANTIALIASED) | (0 if palette is None else FLAG_PALETTE)
    head = MAGIC + np.array([1, count], "<u4").tobytes()
    head += bytes([degree, fraction - dropped, flags, 0])
    head += np.array([len(rows)], "<u4").tobytes()
    parts = [
        _zigzag(np.diff(fixed[order], axis=0, prepend=0)).T,
        opacities[order],
        colors[order],
        scales[order],
        rotations[order].T,
        numbers.astype("<u2")[:, None].view(np.uint8).T,
        rows,
    ]
    # tobytes is in C order. Without a time stamp, the same model makes the same page.
    content = head + b"".join(part.tobytes() for part in parts)
    return gzip.compress(content, 6, mtime=0), count, notes + more


def _through_sog(splats: Splats) -> tuple[Splats, list[str]]:
    with tempfile.TemporaryDirectory(prefix="igsr-page-") as folder:
        path = Path(folder) / "scene.sog"
        notes = splats.save(path)
        return Splats.load(path), notes


def _palette(splats: Splats) -> tuple[Splats, npt.NDArray[np.uint16]]:
    """One splat, otherwise zero, per distinct row of spherical harmonics, and each splat's row."""
    rows = np.ascontiguousarray(splats.sh[:, 1:]).reshape(len(splats), -1)
    as_bytes = rows.view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1]))).ravel()
    _, first, numbers = np.unique(as_bytes, return_index=True, return_inverse=True)
    assert len(first) <= MAX_PALETTE
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
    """Header and arrays, uint8 [N, bytes], of the splats' ``.spz``, and its messages."""
    with tempfile.TemporaryDirectory(prefix="igsr-page-") as folder:
        path = Path(folder) / "scene.spz"
        notes = splats.save(path)
        content = gzip.decompress(path.read_bytes())
    header = content[:SPZ_HEADER_BYTES]
    count, degree = int.from_bytes(header[8:12], "little"), header[12]
    arrays = []
    start = SPZ_HEADER_BYTES
    for width in (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)):
        array = np.frombuffer(content, np.uint8, count * width, start)
        arrays.append(array.reshape(count, width))
        start += count * width
    return header, arrays, notes


def _integers(positions: Bytes) -> Int64:
    """Signed 24-bit numbers, [N, 3]."""
    low, middle, high = np.moveaxis(positions.reshape(-1, 3, 3).astype(np.int64), -1, 0)
    value = low | middle << 8 | high << 16
    return np.asarray(value - ((value >> 23) << 24))


def _coarser(fixed: Int64, fraction: int, radius: float) -> tuple[Int64, int]:
    """Positions with only the bits that the scene needs, and the number of dropped bits."""
    steps = radius * 2.0**fraction / STEPS_PER_RADIUS
    dropped = min(fraction, max(0, int(np.floor(np.log2(steps))) if steps > 0.0 else 0))
    return (fixed + ((1 << dropped) >> 1)) >> dropped, dropped


def _zigzag(differences: Int64) -> Bytes:
    """Bytes [N, 12] of unsigned numbers that are small for small differences of both signs."""
    folded = (differences << 1) ^ (differences >> 63)
    return np.ascontiguousarray(folded.astype("<u4")).view(np.uint8).reshape(-1, 12)
