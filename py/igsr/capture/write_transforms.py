"""Write captures and cameras in the format of nerfstudio's ``transforms.json``."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.atomic_write import atomic_folder
from igsr._internal.json_file import write_json
from igsr.capture.point_cloud import write_point_cloud
from igsr.capture.types import Camera, Capture, View
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
            **_camera_fields(view.camera, _to_world(view.camera)),
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


def write_cameras(path: Path, views: Sequence[View]) -> None:
    """Write ``cameras.json``: the cameras of photos, without the photos.

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
        frame = {"file_path": view.name, **_camera_fields(view.camera, to_world)}
        if view.rig is not None:
            frame["rig"] = view.rig
        if view.pose_evidence is not None:
            frame["pose_evidence"] = vars(view.pose_evidence)
        if view.exposure is not None:
            frame["exposure"] = view.exposure.plain()
        frames.append(frame)
    write_json(path, {"camera_model": "PINHOLE", "frames": frames})


def _camera_fields(camera: Camera, to_world: np.ndarray) -> dict[str, Any]:
    """The camera fields of a frame, given the inverse [4, 4] of the viewmat."""
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


def _to_world(camera: Camera) -> np.ndarray:
    """The exact inverse of a rigid viewmat, unlike in ``write_cameras``."""
    to_world = np.eye(4)
    to_world[:3, :3] = camera.viewmat[:3, :3].T
    to_world[:3, 3] = camera.center
    return to_world
