"""Recognize panoramas of 360 degrees among photos.

A photo is a panorama if its XMP declares it (Google's GPano, which cameras and stitchers write), or
if it is exactly twice as wide as high, its left edge continues the right one, and at least one pole
looks like a single point. The edges are compared by their detail: a sky over a lawn, or a plain
ground, looks alike at both edges of any picture.

Source: https://developers.google.com/streetview/spherical-metadata. XMP is untrusted: it is
searched for a few fields, never parsed as XML, and impossible numbers count as missing.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr.capture.downscaling import plane_area_means
from igsr.capture.image_files import decoded, open_image
from igsr.capture.sharpness import row_means
from igsr.capture.wide_photos import Equirectangular
from igsr.errors import IgsrError

Float64 = npt.NDArray[np.float64]

#: Height of the reduced photo whose edges are compared.
_ROWS = 256
#: Detail is the difference to the mean of this many rows around.
_WINDOW_ROWS = 17
#: Minimum correlation of the detail of the two edges (that of other pictures is 0.1 in the root
#: mean square), also relative to the correlation of neighboring columns.
_MIN_CORRELATION = 0.4
_MIN_PART_OF_NEIGHBORS = 0.5
#: Minimum root mean square of detail, in levels of 255; less is noise.
_MIN_DETAIL_LEVELS = 1.0
#: Maximum difference of the edges: a multiple of the 99th percentile of the differences between
#: neighboring columns, plus levels of 255.
_MAX_JUMP_FACTOR = 1.5
_MAX_JUMP_LEVELS = 3.0
#: Maximum spread of the first or last row, which shows one direction, relative to the median row.
_MAX_POLE_SPREAD = 0.5
#: A cropped panorama that spans fewer degrees is treated as an ordinary photo.
_MIN_DEGREES = 100.0
#: Relative tolerance of aspect ratios in XMP.
_ASPECT_TOLERANCE = 0.02

_FIELD = r"GPano:{name}\s*(?:=\s*[\"']|>)\s*([A-Za-z0-9.+-]+)"
_SIZE_FIELDS = (
    "FullPanoWidthPixels",
    "FullPanoHeightPixels",
    "CroppedAreaImageWidthPixels",
    "CroppedAreaImageHeightPixels",
    "CroppedAreaLeftPixels",
    "CroppedAreaTopPixels",
)


def panorama_of(path: Path) -> Equirectangular | None:
    """Recognize a panorama that is stored upright.

    Args:
        path: a photo; its header is read, and its pixels only if it is twice as wide as high.

    Returns:
        The panorama, or None for any other photo.

    Raises:
        IgsrError: it cannot be read as an image.
    """
    with open_image(path) as image:
        size, xmp = image.size, _xmp(image)
    panorama = panorama_of_xmp(xmp, *size)
    if panorama is not None:
        return panorama
    is_other_projection = _projection(xmp) not in (None, "equirectangular")
    if size[0] != 2 * size[1] or size[1] < 64 or is_other_projection:
        return None
    try:
        with open_image(path) as image:
            small = min(_ROWS, size[1])
            pixels, _ = decoded(image, path, (2 * small, small))
    except IgsrError:
        return None  # loading reports the damage
    return Equirectangular.whole(*size) if edges_join(pixels) else None


def _xmp(image: Image.Image) -> str:
    xmp = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
    if isinstance(xmp, bytes):
        xmp = xmp.decode("utf-8", errors="replace")
    return xmp if isinstance(xmp, str) else ""


def _text(xmp: str, name: str) -> str | None:
    match = re.search(_FIELD.format(name=name), xmp)
    return None if match is None else match[1]


def _projection(xmp: str) -> str | None:
    kind = _text(xmp, "ProjectionType")
    return None if kind is None else kind.lower()


def panorama_of_xmp(xmp: str, width: int, height: int) -> Equirectangular | None:
    """Return the panorama that a photo's XMP declares, or None.

    Args:
        xmp: the whole text, or "".
        width, height: of the photo, pixels; it may have been resized since the XMP was written.
    """
    if _projection(xmp) != "equirectangular":
        return None
    whole = Equirectangular.whole(width, height) if width == 2 * height else None
    numbers = [_number(_text(xmp, name)) for name in _SIZE_FIELDS]
    if None in numbers:
        return whole
    full_width, full_height, shown_width, shown_height, left, top = (
        float(number or 0.0) for number in numbers
    )
    fits = 0.0 < shown_width <= full_width and 0.0 < shown_height <= full_height
    fits = fits and left <= full_width and top + shown_height <= full_height
    if not fits or abs(full_width / max(full_height, 1.0) - 2.0) >= _ASPECT_TOLERANCE:
        return whole
    across, down = width / shown_width, height / shown_height
    if abs(across / down - 1.0) > _ASPECT_TOLERANCE:
        return None  # cropped after the XMP was written
    if 360.0 * shown_width / full_width < _MIN_DEGREES:
        return None
    is_full_circle = shown_width == full_width
    return Equirectangular(
        width,
        height,
        float(width) if is_full_circle else full_width * across,
        full_height * down,
        0.0 if is_full_circle else left * across,
        top * down,
    )


def _number(text: str | None) -> float | None:
    try:
        number = float(text or "")
    except ValueError:
        return None
    return number if 0.0 <= number < 1e6 else None


def edges_join(image: np.ndarray) -> bool:
    """Return whether a picture looks like a panorama of 360 degrees; see the module.

    Args:
        image: uint8 [H, W, 3 or 4], twice as wide as high.
    """
    height = min(_ROWS, image.shape[0])
    gray = plane_area_means(image[..., :3].mean(axis=2), 2 * height, height)
    spread = gray.std(axis=1)
    if min(spread[0], spread[-1]) > _MAX_POLE_SPREAD * float(np.median(spread)):
        return False
    # Rows near the poles show one place, stretched over the whole width.
    rows = slice(height // 16, height - height // 16)
    detail = (gray - row_means(gray, _WINDOW_ROWS))[rows]
    edges = detail[:, :1], detail[:, -1:]
    if min(float(np.sqrt((edge**2).mean())) for edge in edges) < _MIN_DETAIL_LEVELS:
        return False
    of_neighbors = float(np.median(_correlations(detail[:, :-1], detail[:, 1:])))
    of_edges = float(_correlations(*edges)[0])
    if of_edges < max(_MIN_CORRELATION, _MIN_PART_OF_NEIGHBORS * of_neighbors):
        return False
    jump = float(np.sqrt(((gray[rows, 0] - gray[rows, -1]) ** 2).mean()))
    steps = np.sqrt((np.diff(gray[rows], axis=1) ** 2).mean(axis=0))
    return jump <= _MAX_JUMP_FACTOR * float(np.quantile(steps, 0.99)) + _MAX_JUMP_LEVELS


def _correlations(a: Float64, b: Float64) -> Float64:
    """Correlation of each two columns."""
    norms = np.sqrt((a**2).sum(axis=0) * (b**2).sum(axis=0))
    return np.asarray((a * b).sum(axis=0) / np.maximum(norms, 1e-9))
