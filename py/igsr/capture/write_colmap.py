"""Write captures for COLMAP: ``sparse/0``, ``images/``, ``masks/`` and ``depths/``.

Cameras are PINHOLE. If views are of wide photos, the model has rigs and frames (COLMAP 3.12). Of an
image's features, only those with points are written. A point with a track gets the error that its
confidence was computed from (``track_confidence``; -1, as in COLMAP, if it is unknown), a point
without a track 1 / confidence (0 if it is unknown). ``load_capture`` reads both back. A mask has
the photo's whole name and ``.png``, as COLMAP's feature extraction expects.

Source of the formats: https://colmap.github.io/format.html.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr._internal.atomic_write import atomic_folder
from igsr.capture import colmap_files as layouts
from igsr.capture.downscaling import resampled_plane
from igsr.capture.types import Camera, Capture, Points, View
from igsr.capture.write_files import png_names, save_png, write_depths, write_pictures

Float64 = npt.NDArray[np.float64]

_PINHOLE = 1  # COLMAP's number of the camera model
#: Decimals to which rotations within a rig are compared.
_RIG_DECIMALS = 9


def write_colmap(
    capture: Capture,
    out: str | os.PathLike[str],
    *,
    text: bool = False,
    replace: bool = False,
    depths: Sequence[np.ndarray | None] | None = None,
    further_masks: Mapping[str, Sequence[np.ndarray | None]] | None = None,
    notes: Mapping[str, str | bytes] | None = None,
) -> None:
    """Write a capture as a folder for COLMAP and programs that read its models.

    Args:
        capture: the capture to write. The format has no split into train and test views.
        out: the folder; it must be new or empty.
        text: write ``.txt`` files instead of ``.bin``.
        replace: replace an existing folder, once the new one is complete.
        depths: per view camera-space z [h, w] in world units, of any size, or None; the default is
            the views' own. They are written as float32 ``.npy``, which ``load_capture`` reads.
        further_masks: more masks, by the name of their folder: per view bool [h, w] of any size,
            which is resized to the photo's, or None. ``load_capture`` does not read them.
        notes: contents of further files, by file name.

    Raises:
        IgsrError: the folder is not empty, or cannot be written.
    """
    names = png_names(capture.views)
    with atomic_folder(out, replace=replace) as folder:
        write_pictures(folder, capture.views, names, lambda name: f"{name}.png")
        write_depths(folder, names, depths or [view.known_depth for view in capture.views])
        for kind, masks in (further_masks or {}).items():
            for view, name, mask in zip(capture.views, names, masks, strict=True):
                if mask is not None:
                    full = resampled_plane(mask, view.camera.width, view.camera.height)
                    save_png(folder / kind / f"{name}.png", 255 * full.astype(np.uint8))
        for note, content in (notes or {}).items():
            (folder / note).write_bytes(content.encode() if isinstance(content, str) else content)
        path = folder / "sparse" / "0"
        path.mkdir(parents=True)
        model = _model(capture, names)
        (_write_text if text else _write_binary)(path, model)
        if any(view.rig is not None for view in capture.views):
            (_write_rigs_as_text if text else _write_rigs)(path, model)


#: The numbers of a rig's cameras, and their poses relative to the first one.
_Rig = tuple[list[int], list[Float64]]
#: The number of a frame's rig, its pose and the numbers of its images.
_Frame = tuple[int, Float64, list[int]]


@dataclass(frozen=True)
class _Image:
    """An image: ``camera`` is the number of its camera; ``xy`` [N, 2] are its features, in pixels.

    ``pose`` is quaternion wxyz and translation, world to camera.
    """

    name: str
    camera: int
    pose: list[float]
    xy: np.ndarray
    point_ids: np.ndarray


@dataclass(frozen=True)
class _Model:
    """The contents of a model's files; numbers count from 1, in the order of the lists."""

    cameras: list[Camera]
    images: list[_Image]
    # Position, color, error in pixels, and track [L, 2]: images and indices of their features.
    points: list[tuple[list[float], list[int], float, np.ndarray]]
    rigs: list[_Rig]
    frames: list[_Frame]


def _model(capture: Capture, names: list[str]) -> _Model:
    cameras, rigs, frames = _rigs(capture.views)
    features, tracks = _features(capture)
    camera_of: dict[int, int] = {}
    for rig, _, members in frames:
        camera_of |= dict(zip(members, rigs[rig - 1][0], strict=True))
    images = [
        _Image(name, camera_of[number], pose_numbers(view.camera.viewmat), *feature)
        for number, (name, view, feature) in enumerate(
            zip(names, capture.views, features, strict=True), start=1
        )
    ]
    points = []
    if capture.points is not None:
        xyz, rgb = capture.points.xyz.tolist(), capture.points.rgb.tolist()
        errors = _errors(capture.points, tracks).tolist()
        points = list(zip(xyz, rgb, errors, tracks, strict=True))
    return _Model(cameras, images, points, rigs, frames)


def _rigs(views: Sequence[View]) -> tuple[list[Camera], list[_Rig], list[_Frame]]:
    """Distinct cameras, rigs and frames: the images of one photo are a frame.

    Each view of a rig has its own camera, since COLMAP's sensors are cameras.
    """
    photos: dict[str, list[int]] = {}
    for number, view in enumerate(views, start=1):
        photos.setdefault(view.photo, []).append(number)
    cameras: list[Camera] = []
    rigs: list[_Rig] = []
    frames: list[_Frame] = []
    rig_numbers: dict[object, int] = {}
    for members in photos.values():
        of_photo = [views[number - 1].camera for number in members]
        from_world = of_photo[0].viewmat
        poses = [camera.viewmat @ np.linalg.inv(from_world) for camera in of_photo]
        turns = [(pose[:3, :3].round(_RIG_DECIMALS) + 0.0).tobytes() for pose in poses]
        key = tuple(
            (camera.K.tobytes(), camera.width, camera.height, turn)
            for camera, turn in zip(of_photo, turns, strict=True)
        )
        if key not in rig_numbers:
            start = len(cameras) + 1
            cameras += of_photo
            rigs.append((list(range(start, start + len(members))), poses))
            rig_numbers[key] = len(rigs)
        frames.append((rig_numbers[key], from_world, members))
    return cameras, rigs, frames


def _features(
    capture: Capture,
) -> tuple[list[tuple[np.ndarray, np.ndarray]], list[np.ndarray]]:
    """Features of each view (``xy`` and ``point_ids`` of an image), and the track of each point."""
    features = [(np.zeros((0, 2)), np.zeros(0, dtype=np.int64))] * len(capture.views)
    count = 0 if capture.points is None else len(capture.points.xyz)
    tracks = None if capture.points is None else capture.points.tracks
    if tracks is None:
        return features, [np.zeros((0, 2), dtype=np.int64)] * count
    number_of = {name: number for number, name in enumerate(tracks.names)}
    points, elements = [], []
    for index, view in enumerate(capture.views):
        rows = np.flatnonzero(tracks.view == number_of.get(view.name, -1))
        features[index] = tracks.xy[rows], tracks.point[rows] + 1
        points.append(tracks.point[rows])
        elements.append(np.stack([np.full(len(rows), index + 1), np.arange(len(rows))], axis=1))
    point = np.concatenate(points)
    order = np.argsort(point, kind="stable")
    ends = np.cumsum(np.bincount(point, minlength=count))
    # Splitting an empty array gives one part.
    return features, np.split(np.concatenate(elements)[order], ends[:-1])[:count]


def _errors(points: Points, tracks: list[np.ndarray]) -> Float64:
    length = np.array(list(map(len, tracks)))
    if points.confidence is None:
        return np.where(length > 0, -1.0, 0.0)
    of_track = np.maximum(length / points.confidence - 1.0, 0.0)
    return np.where(length > 0, of_track, 1.0 / points.confidence)


def _parameters(camera: Camera) -> list[float]:
    return [float(camera.K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))]


def _write_binary(folder: Path, model: _Model) -> None:
    with open(folder / "cameras.bin", "wb") as file:
        file.write(layouts.COUNT.pack(len(model.cameras)))
        for number, camera in enumerate(model.cameras, start=1):
            file.write(layouts.CAMERA.pack(number, _PINHOLE, camera.width, camera.height))
            file.write(struct.pack("<4d", *_parameters(camera)))
    with open(folder / "images.bin", "wb") as file:
        file.write(layouts.COUNT.pack(len(model.images)))
        for number, image in enumerate(model.images, start=1):
            file.write(layouts.IMAGE.pack(number, *image.pose, image.camera))
            file.write(image.name.encode() + b"\0")
            features = np.zeros(len(image.xy), dtype=layouts.OBSERVATION)
            features["xy"], features["point"] = image.xy, image.point_ids
            file.write(layouts.COUNT.pack(len(features)) + features.tobytes())
    with open(folder / "points3D.bin", "wb") as file:
        file.write(layouts.COUNT.pack(len(model.points)))
        for number, (xyz, rgb, error, track) in enumerate(model.points, start=1):
            file.write(layouts.POINT.pack(number, *xyz, *rgb, error, len(track)))
            file.write(track.astype("<u4").tobytes())


def _write_rigs(folder: Path, model: _Model) -> None:
    with open(folder / "rigs.bin", "wb") as file:
        file.write(layouts.COUNT.pack(len(model.rigs)))
        for number, (cameras, poses) in enumerate(model.rigs, start=1):
            file.write(
                struct.pack("<IIiI", number, len(cameras), layouts.CAMERA_SENSOR, cameras[0])
            )
            for camera, pose in zip(cameras[1:], poses[1:], strict=True):
                file.write(
                    struct.pack("<iIB7d", layouts.CAMERA_SENSOR, camera, 1, *pose_numbers(pose))
                )
    with open(folder / "frames.bin", "wb") as file:
        file.write(layouts.COUNT.pack(len(model.frames)))
        for number, (rig, pose, members) in enumerate(model.frames, start=1):
            file.write(layouts.FRAME.pack(number, rig, *pose_numbers(pose), len(members)))
            rows = [(layouts.CAMERA_SENSOR, model.images[k - 1].camera, k) for k in members]
            file.write(np.array(rows, dtype=layouts.FRAME_DATA).tobytes())


def _write_text(folder: Path, model: _Model) -> None:
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for number, camera in enumerate(model.cameras, start=1):
        params = _joined(_parameters(camera))
        lines.append(f"{number} PINHOLE {camera.width} {camera.height} {params}")
    _write_lines(folder / "cameras.txt", lines)
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[]"]
    for number, image in enumerate(model.images, start=1):
        features = zip(image.xy.tolist(), image.point_ids.tolist(), strict=True)
        observations = " ".join(f"{x!r} {y!r} {point}" for (x, y), point in features)
        lines += [f"{number} {_joined(image.pose)} {image.camera} {image.name}", observations]
    _write_lines(folder / "images.txt", lines)
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"]
    for number, (xyz, rgb, error, track) in enumerate(model.points, start=1):
        lines.append(_joined([number, *xyz, *rgb, error, *track.ravel().tolist()]))
    _write_lines(folder / "points3D.txt", lines)


def _write_rigs_as_text(folder: Path, model: _Model) -> None:
    lines = ["# RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[]"]
    for number, (cameras, poses) in enumerate(model.rigs, start=1):
        line = f"{number} {len(cameras)} CAMERA {cameras[0]}"
        for camera, pose in zip(cameras[1:], poses[1:], strict=True):
            line += f" CAMERA {camera} 1 {_joined(pose_numbers(pose))}"
        lines.append(line)
    _write_lines(folder / "rigs.txt", lines)
    lines = ["# FRAME_ID, RIG_ID, RIG_FROM_WORLD[], NUM_DATA_IDS, DATA_IDS[]"]
    for number, (rig, pose, members) in enumerate(model.frames, start=1):
        line = f"{number} {rig} {_joined(pose_numbers(pose))} {len(members)}"
        for k in members:
            line += f" CAMERA {model.images[k - 1].camera} {k}"
        lines.append(line)
    _write_lines(folder / "frames.txt", lines)


def _joined(numbers: Sequence[float]) -> str:
    return " ".join(map(repr, numbers))


def _write_lines(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def pose_numbers(viewmat: Float64) -> list[float]:
    """Return quaternion wxyz and translation of a pose [4, 4]."""
    return [*quaternion(viewmat[:3, :3]), *map(float, viewmat[:3, 3])]


def quaternion(rotation: Float64) -> list[float]:
    """Return the unit quaternion wxyz of a rotation matrix [3, 3], w not negative.

    Source: Shepperd, "Quaternion from Rotation Matrix", 1978: the largest component comes from the
    diagonal and the others from it, so that none is divided by a small number.
    """
    m, (x, y, z) = rotation, np.diag(rotation)
    products = np.array(
        [
            [1.0 + x + y + z, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], 1.0 + x - y - z, m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], 1.0 - x + y - z, m[2, 1] + m[1, 2]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2], 1.0 - x - y + z],
        ]
    )
    row = products[int(np.diag(products).argmax())]
    row = row / np.linalg.norm(row)
    return [float(value) for value in (row if row[0] >= 0.0 else -row)]
