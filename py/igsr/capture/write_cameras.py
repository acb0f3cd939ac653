"""Write ``cameras.json``: the cameras of photos, without the photos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from igsr._internal.json_file import write_json
from igsr.capture.types import View


def write_cameras(path: Path, views: Sequence[View]) -> None:
    """Write the cameras of photos in the format of nerfstudio's ``transforms.json``.

    One frame per photo: ``file_path`` (its name in the capture), ``w``, ``h``, ``fl_x``, ``fl_y``,
    ``cx``, ``cy`` in pixels, ``transform_matrix`` camera-to-world in OpenGL axes; ``rig``, which
    views of one wide photo share; ``exposure`` where a fit has found it: ``gain`` and ``offset`` of
    R, G and B (see ``Exposure``); ``pose_evidence`` where the camera was found: what it
    ``rests_on``, and the standard deviations of ``rotation`` (degrees) and ``center`` (world units;
    see ``PoseEvidence``).

    Raises:
        IgsrError: the file cannot be written.
    """
    frames = []
    for view in views:
        camera, known = view.camera, view.pose_evidence
        to_world = np.linalg.inv(camera.viewmat)
        to_world[:3, 1:3] *= -1.0
        frames.append(
            {
                "file_path": view.name,
                "w": camera.width,
                "h": camera.height,
                "fl_x": float(camera.K[0, 0]),
                "fl_y": float(camera.K[1, 1]),
                "cx": float(camera.K[0, 2]),
                "cy": float(camera.K[1, 2]),
                "transform_matrix": to_world.tolist(),
                **({} if view.rig is None else {"rig": view.rig}),
                **({} if known is None else {"pose_evidence": vars(known)}),
                **({} if view.exposure is None else {"exposure": view.exposure.plain()}),
            }
        )
    write_json(path, {"camera_model": "PINHOLE", "frames": frames})
