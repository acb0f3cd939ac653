"""Read captures of COLMAP: a sparse model, text or binary, next to a folder of photos.

Models of COLMAP 3.12 and later also have rigs and frames, but their images file still has the pose
of each image. Frames only determine which images are views of one panorama: those of one frame with
one center. Rigs of cameras that are apart are read as single photos.

The confidence of a point with a track follows from the track's length and the point's error. COLMAP
writes no points without a track; the error of those, if positive, is 1 / confidence, as
``write_colmap`` writes it.

LLFF and mip-NeRF 360 keep photos in ``images`` and, reduced by K, in ``images_K``; the model has
the full size. Reduced photos have the same names, the same names with another suffix, or, in LLFF,
other names in the same order.

Source of the camera models: https://colmap.github.io/cameras.html.
"""

from __future__ import annotations

import math
import posixpath
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from igsr._internal.rotations import rotations_of
from igsr._internal.user_warning import warn_user
from igsr.capture import colmap_files
from igsr.capture.colmap_files import ColmapCamera, ColmapImage
from igsr.capture.image_files import DEPTHS, SUFFIXES, find_depth, is_file
from igsr.capture.mask_files import MaskFiles
from igsr.capture.photos import DescribedCapture, Shot, rig_shots
from igsr.capture.rig import Rig, moved_to_side, rig_of
from igsr.capture.types import Camera, Points, Tracks, intrinsic_matrix
from igsr.capture.undistort import Lens, straightened
from igsr.capture.wide_photos import WidePhoto, whole_sphere, wide_fisheye
from igsr.errors import IgsrError

_SPHERE = "EQUIRECTANGULAR"
#: Maximum distance between centers of views of one photo, relative to that of all cameras.
_ONE_CENTER = 1e-6
_REDUCED_FOLDER = re.compile(r"images_([1-9][0-9]{0,2})")


def find_model(path: Path) -> Path | None:
    """Return the folder of a capture's model, or None.

    It is the one of ``sparse/0``, ``sparse/1`` ... with the most images, else ``sparse`` or the
    capture itself.
    """
    numbered = _numbered_models(path)
    if len(numbered) == 1:
        return numbered[0]
    if numbered:
        return min(numbered, key=lambda folder: (-colmap_files.image_count(folder), folder.name))
    return next(filter(_is_model, (path / "sparse", path)), None)


def _numbered_models(path: Path) -> list[Path]:
    return [folder for folder in (path / "sparse").glob("[0-9]*") if _is_model(folder)]


def _is_model(folder: Path) -> bool:
    return any(is_file(folder / f"cameras.{kind}") for kind in ("bin", "txt"))


def reduction_of(folder: str) -> int | None:
    """Return K of a folder's name ``images_K``; None for other names."""
    match = _REDUCED_FOLDER.fullmatch(folder)
    return None if match is None else int(match[1])


def describe_colmap(
    path: Path, model: Path, max_size: int | None = None, folder: str | None = None
) -> DescribedCapture:
    """Read a COLMAP capture except for its photos; all its views are for training.

    Args:
        path: the capture. Its photos are in ``images/``, or reduced in ``images_K/`` or, without
            any of these, in the capture itself. They may have masks (see
            ``igsr.capture.mask_files``), and depths in ``depths/`` (see ``find_depth``).
        model: the folder with cameras, images and points3D, all ``.bin`` or all ``.txt``.
        max_size: longest side in pixels of photos as they will be loaded, or None.
        folder: name of the folder of photos to use, or None for the smallest that is large enough.

    Raises:
        IgsrError: a file is missing, corrupt, or has an unsupported camera model.
    """
    kind = "bin" if is_file(model / "cameras.bin") else "txt"
    cameras_path, images_path, points_path, frames_path = (
        model / f"{name}.{kind}" for name in ("cameras", "images", "points3D", "frames")
    )
    if not is_file(images_path):
        raise IgsrError(
            f"{images_path} is missing next to {cameras_path.name}; copy the whole model"
        )
    cameras = colmap_files.read_cameras(cameras_path)
    images = colmap_files.read_images(images_path)
    images = [replace(image, name=_relative_name(image.name, path)) for image in images]
    for image in images:
        if not PurePosixPath(image.name).name:
            raise IgsrError(
                f"{images_path}: image {image.identity} has no name; export the model again"
            )
    images.sort(key=lambda image: image.name)
    numbered = _numbered_models(path)
    if len(numbered) > 1 and model in numbered:
        warn_user(
            f"{model.parent} has {len(numbered)} models; {model.name}, with the most images, is "
            "used."
        )
    if not images:
        raise IgsrError(f"{images_path} lists no images; give a model with registered images")
    for image in images:
        if image.camera_id not in cameras:
            raise IgsrError(
                f"{images_path}: {image.name} refers to camera {image.camera_id}, which "
                f"{cameras_path.name} does not have; export the model again"
            )
    sizes = [(cameras[i.camera_id].width, cameras[i.camera_id].height) for i in images]
    files = _find_photos(path, [i.name for i in images], sizes, max_size, folder, images_path)
    # Photos keep their names at every size.
    prefix = "images" if files.factor > 1 or (path / "images").is_dir() else ""
    photos: list[_Photo] = []
    for image, file in zip(images, files.files, strict=True):
        viewmat = _viewmat(image, images_path)
        try:
            camera, lens, rig = _camera(cameras[image.camera_id], viewmat)
        except IgsrError as error:
            raise IgsrError(f"{cameras_path}, camera {image.camera_id}: {error}") from error
        name = posixpath.normpath(posixpath.join(prefix, image.name))
        mask = files.masks.of(file)
        shot = Shot(name, file, camera, lens, "train", mask, images_path, files.factor)
        # An absolute name or one with ".." could lead to the photo itself.
        inside = posixpath.normpath(f"/{image.name}").lstrip("/")
        shot = replace(shot, depth_path=find_depth(path / DEPTHS, inside))
        photos.append(_Photo(image, shot, rig))
    files.masks.warn_unless_used()
    frames = colmap_files.read_frames(frames_path) if is_file(frames_path) else []
    shared = _shared_centers(frames, [photo for photo in photos if photo.rig is None])
    shots = []
    for photo in photos:
        if photo.rig is None:
            shots.append(replace(photo.shot, photo=shared.get(photo.image.identity)))
        else:
            shots += rig_shots(photo.shot, photo.rig)

    def points() -> Points | None:
        if not is_file(points_path):
            return None
        table = colmap_files.read_points(points_path)
        return _points(points_path, table, images_path, photos) if len(table) else None

    return DescribedCapture(path, shots, points)


@dataclass(frozen=True)
class _Photo:
    """A photo of a model, and its views if it is a wide one."""

    image: ColmapImage
    shot: Shot
    rig: Rig | None


def _camera(colmap: ColmapCamera, viewmat: np.ndarray) -> tuple[Camera, Lens, Rig | None]:
    colmap_files.check_supported(colmap.model)
    K, lens = intrinsics(colmap)
    camera = Camera(viewmat, K, colmap.width, colmap.height)
    wide: WidePhoto | None = wide_fisheye(K, lens, colmap.width, colmap.height)
    if colmap.model == _SPHERE:
        wide = whole_sphere(colmap.width, colmap.height)
    return camera, lens, None if wide is None else rig_of(wide)


def intrinsics(camera: ColmapCamera) -> tuple[np.ndarray, Lens]:
    """Return the pinhole matrix, float64 [3, 3], and the lens of a camera."""
    params = list(camera.params)
    if not all(map(math.isfinite, params)):
        raise IgsrError("its camera has a parameter that is not finite; run COLMAP again")
    if camera.model == _SPHERE:
        return np.eye(3), Lens()
    if camera.model.startswith(("SIMPLE", "RADIAL")):  # one focal length
        params.insert(1, params[0])
    K, extra = intrinsic_matrix(*params[:4]), params[4:]
    if camera.model in ("OPENCV", "FULL_OPENCV"):
        k1, k2, p1, p2, *rest = extra
        return K, Lens(False, (k1, k2, *rest[:1]), tuple(rest[1:]), (p1, p2))
    if camera.model == "THIN_PRISM_FISHEYE":
        k1, k2, p1, p2, k3, k4, sx1, sy1 = extra
        return K, Lens(True, (k1, k2, k3, k4), (), (p1, p2), (sx1, sy1))
    return K, Lens("FISHEYE" in camera.model, tuple(extra))


def _viewmat(image: ColmapImage, path: Path) -> np.ndarray:
    quat, translation = np.array(image.pose[:4]), image.pose[4:]
    norm = math.hypot(*quat)
    if not (math.isfinite(norm) and norm > 1e-6 and all(map(math.isfinite, translation))):
        raise IgsrError(
            f"{path}: the pose of {image.name} has a NaN or infinite entry or a zero quaternion; "
            "run COLMAP again"
        )
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotations_of(quat / norm)
    viewmat[:3, 3] = translation
    return viewmat


def _shared_centers(frames: list[list[int]], photos: list[_Photo]) -> dict[int, str]:
    """The rig of each image that shares a frame and a center: the name of its first photo."""
    rigs: dict[int, str] = {}
    if not photos:
        return rigs
    names = {photo.image.identity: photo.shot.name for photo in photos}
    centers = {photo.image.identity: photo.shot.camera.center for photo in photos}
    all_centers = np.stack(list(centers.values()))
    extent = float(np.linalg.norm(all_centers - all_centers.mean(axis=0), axis=1).max())
    for frame in frames:
        members = [image for image in frame if image in names]
        if len(members) < 2:
            continue
        places = np.stack([centers[image] for image in members])
        rounding = 1e-9 * (1.0 + float(np.abs(places[0]).max()))
        if np.linalg.norm(places - places[0], axis=1).max() <= _ONE_CENTER * extent + rounding:
            rigs.update(dict.fromkeys(members, min(names[image] for image in members)))
    return rigs


def _points(path: Path, table: np.ndarray, images_path: Path, photos: list[_Photo]) -> Points:
    xyz = np.ascontiguousarray(table["xyz"])
    if not np.isfinite(xyz).all():
        raise IgsrError(f"{path} has a point that is not finite; remove it")
    error, length = table["error"], table["length"].astype(np.float64)
    # Outside these limits, 1 / error is not finite.
    is_usual = (error > 1e-300) & (error < 1e300)
    with np.errstate(divide="ignore"):
        confidence = np.where(length > 0, track_confidence(length, error), 1.0 / error)
    # COLMAP writes -1 for an error that it has not computed.
    is_known = np.where(length > 0, (error == 0.0) | is_usual, is_usual).all()
    points = Points(xyz, np.ascontiguousarray(table["rgb"]), confidence if is_known else None)
    points.tracks = _tracks(images_path, photos, table["id"], xyz)
    return points


def track_confidence(length: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return the confidence of points by their track lengths [P] and mean errors [P] in pixels."""
    return np.asarray(length / (1.0 + error))


def _tracks(path: Path, photos: list[_Photo], ids: np.ndarray, xyz: np.ndarray) -> Tracks | None:
    """Observations of the points with these COLMAP ids; None without any."""
    numbers = ids.astype(np.int64)  # those of the features wrap too
    order = np.argsort(numbers, kind="stable")
    shots: list[Shot] = []
    views, points, places = [], [], []
    for photo in photos:
        image = photo.image
        at = order[np.searchsorted(numbers[order], image.point_ids).clip(0, len(ids) - 1)]
        # An unknown id belongs to a feature without a point, or to a removed point.
        seen = (numbers[at] == image.point_ids) & (image.point_ids != -1)
        if not np.isfinite(image.xy[seen]).all():
            raise IgsrError(
                f"{path}: {image.name} sees a point at no finite place; run COLMAP again"
            )
        point, xy = at[seen], image.xy[seen]
        observations = [(photo.shot, point, xy)]
        if photo.rig is not None:
            viewmat = photo.shot.camera.viewmat
            directions = xyz[point] @ viewmat[:3, :3].T + viewmat[:3, 3]
            observations = []
            for side, shot in zip(photo.rig.sides, rig_shots(photo.shot, photo.rig), strict=True):
                moved, shown = moved_to_side(xy, directions, photo.rig.photo, side.camera)
                observations.append((shot, point[shown], moved[shown]))
        for shot, point, xy in observations:
            views.append(np.full(len(point), len(shots), dtype=np.int64))
            points.append(point)
            places.append(xy)
            shots.append(shot)
    if not any(map(len, views)):
        return None
    names = [shot.name for shot in shots]
    tracks = Tracks(names, *(np.concatenate(part) for part in (views, points, places)))
    return straightened(tracks, xyz, [shot.camera for shot in shots], [shot.lens for shot in shots])


@dataclass(frozen=True)
class _PhotoFiles:
    """The photos of a model in its order, reduced by a factor, and the masks of all photos."""

    files: list[Path]
    factor: int
    masks: MaskFiles


def _find_photos(
    capture: Path,
    names: Sequence[str],
    sizes: Sequence[tuple[int, int]],
    max_size: int | None,
    folder: str | None,
    source: Path,
) -> _PhotoFiles:
    """Find the folder with the smallest photos that are large enough."""
    try:
        entries = {reduction_of(entry.name): entry for entry in capture.iterdir()}
    except OSError:
        entries = {}
    folders = {factor: entry for factor, entry in entries.items() if factor and entry.is_dir()}
    full = next(filter(Path.is_dir, (capture / "images", capture / "input")), None)
    if full is None and not folders:
        full = capture
    if folder is not None:
        factors = [reduction_of(folder) or 1]
        folders = {factors[0]: capture / folder}
    else:
        factors = [1] if full is not None else sorted(folders)
        if max_size is not None:
            large_enough = [
                factor
                for factor in sorted(folders, reverse=True)
                if all(max(size) // factor >= min(max_size, max(size)) for size in sizes)
            ]
            factors = large_enough + factors
        if full is not None:
            folders[1] = full
    for factor in factors:
        files = _photos_in(folders[factor], full, names, same_names=factor == 1)
        if files is not None:
            return _PhotoFiles(files, factor, MaskFiles(capture, factor))
    required = folders[min(folders)]
    missing = next(name for name in names if not is_file(required / name))
    raise IgsrError(
        f"{source} has a camera for {missing} but {required / missing} is missing; put the photo "
        "there"
    )


def _photos_in(
    folder: Path, full: Path | None, names: Sequence[str], same_names: bool
) -> list[Path] | None:
    """The photo of each name in a folder, or None if one is missing; ``full`` has the full size."""
    files = [folder / name for name in names]
    if all(map(is_file, files)):
        return files
    # Other programs change case and suffix, and leave out folders.
    reduced = _sorted_photos(folder)
    for key in (_stem, _base):
        by_key = {key(path.relative_to(folder).as_posix()): path for path in reduced}
        keys = list(map(key, names))
        is_unique = len(by_key) == len(reduced) and len(set(keys)) == len(keys)
        is_flat = key is _stem or not any("/" in name for name in names)
        if is_unique and is_flat and by_key.keys() >= set(keys):
            return [by_key[key] for key in keys]
    if same_names:
        return None
    # LLFF gives its reduced photos new names, in the order of the full ones.
    full_photos = [] if full is None else _sorted_photos(full)
    if full is None or len(full_photos) != len(reduced):
        return None
    full_names = [path.relative_to(full).as_posix() for path in full_photos]
    by_name = dict(zip(full_names, reduced, strict=True))
    return [by_name[name] for name in names] if by_name.keys() >= set(names) else None


def _stem(name: str) -> str:
    return PurePosixPath(name).with_suffix("").as_posix().lower()


def _base(name: str) -> str:
    return PurePosixPath(_stem(name)).name


def _relative_name(name: str, capture: Path) -> str:
    """The name of a photo relative to the folder of photos.

    Models made on Windows have backslashes; some have absolute names, or names from the capture on.
    """
    name = name.replace("\\", "/")
    if is_file(Path(name)) and Path(name).is_absolute():
        return name
    if re.match("([A-Za-z]:)?/", name):
        # The longest end of the name that is a photo.
        parts = name.split("/")
        ends = ["/".join(parts[first:]) for first in range(1, len(parts))]
        known = [capture / folder for folder in ("images", "input")]
        photos = [folder for folder in known if folder.is_dir()] or [capture]
        found = (end for end in ends if any(is_file(folder / end) for folder in photos))
        return next(found, parts[-1])
    if name.startswith("images/") and not (capture / "images" / "images").is_dir():
        name = name.removeprefix("images/")
    return name


def _sorted_photos(folder: Path) -> list[Path]:
    return sorted(
        path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and is_file(path)
    )
