"""Read captures of COLMAP: a sparse model, text or binary, beside a folder of photos.

The files cameras, images and points3D are parsed here and not by pycolmap, which reads a truncated
file as zeros without an error and on other damage ends the whole process. The tests compare this
reader with models that pycolmap wrote. Models of COLMAP 3.12 and later also have rigs and frames,
but their images file still has the pose of each image: of frames, only it is taken which images are
views of one panorama.

The confidence of a point with a track follows from the track's length and the point's error. COLMAP
itself writes no points without a track: their error, if positive, is 1 / confidence, as
``write_colmap`` writes it.

Source of the formats and camera models: https://colmap.github.io/format.html and cameras.html.
"""

from __future__ import annotations

import math
import posixpath
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.rotations import rotations_of
from igsr.capture.colmap_rigs import read_frames, shared_centers
from igsr.capture.depth_files import FOLDER, depth_beside
from igsr.capture.described import DescribedCapture
from igsr.capture.image_folders import find_images
from igsr.capture.photos import Shot, is_file, rig_shots
from igsr.capture.rig import Rig, moved_to_side, rig_of
from igsr.capture.tracks import straightened, track_confidence
from igsr.capture.types import Camera, Capture, Points, Tracks, intrinsic_matrix
from igsr.capture.undistort import Lens
from igsr.capture.wide_photos import WidePhoto, whole_sphere, wide_fisheye
from igsr.errors import IgsrError

# Camera models by COLMAP's number, to name a model that is refused.
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
# Number of parameters of each supported model.
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
    "THIN_PRISM_FISHEYE": 12,
    "SIMPLE_FISHEYE": 3,
    "FISHEYE": 4,
    "EQUIRECTANGULAR": 2,
}
_ONE_FOCAL_LENGTH = (
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "SIMPLE_FISHEYE",
)
_SPHERE = "EQUIRECTANGULAR"


@dataclass(frozen=True)
class _ColmapCamera:
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class _ColmapImage:
    identity: int
    name: str
    quat: tuple[float, ...]  # wxyz, world to camera
    translation: tuple[float, ...]
    camera_id: int
    places: np.ndarray  # [N, 2] of its features, pixels
    point_ids: np.ndarray  # int64 [N], -1 where a feature is of no point


class _ColmapPoints:
    """The points of a model while they are read."""

    def __init__(self) -> None:
        self.ids: list[int] = []
        self.xyz: list[tuple[float, ...]] = []
        self.rgb: list[tuple[int, ...]] = []
        self.errors: list[float] = []
        self.lengths: list[int] = []

    def add(
        self,
        identity: int,
        xyz: tuple[float, ...],
        rgb: tuple[int, ...],
        error: float,
        track_length: int,
    ) -> None:
        self.ids.append(identity)
        self.xyz.append(xyz)
        self.rgb.append(rgb)
        self.errors.append(error)
        self.lengths.append(track_length)

    def points(self, path: Path) -> Points:
        xyz = np.array(self.xyz, dtype=np.float64)
        if not np.isfinite(xyz).all():
            raise IgsrError(f"{path} has a point that is not finite; remove it")
        error, length = np.array(self.errors), np.array(self.lengths, dtype=np.float64)
        # Outside these limits, 1 / error is not finite.
        told = (error > 1e-300) & (error < 1e300)
        with np.errstate(divide="ignore"):
            confidence = np.where(length > 0, track_confidence(length, error), 1.0 / error)
        # COLMAP writes -1 where it has not computed an error.
        known = np.where(length > 0, (error == 0.0) | told, told).all()
        return Points(xyz, np.array(self.rgb, dtype=np.uint8), confidence if known else None)


def find_model(path: Path) -> Path | None:
    """The folder of a capture's model: ``sparse/0``, ``sparse`` or the capture itself, or None."""
    for folder in (path / "sparse" / "0", path / "sparse", path):
        if any(is_file(folder / f"cameras.{kind}") for kind in ("bin", "txt")):
            return folder
    return None


def load_colmap(path: Path, model: Path, max_size: int | None = None) -> Capture:
    """Load a COLMAP capture; see ``described_colmap``."""
    return described_colmap(path, model, max_size).loaded(max_size)


def described_colmap(
    path: Path, model: Path, max_size: int | None = None, folder: str | None = None
) -> DescribedCapture:
    """Read a COLMAP capture, but not its photos; all its views are for training.

    Args:
        path: the capture. Its photos are in ``images/``, or reduced in ``images_K/`` (see
            ``igsr.capture.image_folders``) or, if there is none of these, in the capture itself.
            The mask of a photo, if any, is ``masks/`` + its whole name + ``.png``; its depth, if
            any, is in ``depths/``, see ``igsr.capture.depth_files.depth_beside``.
        model: the folder with cameras, images and points3D, all ``.bin`` or all ``.txt``.
        max_size: longest side in pixels of photos as they will be loaded, or None.
        folder: the name of the folder of photos to take, or None.

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
    images = sorted(images, key=lambda image: image.name)
    sizes = []
    for image in images:
        if image.camera_id not in cameras:
            raise IgsrError(
                f"{images_path}: {image.name} refers to camera {image.camera_id}, which "
                f"{cameras_path.name} does not have; export the model again"
            )
        sizes.append((cameras[image.camera_id].width, cameras[image.camera_id].height))
    names = [image.name for image in images]
    found = find_images(path, names, sizes, max_size, folder, images_path)
    # Photos keep their names at every size.
    prefix = "images" if found.factor > 1 or (path / "images").is_dir() else ""
    frames_path = model / f"frames.{kind}"
    frames = read_frames(frames_path) if is_file(frames_path) else []
    taken = []
    for image, photo in zip(images, found.files, strict=True):
        viewmat = _viewmat(image, images_path)
        colmap_camera = cameras[image.camera_id]
        width, height = colmap_camera.width, colmap_camera.height
        name = posixpath.normpath(posixpath.join(prefix, image.name))
        mask = found.masks / f"{image.name}.png"
        mask_path = mask if is_file(mask) else None
        try:
            K, lens = _intrinsics(colmap_camera)
            camera = Camera(viewmat, K, width, height)
            is_sphere = colmap_camera.model == _SPHERE
            wide: WidePhoto | None = whole_sphere(width, height) if is_sphere else None
            wide = wide or wide_fisheye(K, lens, width, height)
            rig = None if wide is None else rig_of(wide)
        except IgsrError as error:
            raise IgsrError(f"{cameras_path}, camera {image.camera_id}: {error}") from error
        shot = Shot(name, photo, camera, lens, "train", mask_path, images_path, found.factor)
        shot = replace(shot, depth_path=depth_beside(path / FOLDER, image.name))
        taken.append(_Taken(shot, rig))
    plain = {
        image.identity: one.shot
        for image, one in zip(images, taken, strict=True)
        if one.rig is None
    }
    shared = shared_centers(
        frames,
        {identity: shot.name for identity, shot in plain.items()},
        {identity: shot.camera.center for identity, shot in plain.items()},
    )
    shots = []
    for image, one in zip(images, taken, strict=True):
        if one.rig is None:
            shots.append(replace(one.shot, photo=shared.get(image.identity)))
        else:
            shots += rig_shots(one.shot, one.rig)

    def points() -> Points | None:
        if not is_file(points_path):
            return None
        listed = (_binary_points if binary else _text_points)(points_path)
        if not listed.ids:
            return None
        points = listed.points(points_path)
        points.tracks = _tracks(images_path, images, taken, listed.ids, points.xyz)
        return points

    return DescribedCapture(path, shots, points)


@dataclass(frozen=True)
class _Taken:
    """A photo of a model, and the views that it becomes if it is a wide one."""

    shot: Shot
    rig: Rig | None


def _tracks(
    path: Path,
    images: list[_ColmapImage],
    taken: list[_Taken],
    ids: list[int],
    xyz: np.ndarray,
) -> Tracks | None:
    """Where the images see the points with these COLMAP ids; None if no point is seen."""
    number = np.array(ids, dtype=np.uint64).astype(np.int64)  # as those of the features wrap
    order = np.argsort(number, kind="stable")
    shots: list[Shot] = []
    views, points, places = [], [], []
    for image, one in zip(images, taken, strict=True):
        at = order[np.searchsorted(number[order], image.point_ids).clip(0, len(ids) - 1)]
        # An id without a point belongs to a feature without a point, or to a removed point.
        seen = (number[at] == image.point_ids) & (image.point_ids != -1)
        if not np.isfinite(image.places[seen]).all():
            raise IgsrError(
                f"{path}: {image.name} sees a point at no finite place; run COLMAP again"
            )
        found = [(one.shot, at[seen], image.places[seen])]
        if one.rig is not None:
            found = _on_sides(one.shot, one.rig, at[seen], image.places[seen], xyz)
        for shot, point, place in found:
            views.append(np.full(len(point), len(shots), dtype=np.int64))
            points.append(point)
            places.append(place)
            shots.append(shot)
    if not any(map(len, views)):
        return None
    tracks = Tracks(
        [shot.name for shot in shots],
        *(np.concatenate(part) for part in (views, points, places)),
    )
    return straightened(tracks, xyz, [shot.camera for shot in shots], [shot.lens for shot in shots])


def _on_sides(
    shot: Shot, rig: Rig, point: np.ndarray, places: np.ndarray, xyz: np.ndarray
) -> list[tuple[Shot, np.ndarray, np.ndarray]]:
    """Observations of a wide photo in its views: which points, and where."""
    viewmat = shot.camera.viewmat
    directions = xyz[point] @ viewmat[:3, :3].T + viewmat[:3, 3]
    found = []
    for side, view in zip(rig.sides, rig_shots(shot, rig), strict=True):
        moved, shown = moved_to_side(places, directions, rig.photo, side.camera)
        found.append((view, point[shown], moved[shown]))
    return found


def _intrinsics(camera: _ColmapCamera) -> tuple[np.ndarray, Lens]:
    params = list(camera.params)
    if not all(math.isfinite(value) for value in params):
        raise IgsrError("its camera has a parameter that is not finite; run COLMAP again")
    if camera.model == _SPHERE:
        return np.eye(3), Lens()
    if camera.model in _ONE_FOCAL_LENGTH:
        params.insert(1, params[0])
    K, extra = intrinsic_matrix(*params[:4]), params[4:]
    if camera.model in ("OPENCV", "FULL_OPENCV"):
        k1, k2, p1, p2, *rest = extra
        return K, Lens(False, (k1, k2, *rest[:1]), tuple(rest[1:]), (p1, p2))
    if camera.model == "THIN_PRISM_FISHEYE":
        k1, k2, p1, p2, k3, k4, sx1, sy1 = extra
        return K, Lens(True, (k1, k2, k3, k4), (), (p1, p2), (sx1, sy1))
    return K, Lens("FISHEYE" in camera.model, tuple(extra))


def _viewmat(image: _ColmapImage, path: Path) -> np.ndarray:
    norm = math.hypot(*image.quat)
    if not (math.isfinite(norm) and norm > 1e-6 and all(map(math.isfinite, image.translation))):
        raise IgsrError(
            f"{path}: the pose of {image.name} has a NaN or infinite entry or a zero quaternion; "
            "run COLMAP again"
        )
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotations_of(np.array(image.quat, np.float64) / norm)
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
    """A little-endian file read front to back; every read is checked against its length."""

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

    def table(self, layout: np.dtype[Any], count: int) -> np.ndarray:
        start = self.offset
        self.skip(layout.itemsize * count)
        return np.frombuffer(self.data, layout, count, start)

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
_OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])


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
        identity, *pose, camera_id = file.unpack(_IMAGE)
        name = file.name()
        (count,) = file.unpack(_COUNT)
        seen = file.table(_OBSERVATION, count)
        images.append(
            _ColmapImage(
                identity,
                name,
                tuple(pose[:4]),
                tuple(pose[4:]),
                camera_id,
                seen["xy"],
                seen["point"],
            )
        )
    file.finish()
    return images


def _binary_points(path: Path) -> _ColmapPoints:
    file = _Bytes(path)
    points = _ColmapPoints()
    for _ in range(_count(file)):
        identity, x, y, z, r, g, b, error, track_length = file.unpack(_POINT)
        file.skip(8 * track_length)
        points.add(identity, (x, y, z), (r, g, b), error, track_length)
    file.finish()
    return points


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
            name, camera_id, identity = fields[9], int(fields[8]), int(fields[0])
        except (ValueError, IndexError) as error:
            raise _damaged(path, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME") from error
        number, line = next(lines, (number + 1, ""))  # its observations, possibly none
        places, point_ids = _text_observations(path, number, line)
        images.append(
            _ColmapImage(identity, name, pose[:4], pose[4:], camera_id, places, point_ids)
        )
    return images


def _text_observations(path: Path, number: int, line: str) -> tuple[np.ndarray, np.ndarray]:
    fields = line.split()
    try:
        places = np.array([fields[0::3], fields[1::3]], dtype=np.float64).T
        # No point is -1, or the same 64 bits without a sign.
        ids = [-1 if int(field) == (1 << 64) - 1 else int(field) for field in fields[2::3]]
        point_ids = np.array(ids, dtype=np.int64)
        if len(fields) % 3:
            raise ValueError
    except (ValueError, OverflowError) as error:
        raise _damaged(path, number, "X Y POINT3D_ID of each feature") from error
    return places, point_ids


def _text_points(path: Path) -> _ColmapPoints:
    points = _ColmapPoints()
    for number, line in _lines(path):
        if not line:
            continue
        try:
            identity, x, y, z, r, g, b, *rest = line.split()
            # Files of other programs may end here; the error is then not known.
            error, track = float(rest[0]) if rest else math.nan, rest[1:]
            xyz, rgb = (float(x), float(y), float(z)), (int(r), int(g), int(b))
            if not (all(0 <= value <= 255 for value in rgb) and 0 <= int(identity) < 1 << 64):
                raise ValueError
            points.add(int(identity), xyz, rgb, error, len(track) // 2)
        except ValueError as wrong:
            raise _damaged(path, number, "POINT3D_ID X Y Z R G B ERROR TRACK") from wrong
    return points


def _not_utf8(path: Path) -> IgsrError:
    return IgsrError(f"{path} is corrupt or not in UTF-8; export the model again")


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise IgsrError(f"{path} cannot be read ({error.strerror}); check it") from error
