"""The photos of a capture as a list: names, sizes, cameras and marks, from files' headers alone.

No photo is decoded here. What a block needs of it goes to the worker that fits the block.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from igsr.capture.image_files import PhotoHeader
from igsr.capture.load import describe_capture
from igsr.capture.photos import Shot, checked_headers, photo_of
from igsr.capture.types import Points
from igsr.errors import IgsrError

#: Bytes at either end of a file that its mark is made of.
MARKED = 1 << 16


@dataclass(frozen=True, eq=False)
class Manifest:
    """What is known of a capture's photos before any is decoded.

    Attributes:
        path: the capture.
        shots: P photos in the capture's order, with their cameras and split.
        headers: of their files, [P].
        marks: ``file_mark`` of each photo's file and of its mask's and depth's, if any, [P].
        points: reads the capture's points, with tracks.
    """

    path: Path
    shots: list[Shot]
    headers: list[PhotoHeader]
    marks: list[str]
    points: Callable[[], Points | None]

    def of_split(self, split: str) -> list[int]:
        """Indices of the "train" or "test" photos."""
        return [index for index, shot in enumerate(self.shots) if shot.split == split]

    def plain(self) -> list[dict[str, object]]:
        """As ``manifest.json`` has it: a row for each photo."""
        return [
            {
                "name": shot.name,
                "file": str(shot.path),
                "bytes": _size(shot.path),
                "width": header.size[0],
                "height": header.size[1],
                "split": shot.split,
                "mark": mark,
            }
            for shot, header, mark in zip(self.shots, self.headers, self.marks, strict=True)
        ]


def read_manifest(path: Path, max_size: int | None, holdout: int | None) -> Manifest:
    """List the photos of a capture.

    Args:
        path: the capture, as ``igsr.load_capture`` takes it.
        max_size: longest side in pixels that photos will be loaded with, or None.
        holdout: every so many photos, in the order of their names, one is held out for testing;
            None: as the capture has it. Blurred photos are not passed over, as no photo is decoded.

    Raises:
        IgsrError: the capture cannot be read, has no cameras, or a photo is missing or has another
            size than its camera.
    """
    described = describe_capture(path, max_size)
    shots = described.shots if holdout is None else _held_out(described.shots, holdout, path)
    headers = checked_headers(shots)
    with ThreadPoolExecutor(min(16, 4 * (os.cpu_count() or 1))) as pool:
        marks = list(pool.map(shot_mark, shots))
    return Manifest(path, shots, headers, marks, described.points)


def _held_out(shots: Sequence[Shot], every: int, path: Path) -> list[Shot]:
    if isinstance(every, bool) or not isinstance(every, (int, np.integer)) or every < 2:
        raise IgsrError(f"holdout is {every!r}; give a whole number of at least 2, such as 8")
    names = sorted({photo_of(shot) for shot in shots})
    if len(names) < 2:
        raise IgsrError(f"{path} has one photo only, so none can be held out; leave holdout out")
    test = set(names[::every])
    return [replace(shot, split="test" if photo_of(shot) in test else "train") for shot in shots]


def shot_mark(shot: Shot) -> str:
    """The marks of all files of a photo, as one."""
    files = [shot.path, shot.mask_path, shot.depth_path]
    marks = [file_mark(file) for file in files if file is not None]
    return marks[0] if len(marks) == 1 else hashlib.sha256("".join(marks).encode()).hexdigest()


def file_mark(path: Path) -> str:
    """A hash by which a changed file is found: SHA-256 of its size and of both its ends.

    Photos of a large capture are more than can be read through before work begins. The worker that
    decodes a photo hashes its pixels for the checkpoint.

    Raises:
        IgsrError: the file cannot be read.
    """
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            digest = hashlib.sha256(size.to_bytes(8, "little"))
            digest.update(file.read(MARKED))
            if size > MARKED:
                file.seek(max(MARKED, size - MARKED))
                digest.update(file.read(MARKED))
    except OSError as error:
        raise IgsrError(f"Cannot read {path}: {error.strerror or error}.") from error
    return digest.hexdigest()


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
