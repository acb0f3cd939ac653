"""Which folders of a data folder are scenes: those that hold photos, or ``images/`` with photos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from igsr.capture.image_files import SUFFIXES
from igsr.errors import IgsrError


def photo_scenes(data: Path, names: Sequence[str] | None = None) -> tuple[Path, list[str]]:
    """The scenes of a data folder.

    Args:
        data: a folder of photos, or of such folders.
        names: of the scenes, as paths relative to ``data``; None takes all folders directly in it,
            or ``data`` itself where that is a folder of photos.

    Returns:
        The folder that the names are relative to, and the names.

    Raises:
        IgsrError: there are none, a named one holds no photos, or one is named twice.
    """
    if not data.is_dir():
        raise IgsrError(f"{data} does not exist or is no folder; give a folder of photos")
    if names is None:
        if _holds_photos(data):
            whole = data.resolve()
            return whole.parent, [whole.name]
        found = sorted(folder.name for folder in data.iterdir() if _holds_photos(folder))
        if not found:
            raise IgsrError(
                f"{data} holds no photos and no folder with photos; give one, or name --scene"
            )
        return data, found
    for name in names:
        if not _holds_photos(data / name):
            raise IgsrError(f"{data / name} holds no photos; name another --scene")
    files = [file_name(name) for name in names]
    double = [name for k, name in enumerate(names) if files[k] in files[:k]]
    if double:
        raise IgsrError(f"--scene {double[0]} is named twice; name it once")
    return data, list(names)


def file_name(scene: str) -> str:
    """A scene's name as part of a file's name."""
    return scene.strip("/").replace("/", "-")


def _holds_photos(folder: Path) -> bool:
    return any(
        path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()
        for place in (folder, folder / "images")
        if place.is_dir()
        for path in place.iterdir()
    )
