"""SIFT features of photos, found by COLMAP from arrays.

COLMAP's extractor holds Python's lock, so several photos at a time need several processes.
``serve`` runs in each of them.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from igsr._internal.load_pycolmap import load_pycolmap
from igsr.cameras.colmap.database import image_id
from igsr.cameras.estimate import Progress
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError

#: Longest side of a photo at which features are found, pixels.
MAX_SIDE_PX = 1600
#: Maximum number of processes; each may take 0.5 GB.
MAX_PROCESSES = 4
#: With fewer pixels in all, one process is faster.
MIN_PARALLEL_PX = 2_000_000
#: Gray values of red, green and blue (BT.601).
GRAY_WEIGHTS = np.array([0.299, 0.587, 0.114])

#: Keypoints float32 [N, 6]: x, y and the affine shape; descriptors uint8 [N, 128].
Features: TypeAlias = tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8]]
Extract: TypeAlias = Callable[[npt.NDArray[np.uint8]], Features]


def find_features(photos: Sequence[Photo], database: Path, show: Progress) -> None:
    """Write the SIFT features of photos to COLMAP's database, which lists the photos."""
    pycolmap = load_pycolmap()
    sift = pycolmap.FeatureExtractorType.SIFT
    with pycolmap.Database.open(database) as opened:
        for index, (keypoints, descriptors) in enumerate(_features(photos)):
            show("features", index, len(photos))
            usable = usable_pixels(photos[index])
            if usable is not None:
                keep = _inside(keypoints, usable)
                keypoints, descriptors = keypoints[keep], descriptors[keep]
            opened.write_keypoints(image_id(index), keypoints)
            opened.write_descriptors(
                image_id(index),
                pycolmap.FeatureDescriptors(sift, np.ascontiguousarray(descriptors)),
            )
    show("features", len(photos), len(photos))


def usable_pixels(photo: Photo) -> npt.NDArray[np.bool_] | None:
    """Pixels [H, W] that are neither masked nor transparent; None if all are usable."""
    if photo.image.shape[2] != 4:
        return photo.mask
    opaque: npt.NDArray[np.bool_] = photo.image[..., 3] > 0
    return opaque if photo.mask is None else opaque & photo.mask


def _features(photos: Sequence[Photo]) -> Iterator[Features]:
    """Features of each photo, in order."""
    pixels = sum(photo.image.shape[0] * photo.image.shape[1] for photo in photos)
    count = min(MAX_PROCESSES, os.cpu_count() or 1, len(photos))
    if count == 1 or pixels < MIN_PARALLEL_PX:
        yield from (_sift(_gray(photo)) for photo in photos)
        return
    with contextlib.ExitStack() as closing:
        free: SimpleQueue[Extract] = SimpleQueue()
        for _ in range(count):
            free.put(closing.enter_context(_sift_process()))
        pool = closing.enter_context(ThreadPoolExecutor(count))

        def found(photo: Photo) -> Features:
            extract = free.get()
            try:
                return extract(_gray(photo))
            finally:
                free.put(extract)

        yield from pool.map(found, photos)


def _gray(photo: Photo) -> npt.NDArray[np.uint8]:
    gray = (photo.image[..., :3] @ GRAY_WEIGHTS).round().astype(np.uint8)
    usable = usable_pixels(photo)
    if usable is not None:
        # Masked pixels must not influence the features next to them.
        gray[~usable] = round(gray[usable].mean()) if usable.any() else 0
    return gray


def _inside(
    keypoints: npt.NDArray[np.float32], usable: npt.NDArray[np.bool_]
) -> npt.NDArray[np.bool_]:
    """Keypoints [N] that lie on usable pixels."""
    height, width = usable.shape
    column, row = keypoints[:, :2].astype(np.int64).T
    inside: npt.NDArray[np.bool_] = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    inside[inside] = usable[row[inside], column[inside]]
    return inside


def _sift(gray: npt.NDArray[np.uint8]) -> Features:
    pycolmap = load_pycolmap()
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = MAX_SIDE_PX
    options.use_gpu = False
    options.num_threads = 1
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    found, descriptors = extractor.extract(pycolmap.Bitmap.from_array(gray))
    rows = [(p.x, p.y, p.a11, p.a12, p.a21, p.a22) for p in found]
    return np.array(rows, dtype=np.float32).reshape(-1, 6), np.asarray(descriptors.data)


@contextlib.contextmanager
def _sift_process() -> Iterator[Extract]:
    """A process that extracts features of one photo at a time."""
    command = [sys.executable, "-c", "from igsr.cameras.colmap.features import serve; serve()"]
    path = str(Path(__file__).resolve().parents[3])
    environment = {**os.environ, "PYTHONPATH": path}
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        sent, received = process.stdin, process.stdout

        def extract(gray: npt.NDArray[np.uint8]) -> Features:
            try:
                pickle.dump(gray, sent)
                sent.flush()
                features: Features = pickle.load(received)
                return features
            except (OSError, EOFError, pickle.UnpicklingError) as error:
                raise IgsrError(
                    "Finding features ended early; the machine may have run out of memory."
                ) from error

        yield extract


def serve() -> None:
    """Extract features of pickled arrays from stdin until it ends; write them to stdout."""
    pycolmap = load_pycolmap()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process by its stdin
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    while True:
        try:
            gray = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        pickle.dump(_sift(gray), sys.stdout.buffer)
        sys.stdout.buffer.flush()
