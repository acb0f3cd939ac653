"""Parse the files of a COLMAP model, text or binary: cameras, images, points3D and frames.

They are parsed here and not by pycolmap, which reads a truncated file as zeros without an error and
crashes the process on other damage. Damage is an IgsrError here. The tests compare this parser with
models from pycolmap.

Source of the formats: https://colmap.github.io/format.html.
"""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.input_files import open_file, read_file
from igsr.errors import IgsrError

# Parameters of COLMAP's camera models, in the order of their numbers.
_PARAMETER_COUNTS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4,
    "DIVISION": 5,
    "SIMPLE_FISHEYE": 3,
    "FISHEYE": 4,
    "EUCM": 6,
    "EQUIRECTANGULAR": 2,
}

# Models whose lenses igsr cannot undo. Cameras that no photo has may have any model.
_UNSUPPORTED = {"FOV", "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION", "EUCM"}

#: COLMAP's number of the sensor type "camera".
CAMERA_SENSOR = 0
#: Layouts of the binary files.
COUNT = struct.Struct("<Q")
CAMERA = struct.Struct("<IiQQ")
IMAGE = struct.Struct("<I7dI")
POINT = struct.Struct("<Q3d3BdQ")
FRAME = struct.Struct("<II7dI")
OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
FRAME_DATA = np.dtype([("sensor_type", "<i4"), ("sensor", "<u4"), ("image", "<u8")])

_POINT_ROW = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<i8")]
)


@dataclass(frozen=True)
class ColmapCamera:
    """A camera: COLMAP's name of its model, width and height in pixels, parameters."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    """An image.

    Attributes:
        identity: its number.
        name: path of its file, relative to the folder of photos.
        pose: quaternion wxyz and translation, world to camera.
        camera_id: number of its camera.
        xy: float64 [N, 2], its features, pixels.
        point_ids: int64 [N], the features' points; -1 for none.
    """

    identity: int
    name: str
    pose: tuple[float, ...]
    camera_id: int
    xy: np.ndarray
    point_ids: np.ndarray


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """Read ``cameras.bin`` or ``cameras.txt``: the cameras by their numbers."""
    return _text_cameras(path) if path.suffix == ".txt" else _binary_cameras(path)


def read_images(path: Path) -> list[ColmapImage]:
    """Read ``images.bin`` or ``images.txt``."""
    return _text_images(path) if path.suffix == ".txt" else _binary_images(path)


def image_count(folder: Path) -> int:
    """The number of images of the model in a folder; 0 if it cannot be read."""
    try:
        if (folder / "images.bin").is_file():
            with open_file(folder / "images.bin") as file:
                return int(COUNT.unpack(file.read(COUNT.size))[0])
        return sum(1 for _, line in _lines(folder / "images.txt", keep_empty=True)) // 2
    except (OSError, struct.error, IgsrError):
        return 0


def read_points(path: Path) -> np.ndarray:
    """Read ``points3D.bin`` or ``points3D.txt``: [P] of ``_POINT_ROW``; a missing error is NaN."""
    rows = _text_points(path) if path.suffix == ".txt" else _binary_points(path)
    return np.array(rows, dtype=_POINT_ROW)


def read_frames(path: Path) -> list[list[int]]:
    """Read ``frames.bin`` or ``frames.txt`` (COLMAP 3.12): the numbers of each frame's images."""
    try:
        return _text_frames(path) if path.suffix == ".txt" else _binary_frames(path)
    except (ValueError, IndexError) as error:
        raise IgsrError(
            f"{path} is truncated or damaged; export the model again, or delete its rigs and frames"
        ) from error


def check_supported(model: str) -> None:
    """Check a camera's model.

    Raises:
        IgsrError: igsr cannot undo the distortion of its lenses.
    """
    if model in _UNSUPPORTED or model not in _PARAMETER_COUNTS:
        raise IgsrError(
            f"the model {model} is not supported; undistort the photos with COLMAP's "
            "image_undistorter or use an OPENCV model"
        )


def _read(path: Path) -> bytes:
    try:
        return read_file(path)
    except OSError as error:
        raise IgsrError(f"{path} cannot be read ({error.strerror}); check it") from error


def _utf8(path: Path, data: bytes) -> str:
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise IgsrError(f"{path} is corrupt or not in UTF-8; export the model again") from error


class _BinaryReader:
    """A little-endian file read from front to back; every read is checked against its length."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._data = _read(path)
        self._offset = 0

    def _need(self, size: int) -> None:
        if size > len(self._data) - self._offset:
            raise IgsrError(
                f"{self._path} is truncated or corrupt: it has {len(self._data)} bytes and more "
                "are announced; copy or export the model again"
            )

    def skip(self, size: int) -> None:
        self._need(size)
        self._offset += size

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        start = self._offset
        self.skip(layout.size)
        return layout.unpack_from(self._data, start)

    def table(self, layout: np.dtype[Any], count: int) -> np.ndarray:
        start = self._offset
        self.skip(layout.itemsize * count)
        return np.frombuffer(self._data, layout, count, start)

    def entries(self) -> Iterator[None]:
        """Read the number of entries, yield once for each, and check that the file ends there."""
        (count,) = self.unpack(COUNT)
        # No entry is shorter than a byte; range() itself refuses counts beyond 63 bits.
        self._need(count)
        for _ in range(count):
            yield
        left = len(self._data) - self._offset
        if left:
            raise IgsrError(
                f"{self._path} is corrupt: {left} bytes follow its last entry; copy or export the "
                "model again"
            )

    def name(self) -> str:
        start, end = self._offset, self._data.find(b"\0", self._offset)
        if end < 0:
            self._need(len(self._data) + 1)
        self._offset = end + 1
        return _utf8(self._path, self._data[start:end])


def _binary_cameras(path: Path) -> dict[int, ColmapCamera]:
    file = _BinaryReader(path)
    cameras = {}
    models = dict(enumerate(_PARAMETER_COUNTS))
    for _ in file.entries():
        camera_id, number, width, height = file.unpack(CAMERA)
        model = models.get(number)
        if model is None:
            raise IgsrError(
                f"{path}: camera {camera_id} has the model number {number}, which is not "
                "supported; export the model as text"
            )
        params = file.unpack(struct.Struct(f"<{_PARAMETER_COUNTS[model]}d"))
        cameras[camera_id] = ColmapCamera(model, width, height, params)
    return cameras


def _binary_images(path: Path) -> list[ColmapImage]:
    file = _BinaryReader(path)
    images = []
    for _ in file.entries():
        identity, *pose, camera_id = file.unpack(IMAGE)
        name = file.name()
        seen = file.table(OBSERVATION, *file.unpack(COUNT))
        image = ColmapImage(identity, name, tuple(pose), camera_id, seen["xy"], seen["point"])
        images.append(image)
    return images


def _binary_points(path: Path) -> list[tuple[Any, ...]]:
    file = _BinaryReader(path)
    rows = []
    for _ in file.entries():
        identity, x, y, z, r, g, b, error, length = file.unpack(POINT)
        file.skip(8 * length)
        rows.append((identity, (x, y, z), (r, g, b), error, length))
    return rows


def _binary_frames(path: Path) -> list[list[int]]:
    file = _BinaryReader(path)
    frames = []
    for _ in file.entries():
        *_, count = file.unpack(FRAME)
        data = file.table(FRAME_DATA, count)
        frames.append(data["image"][data["sensor_type"] == CAMERA_SENSOR].tolist())
    return frames


def _lines(path: Path, keep_empty: bool = False) -> Iterator[tuple[int, str]]:
    """Numbered lines without comments."""
    for number, line in enumerate(_utf8(path, _read(path)).split("\n"), start=1):
        if not line.startswith("#") and (keep_empty or line.strip()):
            yield number, line.strip()


@contextlib.contextmanager
def _form(path: Path, number: int, expected: str) -> Iterator[None]:
    """Raise an IgsrError that names the line if it does not have the expected form."""
    try:
        yield
    except (ValueError, IndexError, OverflowError) as error:
        raise IgsrError(
            f"{path}, line {number} is not of the form {expected}; export the model again"
        ) from error


def _text_cameras(path: Path) -> dict[int, ColmapCamera]:
    cameras = {}
    for number, line in _lines(path):
        with _form(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS"):
            identity, model, width, height, *params = line.split()
            camera = ColmapCamera(model, int(width), int(height), tuple(map(float, params)))
            camera_id = int(identity)
        count = _PARAMETER_COUNTS.get(model, len(params))
        if len(params) != count:
            raise IgsrError(
                f"{path}, line {number}: {model} has {count} parameters, not {len(params)}; "
                "export the model again"
            )
        cameras[camera_id] = camera
    return cameras


def _text_images(path: Path) -> list[ColmapImage]:
    images = []
    lines = _lines(path, keep_empty=True)
    for number, line in lines:
        if not line:
            continue
        with _form(path, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"):
            fields = line.split(maxsplit=9)
            pose = tuple(map(float, fields[1:8]))
            name, camera_id, identity = fields[9], int(fields[8]), int(fields[0])
        number, line = next(lines, (number + 1, ""))  # its observations, possibly none
        xy, point_ids = _text_observations(path, number, line)
        images.append(ColmapImage(identity, name, pose, camera_id, xy, point_ids))
    return images


def _text_observations(path: Path, number: int, line: str) -> tuple[np.ndarray, np.ndarray]:
    fields = line.split()
    with _form(path, number, "X Y POINT3D_ID of each feature"):
        xy = np.array([fields[0::3], fields[1::3]], dtype=np.float64).T
        # No point is -1, or the same 64 bits without a sign.
        ids = [-1 if int(field) == (1 << 64) - 1 else int(field) for field in fields[2::3]]
        if len(fields) % 3:
            raise ValueError
        return xy, np.array(ids, dtype=np.int64)


def _text_points(path: Path) -> list[tuple[Any, ...]]:
    rows = []
    for number, line in _lines(path):
        with _form(path, number, "POINT3D_ID X Y Z R G B ERROR TRACK"):
            identity, x, y, z, r, g, b, *rest = line.split()
            # Other programs may omit the error and the track.
            error, length = float(rest[0]) if rest else math.nan, max(0, len(rest) - 1) // 2
            xyz, rgb = (float(x), float(y), float(z)), (int(r), int(g), int(b))
            if not (all(0 <= value <= 255 for value in rgb) and 0 <= int(identity) < 1 << 64):
                raise ValueError
        rows.append((int(identity), xyz, rgb, error, length))
    return rows


def _text_frames(path: Path) -> list[list[int]]:
    frames = []
    for _, line in _lines(path):
        fields = line.split()
        data = fields[10:]
        if len(data) != 3 * int(fields[9]):
            raise ValueError
        sensors = zip(data[0::3], data[2::3], strict=True)
        frames.append([int(image) for kind, image in sensors if kind == "CAMERA"])
    return frames
