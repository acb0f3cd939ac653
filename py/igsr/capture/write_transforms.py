"""Write captures for nerfstudio: ``transforms.json`` with cameras in OpenGL axes."""

from __future__ import annotations

import json
import os
from typing import Any

import numpy as np

from igsr._internal.atomic_write import atomic_folder
from igsr.capture.point_cloud import write_point_cloud
from igsr.capture.types import Camera, Capture
from igsr.capture.write_files import png_names, write_depths, write_pictures


def write_transforms(
    capture: Capture, out: str | os.PathLike[str], *, replace: bool = False
) -> None:
    """Write ``transforms.json``, ``images/``, ``masks/``, ``depths/`` and ``points.ply``.

    Depths are float32 ``.npy`` in world units, 0 where they are not known or have a confidence of
    0; other confidences are not written.

    Views of one wide photo have its name as ``rig``, which ``load_capture`` reads back.

    Args:
        capture: the capture to write. The split is written if any view is for testing.
        out: the folder; it must be new or empty.
        replace: replace an existing folder, once the new one is complete.

    Raises:
        IgsrError: the folder is not empty, or cannot be written.
    """
    names = png_names(capture.views)
    frames = []
    for view, name in zip(capture.views, names, strict=True):
        frame = {"file_path": f"images/{name}", **_camera_fields(view.camera)}
        if view.mask is not None:
            frame["mask_path"] = f"masks/{name}"
        if view.rig is not None:
            frame["rig"] = view.rig
        frames.append(frame)
    document: dict[str, Any] = {"camera_model": "PINHOLE", "frames": frames}
    if capture.test_views:
        for split in ("train", "test"):
            document[f"{split}_filenames"] = [
                frame["file_path"]
                for frame, view in zip(frames, capture.views, strict=True)
                if view.split == split
            ]
    with atomic_folder(out, replace=replace) as folder:
        write_pictures(folder, capture.views, names, str)
        written = write_depths(folder, names, [view.known_depth for view in capture.views])
        for frame, name in zip(frames, names, strict=True):
            if name in written:
                frame |= {"depth_file_path": written[name], "depth_unit_scale_factor": 1.0}
        if capture.points is not None:
            document["ply_file_path"] = "points.ply"
            write_point_cloud(folder / "points.ply", capture.points)
        text = json.dumps(document, indent=2, allow_nan=False)
        (folder / "transforms.json").write_text(text + "\n", encoding="utf-8")


def _camera_fields(camera: Camera) -> dict[str, Any]:
    K = camera.K
    pose = np.eye(4)
    pose[:3, :3] = camera.viewmat[:3, :3].T
    pose[:3, 3] = camera.center
    # From x right, y down, z forward to x right, y up, z back.
    pose[:3, 1:3] *= -1.0
    return {
        "fl_x": float(K[0, 0]),
        "fl_y": float(K[1, 1]),
        "cx": float(K[0, 2]),
        "cy": float(K[1, 2]),
        "w": camera.width,
        "h": camera.height,
        "transform_matrix": pose.tolist(),
    }
