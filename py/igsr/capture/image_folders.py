"""Photos beside a COLMAP model, at full size or reduced: ``images``, ``images_2``, ``images_4`` ...

LLFF and mip-NeRF 360 keep photos in ``images`` and, reduced by K, in ``images_K``; the model is
that of the full size. The reduced photos have the same names, or another suffix, or, in LLFF, other
names in the same order.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from igsr.capture.photos import SUFFIXES, is_file
from igsr.errors import IgsrError

_REDUCED = re.compile(r"images_([1-9][0-9]{0,2})")


@dataclass(frozen=True)
class ImageFolder:
    """Where the photos of a model are.

    Attributes:
        files: of each image of the model, in its order.
        factor: by which they are reduced; within a pixel, since sizes are rounded.
        masks: folder of their masks; it need not exist.
    """

    files: list[Path]
    factor: int
    masks: Path


def reduction_of(folder: str) -> int | None:
    """K of a folder's name ``images_K``; None for other names."""
    found = _REDUCED.fullmatch(folder)
    return None if found is None else int(found[1])


def find_images(
    capture: Path,
    names: Sequence[str],
    sizes: Sequence[tuple[int, int]],
    max_size: int | None,
    folder: str | None,
    source: Path,
) -> ImageFolder:
    """The folder whose photos are the smallest that are large enough.

    Args:
        capture: the capture's folder. Without ``images`` and ``images_K``, it holds the photos.
        names: of the model's images.
        sizes: width and height, in pixels, of the camera of each.
        max_size: longest side in pixels of photos as loaded, or None.
        folder: the name of the folder to take, or None.
        source: the file that names the images, for error messages.

    Raises:
        IgsrError: a photo is missing.
    """
    reduced = _reduced_folders(capture)
    full = capture / "images" if (capture / "images").is_dir() or not reduced else None
    if full is not None and not full.is_dir():
        full = capture
    if folder is not None:
        factor = reduction_of(folder) or 1
        return _complete(capture / folder, factor, capture, full, names, source)
    if max_size is not None:
        for factor in sorted(reduced, reverse=True):
            if all(max(size) // factor >= min(max_size, max(size)) for size in sizes):
                files = _files(reduced[factor], full, names)
                if files is not None:
                    return ImageFolder(files, factor, _masks(capture, factor))
    if full is not None:
        return _complete(full, 1, capture, full, names, source)
    for factor in sorted(reduced):
        files = _files(reduced[factor], full, names)
        if files is not None:
            return ImageFolder(files, factor, _masks(capture, factor))
    smallest = min(reduced)
    return _complete(reduced[smallest], smallest, capture, full, names, source)


def _reduced_folders(capture: Path) -> dict[int, Path]:
    """The folders ``images_K`` of a capture by K."""
    try:
        entries = list(capture.iterdir())
    except OSError:
        return {}
    found = {}
    for entry in entries:
        factor = reduction_of(entry.name)
        if factor is not None and entry.is_dir():
            found[factor] = entry
    return found


def _masks(capture: Path, factor: int) -> Path:
    own = capture / f"masks_{factor}"
    return own if factor > 1 and own.is_dir() else capture / "masks"


def _complete(
    folder: Path,
    factor: int,
    capture: Path,
    full: Path | None,
    names: Sequence[str],
    source: Path,
) -> ImageFolder:
    """A folder that must have all photos.

    Raises:
        IgsrError: it lacks one.
    """
    files = _files(folder, full, names) if factor > 1 else [folder / name for name in names]
    for name, file in zip(names, files or [folder / name for name in names], strict=True):
        if not is_file(file):
            raise IgsrError(
                f"{source} has a camera for {name} but {file} is missing; put the photo there"
            )
    return ImageFolder(files or [], factor, _masks(capture, factor))


def _files(folder: Path, full: Path | None, names: Sequence[str]) -> list[Path] | None:
    """The photo of each name in a folder of reduced photos; None where one is missing."""
    files = [folder / name for name in names]
    if all(map(is_file, files)):
        return files
    here = _photos(folder)
    by_stem = {path.relative_to(folder).with_suffix("").as_posix(): path for path in here}
    if len(by_stem) == len(here):
        found = [by_stem.get(PurePosixPath(name).with_suffix("").as_posix()) for name in names]
        if None not in found:
            return [path for path in found if path is not None]
    # LLFF numbers its reduced photos anew, in the order of the full ones.
    if full is None:
        return None
    there = _photos(full)
    if len(there) != len(here):
        return None
    by_name = {
        path.relative_to(full).as_posix(): reduced
        for path, reduced in zip(there, here, strict=True)
    }
    renamed = [by_name.get(name) for name in names]
    return None if None in renamed else [path for path in renamed if path is not None]


def _photos(folder: Path) -> list[Path]:
    return sorted(
        path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and is_file(path)
    )
