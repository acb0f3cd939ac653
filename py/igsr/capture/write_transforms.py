"""Write captures for nerfstudio: ``transforms.json`` with cameras in OpenGL axes."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from igsr._internal.atomic_write import atomic_folder
from igsr._internal.json_file import write_json
from igsr.capture.point_cloud import write_point_cloud
from igsr.capture.types import Camera, Capture
from igsr.capture.write_cameras import camera_fields
from igsr.capture.write_files import png_names, write_depths, write_pictures


def write_transforms(
    capture: Capture, out: str | os.PathLike[str], *, replace: bool = False
) -> None:
    """Write ``transforms.json``, ``images/``, ``masks/``, ``depths/`` and ``points.ply``.

    Depths are float32 ``.npy`` in world units, 0 if they are unknown or have confidence 0; other
    confidences are not written. Views of one wide photo have its name as ``rig``, which
    ``load_capture`` reads back.

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
        frame = {
            "file_path": f"images/{name}",
            **camera_fields(view.camera, _to_world(view.camera)),
        }
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
        depth_files = write_depths(folder, names, [view.known_depth for view in capture.views])
        for frame, name in zip(frames, names, strict=True):
            if name in depth_files:
                frame |= {"depth_file_path": depth_files[name], "depth_unit_scale_factor": 1.0}
        if capture.points is not None:
            document["ply_file_path"] = "points.ply"
            write_point_cloud(folder / "points.ply", capture.points)
        write_json(folder / "transforms.json", document)


def _to_world(camera: Camera) -> np.ndarray:
    """The exact inverse of a rigid viewmat, unlike that of ``write_cameras``."""
    to_world = np.eye(4)
    to_world[:3, :3] = camera.viewmat[:3, :3].T
    to_world[:3, 3] = camera.center
    return to_world
