"""Captures that COLMAP made: a sparse model, text or binary, beside a folder of photos.

The three files that say all a capture needs (cameras, images, points3D) are parsed here and not by
pycolmap, which reads a truncated file as zeros without a word and ends the whole process on others;
the tests hold this reader against models that pycolmap wrote. Models of COLMAP 3.12 and later have
rigs and frames too, but their images file still gives each image's own pose.

Points without a track are not COLMAP's own: their error, where positive, is 1 / confidence, as
``write_colmap`` has it.

Source of the formats and camera models: https://colmap.github.io/format.html and cameras.html.
"""

from __future__ import annotations

import math
import posixpath
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from igsr.capture.photos import Shot, is_file, load_views
from igsr.capture.types import Camera, Capture, Points, intrinsic_matrix
from igsr.capture.undistort import Lens
from igsr.errors import IgsrError

# COLMAP's model numbers, so that what is refused has a name.
_NAMES = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
    "SIMPLE_DIVISION",
    "DIVISION",
    "SIMPLE_FISHEYE",
    "FISHEYE",
    "EUCM",
    "EQUIRECTANGULAR",
)
# How many parameters each supported model has.
_PARAMETER_COUNTS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
}
_ONE_FOCAL_LENGTH = (
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
)


@dataclass(frozen=True)
class _ColmapCamera:
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class _ColmapImage:
    name: str
    quat: tuple[float, ...]  # wxyz, world to camera
    translation: tuple[float, ...]
    camera_id: int


def find_model(path: Path) -> Path | None:
    """The folder of a capture's model: ``sparse/0``, ``sparse`` or the capture itself, or None."""
    for folder in (path / "sparse" / "0", path / "sparse", path):
        if any(is_file(folder / f"cameras.{kind}") for kind in ("bin", "txt")):
            return folder
    return None


def load_colmap(path: Path, model: Path) -> Capture:
    """Load a COLMAP capture; all its views are for training.

    Args:
        path: the capture; its photos are in ``images/`` or, where that is missing, in itself, and
            a photo's mask, where it has one, in ``masks/`` under its whole name and ``.png``.
        model: the folder with cameras, images and points3D, all ``.bin`` or all ``.txt``.

    Raises:
        IgsrError: a file is missing, corrupt, or has a camera model that is not supported.
    """
    kind = "bin" if is_file(model / "cameras.bin") else "txt"
    cameras_path, images_path, points_path = (
        model / f"{name}.{kind}" for name in ("cameras", "images", "points3D")
    )
    if not is_file(images_path):
        raise IgsrError(
            f"{images_path} is missing beside {cameras_path.name}; copy the whole model"
        )
    binary = kind == "bin"
    cameras = (_binary_cameras if binary else _text_cameras)(cameras_path)
    images = (_binary_images if binary else _text_images)(images_path)
    if not images:
        raise IgsrError(f"{images_path} lists no images; give a model with registered images")
    images_folder = path / "images" if (path / "images").is_dir() else path
    shots = []
    for image in sorted(images, key=lambda image: image.name):
        if image.camera_id not in cameras:
            raise IgsrError(
                f"{images_path}: {image.name} refers to camera {image.camera_id}, which "
                f"{cameras_path.name} does not have; export the model again"
            )
        photo = images_folder / image.name
        if not is_file(photo):
            raise IgsrError(
                f"{images_path} has a camera for {image.name} but {photo} is missing; put the "
                "photo there"
            )
        viewmat = _viewmat(image, images_path)
        colmap_camera = cameras[image.camera_id]
        try:
            K, lens = _intrinsics(colmap_camera)
            camera = Camera(viewmat, K, colmap_camera.width, colmap_camera.height)
        except IgsrError as error:
            raise IgsrError(f"{cameras_path}, camera {image.camera_id}: {error}") from error
        name = posixpath.normpath((images_folder.relative_to(path) / image.name).as_posix())
        mask = path / "masks" / f"{image.name}.png"
        mask_path = mask if is_file(mask) else None
        shots.append(Shot(name, photo, camera, lens, "train", mask_path, images_path))
    points = None
    if is_file(points_path):
        points = (_binary_points if binary else _text_points)(points_path)
    return Capture(path, load_views(shots), points)


def _intrinsics(camera: _ColmapCamera) -> tuple[np.ndarray, Lens]:
    params = list(camera.params)
    if not all(math.isfinite(value) for value in params):
        raise IgsrError("its camera has a parameter that is not finite; run COLMAP again")
    if camera.model in _ONE_FOCAL_LENGTH:
        params.insert(1, params[0])
    K, extra = intrinsic_matrix(*params[:4]), params[4:]
    if camera.model in ("OPENCV", "FULL_OPENCV"):
        k1, k2, p1, p2, *rest = extra
        return K, Lens(False, (k1, k2, *rest[:1]), tuple(rest[1:]), (p1, p2))
    return K, Lens("FISHEYE" in camera.model, tuple(extra))


def _viewmat(image: _ColmapImage, path: Path) -> np.ndarray:
    norm = math.hypot(*image.quat)
    if not (math.isfinite(norm) and norm > 1e-6 and all(map(math.isfinite, image.translation))):
        raise IgsrError(
            f"{path}: the pose of {image.name} has a NaN or infinite entry or a zero quaternion; "
            "run COLMAP again"
        )
    w, x, y, z = (value / norm for value in image.quat)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    viewmat[:3, 3] = image.translation
    return viewmat


def _parameter_count(path: Path, camera_id: int, model: str) -> int:
    if model not in _PARAMETER_COUNTS:
        raise IgsrError(
            f"{path}: camera {camera_id} has the model {model}, which is not supported; undistort "
            "the photos with COLMAP's image_undistorter or use an OPENCV model"
        )
    return _PARAMETER_COUNTS[model]


# --- binary ---------------------------------------------------------------------------------------


class _Bytes:
    """A little-endian file read front to back; every read is checked against what is there."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = _read(path)
        self.offset = 0

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        self.need(layout.size)
        values = layout.unpack_from(self.data, self.offset)
        self.offset += layout.size
        return values

    def need(self, size: int) -> None:
        if size > len(self.data) - self.offset:
            raise IgsrError(
                f"{self.path} is truncated or corrupt: it has {len(self.data)} bytes and more are "
                "announced; copy or export the model again"
            )

    def skip(self, size: int) -> None:
        self.need(size)
        self.offset += size

    def name(self) -> str:
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            self.need(len(self.data) + 1)
        try:
            name = self.data[self.offset : end].decode()
        except UnicodeDecodeError as error:
            raise _not_utf8(self.path) from error
        self.offset = end + 1
        return name

    def finish(self) -> None:
        left = len(self.data) - self.offset
        if left:
            raise IgsrError(
                f"{self.path} is corrupt: {left} bytes follow its last entry; copy or export the "
                "model again"
            )


_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3BdQ")


def _binary_cameras(path: Path) -> dict[int, _ColmapCamera]:
    file = _Bytes(path)
    cameras = {}
    for _ in range(_count(file)):
        camera_id, number, width, height = file.unpack(_CAMERA)
        model = _NAMES[number] if 0 <= number < len(_NAMES) else f"number {number}"
        params = file.unpack(struct.Struct(f"<{_parameter_count(path, camera_id, model)}d"))
        cameras[camera_id] = _ColmapCamera(model, width, height, params)
    file.finish()
    return cameras


def _count(file: _Bytes) -> int:
    (count,) = file.unpack(_COUNT)
    # No entry is shorter than a byte; range() itself refuses counts beyond 63 bits.
    file.need(count)
    return int(count)


def _binary_images(path: Path) -> list[_ColmapImage]:
    file = _Bytes(path)
    images = []
    for _ in range(_count(file)):
        _, *pose, camera_id = file.unpack(_IMAGE)
        name = file.name()
        (observations,) = file.unpack(_COUNT)
        file.skip(24 * observations)
        images.append(_ColmapImage(name, tuple(pose[:4]), tuple(pose[4:]), camera_id))
    file.finish()
    return images


def _binary_points(path: Path) -> Points | None:
    file = _Bytes(path)
    xyz: list[tuple[float, ...]] = []
    rgb: list[tuple[int, ...]] = []
    errors: list[float] = []
    for _ in range(_count(file)):
        _, x, y, z, r, g, b, error, track_length = file.unpack(_POINT)
        file.skip(8 * track_length)
        xyz.append((x, y, z))
        rgb.append((r, g, b))
        errors.append(math.nan if track_length else error)
    file.finish()
    return _points(path, xyz, rgb, errors)


# --- text -----------------------------------------------------------------------------------------


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines; comments are left out, empty lines are not."""
    try:
        text = _read(path).decode()
    except UnicodeDecodeError as error:
        raise _not_utf8(path) from error
    for number, line in enumerate(text.split("\n"), start=1):
        if not line.startswith("#"):
            yield number, line.strip()


def _damaged(path: Path, number: int, expected: str) -> IgsrError:
    return IgsrError(f"{path}, line {number} is not of the form {expected}; export the model again")


def _text_cameras(path: Path) -> dict[int, _ColmapCamera]:
    cameras = {}
    for number, line in _lines(path):
        if not line:
            continue
        try:
            identity, model, width, height, *params = line.split()
            camera = _ColmapCamera(model, int(width), int(height), tuple(map(float, params)))
            camera_id = int(identity)
        except ValueError as error:
            raise _damaged(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS") from error
        count = _parameter_count(path, camera_id, model)
        if len(params) != count:
            raise IgsrError(
                f"{path}, line {number}: {model} has {count} parameters, not {len(params)}; "
                "export the model again"
            )
        cameras[camera_id] = camera
    return cameras


def _text_images(path: Path) -> list[_ColmapImage]:
    images = []
    lines = _lines(path)
    for number, line in lines:
        if not line:
            continue
        try:
            fields = line.split(maxsplit=9)
            pose = tuple(map(float, fields[1:8]))
            image = _ColmapImage(fields[9], pose[:4], pose[4:], int(fields[8]))
        except (ValueError, IndexError) as error:
            raise _damaged(path, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME") from error
        images.append(image)
        next(lines, None)  # its observations, possibly none
    return images


def _text_points(path: Path) -> Points | None:
    xyz: list[tuple[float, ...]] = []
    rgb: list[tuple[int, ...]] = []
    errors: list[float] = []
    for number, line in _lines(path):
        if not line:
            continue
        try:
            _, x, y, z, r, g, b, *rest = line.split(maxsplit=8)
            errors.append(float(rest[0]) if len(rest) == 1 else math.nan)
            xyz.append((float(x), float(y), float(z)))
            rgb.append((int(r), int(g), int(b)))
            if not all(0 <= value <= 255 for value in rgb[-1]):
                raise ValueError
        except ValueError as error:
            raise _damaged(path, number, "POINT3D_ID X Y Z R G B ERROR TRACK") from error
    return _points(path, xyz, rgb, errors)


def _points(
    path: Path, xyz: list[tuple[float, ...]], rgb: list[tuple[int, ...]], errors: list[float]
) -> Points | None:
    """Points, ``errors`` NaN where they have tracks."""
    if not xyz:
        return None
    error = np.array(errors, dtype=np.float64)
    # Beyond these, 1 / error is no finite number.
    told = (error > 1e-300) & (error < 1e300)
    confidence = 1.0 / error if told.all() else None
    points = Points(np.array(xyz, dtype=np.float64), np.array(rgb, dtype=np.uint8), confidence)
    if not np.isfinite(points.xyz).all():
        raise IgsrError(f"{path} has a point that is not finite; remove it")
    return points


def _not_utf8(path: Path) -> IgsrError:
    return IgsrError(f"{path} is corrupt or not in UTF-8; export the model again")


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise IgsrError(f"{path} cannot be read ({error.strerror}); check it") from error
