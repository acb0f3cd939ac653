"""SIFT features of photos, found by COLMAP from arrays."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from igsr._internal.load_pycolmap import load_pycolmap
from igsr.cameras.colmap.database import image_id
from igsr.cameras.colmap.processes import process_count, processes
from igsr.cameras.estimate import Progress
from igsr.capture.photo_folder import Photo

#: Longest side of a photo at which features are found, pixels.
MAX_SIDE_PX = 1600
#: Maximum number of features of a photo; the largest are kept. COLMAP's own maximum leaves more.
MAX_FEATURES = 8192
#: A photo with this many features at its own size is not searched at twice its size too, as COLMAP
#: does, which takes four times as long.
ENOUGH_FEATURES = 3072
#: Pixels of a photo that may have this many.
MIN_ONCE_PX = 800_000
#: With fewer pixels in all, one process is faster.
MIN_PARALLEL_PX = 2_000_000
#: Gray values of red, green and blue (BT.601).
GRAY_WEIGHTS = np.array([0.299, 0.587, 0.114])

#: Keypoints float32 [N, 6]: x, y and the affine shape; descriptors uint8 [N, 128].
Features: TypeAlias = tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8]]


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
    count = min(process_count(), len(photos))
    octave = _first_octave(photos)
    if count == 1 or pixels < MIN_PARALLEL_PX:
        yield from (_sift(_gray(photo), octave) for photo in photos)
        return
    with processes(count) as call, ThreadPoolExecutor(count) as pool:
        yield from pool.map(lambda photo: call(_sift, _gray(photo), octave), photos)


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


def _first_octave(photos: Sequence[Photo]) -> int:
    """0 to search photos at their own size, -1 at twice their size; judged by one of them.

    All are searched alike: features of two sizes are placed less accurately.
    """
    gray = _gray(photos[len(photos) // 2])
    if gray.size < MIN_ONCE_PX:
        return -1
    return 0 if len(_sift(gray, 0)[0]) >= ENOUGH_FEATURES else -1


def _sift(gray: npt.NDArray[np.uint8], first_octave: int) -> Features:
    pycolmap = load_pycolmap()
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)  # also in a process
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = MAX_SIDE_PX
    options.use_gpu = False
    options.num_threads = 1
    options.sift.first_octave = first_octave
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    found, descriptors = extractor.extract(pycolmap.Bitmap.from_array(gray))
    rows = [(p.x, p.y, p.a11, p.a12, p.a21, p.a22) for p in found]
    keypoints = np.array(rows, dtype=np.float32).reshape(-1, 6)
    largest = np.sort(np.argsort(-feature_areas(keypoints), kind="stable")[:MAX_FEATURES])
    return keypoints[largest], np.asarray(descriptors.data)[largest]


def feature_areas(keypoints: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """The areas [N] of features, in square pixels up to a factor, from keypoints [N, 6]."""
    areas: npt.NDArray[np.float32] = np.abs(np.linalg.det(keypoints[:, 2:].reshape(-1, 2, 2)))
    return areas
