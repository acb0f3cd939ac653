"""Write ``cameras.json``: the cameras of photos, without the photos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.json_file import write_json
from igsr.capture.types import Camera, View


def write_cameras(path: Path, views: Sequence[View]) -> None:
    """Write the cameras of photos in the format of nerfstudio's ``transforms.json``.

    One frame per photo: ``file_path`` (its name in the capture), ``w``, ``h``, ``fl_x``, ``fl_y``,
    ``cx``, ``cy`` in pixels, ``transform_matrix`` camera-to-world in OpenGL axes; for views of one
    wide photo their common ``rig``; for a photo with an exposure ``exposure``, with ``gain`` and
    ``offset`` of R, G and B (see ``Exposure``); for an estimated camera ``pose_evidence``, with the
    fields of ``PoseEvidence``.

    Raises:
        IgsrError: the file cannot be written.
    """
    frames = []
    for view in views:
        to_world = np.linalg.inv(view.camera.viewmat)
        frame = {"file_path": view.name, **camera_fields(view.camera, to_world)}
        if view.rig is not None:
            frame["rig"] = view.rig
        if view.pose_evidence is not None:
            frame["pose_evidence"] = vars(view.pose_evidence)
        if view.exposure is not None:
            frame["exposure"] = view.exposure.plain()
        frames.append(frame)
    write_json(path, {"camera_model": "PINHOLE", "frames": frames})


def camera_fields(camera: Camera, to_world: np.ndarray) -> dict[str, Any]:
    """Return the camera fields of a frame.

    Args:
        camera: the camera.
        to_world: [4, 4], the inverse of its viewmat.
    """
    opengl = to_world.copy()
    # From x right, y down, z forward to x right, y up, z back.
    opengl[:3, 1:3] *= -1.0
    return {
        "w": camera.width,
        "h": camera.height,
        "fl_x": float(camera.K[0, 0]),
        "fl_y": float(camera.K[1, 1]),
        "cx": float(camera.K[0, 2]),
        "cy": float(camera.K[1, 2]),
        "transform_matrix": opengl.tolist(),
    }
