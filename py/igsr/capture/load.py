"""Load captures of any supported format, or only look at their headers."""

from __future__ import annotations

import functools
import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from igsr.capture.downscaling import check_max_size
from igsr.capture.image_files import SUFFIXES, is_file
from igsr.capture.memory_check import PhotoSizes
from igsr.capture.photo_files import find_photo_files, has_photos
from igsr.capture.photo_folder import FRAMES, pixel_sizes
from igsr.capture.photos import DescribedCapture, checked_headers, shot_sizes
from igsr.capture.read_colmap import describe_colmap, find_model, reduction_of
from igsr.capture.read_transforms import describe_split_transforms, describe_transforms
from igsr.capture.types import Capture, check_holdout
from igsr.errors import IgsrError

logger = logging.getLogger(__name__)


def load_capture(path: str | os.PathLike[str], max_size: int | None = None) -> Capture:
    """Load photos with known cameras.

    A capture is one of the following, tried in this order:

    * a ``transforms.json`` (nerfstudio or instant-ngp), or a folder with one;
    * a folder with ``transforms_train.json`` and ``transforms_test.json`` (NeRF Synthetic);
    * a folder with ``images/`` and a COLMAP model in ``sparse/0``, ``sparse`` or itself;
    * an ``images`` folder next to one of these;
    * an ``images_2``, ``images_4`` or ``images_8`` folder (photos reduced by that factor) next to a
      COLMAP model.

    Photos of a COLMAP model come from the smallest of ``images`` and ``images_K`` that are not
    smaller than ``max_size`` or, without ``images``, from the largest.

    Lens distortion is removed: cameras become pinholes with the focal lengths, principal point and
    size of the distorted camera, and ``View.mask`` is False for pixels outside the lens's view.

    The split is by file for NeRF Synthetic (a ``transforms_val.json`` is not read), and by
    ``train_filenames`` and ``test_filenames`` if nerfstudio's file has them. Otherwise all views
    are for training; ``Capture.with_holdout`` sets another split.

    Args:
        path: the folder, or its ``transforms.json``.
        max_size: longest side, in pixels, of photos as loaded. Larger ones are reduced with an area
            filter as they are decoded, and their cameras, masks and tracks with them; none is
            enlarged. None keeps all as they are.

    Returns:
        The capture, with its photos decoded.

    Raises:
        IgsrError: the capture cannot be loaded; the message names the file and the problem. Or the
            photos need more memory than is available; the message names the size that would fit.
    """
    started = time.monotonic()
    check_max_size(max_size)
    capture = describe_capture(Path(path), max_size).loaded(max_size)
    logger.info("%r, loaded in %.2f s", capture, time.monotonic() - started)
    return capture


def describe_capture(path: Path, max_size: int | None = None) -> DescribedCapture:
    """Read a capture except for its photos' pixels; see ``load_capture``."""
    if is_file(path):
        if path.suffix.lower() != ".json":
            raise IgsrError(f"{path} is no capture; give a folder or a transforms.json")
        return describe_transforms(path)
    try:
        files = sorted(entry.name for entry in path.iterdir())
    except (OSError, ValueError) as error:
        raise IgsrError(
            f"{path} does not exist or cannot be read; give a folder with photos and cameras, or a "
            "transforms.json"
        ) from error
    describe = _reader(path)
    if describe is not None:
        return describe(max_size)
    photos = [name for name in files if name.lower().endswith(SUFFIXES)]
    if photos or (path / "images").is_dir():
        content, place = (f"{len(photos)} images", "them") if photos else ("an images folder", "it")
        raise IgsrError(
            f"{path} holds {content} but no cameras; put a COLMAP model (sparse/0) or a "
            f"transforms.json next to {place}, or find cameras with igsr pose"
        )
    raise IgsrError(
        f"{path} holds no images and no cameras; give a folder with a transforms.json, or with "
        "images and a COLMAP model in sparse/0"
    )


def holds_cameras(path: str | os.PathLike[str]) -> bool:
    """Return whether a path, which need not exist, holds photos with cameras."""
    path = Path(path)
    if is_file(path):
        return path.suffix.lower() == ".json"
    try:
        return _reader(path) is not None
    except (OSError, ValueError):
        return False


def _reader(path: Path) -> Callable[[int | None], DescribedCapture] | None:
    """The function that reads the capture in a folder, given ``max_size``."""
    place = path.resolve()
    # Not "path/..", which follows links and cannot leave ".".
    for folder in (path, place.parent) if place.name == "images" else (path,):
        if is_file(folder / "transforms.json"):
            return lambda _: describe_transforms(folder / "transforms.json")
        if is_file(folder / "transforms_train.json"):
            return lambda _: describe_split_transforms(folder)
        model = find_model(folder)
        if model is not None:
            return functools.partial(describe_colmap, folder, model)
    model = None if reduction_of(place.name) is None else find_model(place.parent)
    if model is None:
        return None
    return functools.partial(describe_colmap, place.parent, model, folder=place.name)


@dataclass(frozen=True, kw_only=True)
class Overview(PhotoSizes):
    """Photos before they are decoded.

    Attributes:
        path: of the capture, folder or video.
        has_cameras: whether it is a capture, whose cameras are known.
        train: number of the photos that are for training; all of them without cameras.
        masks: number of photos with a mask.
        skipped: files that are not photos of the scene, in words.
    """

    path: Path
    has_cameras: bool
    train: int
    masks: int = 0
    skipped: str = ""

    def train_photos(self, holdout: int | None) -> int:
        """Return the maximum number of photos to fit if every ``holdout``-th is held out."""
        if holdout is None:
            return self.train
        views = self.views or [1] * len(self.sizes)
        check_holdout(holdout, len(views), self.path)
        return sum(views) - sum(views[::holdout])


def look_at(
    path: str | os.PathLike[str], frames: int = FRAMES, max_size: int | None = None
) -> Overview:
    """Look at a capture, a folder of photos or a video.

    Args:
        path: as for ``igsr.load_capture`` and ``igsr.find_cameras``.
        frames: maximum number of frames taken from each video.
        max_size: longest side in pixels of photos as they will be loaded, or None; a capture may
            have its photos at several sizes.

    Raises:
        IgsrError: nothing can be loaded from there.
    """
    path = Path(path)
    if not os.path.exists(path):
        raise IgsrError(
            f"{path} does not exist or cannot be read; give a folder of photos, a video or a "
            "capture"
        )
    # A folder without photos is refused by ``pixel_sizes``.
    if holds_cameras(path) or not (path.is_dir() or has_photos(path)):
        shots = describe_capture(path, max_size).shots
        sizes = shot_sizes(shots, checked_headers(shots))
        train = sum(shot.split == "train" for shot in shots)
        masks = sum(shot.mask_path is not None for shot in shots)
        return Overview(path=path, has_cameras=True, train=train, masks=masks, **vars(sizes))
    sizes, found = pixel_sizes(path, frames), find_photo_files(path)
    return Overview(
        path=path,
        has_cameras=False,
        train=len(sizes.sizes),
        masks=found.mask_count(),
        skipped=found.skipped_words(),
        **vars(sizes),
    )
