"""Cameras to jump to, and photos to compare renders with."""

from __future__ import annotations

import io
import os
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from igsr.errors import IgsrError
from igsr.fitting.followed_run import CAMERAS, VIEW
from igsr.rendering.scene_page import PageCamera
from igsr.rendering.scene_surroundings import cameras_of

#: Endings of the photos that are shown.
ENDINGS = (".jpg", ".jpeg", ".png")
#: Longest side of photos as they are sent, pixels.
LONGEST_SIDE = 1600


@dataclass(frozen=True)
class SeenCamera:
    """A camera to jump to.

    Attributes:
        shown: its name and the camera.
        photo: the photo, where there is one.
    """

    shown: PageCamera
    photo: Path | None


def camera_files(path: Path) -> list[Path]:
    """Where the cameras of a splat file or a folder lie, if there are any."""
    folder = path if path.is_dir() else path.parent
    return [folder / VIEW / CAMERAS, folder / CAMERAS]


def seen_cameras(file: Path) -> list[SeenCamera]:
    """The cameras of a ``cameras.json``; none where it cannot be read.

    A photo is looked for under the camera's name, within the file's folder alone: the name may say
    anything.
    """
    try:
        cameras = cameras_of(file) if file.is_file() else []
    except IgsrError:
        return []
    return [SeenCamera(one, _photo(file.parent, one.name)) for one in cameras]


def jpeg_of(path: Path) -> bytes:
    """A photo as a JPEG of at most ``LONGEST_SIDE`` pixels.

    Raises:
        IgsrError: it cannot be read.
    """
    try:
        with Image.open(path, formats=("JPEG", "PNG")) as photo:
            photo.draft("RGB", (LONGEST_SIDE, LONGEST_SIDE))
            small = photo.convert("RGB")
        small.thumbnail((LONGEST_SIDE, LONGEST_SIDE))
        file = io.BytesIO()
        small.save(file, format="JPEG", quality=90)
    # Pillow has errors of many kinds for files that are damaged or too large.
    except Exception as error:
        raise IgsrError(f"{path} cannot be shown: {error}.") from error
    return file.getvalue()


def _photo(folder: Path, name: str) -> Path | None:
    if not name.lower().endswith(ENDINGS) or "\0" in name:
        return None
    try:
        inside = os.path.realpath(folder)
        path = os.path.realpath(os.path.join(inside, name))
        if os.path.commonpath([inside, path]) != inside or not os.path.isfile(path):
            return None
    except (OSError, ValueError):
        return None
    return Path(path)
