"""Decode photos and masks, check them against their cameras, and undistort them."""

from __future__ import annotations

import os
import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from igsr._internal.choices import Split
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
    """

    name: str
    path: Path
    camera: Camera
    lens: Lens
    split: Split
    mask_path: Path | None
    source: Path


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


def _decode(path: Path, width: int, height: int, source: Path, what: str) -> Image.Image:
    with open_image(path) as image:
        if image.size != (width, height):
            turned = (
                " (an EXIF orientation is never applied)"
                if what == "image" and image.size == (height, width)
                else ""
            )
            raise IgsrError(
                f"{path} is {image.width}x{image.height} pixels but its camera in {source.name} "
                f"is {width}x{height}{turned}; resize the {what} or correct the camera"
            )
        load_pixels(image, path)
        return image


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
    """A 16-bit grey image in 8 bits; any other image as it is."""
    if image.mode.startswith("I"):
        grey = np.asarray(image)
        if grey.min() < 0 or grey.max() > 65535:
            raise IgsrError(f"{path} has 32-bit pixels; save it with 8 or 16 bits")
        return Image.fromarray(np.rint(grey / 257.0).astype(np.uint8))
    if image.mode == "F":
        raise IgsrError(f"{path} has floating-point pixels; save it with 8 or 16 bits")
    return image


def read_image(path: Path, width: int, height: int, source: Path) -> np.ndarray:
    """Read a photo's pixels as stored, without applying its EXIF orientation.

    Palettes, greys, 16 bits, CMYK and the like are converted.

    Args:
        path: the photo.
        width, height: its camera's size, pixels.
        source: the file that gave the camera, for error messages.

    Returns:
        uint8 [H, W, 3] RGB, or [H, W, 4] with straight alpha if the file has transparency.

    Raises:
        IgsrError: the file is missing, unreadable, truncated, or has another size.
    """
    return pixels_of(_decode(path, width, height, source, "image"), path)


def pixels_of(image: Image.Image, path: Path) -> np.ndarray:
    """A decoded image as uint8 [H, W, 3] RGB, or [H, W, 4] with straight alpha if it has alpha.

    Raises:
        IgsrError: the kind of its pixels is not supported.
    """
    image = _eight_bit(image, path)
    transparent = "transparency" in image.info or image.mode in ("RGBA", "LA", "PA", "RGBa", "La")
    mode = "RGBA" if transparent else "RGB"
    if image.mode == "La":
        image = image.convert("LA")
    try:
        return np.array(image if image.mode == mode else image.convert(mode))
    except Exception as error:
        raise IgsrError(
            f"{path} has pixels of the unsupported kind {image.mode}; save it as RGB or RGBA"
        ) from error


def read_mask(path: Path, width: int, height: int, source: Path) -> np.ndarray:
    """Read a mask: bool [H, W], True where it is brighter than half of its brightest pixel.

    So masks of 0 and 1 mean the same as masks of 0 and 255.

    Raises:
        IgsrError: as ``read_image``.
    """
    return mask_of(_decode(path, width, height, source, "mask"), path)


def mask_of(image: Image.Image, path: Path) -> np.ndarray:
    """A decoded image as a mask, bool [H, W]; see ``read_mask``.

    Raises:
        IgsrError: the kind of its pixels is not supported.
    """
    image = _eight_bit(image, path)
    try:
        # convert("L") of transparent images keeps the grey and drops the alpha.
        grey = np.array(image.convert("L")).astype(np.int32)
    except Exception as error:
        raise IgsrError(f"{path} has pixels of the unsupported kind {image.mode}") from error
    return 2 * grey > max(int(grey.max()), 1)


class _Undistorters:
    """One resampling map per distinct camera, freed after its last photo: a map is larger."""

    def __init__(self, shots: list[Shot]) -> None:
        self._maps: dict[object, Undistorter] = {}
        self._uses = Counter(self._key(shot) for shot in shots)
        # A lock for each camera, so that different cameras are mapped side by side.
        self._locks = {key: threading.Lock() for key in self._uses}

    @staticmethod
    def _key(shot: Shot) -> object:
        return shot.lens, shot.camera.K.tobytes(), shot.camera.width, shot.camera.height

    def take(self, shot: Shot) -> Undistorter:
        key = self._key(shot)
        with self._locks[key]:
            if key not in self._maps:
                camera = shot.camera
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


def load_views(shots: list[Shot]) -> list[View]:
    """Load all photos of a capture on all cores, in the order given.

    Raises:
        IgsrError: a photo cannot be used; of several, the message is about the first.
    """
    _refuse_duplicates(shots)
    undistorters = _Undistorters([shot for shot in shots if not shot.lens.is_pinhole])

    def load(shot: Shot) -> View:
        size = (shot.camera.width, shot.camera.height, shot.source)
        image = read_image(shot.path, *size)
        mask = read_mask(shot.mask_path, *size) if shot.mask_path is not None else None
        if not shot.lens.is_pinhole:
            undistorter = undistorters.take(shot)
            image = undistorter.image(image)
            mask = undistorter.valid.copy() if mask is None else undistorter.mask(mask)
            if mask.all():
                mask = None
        return View(shot.name, shot.camera, shot.split, image, mask)

    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        futures = [pool.submit(load, shot) for shot in shots]
        try:
            return [future.result() for future in futures]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
