"""SIFT features of photos, found by COLMAP."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr.capture.photo_folder import Photo
from igsr.pose.colmap.database import photo_file
from igsr.pose.estimate import Progress

#: Pixels of a photo's longer side at which features are found; bounds time.
LONGEST = 1600
#: Photos done between two calls of progress; Ctrl-C is heard then. Each may take 0.5 GB.
FEATURES_AT_ONCE = 4


def find_features(photos: Sequence[Photo], workspace: Path, database: Path, show: Progress) -> None:
    import pycolmap

    images, masks = workspace / "images", workspace / "masks"
    images.mkdir()
    masks.mkdir()
    masked = any(usable_pixels(photo) is not None for photo in photos)
    reader = pycolmap.ImageReaderOptions()
    if masked:
        reader.mask_path = masks
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = LONGEST
    extraction.use_gpu = False
    for start in range(0, len(photos), FEATURES_AT_ONCE):
        show("features", start, len(photos))
        chunk = range(start, min(start + FEATURES_AT_ONCE, len(photos)))
        for index in chunk:
            mask_path = masks / f"{photo_file(index)}.png" if masked else None
            _write(photos[index], images / photo_file(index), mask_path)
        pycolmap.extract_features(
            database,
            images,
            [photo_file(index) for index in chunk],
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )
        for index in chunk:
            (images / photo_file(index)).unlink()
    show("features", len(photos), len(photos))


def usable_pixels(photo: Photo) -> npt.NDArray[np.bool_] | None:
    """Pixels [H, W] that have features: neither masked nor transparent; None for all."""
    if photo.image.shape[2] != 4:
        return photo.mask
    opaque: npt.NDArray[np.bool_] = photo.image[..., 3] > 0
    return opaque if photo.mask is None else opaque & photo.mask


def _write(photo: Photo, path: Path, mask_path: Path | None) -> None:
    image = photo.image
    grey = (image[..., :3] @ np.array([0.299, 0.587, 0.114])).round().astype(np.uint8)
    if mask_path is not None:
        usable = usable_pixels(photo)
        usable = np.ones(grey.shape, dtype=np.bool_) if usable is None else usable
        # Masked pixels must not influence the features next to them.
        grey[~usable] = round(grey[usable].mean()) if usable.any() else 0
        Image.fromarray(255 * usable.astype(np.uint8)).save(mask_path)
    Image.fromarray(grey).save(path, compress_level=1)
