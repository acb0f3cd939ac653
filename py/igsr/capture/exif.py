"""EXIF of a photo: orientation, focal length and camera.

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
#: Orientations that exchange width and height.
TURNED = (5, 6, 7, 8)
_FILM_DIAGONAL = math.hypot(36.0, 24.0)
# In units of the longer side. Fisheyes and telescopes are within; other numbers are wrong fields.
_FOCAL_RANGE = (0.2, 50.0)
# Seconds, f-number and ISO of cameras there are; other numbers are wrong fields.
_TIMES, _F_NUMBERS, _ISOS = (1e-6, 3600.0), (0.5, 128.0), (1.0, 5e6)


@dataclass(frozen=True)
class Exif:
    """The fields of a photo's EXIF that are used.

    Attributes:
        orientation: 1 to 8, as in EXIF; 1 is upright.
        focal: focal length in pixels of the photo as stored, or None.
        device: make, model and lens of the camera, or None.
        exposure_value: how much light the photo took, in stops: log2(seconds * ISO / 100 /
            f-number squared), by exposure time, f-number and ISO (Exif 2.32, section 4.6.5). It
            compares photos of one place: a larger one is brighter there. None where a field is
            missing or cannot be true.
        screenshot: whether the comment says that it is one, as phones write it.
    """

    orientation: int
    focal: float | None
    device: str | None
    exposure_value: float | None
    screenshot: bool = False


def read_exif(image: Image.Image) -> Exif:
    """Read the EXIF of an open image; its pixels need not be decoded."""
    try:
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
    # Eight bytes that name the encoding come first.
    text = comment[8:].decode("ascii", "replace") if isinstance(comment, bytes) else _text(comment)
    screenshot = text.strip(" \0").lower() == "screenshot"
    focal, light = _focal(fields, *image.size), _exposure_value(fields)
    return Exif(orientation, focal, device, light, screenshot)


def _exposure_value(fields: dict[int, Any]) -> float | None:
    iso = fields.get(_ISO)
    if isinstance(iso, (tuple, list)) and iso:
        iso = iso[0]
    numbers = [_number(value) for value in (fields.get(_EXPOSURE_TIME), fields.get(_F_NUMBER), iso)]
    ranges = (_TIMES, _F_NUMBERS, _ISOS)
    sane = [
        number
        for number, (low, high) in zip(numbers, ranges, strict=True)
        if number is not None and low <= number <= high
    ]
    if len(sane) < len(ranges):
        return None
    seconds, f_number, speed = sane
    return math.log2(seconds * speed / 100.0 / f_number**2)


def _focal(fields: dict[int, Any], width: int, height: int) -> float | None:
    equivalent = _number(fields.get(_FOCAL_LENGTH_35MM))
    if equivalent is not None:
        return _plausible(equivalent * math.hypot(width, height) / _FILM_DIAGONAL, width, height)
    length, resolution = (_number(fields.get(tag)) for tag in (_FOCAL_LENGTH, _PLANE_RESOLUTION))
    if length is None or resolution is None:
        return None
    unit = _MM_FROM_UNIT.get(fields.get(_PLANE_UNIT, 2), 25.4)
    # The resolution refers to the photo as it was taken, before it was downscaled.
    taken = _number(fields.get(_PIXEL_WIDTH)) or float(width)
    reduced = max(width, height) / taken if taken >= max(width, height) else 1.0
    return _plausible(length * resolution / unit * reduced, width, height)


def _plausible(focal: float, width: int, height: int) -> float | None:
    low, high = (factor * max(width, height) for factor in _FOCAL_RANGE)
    return focal if low < focal < high else None


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
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in TURNED:
        pixels = np.swapaxes(pixels, 0, 1)
    return np.ascontiguousarray(pixels)
