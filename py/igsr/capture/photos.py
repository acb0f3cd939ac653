"""Decode photos and masks, check them against their cameras, and undistort them."""

from __future__ import annotations

import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from igsr._internal.choices import Split
from igsr.capture.depth_files import depth_array, depth_of, holds_array, in_world_units
from igsr.capture.downscaling import (
    area_means,
    plane_area_means,
    reduced_size,
    resampled_plane,
    resized_camera,
)
from igsr.capture.exif import read_exif
from igsr.capture.memory_check import decoding_threads
from igsr.capture.rig import LEAST_SHOWN, Rig, sampled_views, shown_part, sides_at
from igsr.capture.types import Camera, View
from igsr.capture.undistort import Lens, Undistorter
from igsr.errors import IgsrError

_HEIF_SUFFIXES = (".heic", ".heif")
SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".ppm", ".gif"),
    *_HEIF_SUFFIXES,
)

# Pillow reads more formats, but for some of them (EPS) it runs another program.
_FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "PPM", "GIF")

#: Part by which a depth's ratio of sides may differ from its photo's: networks round sides to whole
#: patches.
DEPTH_ASPECT = 0.05

# No photo is packed tighter; a file that claims more is a decompression bomb or damaged.
_MOST_PIXELS_PER_BYTE = 10_000


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
        factor: by which the photo is smaller than its camera says, within a pixel.
        rig: of a view of a wide photo, all views that this becomes; None for other photos.
        side: which of these the shot is.
        photo: the wide photo's name; also of views that were written as such.
        depth_path: the file of the photo's depth, or None.
        depth_unit: world units of one of its numbers; None: as ``in_world_units`` has it.
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
    def photo_size(self) -> tuple[int, int]:
        """Width and height in pixels that the photo has by its camera, before it is reduced."""
        if self.rig is not None:
            return self.rig.photo.width, self.rig.photo.height
        return self.camera.width, self.camera.height

    @property
    def is_resampled(self) -> bool:
        """Whether the view's pixels are not those of the photo."""
        return self.rig is not None or not self.lens.is_pinhole


def rig_shots(shot: Shot, rig: Rig) -> list[Shot]:
    """The views of a wide photo.

    Args:
        shot: the photo; of its camera, only the pose counts.
        rig: its views.

    Raises:
        IgsrError: the photo comes with depth: distances from its center are not read.
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
    """The name of the photo that a shot is of, as ``View.photo``."""
    return shot.photo or shot.name


def is_file(path: Path) -> bool:
    """Whether the path is a file; False for paths that no file can have (an embedded NUL)."""
    try:
        return path.is_file()
    except (ValueError, OSError):
        return False


def open_image(path: Path) -> Image.Image:
    """Open an image without decoding its pixels.

    Raises:
        IgsrError: the file is missing, has no format that is read, or claims more pixels than its
            bytes can hold.
    """
    formats: tuple[str, ...] = _FORMATS
    if path.suffix.lower() in _HEIF_SUFFIXES:
        # It loads an HEVC decoder, which few captures need.
        import pillow_heif

        pillow_heif.register_heif_opener()
        formats = ("HEIF",)
    try:
        file_size = path.stat().st_size
        image = Image.open(path, formats=formats)
    except FileNotFoundError as error:
        raise IgsrError(f"{path} does not exist; put the image there") from error
    except Image.DecompressionBombError as error:
        raise IgsrError(f"{path} claims too many pixels for a photo; shrink it") from error
    except Exception as error:  # Pillow's plugins raise anything at all on broken files.
        raise IgsrError(
            f"{path} cannot be read as an image; save it as PNG, JPEG, WebP or TIFF again"
        ) from error
    if image.width * image.height > file_size * _MOST_PIXELS_PER_BYTE:
        image.close()
        raise IgsrError(
            f"{path} claims {image.width}x{image.height} pixels but has only {file_size} bytes; "
            "save it again"
        )
    return image


def image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels as stored (EXIF orientation not applied), from the header alone.

    Raises:
        IgsrError: the file is missing or not an image.
    """
    with open_image(path) as image:
        return image.size


def load_pixels(image: Image.Image, path: Path) -> None:
    """Decode the pixels of an image from ``open_image``.

    Raises:
        IgsrError: the file is truncated or damaged.
    """
    try:
        image.load()
    except Exception as error:  # as in open_image
        raise IgsrError(f"{path} is truncated or damaged; copy it again") from error


def _eight_bit(image: Image.Image, path: Path) -> Image.Image:
    """A 16-bit gray image in 8 bits; any other image as it is."""
    if image.mode.startswith("I"):
        gray = np.asarray(image)
        if gray.min() < 0 or gray.max() > 65535:
            raise IgsrError(f"{path} has 32-bit pixels; save it with 8 or 16 bits")
        return Image.fromarray(np.rint(gray / 257.0).astype(np.uint8))
    if image.mode == "F":
        raise IgsrError(f"{path} has floating-point pixels; save it with 8 or 16 bits")
    return image


def decoded(
    image: Image.Image,
    path: Path,
    size: tuple[int, int] | None = None,
    mask: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray | None]:
    """Decode an image from ``open_image``, as stored: its EXIF orientation is not applied.

    Palettes, grays, 16 bits, CMYK and the like are converted. A JPEG that is to become much smaller
    is decoded at a half, a quarter or an eighth of its size, as long as that is at least twice the
    wanted one, and an area filter does the rest.

    Args:
        image: whose pixels are not decoded yet.
        path: of its file, for error messages.
        size: width and height to reduce it to, or None.
        mask: bool [H, W] of its pixels: masked ones lend no color to the smaller photo.

    Returns:
        uint8 [h, w, 3] RGB, or [h, w, 4] with straight alpha if the file has transparency, and the
        mask at that size.

    Raises:
        IgsrError: the file is truncated or damaged, or has pixels of an unsupported kind.
    """
    box = None
    if size is not None and size != image.size and mask is None:
        full = image.size
        drafted = image.draft(None, (2 * size[0], 2 * size[1]))
        if drafted is not None and image.size != full:
            box = drafted[1][2], drafted[1][3]  # its last row and column may lie partly beyond
    load_pixels(image, path)
    if size is None or size == image.size:
        return pixels_of(image, path), mask
    return area_means(_ImageRows(image, path), *size, mask, box)


class _ImageRows:
    """Pixels of a decoded image, made an array a few rows at a time: it is never held twice."""

    def __init__(self, image: Image.Image, path: Path) -> None:
        self._image, self._path = image, path
        self.shape = (image.height, image.width, 4 if _has_alpha(image) else 3)

    def __getitem__(self, rows: slice, /) -> np.ndarray:
        box = (0, rows.start, self._image.width, min(rows.stop, self._image.height))
        return pixels_of(self._image.crop(box), self._path)


def _has_alpha(image: Image.Image) -> bool:
    return "transparency" in image.info or image.mode in ("RGBA", "LA", "PA", "RGBa", "La")


def pixels_of(image: Image.Image, path: Path) -> np.ndarray:
    """A decoded image as uint8 [H, W, 3] RGB, or [H, W, 4] with straight alpha if it has alpha.

    Raises:
        IgsrError: the kind of its pixels is not supported.
    """
    image = _eight_bit(image, path)
    mode = "RGBA" if _has_alpha(image) else "RGB"
    if image.mode == "La":
        image = image.convert("LA")
    try:
        return np.array(image if image.mode == mode else image.convert(mode))
    except Exception as error:
        raise IgsrError(
            f"{path} has pixels of the unsupported kind {image.mode}; save it as RGB or RGBA"
        ) from error


def mask_of(image: Image.Image, path: Path) -> np.ndarray:
    """A decoded image as a mask, bool [H, W], True where it is brighter than half of its brightest.

    So masks of 0 and 1 mean the same as masks of 0 and 255.

    Raises:
        IgsrError: the kind of its pixels is not supported.
    """
    image = _eight_bit(image, path)
    try:
        # convert("L") of transparent images keeps the gray and drops the alpha.
        gray = np.array(image.convert("L")).astype(np.int32)
    except Exception as error:
        raise IgsrError(f"{path} has pixels of the unsupported kind {image.mode}") from error
    return 2 * gray > max(int(gray.max()), 1)


class _Undistorters:
    """One resampling map per distinct camera, freed after its last photo: a map is larger."""

    def __init__(self, shots: list[Shot], cameras: list[Camera]) -> None:
        self._maps: dict[object, Undistorter] = {}
        pairs = zip(shots, cameras, strict=True)
        self._uses = Counter(
            self._key(shot, camera) for shot, camera in pairs if not shot.lens.is_pinhole
        )
        # A lock for each camera, so that different cameras are mapped side by side.
        self._locks = {key: threading.Lock() for key in self._uses}

    @staticmethod
    def _key(shot: Shot, camera: Camera) -> object:
        return shot.lens, camera.K.tobytes(), camera.width, camera.height

    def take(self, shot: Shot, camera: Camera) -> Undistorter:
        key = self._key(shot, camera)
        with self._locks[key]:
            if key not in self._maps:
                try:
                    self._maps[key] = Undistorter(shot.lens, camera.K, camera.width, camera.height)
                except IgsrError as error:
                    raise IgsrError(f"{shot.source}: the camera of {shot.name}: {error}") from error
            undistorter = self._maps[key]
            self._uses[key] -= 1
            if self._uses[key] == 0:
                del self._maps[key]
        return undistorter


def _refuse_duplicates(shots: list[Shot]) -> None:
    source_from_name: dict[str, Path] = {}
    for shot in shots:
        if shot.name in source_from_name:
            sources = dict.fromkeys([source_from_name[shot.name].name, shot.source.name])
            raise IgsrError(
                f"{shot.source.parent} has two cameras for the image {shot.name} "
                f"({' and '.join(sources)}); remove one"
            )
        source_from_name[shot.name] = shot.source


@dataclass(frozen=True)
class PhotoHeader:
    """What the file of a photo says before it is decoded.

    Attributes:
        size: width and height, pixels, as stored.
        channels: 3, or 4 with alpha.
    """

    size: tuple[int, int]
    channels: int


def photo_header(path: Path) -> PhotoHeader:
    """Read the header of a photo.

    Raises:
        IgsrError: as ``open_image``.
    """
    with open_image(path) as image:
        return PhotoHeader(image.size, 4 if _has_alpha(image) else 3)


def checked_headers(shots: list[Shot]) -> list[PhotoHeader]:
    """Read the headers of all photos of a capture, and check their sizes against their cameras.

    Raises:
        IgsrError: two photos have one name, one cannot be read, or has another size.
    """
    _refuse_duplicates(shots)
    headers = []
    for shot in shots:
        header = photo_header(shot.path)
        _check_size(shot.path, header.size, shot, "image")
        headers.append(header)
    return headers


def loaded_sizes(shots: list[Shot], headers: list[PhotoHeader]) -> list[tuple[int, int]]:
    """Width and height in pixels of each view before it is reduced."""
    return [
        header.size if shot.rig is None else (shot.camera.width, shot.camera.height)
        for shot, header in zip(shots, headers, strict=True)
    ]


def _check_size(path: Path, size: tuple[int, int], shot: Shot, what: str) -> None:
    """Check a photo's or mask's size against its camera."""
    wanted = shot.photo_size
    if size == wanted and (shot.factor == 1 or what == "mask"):
        return
    # Programs round the size of a reduced photo up, down or to the nearest.
    near = all(abs(one - full / shot.factor) <= 1.0 for one, full in zip(size, wanted, strict=True))
    if shot.factor > 1 and near:
        return
    is_turned = what == "image" and shot.factor == 1 and size == wanted[::-1]
    turned = " (an EXIF orientation is never applied)" if is_turned else ""
    reduced = "" if shot.factor == 1 else f", and {path.parent.name} says 1/{shot.factor} of it"
    raise IgsrError(
        f"{path} is {size[0]}x{size[1]} pixels but its camera in {shot.source.name} "
        f"is {wanted[0]}x{wanted[1]}{reduced}{turned}; resize the {what} or correct the camera"
    )


def load_views(
    shots: list[Shot], headers: list[PhotoHeader], max_size: int | None = None
) -> list[View]:
    """Load all photos of a capture on all cores, in the order given.

    Args:
        shots: the photos.
        headers: of their files, from ``checked_headers``.
        max_size: longest side in pixels of photos as loaded; larger ones are reduced. None keeps
            all as they are.

    Raises:
        IgsrError: a photo cannot be used; of several, the message is about the first.
    """
    plain = [(s, h) for s, h in zip(shots, headers, strict=True) if s.rig is None]
    cameras = {
        shot.name: resized_camera(shot.camera, *reduced_size(*header.size, max_size))
        for shot, header in plain
    }
    undistorters = _Undistorters([shot for shot, _ in plain], list(cameras.values()))

    def load(group: list[Shot], header: PhotoHeader) -> list[View]:
        shot, rig = group[0], group[0].rig
        if rig is None:
            size = cameras[shot.name].width, cameras[shot.name].height
        else:
            size = _sampled_size(rig, header.size, max_size)
        with open_image(shot.path) as opened:
            if opened.size != header.size:
                raise IgsrError(f"{shot.path} was changed while it was read; try again")
            mask = _mask(shot, header.size)
            image, mask = decoded(opened, shot.path, size, mask)
            light = read_exif(opened).exposure_value
        if rig is not None:
            return _rig_views(group, rig, image, mask, max_size, light)
        camera = cameras[shot.name]
        if not shot.lens.is_pinhole:
            undistorter = undistorters.take(shot, camera)
            image = undistorter.image(image)
            mask = undistorter.valid.copy() if mask is None else undistorter.mask(mask)
            if mask.all():
                mask = None
        view = View(shot.name, camera, shot.split, image, mask, exposure_value=light)
        depth = _depth(shot, camera)
        if depth is not None and not shot.lens.is_pinhole:
            depth = undistorters.take(shot, camera).nearest(depth)
        return [replace(view, rig=shot.photo, depth=depth)]

    # The views of a wide photo come from one decoding of it.
    groups: dict[str, tuple[list[Shot], PhotoHeader]] = {}
    for shot, header in zip(shots, headers, strict=True):
        key = shot.name if shot.rig is None else photo_of(shot)
        groups.setdefault(key, ([], header))[0].append(shot)
    threads = decoding_threads(
        loaded_sizes(shots, headers),
        max_size,
        channels=max((header.channels for header in headers), default=3),
        decoded=[header.size for header in headers],
    )
    with ThreadPoolExecutor(max_workers=threads) as pool:
        futures = [pool.submit(load, *group) for group in groups.values()]
        try:
            return [view for future in futures for view in future.result()]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _sampled_size(rig: Rig, size: tuple[int, int], max_size: int | None) -> tuple[int, int]:
    """The size at which a wide photo is decoded, whose file has ``size`` pixels."""
    wanted = sides_at(rig, max_size)[1]
    return min(size[0], wanted[0]), min(size[1], wanted[1])


def _rig_views(
    shots: list[Shot],
    rig: Rig,
    image: np.ndarray,
    mask: np.ndarray | None,
    max_size: int | None,
    light: float | None,
) -> list[View]:
    """The views of a wide photo."""
    sampled = sampled_views(rig, image, shown_part(rig, image, mask), max_size)
    views = []
    for shot in shots:
        camera, pixels, shown = sampled[shot.side]
        if shown is not None and shown.mean() < LEAST_SHOWN:
            continue  # all masked, or beyond the circle that the lens shows
        camera = replace(camera, viewmat=shot.camera.viewmat)
        views.append(
            View(
                shot.name,
                camera,
                shot.split,
                pixels,
                shown,
                exposure_value=light,
                rig=shot.photo,
            )
        )
    return views


def _depth(shot: Shot, camera: Camera) -> np.ndarray | None:
    """The depth of a photo [H, W] in the camera's pixels, each that of the file's pixel there."""
    if shot.depth_path is None:
        return None
    if holds_array(shot.depth_path):
        stored = depth_array(shot.depth_path)
    else:
        with open_image(shot.depth_path) as opened:
            load_pixels(opened, shot.depth_path)
            stored = depth_of(opened, shot.depth_path)
    depth = in_world_units(stored, shot.depth_unit)
    height, width = depth.shape
    # Depth cameras have fewer pixels than photos, but see as much.
    whole = shot.camera
    apart = abs(width * whole.height - height * whole.width)
    rounding = max(whole.width, whole.height)
    if apart > max(DEPTH_ASPECT * height * whole.width, rounding):
        raise IgsrError(
            f"{shot.depth_path} is {width}x{height} pixels but its photo {whole.width}x"
            f"{whole.height}, of another shape; give depth of the whole photo"
        )
    return resampled_plane(depth, camera.width, camera.height)


def _mask(shot: Shot, size: tuple[int, int]) -> np.ndarray | None:
    """The mask of a photo in the photo's pixels; one of the camera's size is brought to them."""
    if shot.mask_path is None:
        return None
    with open_image(shot.mask_path) as opened:
        _check_size(shot.mask_path, opened.size, shot, "mask")
        load_pixels(opened, shot.mask_path)
        mask = mask_of(opened, shot.mask_path)
    if (mask.shape[1], mask.shape[0]) == size:
        return mask
    if mask.shape[1] < size[0] or mask.shape[0] < size[1]:
        raise IgsrError(
            f"{shot.mask_path} is {mask.shape[1]}x{mask.shape[0]} pixels but its photo is "
            f"{size[0]}x{size[1]}; resize the mask"
        )
    # The smaller photo mixes what the mask tells apart: a pixel counts if all under it do.
    return plane_area_means(mask, *size) > 1.0 - 1e-6
