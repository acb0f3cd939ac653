"""Write captures for COLMAP: ``sparse/0``, ``images/``, ``masks/`` and ``depths/``.

Cameras are PINHOLE. Where views are of wide photos, the model has rigs and frames (COLMAP 3.12).
Of an image's features, only those of points are written. A point with a track gets the error that
its confidence was made from (see ``track_confidence``; -1, as in COLMAP, if it is not known). A
point without a track gets 1 / confidence as its error (0 if it is not known). ``load_capture``
reads both back. A mask has the photo's whole name and ``.png``, as COLMAP's feature extraction
expects.

Source of the formats: https://colmap.github.io/format.html.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr._internal.atomic_write import atomic_folder
from igsr.capture.colmap_rigs import Rigs, pose_numbers
from igsr.capture.types import Camera, Capture, Points
from igsr.capture.write_files import png_names, save_png, write_depths, write_pictures

Float64 = npt.NDArray[np.float64]

_PINHOLE = 1


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
                    save_png(folder / kind / f"{name}.png", _at_size(mask, view.camera))
        for note, content in (notes or {}).items():
            (folder / note).write_bytes(content.encode() if isinstance(content, str) else content)
        model = folder / "sparse" / "0"
        model.mkdir(parents=True)
        cameras = [view.camera for view in capture.views]
        seen = _Seen(capture)
        distinct, number_of = _distinct(cameras)
        if any(view.rig is not None for view in capture.views):
            rigs = Rigs(capture.views)
            distinct, number_of = rigs.cameras, rigs.number_of
            rigs.write(model, text)
        write = _write_text if text else _write_binary
        write(model, cameras, names, distinct, number_of, capture.points, seen)


class _Seen:
    """Where the views of a capture see its points.

    Attributes:
        places: per view float64 [N, 2], pixels.
        ids: per view int64 [N], numbers of the points in the file, from 1.
        tracks: per point int64 [L, 2]: the number of the image, from 1, and which of its features.
    """

    def __init__(self, capture: Capture) -> None:
        self.places = [np.zeros((0, 2))] * len(capture.views)
        self.ids = [np.zeros(0, dtype=np.int64)] * len(capture.views)
        self.tracks = [np.zeros((0, 2), dtype=np.int64)] * (
            0 if capture.points is None else len(capture.points.xyz)
        )
        tracks = None if capture.points is None else capture.points.tracks
        if tracks is None:
            return
        number_of = {name: number for number, name in enumerate(tracks.names)}
        points, elements = [], []
        for index, view in enumerate(capture.views):
            mine = np.flatnonzero(tracks.view == number_of.get(view.name, -1))
            self.places[index], self.ids[index] = tracks.xy[mine], tracks.point[mine] + 1
            points.append(tracks.point[mine])
            image = np.full(len(mine), index + 1)
            elements.append(np.stack([image, np.arange(len(mine))], axis=1))
        point = np.concatenate(points)
        order = np.argsort(point, kind="stable")
        ends = np.cumsum(np.bincount(point, minlength=len(self.tracks)))
        # Splitting nothing gives one part.
        self.tracks = np.split(np.concatenate(elements)[order], ends[:-1])[: len(self.tracks)]


def _at_size(mask: np.ndarray, camera: Camera) -> np.ndarray:
    """A mask [h, w] as 0 and 255 in the pixels of a camera, each from the nearest."""
    row, column = (
        ((np.arange(size) + 0.5) * given / size).astype(np.int64)
        for size, given in zip((camera.height, camera.width), mask.shape, strict=True)
    )
    return 255 * mask[np.ix_(row, column)].astype(np.uint8)


def _distinct(cameras: list[Camera]) -> tuple[list[Camera], list[int]]:
    """Cameras of different intrinsics, and each one's number among them, from 1."""
    numbers: dict[object, int] = {}
    distinct, number_of = [], []
    for camera in cameras:
        key = camera.K.tobytes(), camera.width, camera.height
        if key not in numbers:
            numbers[key] = len(numbers) + 1
            distinct.append(camera)
        number_of.append(numbers[key])
    return distinct, number_of


def _parameters(camera: Camera) -> list[float]:
    K = camera.K
    return [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]


def _errors(points: Points, seen: _Seen) -> Float64:
    length = np.array(list(map(len, seen.tracks)))
    if points.confidence is None:
        return np.where(length > 0, -1.0, 0.0)
    of_track = np.maximum(length / points.confidence - 1.0, 0.0)
    return np.where(length > 0, of_track, 1.0 / points.confidence)


def _write_binary(
    model: Path,
    cameras: list[Camera],
    names: list[str],
    distinct: list[Camera],
    number_of: list[int],
    points: Points | None,
    seen: _Seen,
) -> None:
    with open(model / "cameras.bin", "wb") as file:
        file.write(struct.pack("<Q", len(distinct)))
        for number, camera in enumerate(distinct, start=1):
            file.write(struct.pack("<IiQQ", number, _PINHOLE, camera.width, camera.height))
            file.write(struct.pack("<4d", *_parameters(camera)))
    with open(model / "images.bin", "wb") as file:
        file.write(struct.pack("<Q", len(cameras)))
        for image, (camera, name, number) in enumerate(
            zip(cameras, names, number_of, strict=True), start=1
        ):
            file.write(struct.pack("<I7dI", image, *pose_numbers(camera.viewmat), number))
            file.write(name.encode() + b"\0")
            features = np.zeros(len(seen.ids[image - 1]), dtype=[("xy", "<f8", 2), ("id", "<i8")])
            features["xy"], features["id"] = seen.places[image - 1], seen.ids[image - 1]
            file.write(struct.pack("<Q", len(features)) + features.tobytes())
    with open(model / "points3D.bin", "wb") as file:
        file.write(struct.pack("<Q", 0 if points is None else len(points.xyz)))
        if points is None:
            return
        rows = zip(points.xyz, points.rgb, _errors(points, seen), seen.tracks, strict=True)
        for number, (xyz, rgb, error, track) in enumerate(rows, start=1):
            file.write(struct.pack("<Q3d3BdQ", number, *xyz, *rgb, error, len(track)))
            file.write(track.astype("<u4").tobytes())


def _write_text(
    model: Path,
    cameras: list[Camera],
    names: list[str],
    distinct: list[Camera],
    number_of: list[int],
    points: Points | None,
    seen: _Seen,
) -> None:
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for number, camera in enumerate(distinct, start=1):
        numbers = " ".join(map(repr, _parameters(camera)))
        lines.append(f"{number} PINHOLE {camera.width} {camera.height} {numbers}")
    _write_lines(model / "cameras.txt", lines)
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[]"]
    for image, (camera, name, number) in enumerate(
        zip(cameras, names, number_of, strict=True), start=1
    ):
        features = zip(seen.places[image - 1].tolist(), seen.ids[image - 1].tolist(), strict=True)
        observed = " ".join(f"{x!r} {y!r} {point}" for (x, y), point in features)
        lines += [
            f"{image} {' '.join(map(repr, pose_numbers(camera.viewmat)))} {number} {name}",
            observed,
        ]
    _write_lines(model / "images.txt", lines)
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"]
    if points is not None:
        errors = _errors(points, seen).tolist()
        rows = zip(points.xyz.tolist(), points.rgb.tolist(), errors, seen.tracks, strict=True)
        for point, (xyz, rgb, error, track) in enumerate(rows, start=1):
            row = [*map(repr, xyz), *map(str, rgb), repr(error), *map(str, track.ravel())]
            lines.append(f"{point} {' '.join(row)}")
    _write_lines(model / "points3D.txt", lines)


def _write_lines(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
