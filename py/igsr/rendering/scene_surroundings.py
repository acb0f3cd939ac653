"""What a scene page takes from the files beside a scene: cameras, and the background."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

from igsr.capture.load import describe_capture
from igsr.capture.read_transforms import read_cameras
from igsr.errors import IgsrError
from igsr.rendering.scene_page import PageCamera

#: The cameras that fits and refinements write beside their scene.
CAMERAS = "cameras.json"
#: Their report, which records the background.
REPORT = "report.json"


def cameras_of(capture: Path) -> list[PageCamera]:
    """The cameras of a capture, or of a ``cameras.json``; no photo is read.

    Args:
        capture: a ``cameras.json`` of igsr, a folder with one, or what ``load_capture`` reads.

    Raises:
        IgsrError: there is no such capture, or it cannot be read.
    """
    for path in (capture, capture / CAMERAS):
        if path.name == CAMERAS and path.is_file():
            return [PageCamera(name, camera) for name, camera in read_cameras(path)]
    return [PageCamera(shot.name, shot.camera) for shot in describe_capture(capture).shots]


def cameras_beside(scene: Path) -> list[PageCamera]:
    """The cameras in the ``cameras.json`` of a scene's fit; none where there is no such file.

    A file that cannot be read is named in a ``UserWarning``: nobody asked for it.
    """
    paths = (folder / CAMERAS for folder in _folders_of(scene))
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        return []
    try:
        return cameras_of(path)
    except IgsrError as error:
        warnings.warn(f"{error}; the page has no cameras", stacklevel=2)
        return []


def background_beside(scene: Path) -> tuple[float, float, float] | None:
    """The background, RGB in [0, 1], that the ``report.json`` of a scene's fit records.

    None where there is no such file, or it records none.
    """
    found = (_background_in(folder) for folder in _folders_of(scene))
    return next((color for color in found if color is not None), None)


def _folders_of(scene: Path) -> list[Path]:
    """A scene's own folder, and that of the refinement whose round or checkpoint it is."""
    own = scene.parent
    whole = own.resolve()
    if whole.parent.name == "rounds":
        return [own, whole.parent.parent]
    return [own, whole.parent] if whole.name == "checkpoints" else [own]


def _background_in(folder: Path) -> tuple[float, float, float] | None:
    try:
        report = json.loads((folder / REPORT).read_bytes())
        # A refinement's report has the protocol of its last scores alone.
        protocol = report.get("protocol") or report["test"]["protocol"]
        red, green, blue = (float(channel) for channel in protocol["background"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    in_range = all(0.0 <= channel <= 1.0 for channel in (red, green, blue))
    return (red, green, blue) if in_range else None
