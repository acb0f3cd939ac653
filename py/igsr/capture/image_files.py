"""Open and decode the files of photos, masks and depths, which are untrusted."""

from __future__ import annotations

import os
import posixpath
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
import numpy.typing as npt
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from igsr import _core
from igsr._internal.input_files import open_file
from igsr._internal.untrusted_npz import DAMAGE, stored_array
from igsr.capture.downscaling import area_means
from igsr.errors import IgsrError

Numbers = npt.NDArray[Any]

SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".mpo", ".webp", ".tif", ".tiff"),
    *(".bmp", ".ppm", ".gif", ".heic", ".heif", ".avif"),
)

# Pillow reads more formats, but runs another program for some of them (EPS).
_FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "PPM", "GIF")

# A file that claims more is a decompression bomb or damaged.
_MAX_PIXELS_PER_BYTE = 10_000

#: Folder of depths, for cameras that do not name their depth files.
DEPTHS = "depths"
_DEPTH_SUFFIXES = (".npy", ".exr", ".png", ".tif", ".tiff")
#: Pixels that a depth may have even if its photo has fewer.
MAX_FREE_DEPTH = 1 << 22
# World units of a whole number, unless a capture gives them: depth cameras write millimeters.
_WHOLE_NUMBER_UNIT = 1e-3
# Depths outside these limits count as unknown; products with them would overflow float32.
_MIN_DEPTH = 1e-20
_MAX_DEPTH = 1e20


class _LimitedFile:
    """A file from which at most twice its bytes are read.

    Thousands of fields of EXIF or TIFF could otherwise copy the same bytes.
    """

    def __init__(self, file: IO[bytes]) -> None:
        here = file.tell()
        self._file, self._left = file, 2 * file.seek(0, os.SEEK_END)
        file.seek(here)

    def read(self, size: int) -> bytes:
        self._left -= size
        if self._left < 0:
            raise OSError("fields overlap")
        return self._file.read(size)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


_load_directory = ImageFileDirectory_v2.load


def _load_limited(directory: ImageFileDirectory_v2, file: IO[bytes]) -> None:
    _load_directory(directory, cast(IO[bytes], _LimitedFile(file)))


# Pillow reads the fields while it opens JPEG and TIFF, before they could be checked.
ImageFileDirectory_v2.load = _load_limited  # type: ignore[assignment]


def is_file(path: Path) -> bool:
    """Return whether the path is a file; False for impossible paths (an embedded NUL)."""
    try:
        return path.is_file()
    except (ValueError, OSError):
        return False


def open_image(path: Path) -> Image.Image:
    """Open an image without decoding its pixels.

    Raises:
        IgsrError: the file is missing, has an unsupported format, or claims more pixels than its
            bytes can hold.
    """
    try:
        file_size = path.stat().st_size
        image = Image.open(path, formats=_formats(path))
    except FileNotFoundError as error:
        raise IgsrError(f"{path} does not exist; put the image there") from error
    except Image.DecompressionBombError as error:
        raise IgsrError(f"{path} claims too many pixels for a photo; shrink it") from error
    except Exception as error:  # Pillow's plugins raise anything at all on broken files.
        raise IgsrError(
            f"{path} cannot be read as an image; save it as PNG, JPEG, WebP or TIFF again"
        ) from error
    if image.width * image.height > file_size * _MAX_PIXELS_PER_BYTE:
        image.close()
        raise IgsrError(
            f"{path} claims {image.width}x{image.height} pixels but has only {file_size} bytes; "
            "save it again"
        )
    return image


def _formats(path: Path) -> tuple[str, ...]:
    """The formats that a file may have by its first bytes; phones name JPEGs .heic."""
    with open_file(path) as file:
        head = file.read(12)
    if head[4:8] != b"ftyp":
        return _FORMATS
    if head[8:12] in (b"avif", b"avis"):
        return ("AVIF",)
    # Imported here because it loads an HEVC decoder, which few captures need.
    import pillow_heif

    pillow_heif.register_heif_opener()
    return ("HEIF",)


@dataclass(frozen=True)
class PhotoHeader:
    """Width and height of a photo in pixels as stored, and channels: 3, or 4 with alpha."""

    size: tuple[int, int]
    channels: int


def photo_header(path: Path) -> PhotoHeader:
    """Read the header of a photo; raises as ``open_image``."""
    with open_image(path) as image:
        return PhotoHeader(image.size, 4 if _has_alpha(image) else 3)


def load_pixels(image: Image.Image, path: Path) -> None:
    """Decode the pixels of an image from ``open_image``; damage is an IgsrError."""
    try:
        image.load()
    except Exception as error:  # as in open_image
        raise IgsrError(f"{path} is truncated or damaged; copy it again") from error


def decoded(
    image: Image.Image,
    path: Path,
    size: tuple[int, int] | None = None,
    mask: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray | None]:
    """Decode an image from ``open_image`` as stored: its EXIF orientation is not applied.

    Palettes, grays, 16 bits, CMYK and the like are converted. To reduce a JPEG by more than 2, it
    is decoded at a half, a quarter or an eighth of its size, at least twice the wanted size, and
    then reduced by an area filter.

    Args:
        image: its pixels are not decoded yet.
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
            box = drafted[1][2], drafted[1][3]  # the last row and column may be partly outside
    load_pixels(image, path)
    if size is None or size == image.size:
        return _pixels(image, path), mask
    return area_means(_ImageRows(image, path), *size, mask, box)


class _ImageRows:
    """Pixels of a decoded image, converted a few rows at a time to save memory."""

    def __init__(self, image: Image.Image, path: Path) -> None:
        self._image, self._path = image, path
        self.shape = (image.height, image.width, 4 if _has_alpha(image) else 3)

    def __getitem__(self, rows: slice, /) -> np.ndarray:
        box = (0, rows.start, self._image.width, min(rows.stop, self._image.height))
        return _pixels(self._image.crop(box), self._path)


def _has_alpha(image: Image.Image) -> bool:
    return "transparency" in image.info or image.mode in ("RGBA", "LA", "PA", "RGBa", "La")


def _pixels(image: Image.Image, path: Path) -> np.ndarray:
    """A decoded image as uint8 [H, W, 3] RGB, or [H, W, 4] with straight alpha if it has alpha."""
    image = _eight_bit(image, path)
    mode = "RGBA" if _has_alpha(image) else "RGB"
    if image.mode == "La":
        image = image.convert("LA")
    return np.array(image if image.mode == mode else _converted(image, path, mode))


def mask_of(image: Image.Image, path: Path) -> np.ndarray:
    """Decode an image from ``open_image`` as a mask, bool [H, W].

    It is True for pixels brighter than half of the brightest, so that masks of 0 and 1 mean the
    same as masks of 0 and 255.
    """
    load_pixels(image, path)
    # convert("L") of transparent images keeps the gray and drops the alpha.
    gray = np.array(_converted(_eight_bit(image, path), path, "L")).astype(np.int32)
    return 2 * gray > max(int(gray.max()), 1)


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


def _converted(image: Image.Image, path: Path, mode: str) -> Image.Image:
    try:
        return image.convert(mode)
    except Exception as error:
        raise IgsrError(
            f"{path} has pixels of the unsupported kind {image.mode}; save it as RGB or RGBA"
        ) from error


def find_depth(folder: Path, name: str) -> Path | None:
    """Return a photo's depth file: its name, with or without suffix, and a suffix of depth."""
    stems = (name, posixpath.splitext(name)[0])
    files = (folder / f"{stem}{suffix}" for stem in stems for suffix in _DEPTH_SUFFIXES)
    return next(filter(is_file, files), None)


def write_depth(path: Path, depth: Numbers) -> None:
    """Write depth [h, w] in world units as float32 ``.npy``; a missing folder is created."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, depth.astype(np.float32), allow_pickle=False)


def read_depth(path: Path, unit: float | None, photo: tuple[int, int]) -> npt.NDArray[np.float32]:
    """Read a depth file.

    Args:
        path: an ``.npy``, an OpenEXR (channel Z, or else its only one), a 16-bit picture or a
            32-bit float TIFF. 0, negative and non-finite numbers mean that the depth is unknown.
        unit: world units of one number in the file; None is 0.001 for whole numbers and 1 for
            floats.
        photo: width and height of the photo. Depth cameras have fewer pixels.

    Returns:
        Camera-space z [h, w] in world units, 0 for unknown depths.

    Raises:
        IgsrError: the file cannot be read, holds something else, or has more pixels than the photo
            and ``MAX_FREE_DEPTH``.
    """
    suffix = path.suffix.lower()
    read = _npy if suffix == ".npy" else _exr if suffix == ".exr" else _picture
    stored = read(path, max(photo[0] * photo[1], MAX_FREE_DEPTH))
    if unit is None:
        unit = _WHOLE_NUMBER_UNIT if np.issubdtype(stored.dtype, np.integer) else 1.0
    depth = np.zeros(stored.shape, np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for row, numbers in zip(depth, stored, strict=True):  # by rows, to save memory
            exact = numbers.astype(np.float64) * unit
            is_known = (exact > _MIN_DEPTH) & (exact < _MAX_DEPTH)
            row[is_known] = exact[is_known]
    return depth


def _picture(path: Path, most: int) -> Numbers:
    with open_image(path) as image:
        pixels = image.width * image.height
        if pixels > most:
            raise IgsrError(f"{path} has {pixels} pixels, more than its photo; give smaller depth")
        load_pixels(image, path)
        if image.mode not in ("I", "I;16", "I;16B", "F"):
            raise IgsrError(
                f"{path} is an 8-bit picture, which cannot hold depth; give a 16-bit PNG, .npy or "
                "EXR"
            )
        return np.array(image)


def _exr(path: Path, most: int) -> Numbers:
    try:
        return _core.read_exr_depth(str(path), most)
    except (OSError, ValueError) as error:
        raise IgsrError(f"{path} cannot be read as depth: {error}") from error


def _npy(path: Path, most: int) -> Numbers:
    try:
        stored = stored_array(path, most)
    except DAMAGE as error:
        raise IgsrError(f"{path} cannot be read as depth: {error}") from error
    if stored.dtype.kind not in "uif":
        raise IgsrError(f"{path} holds no numbers; give depth as a .npy array of [H, W]")
    if stored.ndim == 3 and 1 in (stored.shape[0], stored.shape[2]):
        stored = stored[0] if stored.shape[0] == 1 else stored[..., 0]
    if stored.ndim != 2 or 0 in stored.shape:
        raise IgsrError(f"{path} has shape {list(stored.shape)}; give depth as [H, W]")
    return stored
