"""Read the EXIF of a photo: orientation, focal length, camera and exposure.

EXIF is untrusted and often wrong or damaged: a field that cannot be read counts as missing.

Sources: Exif 2.32 (CIPA DC-008); 35 mm equivalents refer to the diagonal of the picture, 43.27 mm
on film (CIPA DCG-001).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

_ORIENTATION, _MAKE, _MODEL, _SUB_FOLDER = 0x0112, 0x010F, 0x0110, 0x8769
_FOCAL_LENGTH, _FOCAL_LENGTH_35MM, _LENS_MODEL = 0x920A, 0xA405, 0xA434
_PIXEL_WIDTH, _PLANE_RESOLUTION, _PLANE_UNIT = 0xA002, 0xA20E, 0xA210
_USER_COMMENT = 0x9286
_EXPOSURE_TIME, _F_NUMBER, _ISO = 0x829A, 0x829D, 0x8827
_MM_FROM_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
#: JPEG files hold at most 64 kB; Pillow makes objects of all values.
_MAX_EXIF_BYTES = 1 << 20
#: Orientations that exchange width and height.
TURNED = (5, 6, 7, 8)
_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
# Plausible values: focal lengths in units of the longer side, from fisheyes to telescopes ...
_FOCAL_RANGE = (0.2, 50.0)
# ... and seconds, f-numbers and ISO speeds.
_EXPOSURE_RANGES = {_EXPOSURE_TIME: (1e-6, 3600.0), _F_NUMBER: (0.5, 128.0), _ISO: (1.0, 5e6)}


@dataclass(frozen=True)
class Exif:
    """The EXIF fields of a photo that igsr uses.

    Attributes:
        orientation: 1 to 8, as in EXIF; 1 is upright.
        focal: focal length in pixels of the photo as stored, or None.
        device: make, model and lens of the camera, or None.
        exposure_value: exposure in stops: log2(seconds * ISO / 100 / f-number squared), from
            exposure time, f-number and ISO (Exif 2.32, section 4.6.5). Of two photos of one place,
            the one with the larger value is brighter. None if a field is missing or implausible.
        screenshot: whether the comment marks a screenshot, as phones write it.
    """

    orientation: int
    focal: float | None
    device: str | None
    exposure_value: float | None
    screenshot: bool = False


def read_exif(image: Image.Image) -> Exif:
    """Read the EXIF of an open image; its pixels need not be decoded."""
    try:
        if len(image.info.get("exif", b"")) > _MAX_EXIF_BYTES:
            raise ValueError("EXIF is too large")
        fields = dict(image.getexif())
        fields.update(image.getexif().get_ifd(_SUB_FOLDER))
    except Exception:  # Pillow raises anything at all on broken EXIF
        fields = {}
    orientation = fields.get(_ORIENTATION)
    if not isinstance(orientation, int) or not 1 <= orientation <= 8:
        orientation = 1
    names = [_text(fields.get(tag)) for tag in (_MAKE, _MODEL, _LENS_MODEL)]
    device = " ".join(name for name in names if name) or None
    comment = fields.get(_USER_COMMENT)
    # The first eight bytes name the encoding.
    text = comment[8:].decode("ascii", "replace") if isinstance(comment, bytes) else _text(comment)
    screenshot = text.strip(" \0").lower() == "screenshot"
    focal = _focal(fields, *image.size)
    return Exif(orientation, focal, device, _exposure_value(fields), screenshot)


def _exposure_value(fields: dict[int, Any]) -> float | None:
    numbers = []
    for tag, (low, high) in _EXPOSURE_RANGES.items():
        value = fields.get(tag)
        if tag == _ISO and isinstance(value, (tuple, list)) and value:
            value = value[0]
        number = _number(value)
        if number is None or not low <= number <= high:
            return None
        numbers.append(number)
    seconds, f_number, iso = numbers
    return math.log2(seconds * iso / 100.0 / f_number**2)


def _focal(fields: dict[int, Any], width: int, height: int) -> float | None:
    longer = max(width, height)
    equivalent = _number(fields.get(_FOCAL_LENGTH_35MM))
    length, resolution = (_number(fields.get(tag)) for tag in (_FOCAL_LENGTH, _PLANE_RESOLUTION))
    if equivalent is not None:
        focal = equivalent * math.hypot(width, height) / _FILM_DIAGONAL_MM
    elif length is not None and resolution is not None:
        unit = _MM_FROM_UNIT.get(fields.get(_PLANE_UNIT, 2), 25.4)
        # The resolution is that of the original photo, before it was downscaled.
        original = _number(fields.get(_PIXEL_WIDTH)) or float(width)
        focal = length * resolution / unit * (longer / original if original >= longer else 1.0)
    else:
        return None
    return focal if _FOCAL_RANGE[0] * longer < focal < _FOCAL_RANGE[1] * longer else None


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0.0 else None


def _text(value: Any) -> str:
    if not isinstance(value, str):
        return ""
    return " ".join("".join(c if c.isprintable() else " " for c in value).split())


def upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Turn and mirror pixels [H, W, ...] by an EXIF orientation, so that the photo is upright."""
    if orientation in TURNED:
        pixels = np.swapaxes(pixels, 0, 1)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)


def turned_back(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Undo ``upright``."""
    # Quarter turns are each other's inverse; all other orientations are their own.
    return upright(pixels, {6: 8, 8: 6}.get(orientation, orientation))
