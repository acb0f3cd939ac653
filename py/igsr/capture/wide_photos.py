"""Photos that no single pinhole can show: 360° panoramas, and fisheye lenses of more than 120°.

Each says where in the photo a direction is. The frame is that of the camera: x right, y down, z
forward, which is where the middle of a panorama looks.
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

#: Degrees across, along the wider side, up to which a fisheye photo becomes one pinhole photo: at
#: such an edge, a pixel has become four.
WIDEST_PINHOLE = 120.0
#: A fisheye photo whose corners, of one part in so many of its side, have no level above ``BLACK``
#: shows a circle: up to where this part of a ring around its middle has one.
CORNER, BLACK, LIT = 32, 16, 0.2


@dataclass(frozen=True)
class Equirectangular:
    """A panorama whose columns are longitudes and whose rows are latitudes.

    Attributes:
        width, height: of the photo, pixels.
        full_width, full_height: of the whole sphere at that scale, pixels.
        left, top: where the photo lies on it, pixels; the whole sphere's middle looks forward.
    """

    width: int
    height: int
    full_width: float
    full_height: float
    left: float = 0.0
    top: float = 0.0

    @staticmethod
    def whole(width: int, height: int) -> Equirectangular:
        """A photo of all directions."""
        return Equirectangular(width, height, float(width), float(height))

    @property
    def wraps(self) -> bool:
        """Whether the left edge goes on at the right one."""
        return self.full_width == self.width

    @property
    def pixels_per_radian(self) -> float:
        """In the middle of the photo."""
        return max(self.full_width / (2.0 * math.pi), self.full_height / math.pi)

    def places(self, directions: Float64) -> tuple[Float64, Float64, Bool]:
        """Pixel coordinates of directions.

        Args:
            directions: [..., 3], of any length.

        Returns:
            u, v: [...], pixels (centers at +0.5).
            valid: whether that is within the photo.
        """
        x, y, z = np.moveaxis(directions, -1, 0)
        u = (np.arctan2(x, z) / (2.0 * math.pi) + 0.5) * self.full_width - self.left
        if not self.wraps:
            # A photo of a part may lie across the sphere's own edge.
            u = np.where(u < 0.0, u + self.full_width, u)
        latitude = np.arctan2(y, np.hypot(x, z))
        v = (latitude / math.pi + 0.5) * self.full_height - self.top
        tiny = 1e-9 * self.full_width  # rounding at the edges of a whole sphere
        valid = (u >= -tiny) & (u <= self.width + tiny) & (v >= -tiny) & (v <= self.height + tiny)
        return u, v, valid

    def resized(self, width: int, height: int) -> Equirectangular:
        """The same of a photo at another size."""
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
    """A fisheye photo of more than a pinhole can show.

    Attributes:
        width, height: pixels.
        fx, fy, cx, cy: pixels.
        lens: its distortion.
        radius: of the circle around cx, cy that the lens shows, pixels.
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
        """Whether the left edge goes on at the right one."""
        return False

    @property
    def pixels_per_radian(self) -> float:
        """On the axis."""
        return max(self.fx, self.fy)

    def places(self, directions: Float64) -> tuple[Float64, Float64, Bool]:
        """Pixel coordinates of directions; see ``Equirectangular.places``."""
        x, y, valid = self.lens.fisheye_places(directions)
        with np.errstate(all="ignore"):
            u, v = self.fx * x + self.cx, self.fy * y + self.cy
            valid = valid & (u >= 0.0) & (u <= self.width) & (v >= 0.0) & (v <= self.height)
            valid &= np.hypot(u - self.cx, v - self.cy) <= self.radius
        return u, v, valid

    def resized(self, width: int, height: int) -> WideFisheye:
        """The same of a photo at another size."""
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
    """A fisheye photo that is too wide for one pinhole; None for any other photo.

    Args:
        K: [3, 3], pixels.
        lens: of any kind.
        width, height: pixels.
        radius: as ``WideFisheye.radius``.
    """
    if not lens.fisheye:
        return None
    fx, fy, cx, cy = (float(K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    wide = WideFisheye(width, height, fx, fy, cx, cy, lens, radius)
    return wide if field_of_view(wide) > WIDEST_PINHOLE else None


def field_of_view(photo: WideFisheye) -> float:
    """Degrees that a fisheye photo shows across, or down where that is more."""
    angles = np.radians(np.arange(0.0, 180.0, 0.25))
    zero, along, ahead = np.zeros_like(angles), np.sin(angles), np.cos(angles)
    widest = 0.0
    for axis in ((along, zero), (zero, along)):
        both = 0.0
        for sign in (1.0, -1.0):
            directions = np.stack([sign * axis[0], sign * axis[1], ahead], axis=-1)
            # Up to where it first leaves the photo.
            valid = photo.places(directions)[2]
            both += 0.25 * (int(valid.argmin()) if not valid.all() else len(valid))
        widest = max(widest, both)
    return widest


def lit_circle(image: npt.NDArray[np.uint8], photo: WideFisheye) -> Bool | None:
    """What a fisheye photo shows, where its corners are black: the circle that has light.

    Args:
        image: uint8 [H, W, 3 or 4].
        photo: it, at the image's size.

    Returns:
        bool [H, W], True within the circle; None where a corner has light.
    """
    height, width = image.shape[:2]
    brightest = image[..., :3].max(axis=2)
    corner = max(1, min(height, width) // CORNER)
    for rows in (slice(0, corner), slice(height - corner, height)):
        for columns in (slice(0, corner), slice(width - corner, width)):
            if brightest[rows, columns].max() > BLACK:
                return None
    y, x = np.ogrid[:height, :width]
    away = np.hypot(x + 0.5 - photo.cx, y + 0.5 - photo.cy)
    ring = away.astype(np.int64)
    lit = np.bincount(ring.ravel(), (brightest > BLACK).ravel()) / np.maximum(
        np.bincount(ring.ravel()), 1
    )
    shown = np.flatnonzero(lit > LIT)
    # The last ring is half dark.
    return None if not len(shown) else np.asarray(away < max(0, int(shown[-1]) - 1))


def whole_sphere(width: int, height: int) -> Equirectangular:
    """A panorama of all directions.

    Raises:
        IgsrError: it is not twice as wide as it is high.
    """
    if width != 2 * height:
        raise IgsrError(
            f"an equirectangular camera of {width}x{height} pixels is not twice as wide as it is "
            "high; give the whole panorama"
        )
    return Equirectangular.whole(width, height)
