"""Photos that no single pinhole can show: 360° panoramas, and fisheye lenses of more than 120°.

Each class maps directions to pixels of the photo. The frame is the camera's: x right, y down, z
forward, towards the middle of a panorama.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

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
        """Project directions.

        Args:
            directions: [..., 3], of any length.

        Returns:
            u, v: [...], pixels (centers at +0.5).
            valid: whether that is within the photo.
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

    @property
    def wraps(self) -> bool:
        """Whether the right edge continues at the left one."""
        return False

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
    """Return a fisheye photo that is too wide for one pinhole; None for any other photo.

    Args:
        K: [3, 3], pixels.
        lens: of any kind.
        width, height: pixels.
        radius: as ``WideFisheye.radius``.
    """
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
    """Find the lit circle of a fisheye photo with black corners.

    Args:
        image: uint8 [H, W, 3 or 4].
        photo: the photo, at the image's size.

    Returns:
        bool [H, W], True within the circle; None if a corner is lit.
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
    """Return a panorama of all directions.

    Raises:
        IgsrError: it is not twice as wide as it is high.
    """
    if width != 2 * height:
        raise IgsrError(
            f"an equirectangular camera of {width}x{height} pixels is not twice as wide as it is "
            "high; give the whole panorama"
        )
    return Equirectangular.whole(width, height)
