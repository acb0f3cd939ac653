"""``load_capture``: finds out which format a capture has and reads it."""

from __future__ import annotations

import logging
import os
import time
from pathlib import Path

from igsr.capture.photos import SUFFIXES, is_file
from igsr.capture.read_colmap import find_model, load_colmap
from igsr.capture.read_transforms import load_split_transforms, load_transforms
from igsr.capture.types import Capture
from igsr.errors import IgsrError

logger = logging.getLogger(__name__)


def load_capture(path: str | os.PathLike[str]) -> Capture:
    """Load photos with known cameras.

    A capture is one of, tried in this order:

    * a ``transforms.json`` (nerfstudio or instant-ngp), or a folder with one;
    * a folder with ``transforms_train.json`` and ``transforms_test.json`` (NeRF Synthetic);
    * a folder with ``images/`` and a COLMAP model in ``sparse/0``, ``sparse`` or itself;
    * an ``images`` folder that has one of these beside it.

    Lens distortion is undone: cameras come out as pinholes with the focal lengths, principal point
    and size of the distorted camera, and ``View.mask`` is False where the lens saw nothing.

    The split is by file for NeRF Synthetic (a ``transforms_val.json`` is not read), by
    ``train_filenames`` and ``test_filenames`` where nerfstudio's file has them, and otherwise all
    views are for training; ``Capture.with_holdout`` splits anew.

    Args:
        path: the folder, or its ``transforms.json``.

    Returns:
        The capture, with its photos decoded.

    Raises:
        IgsrError: nothing can be loaded; the message names the file and what is wrong with it.
    """
    started = time.monotonic()
    capture = _load(Path(path))
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


def _load(path: Path) -> Capture:
    if is_file(path):
        if path.suffix.lower() != ".json":
            raise IgsrError(f"{path} is no capture; give a folder or a transforms.json")
        return load_transforms(path)
    try:
        files = sorted(entry.name for entry in path.iterdir())
    except (OSError, ValueError) as error:
        raise IgsrError(f"{path} does not exist or cannot be read; give a capture") from error
    found = _load_folder(path)
    # "path/.." would follow links and leave "." where it is; the real parent is meant.
    if found is None and path.resolve().name == "images":
        found = _load_folder(path.resolve().parent)
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
        folders = [path, path.resolve().parent] if path.resolve().name == "images" else [path]
    except (OSError, ValueError):
        return False
    return any(
        is_file(folder / "transforms.json")
        or is_file(folder / "transforms_train.json")
        or find_model(folder) is not None
        for folder in folders
    )


def _load_folder(path: Path) -> Capture | None:
    if is_file(path / "transforms.json"):
        return load_transforms(path / "transforms.json")
    if is_file(path / "transforms_train.json"):
        return load_split_transforms(path)
    model = find_model(path)
    if model is None:
        return None
    logger.debug("%s: COLMAP model in %s", path, model)
    return load_colmap(path, model)
