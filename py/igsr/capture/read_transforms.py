"""Read captures with a ``transforms.json``: NeRF Synthetic, nerfstudio and instant-ngp.

All three have a list of frames with a camera-to-world matrix each, but use different fields. Every
camera field may be in the frame or, for all frames, next to the list.

Only this reader converts OpenGL cameras (x right, y up, z back) into OpenCV cameras.

Sources: https://docs.nerf.studio/quickstart/data_conventions.html, the NeRF Synthetic data, and
instant-ngp's ``docs/nerf_dataset_tips.md``.
"""

from __future__ import annotations

import json
import math
import posixpath
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.choices import SPLITS, Split
from igsr._internal.input_files import read_json
from igsr.capture.image_files import is_file, photo_header
from igsr.capture.mask_files import MaskFiles
from igsr.capture.photos import DescribedCapture, Shot, rig_shots
from igsr.capture.point_cloud import read_point_cloud
from igsr.capture.rig import rig_of
from igsr.capture.types import Camera, Points, intrinsic_matrix, nearest_rigid
from igsr.capture.undistort import Lens
from igsr.capture.wide_photos import WideFisheye, WidePhoto, whole_sphere, wide_fisheye
from igsr.errors import IgsrError

# nerfstudio does not distinguish the perspective models: the coefficients determine the lens.
_PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_FISHEYE = "OPENCV_FISHEYE"
_EQUIRECTANGULAR = "EQUIRECTANGULAR"

#: Limits of a file, for 100 000 cameras: each has 30 values.
_MAX_BYTES = 128 << 20
MAX_VALUES = 1 << 22

# NeRF Synthetic omits the suffix.
_OMITTED_SUFFIXES = (".png", ".jpg", ".jpeg")


def describe_transforms(path: Path) -> DescribedCapture:
    """Read a ``transforms.json`` except for its photos; paths in it are relative to its folder."""
    document = _read_json(path)
    frames = _frames(document, path)
    split_from_name = _named_splits(document, path, frames)
    shots = []
    for index, frame in enumerate(frames):
        name = _frame_name(frame, path, index)
        split: Split | None = "train" if split_from_name is None else split_from_name.get(name)
        if split is not None:
            shots += _shots(document, frame, path, index, split)

    def points() -> Points | None:
        if "ply_file_path" not in document:
            return None
        return read_point_cloud(path.parent / _file_text(document, "ply_file_path", str(path)))

    return DescribedCapture(path.parent, _with_masks(shots, path.parent), points)


def _with_masks(shots: list[Shot], folder: Path) -> list[Shot]:
    """The photos with masks by their names, if the file names no mask."""
    if any(shot.mask_path is not None for shot in shots):
        return shots
    masks, found = MaskFiles(folder), []
    for shot in shots:
        mask = masks.of(shot.path) if shot.rig is None else None
        found.append(shot if mask is None else replace(shot, mask_path=mask))
    masks.warn_unless_used()
    return found


def describe_split_transforms(folder: Path) -> DescribedCapture:
    """Read ``transforms_train.json`` and, if it exists, ``transforms_test.json`` of a folder."""
    shots = []
    for split in SPLITS:
        path = folder / f"transforms_{split}.json"
        if split == "train" or is_file(path):
            document = _read_json(path)
            for index, frame in enumerate(_frames(document, path)):
                shots += _shots(document, frame, path, index, split)
    return DescribedCapture(folder, shots, lambda: None)


def read_cameras(path: Path, most: int = MAX_VALUES) -> list[tuple[str, Camera]]:
    """Read the photos' names and cameras of a ``cameras.json`` that igsr wrote.

    Files of more than ``most`` values are refused.
    """
    document = _read_json(path, most)
    if document.get("camera_model") != "PINHOLE":
        raise IgsrError(f"{path}: camera_model must be PINHOLE, as igsr writes it")
    cameras = []
    for index, frame in enumerate(_frames(document, path)):
        name = _file_text(frame, "file_path", f"{path}, frame {index}")
        where = f"{path}, frame {index} ({name})"
        width, height = _size(frame, where)
        K, _ = _intrinsics(frame, width, height, where)
        cameras.append((name, Camera(_viewmat(frame, where), K, width, height)))
    return cameras


def read_lens(path: Path) -> WideFisheye:
    """Read the lens of fisheye photos without cameras.

    Args:
        path: a JSON file with the camera fields of a frame: ``w``, ``h``, ``camera_model``
            OPENCV_FISHEYE, ``fl_x`` and so on.

    Raises:
        IgsrError: a field is missing or out of range, or a pinhole can show the lens's view.
    """
    fields, where = _read_json(path), str(path)
    width, height = _size(fields, where)
    _required(fields, "fl_x", where)
    K, lens = _intrinsics(fields, width, height, where)
    wide = wide_fisheye(K, lens, width, height, _crop_radius(fields, where))
    if wide is None:
        raise IgsrError(
            f"{path} describes no fisheye of more than 120 degrees; delete it, since cameras of "
            "other lenses are found with their distortion"
        )
    return wide


def _read_json(path: Path, most: int = MAX_VALUES) -> dict[str, Any]:
    try:
        document = read_json(path, _MAX_BYTES, most)
    except OSError as error:
        raise IgsrError(f"{path} cannot be read ({error.strerror}); check it") from error
    except ValueError as error:
        where = f" at line {error.lineno}" if isinstance(error, json.JSONDecodeError) else ""
        raise IgsrError(f"{path} is not valid JSON{where}; write it again") from error
    if not isinstance(document, dict):
        raise IgsrError(f"{path} is not a JSON object with frames; write it again")
    return document


def _frames(document: dict[str, Any], path: Path) -> list[dict[str, Any]]:
    frames = _required(document, "frames", str(path))
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise IgsrError(f"{path}: frames must be a list of objects; correct it")
    if not frames:
        raise IgsrError(f"{path}: frames is empty, so there are no images; add some")
    return frames


def _required(fields: dict[str, Any], key: str, where: str) -> Any:
    if key not in fields:
        raise IgsrError(f"{where}: {key} is missing; add it")
    return fields[key]


def _text(fields: dict[str, Any], key: str, where: str) -> str:
    value = _required(fields, key, where)
    # JSON can hold half a surrogate pair, which file names and terminals cannot.
    if not isinstance(value, str) or not value or re.search("[\0\ud800-\udfff]", value):
        raise IgsrError(f"{where}: {key} must be a file's path, not {_shown(value)}; correct it")
    return value


def _shown(value: Any) -> str:
    text = ascii(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _number(fields: dict[str, Any], key: str, where: str, default: float | None = None) -> float:
    if key not in fields and default is not None:
        return default
    value = _required(fields, key, where)
    if not _is_number(value):
        raise IgsrError(f"{where}: {key} must be a number, not {_shown(value)}; correct it")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise IgsrError(f"{where}: {key} is not finite; give a finite number")
    return number


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _frame_name(frame: dict[str, Any], path: Path, index: int) -> str:
    """``file_path``, normalized: "./a.png" and "a.png" are the same frame."""
    return posixpath.normpath(_file_text(frame, "file_path", f"{path}, frame {index}"))


def _file_text(fields: dict[str, Any], key: str, where: str) -> str:
    """The path of a file; files made on Windows have backslashes."""
    return _text(fields, key, where).replace("\\", "/")


def _shots(
    document: dict[str, Any], frame: dict[str, Any], path: Path, index: int, split: Split
) -> list[Shot]:
    """The photo of a frame, or its views if it is a wide one."""
    name = _frame_name(frame, path, index)
    where = f"{path}, frame {index} ({name})"
    for suffix in ("", *_OMITTED_SUFFIXES):
        if is_file(path.parent / (name + suffix)):
            name += suffix
            break
    else:
        raise IgsrError(f"{where}: the image {path.parent / name} is missing; put it there")
    photo = path.parent / name
    mask_path = _named_file(frame, "mask_path", "mask", path, where)
    fields = {**document, **frame}
    depth_path = _named_file(fields, "depth_file_path", "depth", path, where)
    depth_unit = None
    if depth_path is not None and "depth_unit_scale_factor" in fields:
        depth_unit = _number(fields, "depth_unit_scale_factor", where)
        if depth_unit <= 0.0:
            raise IgsrError(
                f"{where}: depth_unit_scale_factor is {depth_unit:g}; give the world units of one "
                "number of the depth's file"
            )
    has_size = "w" in fields or "h" in fields
    width, height = _size(fields, where) if has_size else photo_header(photo).size
    viewmat = _viewmat(frame, where)
    is_sphere = fields.get("camera_model") == _EQUIRECTANGULAR
    K, lens = (np.eye(3), Lens()) if is_sphere else _intrinsics(fields, width, height, where)
    rig = _text(frame, "rig", where) if "rig" in frame else None
    try:
        camera = Camera(viewmat, K, width, height)
        wide: WidePhoto | None
        if is_sphere:
            wide = whole_sphere(width, height)
        else:
            wide = wide_fisheye(K, lens, width, height, _crop_radius(fields, where))
        shot = Shot(name, photo, camera, lens, split, mask_path, path, photo=rig)
        shot = replace(shot, depth_path=depth_path, depth_unit=depth_unit)
        return [shot] if wide is None else rig_shots(shot, rig_of(wide))
    except IgsrError as error:
        raise IgsrError(f"{where}: {error}") from error


def _crop_radius(fields: dict[str, Any], where: str) -> float:
    """nerfstudio's radius of the image circle, pixels."""
    return _number(fields, "fisheye_crop_radius", where, math.inf)


def _named_file(fields: dict[str, Any], key: str, kind: str, path: Path, where: str) -> Path | None:
    if key not in fields:
        return None
    file = path.parent / _file_text(fields, key, where)
    if not is_file(file):
        raise IgsrError(f"{where}: the {kind} {file} is missing; put it there")
    return file


def _size(fields: dict[str, Any], where: str) -> tuple[int, int]:
    width, height = (_number(fields, key, where) for key in ("w", "h"))
    for key, value in (("w", width), ("h", height)):
        if value < 1 or value != int(value):
            raise IgsrError(f"{where}: {key} is {value:g}; give a whole number of pixels")
    return int(width), int(height)


def _intrinsics(
    fields: dict[str, Any], width: int, height: int, where: str
) -> tuple[np.ndarray, Lens]:
    if "fl_x" in fields:
        fx = fy = _number(fields, "fl_x", where)
    elif "camera_angle_x" in fields:
        fx = fy = _focal_length(fields, "camera_angle_x", width, where)
        if "camera_angle_y" in fields and "fl_y" not in fields:
            fy = _focal_length(fields, "camera_angle_y", height, where)
    else:
        raise IgsrError(f"{where}: fl_x or camera_angle_x is missing; add one of them")
    fy = _number(fields, "fl_y", where, fy)
    cx = _number(fields, "cx", where, width / 2)
    cy = _number(fields, "cy", where, height / 2)
    for key, value in (("fl_x", fx), ("fl_y", fy)):
        if value <= 0.0:
            raise IgsrError(
                f"{where}: {key} is {value:g}, so the intrinsics are singular; give a positive "
                "focal length in pixels"
            )
    return intrinsic_matrix(fx, fy, cx, cy), _lens(fields, where)


def _focal_length(fields: dict[str, Any], key: str, size: int, where: str) -> float:
    angle = _number(fields, key, where)
    if not 0.0 < angle < math.pi:
        raise IgsrError(f"{where}: {key} is {angle:g}; give an angle between 0 and pi radians")
    return 0.5 * size / math.tan(0.5 * angle)


def _lens(fields: dict[str, Any], where: str) -> Lens:
    model = fields.get("camera_model", "OPENCV")
    if model not in (*_PERSPECTIVE, _FISHEYE):
        raise IgsrError(
            f"{where}: the camera_model {_shown(model)} is not supported; undistort the images to "
            "PINHOLE or use OPENCV, OPENCV_FISHEYE or EQUIRECTANGULAR"
        )
    fisheye = model == _FISHEYE or fields.get("is_fisheye") is True
    k1, k2, k3, k4, p1, p2 = (
        _number(fields, key, where, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2")
    )
    # Ignoring a coefficient would distort the scene.
    unused = {key: _number(fields, key, where, 0.0) for key in ("k5", "k6")}
    unused.update({"p1": p1, "p2": p2} if fisheye else {"k4": k4})
    for key, value in unused.items():
        if value != 0.0:
            kind = "fisheye" if fisheye else "perspective"
            raise IgsrError(
                f"{where}: {key} is {value:g}, which has no agreed meaning for a {kind} lens here; "
                "undistort the images to PINHOLE first"
            )
    if fisheye:
        return Lens(True, (k1, k2, k3, k4))
    return Lens(False, (k1, k2, k3), (), (p1, p2))


def _viewmat(frame: dict[str, Any], where: str) -> np.ndarray:
    """World to camera in OpenCV axes, from camera to world in OpenGL axes (3 or 4 rows of 4)."""
    matrix = _required(frame, "transform_matrix", where)
    is_matrix = (
        isinstance(matrix, list)
        and len(matrix) in (3, 4)
        and all(isinstance(row, list) and len(row) == 4 for row in matrix)
        and all(_is_number(entry) for row in matrix for entry in row)
    )
    if not is_matrix:
        raise IgsrError(f"{where}: transform_matrix must be 4 rows of 4 numbers; correct it")
    rows = matrix if len(matrix) == 4 else [*matrix, [0.0, 0.0, 0.0, 1.0]]
    try:
        world_from_camera = nearest_rigid(np.array(rows, dtype=object), "transform_matrix")
    except IgsrError as error:
        raise IgsrError(f"{where}: {error}") from error
    world_from_camera[:3, 1:3] *= -1.0
    rotation = world_from_camera[:3, :3].T
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ world_from_camera[:3, 3]
    return viewmat


def _named_splits(
    document: dict[str, Any], path: Path, frames: list[dict[str, Any]]
) -> dict[str, Split] | None:
    """nerfstudio's lists as {frame name: split}, or None if the file has none.

    Frames in ``val_filenames`` only are ignored, as a ``transforms_val.json`` is. Frames in no list
    are for training if there is no ``train_filenames``, else ignored.
    """
    if not {"train_filenames", "test_filenames"} & document.keys():
        return None
    split_from_name: dict[str, Split] = {}
    known = {_frame_name(frame, path, index) for index, frame in enumerate(frames)}
    for split in SPLITS:
        listed = document.get(f"{split}_filenames", [])
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise IgsrError(f"{path}: {split}_filenames must be a list of paths; correct it")
        for name in map(posixpath.normpath, listed):
            if name not in known:
                raise IgsrError(
                    f"{path}: {split}_filenames names {_shown(name)}, which is no frame's "
                    "file_path; correct it"
                )
            if split_from_name.setdefault(name, split) != split:
                raise IgsrError(
                    f"{path}: {_shown(name)} is both in train_filenames and in "
                    "test_filenames; remove one"
                )
    if "train_filenames" not in document:
        listed = document.get("val_filenames", [])
        names = listed if isinstance(listed, list) else []
        left_out = {posixpath.normpath(name) for name in names if isinstance(name, str)}
        for name in known - left_out:
            split_from_name.setdefault(name, "train")
    return split_from_name
