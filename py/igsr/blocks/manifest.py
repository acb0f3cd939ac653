"""The photos of a capture: names, sizes, cameras and checksums, from file headers alone.

No photo is decoded here; workers decode the photos of their block.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from igsr._internal.input_files import open_file
from igsr.capture.image_files import PhotoHeader
from igsr.capture.load import describe_capture
from igsr.capture.photos import DescribedCapture, Shot, checked_headers, photo_of
from igsr.capture.types import Points, View
from igsr.errors import IgsrError

#: Bytes at each end of a file that its checksum covers.
CHECKSUM_BYTES = 1 << 16
#: Photos that are in memory at a time while crops are taken or scores computed.
BATCH_PHOTOS = 8


@dataclass(frozen=True, eq=False)
class Manifest:
    """The photos of a capture before any is decoded.

    Attributes:
        path: the capture.
        shots: P photos in the capture's order, with their cameras and split.
        headers: of their files, [P].
        marks: ``shot_mark`` of each photo, [P].
        points: reads the capture's points with their tracks.
    """

    path: Path
    shots: list[Shot]
    headers: list[PhotoHeader]
    marks: list[str]
    points: Callable[[], Points | None]

    def of_split(self, split: str) -> list[int]:
        """Indices of the "train" or "test" photos."""
        return [index for index, shot in enumerate(self.shots) if shot.split == split]

    def has_alpha(self, photos: Sequence[int]) -> bool:
        """Whether any of these photos has an alpha channel."""
        return any(self.headers[index].channels == 4 for index in photos)

    def plain(self) -> list[dict[str, object]]:
        """One row per photo, for ``manifest.json``."""
        return [
            {
                "name": shot.name,
                "file": str(shot.path),
                "bytes": shot.path.stat().st_size,
                "width": header.size[0],
                "height": header.size[1],
                "split": shot.split,
                "mark": mark,
            }
            for shot, header, mark in zip(self.shots, self.headers, self.marks, strict=True)
        ]


def read_manifest(path: Path, max_size: int | None, holdout: int | None) -> Manifest:
    """List the photos of a capture.

    Every ``holdout``-th photo by name is held out; None keeps the capture's split. Unlike
    ``Capture.with_holdout``, blurred photos are not skipped: that needs decoded photos.

    Raises:
        IgsrError: the capture cannot be read or has no cameras, or a photo is missing or differs
            from its camera in size.
    """
    described = describe_capture(path, max_size)
    shots = described.shots if holdout is None else _with_holdout(described.shots, holdout, path)
    headers = checked_headers(shots)
    with ThreadPoolExecutor(min(16, 4 * (os.cpu_count() or 1))) as pool:
        marks = list(pool.map(shot_mark, shots))
    return Manifest(path, shots, headers, marks, described.points)


def _with_holdout(shots: Sequence[Shot], every: int, path: Path) -> list[Shot]:
    if isinstance(every, bool) or not isinstance(every, (int, np.integer)) or every < 2:
        raise IgsrError(f"holdout is {every!r}; give a whole number of at least 2, such as 8")
    names = sorted({photo_of(shot) for shot in shots})
    if len(names) < 2:
        raise IgsrError(f"{path} has one photo only, so none can be held out; leave holdout out")
    test = set(names[::every])
    return [replace(shot, split="test" if photo_of(shot) in test else "train") for shot in shots]


def loaded_batches(
    capture: Path, shots: Sequence[Shot], max_size: int | None
) -> Iterator[list[View]]:
    """Decode photos, ``BATCH_PHOTOS`` at a time."""
    for first in range(0, len(shots), BATCH_PHOTOS):
        batch = list(shots[first : first + BATCH_PHOTOS])
        yield DescribedCapture(capture, batch, lambda: None).loaded(max_size).views


def shot_mark(shot: Shot) -> str:
    """The checksum of a photo with its mask and its depth."""
    files = [shot.path, shot.mask_path, shot.depth_path]
    marks = [file_mark(file) for file in files if file is not None]
    return marks[0] if len(marks) == 1 else hashlib.sha256("".join(marks).encode()).hexdigest()


def file_mark(path: Path) -> str:
    """The checksum of a file: SHA-256 of its size and both ends.

    Reading a large capture in full would take too long; checkpoints hash the decoded pixels.
    """
    try:
        with open_file(path) as file:
            size = os.fstat(file.fileno()).st_size
            digest = hashlib.sha256(size.to_bytes(8, "little"))
            digest.update(file.read(CHECKSUM_BYTES))
            if size > CHECKSUM_BYTES:
                file.seek(max(CHECKSUM_BYTES, size - CHECKSUM_BYTES))
                digest.update(file.read(CHECKSUM_BYTES))
    except OSError as error:
        raise IgsrError(f"Cannot read {path}: {error.strerror or error}.") from error
    return digest.hexdigest()
