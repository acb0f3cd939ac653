"""Recognize panoramas of 360 degrees among photos.

A photo is one if its XMP says so (Google's GPano, which cameras and stitchers write), or if it is
just twice as wide as it is high and its left edge goes on at its right one. Whether edges go on is
asked of their detail, since a sky over a lawn, or a plain ground, looks alike at both edges of any
picture. And one pole at least must look like one place.

Source: https://developers.google.com/streetview/spherical-metadata. XMP is untrusted: it is
searched for a few fields, never parsed as XML, and numbers that cannot be true count as missing.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr.capture.downscaling import plane_area_means
from igsr.capture.photos import decoded, open_image
from igsr.capture.wide_photos import Equirectangular
from igsr.errors import IgsrError

Float64 = npt.NDArray[np.float64]

#: Rows of the reduced photo that edges are compared in.
_ROWS = 256
#: Rows that detail is told from: the mean of so many around is taken away.
_AROUND = 17
#: Detail of the two edges correlates at least so much, and at least this part of what neighboring
#: columns do. Of other pictures it is 0.1 in the root mean square.
_LEAST_CORRELATION, _PART_OF_NEIGHBORS = 0.4, 0.5
#: Levels of 255 that detail has at least, in the root mean square: less is noise, and says nothing.
_LEAST_DETAIL = 1.0
#: The edges differ by no more than so many times what the most different of neighboring columns do
#: (but for one in a hundred), and so many levels.
_JUMP, _JUMP_LEVELS = 1.5, 3.0
#: The first or the last row, which is about one direction, varies by less than this part of what
#: rows do in the median.
_POLE = 0.5
#: A photo that spans fewer degrees than this has one pinhole: it is left as it is.
_LEAST_DEGREES = 100.0

_FIELD = r"GPano:{name}\s*(?:=\s*[\"']|>)\s*([A-Za-z0-9.+-]+)"


def panorama_of(path: Path) -> Equirectangular | None:
    """What a photo is a panorama of; None where it is none, or is not upright as stored.

    Args:
        path: a photo, whose header is read; its pixels too where it is twice as wide as high.

    Raises:
        IgsrError: it cannot be read as an image.
    """
    with open_image(path) as image:
        size, xmp = image.size, _xmp(image)
    told = told_by_xmp(xmp, *size)
    if told is not None:
        return told
    if size[0] != 2 * size[1] or size[1] < 64 or _says_another(xmp):
        return None
    try:
        with open_image(path) as image:
            small = min(_ROWS, size[1])
            pixels, _ = decoded(image, path, (2 * small, small))
    except IgsrError:
        return None  # it is named as damaged where it is loaded
    return Equirectangular.whole(*size) if edges_join(pixels) else None


def _xmp(image: Image.Image) -> str:
    found = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
    if isinstance(found, bytes):
        found = found.decode("utf-8", errors="replace")
    return found if isinstance(found, str) else ""


def _text(xmp: str, name: str) -> str | None:
    found = re.search(_FIELD.format(name=name), xmp)
    return None if found is None else found[1]


def _says_another(xmp: str) -> bool:
    kind = _text(xmp, "ProjectionType")
    return kind is not None and kind.lower() != "equirectangular"


def told_by_xmp(xmp: str, width: int, height: int) -> Equirectangular | None:
    """The panorama that a photo is by its XMP, or None.

    Args:
        xmp: the whole text, or "".
        width, height: of the photo, pixels; it may have been resized since the XMP was written.
    """
    if (_text(xmp, "ProjectionType") or "").lower() != "equirectangular":
        return None
    names = (
        "FullPanoWidthPixels",
        "FullPanoHeightPixels",
        "CroppedAreaImageWidthPixels",
        "CroppedAreaImageHeightPixels",
        "CroppedAreaLeftPixels",
        "CroppedAreaTopPixels",
    )
    numbers = [_number(_text(xmp, name)) for name in names]
    if any(number is None for number in numbers):
        # Without the part that is shown, it is all.
        return Equirectangular.whole(width, height) if width == 2 * height else None
    full_width, full_height, shown_width, shown_height, left, top = (
        float(number or 0.0) for number in numbers
    )
    whole = 0.0 < shown_width <= full_width and 0.0 < shown_height <= full_height
    inside = left <= full_width and top + shown_height <= full_height
    square = abs(full_width / max(full_height, 1.0) - 2.0) < 0.02
    if not (whole and inside and square):
        return Equirectangular.whole(width, height) if width == 2 * height else None
    across, down = width / shown_width, height / shown_height
    if abs(across / down - 1.0) > 0.02:
        return None  # it was cropped since
    if 360.0 * shown_width / full_width < _LEAST_DEGREES:
        return None
    everywhere = shown_width == full_width
    return Equirectangular(
        width,
        height,
        float(width) if everywhere else full_width * across,
        full_height * down,
        0.0 if everywhere else left * across,
        top * down,
    )


def _number(text: str | None) -> float | None:
    try:
        number = float(text or "")
    except ValueError:
        return None
    return number if 0.0 <= number < 1e6 else None


def edges_join(image: np.ndarray) -> bool:
    """Whether the left edge of a picture goes on at its right one; see the module.

    Args:
        image: uint8 [H, W, 3 or 4], twice as wide as high.
    """
    height = min(_ROWS, image.shape[0])
    gray = plane_area_means(image[..., :3].mean(axis=2), 2 * height, height)
    detail = gray - _around(gray)
    # Poles are one place each, stretched over the whole width.
    rows = slice(height // 16, height - height // 16)
    columns = detail[rows]
    neighbors = _correlations(columns[:, :-1], columns[:, 1:])
    spread = gray.std(axis=1)
    if min(spread[0], spread[-1]) > _POLE * float(np.median(spread)):
        return False
    edge = columns[:, :1], columns[:, -1:]
    if min(float(np.sqrt((side**2).mean())) for side in edge) < _LEAST_DETAIL:
        return False
    joined = float(_correlations(*edge)[0])
    if joined < max(_LEAST_CORRELATION, _PART_OF_NEIGHBORS * float(np.median(neighbors))):
        return False
    jump = float(np.sqrt(((gray[rows, 0] - gray[rows, -1]) ** 2).mean()))
    apart = np.sqrt((np.diff(gray[rows], axis=1) ** 2).mean(axis=0))
    return jump <= _JUMP * float(np.quantile(apart, 0.99)) + _JUMP_LEVELS


def _around(gray: Float64) -> Float64:
    """The mean of ``_AROUND`` rows around each pixel."""
    half = _AROUND // 2
    padded = np.pad(gray, ((half + 1, half), (0, 0)), mode="edge")
    sums = padded.cumsum(axis=0)
    return np.asarray((sums[_AROUND:] - sums[:-_AROUND]) / _AROUND)


def _correlations(a: Float64, b: Float64) -> Float64:
    """Of each two columns."""
    norms = np.sqrt((a**2).sum(axis=0) * (b**2).sum(axis=0))
    return np.asarray((a * b).sum(axis=0) / np.maximum(norms, 1e-9))
