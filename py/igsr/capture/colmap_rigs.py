"""Rigs of COLMAP models (version 3.12 and later): which images share a frame.

Frames whose images have one center are views of one wide photo. Other rigs, of cameras that stand
apart, are read as single photos: their images have poses of their own.

Source of the formats: https://colmap.github.io/format.html.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr.capture.types import Camera, View
from igsr.errors import IgsrError

Float64 = npt.NDArray[np.float64]

_CAMERA = 0  # of COLMAP's types of sensors
_COUNT, _FRAME, _DATA = struct.Struct("<Q"), struct.Struct("<II7dI"), struct.Struct("<iIQ")
#: Centers are one if they are no further apart than this part of what all cameras are.
_ONE_CENTER = 1e-6
#: Decimals to which turns within a rig are compared.
_DECIMALS = 9


def read_frames(path: Path) -> list[list[int]]:
    """The images of each frame, by COLMAP's numbers.

    Args:
        path: ``frames.bin`` or ``frames.txt``.

    Raises:
        IgsrError: the file is truncated or damaged.
    """
    try:
        data = path.read_bytes()
        return _text_frames(data.decode()) if path.suffix == ".txt" else _binary_frames(data)
    except (OSError, ValueError, IndexError, struct.error) as error:
        raise IgsrError(
            f"{path} is truncated or damaged; export the model again, or delete its rigs and frames"
        ) from error


def _binary_frames(data: bytes) -> list[list[int]]:
    (count,) = _COUNT.unpack_from(data)
    at, frames = _COUNT.size, []
    if count > len(data):
        raise ValueError
    for _ in range(count):
        *_, number = _FRAME.unpack_from(data, at)
        at += _FRAME.size
        if number * _DATA.size > len(data) - at:
            raise ValueError
        entries = [_DATA.unpack_from(data, at + k * _DATA.size) for k in range(number)]
        at += number * _DATA.size
        frames.append([image for kind, _, image in entries if kind == _CAMERA])
    if at != len(data):
        raise ValueError
    return frames


def _text_frames(text: str) -> list[list[int]]:
    frames = []
    for line in text.split("\n"):
        fields = line.split()
        if not fields or line.startswith("#"):
            continue
        data = fields[10:]
        if len(data) != 3 * int(fields[9]):
            raise ValueError
        entries = zip(data[0::3], data[2::3], strict=True)
        frames.append([int(image) for kind, image in entries if kind == "CAMERA"])
    return frames


def shared_centers(
    frames: Sequence[Sequence[int]], names: dict[int, str], centers: dict[int, Float64]
) -> dict[int, str]:
    """The rigs of images that share a frame and a center: the name of the first of them.

    Args:
        frames: the images of each frame.
        names: of the images, by number; numbers without a name are passed over.
        centers: of their cameras.
    """
    rigs: dict[int, str] = {}
    if not centers:
        return rigs
    everywhere = np.stack(list(centers.values()))
    apart = float(np.linalg.norm(everywhere - everywhere.mean(axis=0), axis=1).max())
    for frame in frames:
        here = [image for image in frame if image in names]
        if len(here) < 2:
            continue
        place = np.stack([centers[image] for image in here])
        rounding = 1e-9 * (1.0 + float(np.abs(place[0]).max()))
        if np.linalg.norm(place - place[0], axis=1).max() <= _ONE_CENTER * apart + rounding:
            first = min(names[image] for image in here)
            rigs.update(dict.fromkeys(here, first))
    return rigs


class Rigs:
    """Numbers of cameras, rigs and frames for a model with rigs.

    Images of one photo are a frame; each view of a rig has a camera of its own, since COLMAP's
    sensors are cameras.

    Attributes:
        cameras: distinct cameras, whose numbers count from 1.
        number_of: of each view's camera.
        rigs: per rig, its camera numbers and each one's pose from the first.
        frames: per frame, the number of its rig, its pose and its views, by index.
    """

    def __init__(self, views: Sequence[View]) -> None:
        """Number all of them."""
        photos: dict[str, list[int]] = {}
        for index, view in enumerate(views):
            photos.setdefault(view.photo, []).append(index)
        self.cameras: list[Camera] = []
        self.number_of = [0] * len(views)
        self.rigs: list[tuple[list[int], list[Float64]]] = []
        self.frames: list[tuple[int, Float64, list[int]]] = []
        known: dict[object, int] = {}
        for members in photos.values():
            first = views[members[0]].camera.viewmat
            poses = [views[k].camera.viewmat @ np.linalg.inv(first) for k in members]
            key = tuple(
                (*_intrinsics(views[k].camera), *(pose[:3, :3].round(_DECIMALS) + 0.0).ravel())
                for k, pose in zip(members, poses, strict=True)
            )
            if key not in known:
                start = len(self.cameras) + 1
                self.cameras += [views[k].camera for k in members]
                self.rigs.append((list(range(start, start + len(members))), poses))
                known[key] = len(self.rigs)
            rig = known[key]
            for k, number in zip(members, self.rigs[rig - 1][0], strict=True):
                self.number_of[k] = number
            self.frames.append((rig, first, members))

    def write(self, model: Path, text: bool) -> None:
        """Write the files of rigs and frames.

        Args:
            model: the folder.
            text: write ``.txt`` files instead of ``.bin``.
        """
        (self._write_text if text else self._write_binary)(model)

    def _write_binary(self, model: Path) -> None:
        parts = [_COUNT.pack(len(self.rigs))]
        for number, (cameras, poses) in enumerate(self.rigs, start=1):
            parts.append(struct.pack("<IIiI", number, len(cameras), _CAMERA, cameras[0]))
            for camera, pose in zip(cameras[1:], poses[1:], strict=True):
                parts.append(struct.pack("<iIB7d", _CAMERA, camera, 1, *pose_numbers(pose)))
        (model / "rigs.bin").write_bytes(b"".join(parts))
        parts = [_COUNT.pack(len(self.frames))]
        for number, (rig, pose, members) in enumerate(self.frames, start=1):
            parts.append(_FRAME.pack(number, rig, *pose_numbers(pose), len(members)))
            parts += [_DATA.pack(_CAMERA, self.number_of[k], k + 1) for k in members]
        (model / "frames.bin").write_bytes(b"".join(parts))

    def _write_text(self, model: Path) -> None:
        lines = ["# RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[]"]
        for number, (cameras, poses) in enumerate(self.rigs, start=1):
            others = [
                f"CAMERA {camera} 1 {' '.join(map(repr, pose_numbers(pose)))}"
                for camera, pose in zip(cameras[1:], poses[1:], strict=True)
            ]
            lines.append(" ".join([f"{number} {len(cameras)} CAMERA {cameras[0]}", *others]))
        _write_lines(model / "rigs.txt", lines)
        lines = ["# FRAME_ID, RIG_ID, RIG_FROM_WORLD[], NUM_DATA_IDS, DATA_IDS[]"]
        for number, (rig, pose, members) in enumerate(self.frames, start=1):
            data = [f"CAMERA {self.number_of[k]} {k + 1}" for k in members]
            numbers = " ".join(map(repr, pose_numbers(pose)))
            lines.append(" ".join([f"{number} {rig} {numbers} {len(members)}", *data]))
        _write_lines(model / "frames.txt", lines)


def _write_lines(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def _intrinsics(camera: Camera) -> tuple[float, ...]:
    return (*map(float, camera.K.ravel()), camera.width, camera.height)


def pose_numbers(viewmat: Float64) -> list[float]:
    """Quaternion wxyz and translation of a pose [4, 4]."""
    return [*quaternion(viewmat[:3, :3]), *map(float, viewmat[:3, 3])]


def quaternion(rotation: Float64) -> list[float]:
    """The unit quaternion wxyz of a rotation matrix [3, 3], w not negative.

    Source: Shepperd, "Quaternion from Rotation Matrix", 1978: the largest component comes from the
    diagonal and the others from it, so that none is divided by a small number.
    """
    m = rotation
    squares = np.array(
        [
            1.0 + m[0, 0] + m[1, 1] + m[2, 2],
            1.0 + m[0, 0] - m[1, 1] - m[2, 2],
            1.0 - m[0, 0] + m[1, 1] - m[2, 2],
            1.0 - m[0, 0] - m[1, 1] + m[2, 2],
        ]
    )
    products = np.array(
        [
            [squares[0], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], squares[1], m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], squares[2], m[2, 1] + m[1, 2]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2], squares[3]],
        ]
    )
    row = products[int(squares.argmax())]
    row = row / np.linalg.norm(row)
    return [float(value) for value in (row if row[0] >= 0.0 else -row)]
