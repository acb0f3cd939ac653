"""The front door: finds out which kind of capture a path is."""

from __future__ import annotations

import os
from pathlib import Path

from igsr.capture.photos import SUFFIXES, is_file
from igsr.capture.read_colmap import find_model, load_colmap
from igsr.capture.read_transforms import load_split_transforms, load_transforms
from igsr.capture.types import Capture
from igsr.errors import IgsrError


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
        path: folder or file.

    Returns:
        The capture, photos decoded.

    Raises:
        IgsrError: one sentence naming what is wrong with which file.
    """
    path = Path(path)
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
    """Whether a path is a capture, photos with cameras, as ``load_capture`` finds it."""
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
    return load_colmap(path, model) if model is not None else None
