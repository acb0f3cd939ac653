"""Write the photos, masks and depths of a capture, which all formats of cameras share."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

from igsr.capture.image_files import DEPTHS, write_depth
from igsr.capture.types import View


def relative_name(name: str) -> PurePosixPath:
    """Return a view's name as a relative path that stays inside the folder it is joined to.

    Unprintable characters become "_": a line break would end a name in text formats.
    """
    name = "".join(letter if letter.isprintable() else "_" for letter in name)
    parts = [part for part in PurePosixPath(name).parts if part not in ("/", "..", ".")]
    return PurePosixPath(*parts) if parts else PurePosixPath("view")


def unique_stems(names: Iterable[str], *suffixes: str) -> list[str]:
    """Return a path for each view's name; with any of the suffixes, it names no other view's file.

    Upper and lower case are the same to some file systems.
    """
    taken: set[str] = set()
    tried: Counter[str] = Counter()
    stems: list[str] = []
    for name in names:
        path = relative_name(name)
        stem, longer = path.with_suffix("").as_posix(), path.as_posix()
        while not taken.isdisjoint(files := {(stem + end).casefold() for end in suffixes}):
            tried[longer.casefold()] += 1
            number = tried[longer.casefold()]
            stem = longer if number == 1 else f"{longer}_{number}"
        taken |= files
        stems.append(stem)
    return stems


def png_names(views: list[View]) -> list[str]:
    """Return a unique ``.png`` name for each view, without a leading ``images/``."""
    names = []
    for view in views:
        first, *rest = (path := relative_name(view.name)).parts
        names.append("/".join(rest) if rest and first == "images" else path.as_posix())
    return [f"{stem}.png" for stem in unique_stems(names, ".png")]


def write_pictures(
    folder: Path, views: list[View], names: list[str], mask_name: Callable[[str], str]
) -> None:
    """Write ``images/`` and, if views have masks, ``masks/`` into a folder, all as PNG.

    Args:
        folder: folder of the capture.
        views: the views to write.
        names: their file names, from ``png_names``.
        mask_name: returns the mask's name in ``masks/`` for the photo's in ``images/``.
    """

    def write(view: View, name: str) -> None:
        save_png(folder / "images" / name, view.image)
        if view.mask is not None:
            save_png(folder / "masks" / mask_name(name), 255 * view.mask.astype(np.uint8))

    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        list(pool.map(write, views, names))


def write_depths(
    folder: Path, names: list[str], depths: Sequence[np.ndarray | None]
) -> dict[str, str]:
    """Write the depths of photos into ``depths/`` of a folder, if there are any.

    Args:
        folder: folder of the capture.
        names: the photos' file names, from ``png_names``.
        depths: per photo z [h, w] in world units, of any size, 0 for unknown depths; or None.

    Returns:
        The name of each file in the folder, by the name of its photo.
    """
    written = {}
    for name, depth in zip(names, depths, strict=True):
        if depth is not None:
            written[name] = f"{DEPTHS}/{name}.npy"
            write_depth(folder / written[name], depth)
    return written


def save_png(path: Path, pixels: np.ndarray) -> None:
    """Write uint8 [H, W], [H, W, 3] or [H, W, 4]; a missing folder is created."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # The highest level takes ten times as long and hardly makes photos smaller.
    Image.fromarray(pixels).save(path, compress_level=3)
