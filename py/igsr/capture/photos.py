"""Photos with known cameras: checked against their cameras, decoded and undistorted into views."""

from __future__ import annotations

import math
import threading
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np

from igsr._internal.choices import Split
from igsr.capture.downscaling import (
    check_max_size,
    plane_area_means,
    reduced_size,
    resampled_plane,
    resized_camera,
    resized_tracks,
)
from igsr.capture.exif import read_exif
from igsr.capture.image_files import (
    MAX_FREE_DEPTH,
    PhotoHeader,
    decoded,
    mask_of,
    open_image,
    photo_header,
    read_depth,
)
from igsr.capture.memory_check import PhotoSizes
from igsr.capture.rig import Rig, decoded_size, sampled_views
from igsr.capture.types import Camera, Capture, Points, View
from igsr.capture.undistort import Lens, Undistorter
from igsr.errors import IgsrError

#: Relative tolerance between the aspect ratios of a depth and its photo: networks round sides to
#: whole patches.
DEPTH_ASPECT_TOLERANCE = 0.05


@dataclass(frozen=True)
class Shot:
    """A photo to load, as a reader of captures describes it.

    Attributes:
        name: the view's name.
        path: the photo's file.
        camera: its pinhole camera; ``K`` and the size are the distorted photo's too.
        lens: its distortion.
        split: "train" or "test".
        mask_path: the mask's file, or None.
        source: the file that describes the camera, for error messages.
        factor: the photo is smaller than its camera by this factor, within a pixel.
        rig: for a view of a wide photo, all views of that photo; None for other photos.
        side: index of the view in ``rig``.
        photo: the wide photo's name; also set for views that were written as files.
        depth_path: the file of the photo's depth, or None.
        depth_unit: world units of one number in it; None: as in ``read_depth``.
    """

    name: str
    path: Path
    camera: Camera
    lens: Lens
    split: Split
    mask_path: Path | None
    source: Path
    factor: int = 1
    rig: Rig | None = None
    side: int = 0
    photo: str | None = None
    depth_path: Path | None = None
    depth_unit: float | None = None

    @property
    def is_resampled(self) -> bool:
        """Whether the view's pixels are interpolated from those of the photo."""
        return self.rig is not None or not self.lens.is_pinhole


def rig_shots(shot: Shot, rig: Rig) -> list[Shot]:
    """Split a wide photo, of whose camera only the pose is used, into its views.

    Raises:
        IgsrError: the photo has a depth file, which wide photos do not support.
    """
    if shot.depth_path is not None:
        raise IgsrError(
            f"{shot.depth_path}: depth of a panorama or wide fisheye photo is not read; leave it "
            "out"
        )
    return [
        replace(
            shot,
            name=side.named(shot.name),
            camera=side.in_world(shot.camera.viewmat),
            lens=Lens(),
            rig=rig,
            side=index,
            photo=shot.name,
        )
        for index, side in enumerate(rig.sides)
    ]


def photo_of(shot: Shot) -> str:
    """Return the name of the photo that a shot is part of, as ``View.photo``."""
    return shot.photo or shot.name


@dataclass(frozen=True)
class DescribedCapture:
    """A capture whose photos are not decoded yet.

    Attributes:
        path: the folder of the capture.
        shots: its photos, in their order.
        points: reads the points, with tracks in the pixels of the shots' cameras.
    """

    path: Path
    shots: list[Shot]
    points: Callable[[], Points | None]

    def loaded(self, max_size: int | None = None) -> Capture:
        """Decode the photos, as ``load_capture``."""
        check_max_size(max_size)
        headers = checked_headers(self.shots)
        shot_sizes(self.shots, headers).check_memory(max_size)
        points = self.points()
        views = _load_views(self.shots, headers, max_size)
        before = {shot.name: shot.camera for shot in self.shots}
        after = {view.name: view.camera for view in views}
        return Capture(self.path, views, resized_tracks(points, before, after))


def checked_headers(shots: list[Shot]) -> list[PhotoHeader]:
    """Read the headers of all photos of a capture, and check their sizes against their cameras.

    Raises:
        IgsrError: two photos have one name, or a photo cannot be read or has another size.
    """
    source_from_name: dict[str, Path] = {}
    for shot in shots:
        if shot.name in source_from_name:
            sources = dict.fromkeys([source_from_name[shot.name].name, shot.source.name])
            raise IgsrError(
                f"{shot.source.parent} has two cameras for the image {shot.name} "
                f"({' and '.join(sources)}); remove one"
            )
        source_from_name[shot.name] = shot.source
    headers = []
    for shot in shots:
        header = photo_header(shot.path)
        _check_size(shot.path, header.size, shot, "image")
        headers.append(header)
    return headers


def _check_size(path: Path, size: tuple[int, int], shot: Shot, kind: str) -> None:
    """Check the size of a photo ("image") or "mask" against its camera."""
    full = shot.camera if shot.rig is None else shot.rig.photo
    wanted = full.width, full.height
    if size == wanted and (shot.factor == 1 or kind == "mask"):
        return
    # Programs round the size of a reduced photo up, down or to the nearest.
    off = max(abs(a - b / shot.factor) for a, b in zip(size, wanted, strict=True))
    if shot.factor > 1 and off <= 1.0:
        return
    is_turned = kind == "image" and shot.factor == 1 and size == wanted[::-1]
    turned = " (an EXIF orientation is never applied)" if is_turned else ""
    reduced = "" if shot.factor == 1 else f", and {path.parent.name} says 1/{shot.factor} of it"
    raise IgsrError(
        f"{path} is {size[0]}x{size[1]} pixels but its camera in {shot.source.name} "
        f"is {wanted[0]}x{wanted[1]}{reduced}{turned}; resize the {kind} or correct the camera"
    )


def shot_sizes(shots: list[Shot], headers: list[PhotoHeader]) -> PhotoSizes:
    """Return the sizes of photos, from the headers of their files (``checked_headers``)."""
    return PhotoSizes(
        sizes=[
            header.size if shot.rig is None else (shot.camera.width, shot.camera.height)
            for shot, header in zip(shots, headers, strict=True)
        ],
        channels=max((header.channels for header in headers), default=3),
        masked=any(shot.is_resampled or shot.mask_path is not None for shot in shots),
        depths=any(shot.depth_path is not None for shot in shots),
        decoded=[_decoded(shot, header) for shot, header in zip(shots, headers, strict=True)],
        views=[number for _, number in sorted(Counter(map(photo_of, shots)).items())],
        plain=[shot.path for shot in shots if shot.rig is None and shot.mask_path is None],
    )


def _decoded(shot: Shot, header: PhotoHeader) -> tuple[int, int]:
    """The largest that a photo, its mask and its depth may be; the two may have the full size."""
    sizes = [header.size]
    if shot.mask_path is not None or shot.depth_path is not None:
        sizes.append((shot.camera.width, shot.camera.height))
    if shot.depth_path is not None:
        sizes.append((MAX_FREE_DEPTH, 1))
    return max(sizes, key=math.prod)


def _load_views(shots: list[Shot], headers: list[PhotoHeader], max_size: int | None) -> list[View]:
    """Load all photos of a capture on all cores, in the order given."""
    undistorters = _Undistorters(zip(shots, headers, strict=True))

    def load(group: list[tuple[Shot, PhotoHeader]]) -> list[View]:
        (shot, header), rig = group[0], group[0][0].rig
        if rig is None:
            size = reduced_size(*header.size, max_size)
        else:
            size = decoded_size(rig, header.size, max_size)
        with open_image(shot.path) as opened:
            if opened.size != header.size:
                raise IgsrError(f"{shot.path} was changed while it was read; try again")
            mask = _read_mask(shot, header.size)
            image, mask = decoded(opened, shot.path, size, mask)
            exposure_value = read_exif(opened).exposure_value
        if rig is None:
            camera = resized_camera(shot.camera, *size)
            undistorter = undistorters.take(shot, header, camera)
            views = [_undistorted(shot, camera, image, mask, undistorter)]
        else:
            views = _rig_views([shot for shot, _ in group], rig, image, mask, max_size)
        return [replace(view, exposure_value=exposure_value, rig=shot.photo) for view in views]

    # The views of a wide photo share one decoding of it.
    pairs = zip(shots, headers, strict=True)
    groups = groupby(pairs, lambda pair: pair[0].name if pair[0].rig is None else pair[0].photo)
    threads = shot_sizes(shots, headers).decoding_threads(max_size)
    with ThreadPoolExecutor(max_workers=threads) as pool:
        futures = [pool.submit(load, list(group)) for _, group in groups]
        try:
            return [view for future in futures for view in future.result()]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


class _Undistorters:
    """One resampling map per distinct camera, freed after its last photo to save memory."""

    def __init__(self, photos: Iterable[tuple[Shot, PhotoHeader]]) -> None:
        self._maps: dict[object, Undistorter] = {}
        self._uses = Counter(self._key(shot, header) for shot, header in photos)
        # One lock per camera, so that maps of different cameras are computed in parallel.
        self._locks = {key: threading.Lock() for key in self._uses}

    @staticmethod
    def _key(shot: Shot, header: PhotoHeader) -> object:
        camera = shot.camera
        return shot.lens, camera.K.tobytes(), camera.width, camera.height, header.size

    def take(self, shot: Shot, header: PhotoHeader, camera: Camera) -> Undistorter | None:
        if shot.lens.is_pinhole:
            return None
        key = self._key(shot, header)
        with self._locks[key]:
            if key not in self._maps:
                try:
                    self._maps[key] = Undistorter(shot.lens, camera.K, camera.width, camera.height)
                except IgsrError as error:
                    raise IgsrError(f"{shot.source}: the camera of {shot.name}: {error}") from error
            self._uses[key] -= 1
            return self._maps[key] if self._uses[key] else self._maps.pop(key)


def _undistorted(
    shot: Shot,
    camera: Camera,
    image: np.ndarray,
    mask: np.ndarray | None,
    undistorter: Undistorter | None,
) -> View:
    depth = _read_depth(shot, camera)
    if undistorter is not None:
        image = undistorter.image(image)
        mask = undistorter.valid.copy() if mask is None else undistorter.mask(mask)
        mask = None if mask.all() else mask
        depth = None if depth is None else undistorter.nearest(depth)
    return View(shot.name, camera, shot.split, image, mask, depth=depth)


def _rig_views(
    shots: list[Shot], rig: Rig, image: np.ndarray, mask: np.ndarray | None, max_size: int | None
) -> list[View]:
    """The views of a wide photo, without those that its mask hides."""
    sampled = sampled_views(rig, image, mask, max_size)
    views = []
    for shot in shots:
        if shot.side in sampled:
            camera, pixels, shown = sampled[shot.side]
            camera = replace(camera, viewmat=shot.camera.viewmat)
            views.append(View(shot.name, camera, shot.split, pixels, shown))
    return views


def _read_depth(shot: Shot, camera: Camera) -> np.ndarray | None:
    """The depth of a photo in the camera's pixels [H, W], from the nearest pixels of the file."""
    if shot.depth_path is None:
        return None
    full = shot.camera
    depth = read_depth(shot.depth_path, shot.depth_unit, (full.width, full.height))
    height, width = depth.shape
    # Depth cameras have the same field of view as photos.
    difference = abs(width * full.height - height * full.width)
    rounding = max(full.width, full.height)
    if difference > max(DEPTH_ASPECT_TOLERANCE * height * full.width, rounding):
        raise IgsrError(
            f"{shot.depth_path} is {width}x{height} pixels but its photo {full.width}x"
            f"{full.height}, of another shape; give depth of the whole photo"
        )
    return resampled_plane(depth, camera.width, camera.height)


def _read_mask(shot: Shot, size: tuple[int, int]) -> np.ndarray | None:
    """The mask of a photo in the photo's pixels, reduced if it has the camera's size."""
    if shot.mask_path is None:
        return None
    with open_image(shot.mask_path) as opened:
        _check_size(shot.mask_path, opened.size, shot, "mask")
        mask = mask_of(opened, shot.mask_path)
    if (mask.shape[1], mask.shape[0]) == size:
        return mask
    if mask.shape[1] < size[0] or mask.shape[0] < size[1]:
        raise IgsrError(
            f"{shot.mask_path} is {mask.shape[1]}x{mask.shape[0]} pixels but its photo is "
            f"{size[0]}x{size[1]}; resize the mask"
        )
    # A reduced pixel may be used only if all pixels under it may.
    return plane_area_means(mask, *size) > 1.0 - 1e-6
