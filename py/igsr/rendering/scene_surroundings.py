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
    """The cameras in the ``cameras.json`` beside a scene; none where there is no such file.

    A file that cannot be read is named in a ``UserWarning``: nobody asked for it.
    """
    path = scene.parent / CAMERAS
    if not path.is_file():
        return []
    try:
        return cameras_of(path)
    except IgsrError as error:
        warnings.warn(f"{error}; the page has no cameras", stacklevel=2)
        return []


def background_beside(scene: Path) -> tuple[float, float, float] | None:
    """The background, RGB in [0, 1], that the ``report.json`` beside a scene records.

    None where there is no such file, or it records none.
    """
    try:
        report = json.loads((scene.parent / REPORT).read_bytes())
        # A refinement's report has the protocol of its last scores alone.
        protocol = report.get("protocol") or report["test"]["protocol"]
        red, green, blue = (float(channel) for channel in protocol["background"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    in_range = all(0.0 <= channel <= 1.0 for channel in (red, green, blue))
    return (red, green, blue) if in_range else None
