"""``load_capture``: finds out which format a capture has and reads it."""

from __future__ import annotations

import logging
import os
import time
from pathlib import Path

from igsr.capture.described import DescribedCapture
from igsr.capture.downscaling import check_max_size
from igsr.capture.image_folders import reduction_of
from igsr.capture.photos import SUFFIXES, is_file
from igsr.capture.read_colmap import described_colmap, find_model
from igsr.capture.read_transforms import described_split_transforms, described_transforms
from igsr.capture.types import Capture
from igsr.errors import IgsrError

logger = logging.getLogger(__name__)


def load_capture(path: str | os.PathLike[str], max_size: int | None = None) -> Capture:
    """Load photos with known cameras.

    A capture is one of, tried in this order:

    * a ``transforms.json`` (nerfstudio or instant-ngp), or a folder with one;
    * a folder with ``transforms_train.json`` and ``transforms_test.json`` (NeRF Synthetic);
    * a folder with ``images/`` and a COLMAP model in ``sparse/0``, ``sparse`` or itself;
    * an ``images`` folder that has one of these beside it;
    * an ``images_2``, ``images_4`` or ``images_8`` folder (photos reduced by as much) that has a
      COLMAP model beside it.

    Photos of a COLMAP model are taken from the smallest of ``images`` and ``images_K`` that are not
    smaller than ``max_size``, or, where ``images`` is missing, from the largest that there are.

    Lens distortion is undone: cameras come out as pinholes with the focal lengths, principal point
    and size of the distorted camera, and ``View.mask`` is False where the lens saw nothing.

    The split is by file for NeRF Synthetic (a ``transforms_val.json`` is not read), by
    ``train_filenames`` and ``test_filenames`` where nerfstudio's file has them, and otherwise all
    views are for training; ``Capture.with_holdout`` splits anew.

    Args:
        path: the folder, or its ``transforms.json``.
        max_size: longest side, in pixels, of photos as loaded. Larger ones are reduced with an area
            filter as they are decoded, and their cameras, masks and tracks with them; none is
            enlarged. None keeps all as they are.

    Returns:
        The capture, with its photos decoded.

    Raises:
        IgsrError: nothing can be loaded; the message names the file and what is wrong with it. Or
            the photos need more memory than there is; then it names the size that would fit.
    """
    started = time.monotonic()
    check_max_size(max_size)
    capture = describe_capture(Path(path), max_size).loaded(max_size)
    points = "no" if capture.points is None else len(capture.points.xyz)
    logger.info(
        "%s: %d views (%d train, %d test), %s points, loaded in %.2f s",
        path,
        len(capture.views),
        len(capture.train_views),
        len(capture.test_views),
        points,
        time.monotonic() - started,
    )
    return capture


def describe_capture(path: Path, max_size: int | None = None) -> DescribedCapture:
    """Read a capture but for its photos' pixels; see ``load_capture``."""
    if is_file(path):
        if path.suffix.lower() != ".json":
            raise IgsrError(f"{path} is no capture; give a folder or a transforms.json")
        return described_transforms(path)
    try:
        files = sorted(entry.name for entry in path.iterdir())
    except (OSError, ValueError) as error:
        raise IgsrError(f"{path} does not exist or cannot be read; give a capture") from error
    found = _described_folder(path, max_size)
    # "path/.." would follow links and leave "." where it is; the real parent is meant.
    if found is None and path.resolve().name == "images":
        found = _described_folder(path.resolve().parent, max_size)
    if found is None and reduction_of(path.resolve().name) is not None:
        found = _described_model(path.resolve().parent, max_size, path.resolve().name)
    if found is not None:
        return found
    photos = [name for name in files if name.lower().endswith(SUFFIXES)]
    if photos:
        raise IgsrError(
            f"{path} holds {len(photos)} images but no cameras; put a COLMAP model (sparse/0) or a "
            "transforms.json beside them, or find cameras with igsr pose"
        )
    if (path / "images").is_dir():
        raise IgsrError(
            f"{path} holds an images folder but no cameras; put a COLMAP model (sparse/0) or a "
            "transforms.json beside it, or find cameras with igsr pose"
        )
    raise IgsrError(
        f"{path} holds no images and no cameras; give a folder with a transforms.json, or with "
        "images and a COLMAP model in sparse/0"
    )


def holds_cameras(path: str | os.PathLike[str]) -> bool:
    """Whether a path holds photos with cameras, as ``load_capture`` looks for them.

    Args:
        path: a folder or file; it need not exist.
    """
    path = Path(path)
    if is_file(path):
        return path.suffix.lower() == ".json"
    try:
        place = path.resolve()
    except (OSError, ValueError):
        return False
    if reduction_of(place.name) is not None and find_model(place.parent) is not None:
        return True
    folders = [path, place.parent] if place.name == "images" else [path]
    return any(
        is_file(folder / "transforms.json")
        or is_file(folder / "transforms_train.json")
        or find_model(folder) is not None
        for folder in folders
    )


def _described_folder(path: Path, max_size: int | None) -> DescribedCapture | None:
    if is_file(path / "transforms.json"):
        return described_transforms(path / "transforms.json")
    if is_file(path / "transforms_train.json"):
        return described_split_transforms(path)
    return _described_model(path, max_size)


def _described_model(
    path: Path, max_size: int | None, folder: str | None = None
) -> DescribedCapture | None:
    model = find_model(path)
    if model is None:
        return None
    logger.debug("%s: COLMAP model in %s", path, model)
    return described_colmap(path, model, max_size, folder)
