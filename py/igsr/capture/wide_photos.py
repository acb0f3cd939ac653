"""Photos that no single pinhole can show: 360° panoramas, and fisheye lenses of more than 120°.

Each class maps directions to pixels of the photo. The frame is the camera's: x right, y down, z
forward, towards the middle of a panorama.

A photo is a panorama if its XMP declares it (Google's GPano, which cameras and stitchers write), or
if it is exactly twice as wide as high, its left edge continues the right one, and at least one pole
looks like a single point. The edges are compared by their detail: a sky over a lawn, or a plain
ground, looks alike at both edges of any picture.

Source: https://developers.google.com/streetview/spherical-metadata. XMP is untrusted: it is
searched for a few fields, never parsed as XML, and impossible numbers count as missing.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr.capture.downscaling import plane_area_means
from igsr.capture.image_files import decoded, open_image
from igsr.capture.sharpness import row_means
from igsr.capture.undistort import Lens
from igsr.errors import IgsrError

Float64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

#: Fisheye photos up to this field of view, along the wider side, become one pinhole photo: at such
#: an edge, a pixel has become four.
MAX_PINHOLE_DEGREES = 120.0
#: Sides of the corner squares that must be black for a lit circle, as a part of the photo's side.
_CORNER_PART = 1 / 32
#: Highest level of a black pixel, of 255.
_BLACK_LEVEL = 16
#: A ring around the middle is lit if more than this part of it is not black.
_MIN_LIT_PART = 0.2
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


@dataclass(frozen=True)
class Equirectangular:
    """A panorama whose columns are longitudes and whose rows are latitudes.

    Attributes:
        width, height: of the photo, pixels.
        full_width, full_height: of the whole sphere at that scale, pixels.
        left, top: offset of the photo on the sphere, pixels; the sphere's middle looks forward.
    """

    width: int
    height: int
    full_width: float
    full_height: float
    left: float = 0.0
    top: float = 0.0

    @staticmethod
    def whole(width: int, height: int) -> Equirectangular:
        """Return a photo of all directions."""
        return Equirectangular(width, height, float(width), float(height))

    @property
    def wraps(self) -> bool:
        """Whether the right edge continues at the left one."""
        return self.full_width == self.width

    @property
    def pixels_per_radian(self) -> float:
        """Resolution in the middle of the photo."""
        return max(self.full_width / (2.0 * math.pi), self.full_height / math.pi)

    def places(self, directions: Float64) -> tuple[Float64, Float64, Bool]:
        """Project directions [..., 3] of any length.

        Returns:
            Pixels u and v [...] (centers at +0.5), and whether they are within the photo.
        """
        x, y, z = np.moveaxis(directions, -1, 0)
        u = (np.arctan2(x, z) / (2.0 * math.pi) + 0.5) * self.full_width - self.left
        if not self.wraps:
            # A partial panorama may cross the edge of the sphere.
            u = np.where(u < 0.0, u + self.full_width, u)
        latitude = np.arctan2(y, np.hypot(x, z))
        v = (latitude / math.pi + 0.5) * self.full_height - self.top
        rounding = 1e-9 * self.full_width
        valid = (u >= -rounding) & (u <= self.width + rounding)
        valid &= (v >= -rounding) & (v <= self.height + rounding)
        return u, v, valid

    def resized(self, width: int, height: int) -> Equirectangular:
        """Return the same photo at another size."""
        across, down = width / self.width, height / self.height
        return Equirectangular(
            width,
            height,
            float(width) if self.wraps else self.full_width * across,
            self.full_height * down,
            self.left * across,
            self.top * down,
        )


@dataclass(frozen=True)
class WideFisheye:
    """A fisheye photo that shows more than a pinhole can.

    Attributes:
        width, height: pixels.
        fx, fy, cx, cy: pixels.
        lens: its distortion.
        radius: of the image circle around cx, cy, pixels.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    lens: Lens
    radius: float = math.inf
    wraps: ClassVar[bool] = False

    @property
    def pixels_per_radian(self) -> float:
        """Resolution on the axis."""
        return max(self.fx, self.fy)

    def places(self, directions: Float64) -> tuple[Float64, Float64, Bool]:
        """Project directions; see ``Equirectangular.places``."""
        x, y, valid = self.lens.fisheye_places(directions)
        with np.errstate(all="ignore"):
            u, v = self.fx * x + self.cx, self.fy * y + self.cy
            valid = valid & (u >= 0.0) & (u <= self.width) & (v >= 0.0) & (v <= self.height)
            valid &= np.hypot(u - self.cx, v - self.cy) <= self.radius
        return u, v, valid

    def resized(self, width: int, height: int) -> WideFisheye:
        """Return the same photo at another size."""
        across, down = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * across,
            fy=self.fy * down,
            cx=self.cx * across,
            cy=self.cy * down,
            radius=self.radius * min(across, down),
        )


#: A photo that becomes a rig of pinhole views.
WidePhoto = Equirectangular | WideFisheye


def wide_fisheye(
    K: Float64, lens: Lens, width: int, height: int, radius: float = math.inf
) -> WideFisheye | None:
    """Return a fisheye photo that is too wide for one pinhole; None for any other photo."""
    if not lens.fisheye:
        return None
    fx, fy, cx, cy = (float(K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    photo = WideFisheye(width, height, fx, fy, cx, cy, lens, radius)
    return photo if field_of_view(photo) > MAX_PINHOLE_DEGREES else None


def field_of_view(photo: WideFisheye) -> float:
    """Return the degrees that a fisheye photo shows across or down, whichever is more."""
    angles = np.radians(np.arange(0.0, 180.0, 0.25))
    zero, along, ahead = np.zeros_like(angles), np.sin(angles), np.cos(angles)
    widest = 0.0
    for x, y in ((along, zero), (zero, along)):
        degrees = 0.0
        for sign in (1.0, -1.0):
            # Up to the angle at which the ray first leaves the photo.
            valid = photo.places(np.stack([sign * x, sign * y, ahead], axis=-1))[2]
            degrees += 0.25 * (int(valid.argmin()) if not valid.all() else len(valid))
        widest = max(widest, degrees)
    return widest


def lit_circle(image: npt.NDArray[np.uint8], photo: WideFisheye) -> Bool | None:
    """Find the lit circle of a fisheye photo, bool [H, W]; None unless its corners are black.

    ``image`` is uint8 [H, W, 3 or 4], ``photo`` has its size.
    """
    height, width = image.shape[:2]
    is_lit = image[..., :3].max(axis=2) > _BLACK_LEVEL
    corner = max(1, int(min(height, width) * _CORNER_PART))
    for rows in (slice(0, corner), slice(height - corner, height)):
        for columns in (slice(0, corner), slice(width - corner, width)):
            if is_lit[rows, columns].any():
                return None
    y, x = np.ogrid[:height, :width]
    distance = np.hypot(x + 0.5 - photo.cx, y + 0.5 - photo.cy)
    ring = distance.astype(np.int64).ravel()
    lit_part = np.bincount(ring, is_lit.ravel()) / np.maximum(np.bincount(ring), 1)
    shown = np.flatnonzero(lit_part > _MIN_LIT_PART)
    # The last ring is half dark.
    return None if not len(shown) else np.asarray(distance < max(0, int(shown[-1]) - 1))


def whole_sphere(width: int, height: int) -> Equirectangular:
    """Return a panorama of all directions; a size that is not twice as wide is an IgsrError."""
    if width != 2 * height:
        raise IgsrError(
            f"an equirectangular camera of {width}x{height} pixels is not twice as wide as it is "
            "high; give the whole panorama"
        )
    return Equirectangular.whole(width, height)


def panorama_of(path: Path) -> Equirectangular | None:
    """Recognize a panorama that is stored upright; None for any other photo.

    The header is read, and pixels only of photos that are twice as wide as high.
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

    The photo, of a size in pixels, may have been resized since the XMP was written.
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
    """Return whether a picture, uint8 [H, 2 H, 3 or 4], looks like a panorama; see the module."""
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
