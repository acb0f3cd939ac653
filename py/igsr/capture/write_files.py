"""The photos and masks of a capture as files, whatever the format that describes their cameras."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

from igsr.capture.types import View


def relative_name(name: str) -> PurePosixPath:
    """A view's name as a relative path that cannot leave the folder it is joined to.

    What cannot be printed, such as line breaks, which text formats end a name with, becomes "_".
    """
    name = "".join(letter if letter.isprintable() else "_" for letter in name)
    parts = [part for part in PurePosixPath(name).parts if part not in ("/", "..", ".")]
    return PurePosixPath(*parts) if parts else PurePosixPath("view")


def png_names(views: list[View]) -> list[str]:
    """A ``.png`` name for each view, all different; a leading ``images/`` is left away."""
    names: list[str] = []
    for view in views:
        path = relative_name(view.name)
        if len(path.parts) > 1 and path.parts[0] == "images":
            path = path.relative_to("images")
        name = path.with_suffix(".png").as_posix()
        if name in names:
            name = f"{path.as_posix()}.png"
        while name in names:
            name = f"{name[:-4]}_.png"
        names.append(name)
    return names


def write_pictures(
    folder: Path, views: list[View], names: list[str], mask_name: Callable[[str], str]
) -> None:
    """Write ``images/`` and, where views have them, ``masks/`` into a folder; all are PNG.

    Args:
        folder: the capture's.
        views: what to write.
        names: of ``png_names``.
        mask_name: gives the mask's name in ``masks/``, from the photo's in ``images/``.
    """

    def write(view: View, name: str) -> None:
        save_png(folder / "images" / name, view.image)
        if view.mask is not None:
            save_png(folder / "masks" / mask_name(name), 255 * view.mask.astype(np.uint8))

    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        list(pool.map(write, views, names))


def save_png(path: Path, pixels: np.ndarray) -> None:
    """Write uint8 [H, W], [H, W, 3] or [H, W, 4]; its folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # Photos compress hardly better at the highest level, and take ten times as long.
    Image.fromarray(pixels).save(path, compress_level=3)
