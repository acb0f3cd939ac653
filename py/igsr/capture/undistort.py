"""Undistort photos: a distorted photo becomes a pinhole photo and a mask of its valid pixels.

The pinhole camera keeps the focal lengths, principal point and size of the distorted camera. So the
middle of the picture keeps its resolution, and no crop has to be chosen. What the lens saw outside
this frame is dropped; pixels of the frame that the lens did not see are masked.

Each pixel of the pinhole picture goes through the lens model, which is explicit in this direction,
and the photo is sampled there. Nothing is iterated, so nothing can fail to converge.

Sources of the models: OpenCV ``calib3d`` (Brown-Conrady, rational and equidistant fisheye) and
COLMAP's camera models, which agree with it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from igsr.errors import IgsrError

# Pixels mapped at a time: limits the float64 temporaries to a few MB for photos of any size.
_BAND_PIXELS = 1 << 17


@dataclass(frozen=True)
class Lens:
    """The distortion of a lens, which acts on normalized coordinates x / z, y / z.

    Perspective: radial factor (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6), with
    ``radial`` = (k1, k2, k3), ``denominator`` = (k4, k5, k6), plus the tangential p1, p2.
    Fisheye: the angle t from the axis becomes the radius t (1 + k1 t^2 + k2 t^4 + ...), with
    ``radial`` = (k1, k2, k3, k4). Of a thin prism fisheye, p1, p2 and ``thin_prism`` = (sx1, sy1)
    are added, all in terms of t. Missing trailing coefficients are 0.
    """

    fisheye: bool = False
    radial: tuple[float, ...] = ()
    denominator: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    thin_prism: tuple[float, float] = (0.0, 0.0)

    @property
    def is_pinhole(self) -> bool:
        """Whether the lens has no distortion."""
        return not self.fisheye and not any(self.radial + self.denominator + self.tangential)

    @np.errstate(all="ignore")
    def fisheye_places(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where a fisheye lens shows directions, also those beside and behind it.

        Args:
            directions: float64 [..., 3], x right, y down, z forward, of any length.

        Returns:
            x, y: float64 [...], distorted normalized coordinates.
            valid: bool [...], False beyond the angle where the model folds back on itself, and
                straight behind, which is no one place.
        """
        x, y, z = np.moveaxis(directions, -1, 0)
        across = np.hypot(x, y)
        angle = np.arctan2(across, z)
        polynomial = np.polynomial.Polynomial((1.0, *self.radial))
        s_poly = np.polynomial.Polynomial((0.0, 2.0))
        fold = _first_positive_root(polynomial + s_poly * polynomial.deriv())
        valid = (angle * angle < fold) & ((across > 0.0) | (z > 0.0))
        ratio = np.where(across > 0.0, angle / np.where(across > 0.0, across, 1.0), 0.0)
        bent_x, bent_y, prism_valid = self._with_prism(x * ratio, y * ratio, polynomial)
        return bent_x, bent_y, valid & prism_valid

    def _with_prism(
        self, x: np.ndarray, y: np.ndarray, radial: np.polynomial.Polynomial
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distort x, y of length t: radially, and by the tangential and thin prism terms."""
        s = x * x + y * y
        factor = radial(s)
        if not any(self.tangential + self.thin_prism):
            return x * factor, y * factor, np.ones(s.shape, dtype=bool)
        (p1, p2), (sx, sy) = self.tangential, self.thin_prism
        slope = radial.deriv()(s)
        along_x = factor + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x + 2.0 * sx * x
        along_y = factor + 2.0 * y * y * slope + 2.0 * p2 * x + 6.0 * p1 * y + 2.0 * sy * y
        mixed = 2.0 * (x * y * slope + p1 * x + p2 * y)
        crossed = (mixed + 2.0 * sx * y) * (mixed + 2.0 * sy * x)
        return (
            x * factor + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x) + sx * s,
            y * factor + 2.0 * p2 * x * y + p1 * (s + 2.0 * y * y) + sy * s,
            (along_x > 0.0) & (along_x * along_y - crossed > 0.0),
        )

    @np.errstate(all="ignore")  # absurd coefficients overflow, and the result is not valid
    def distort(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distort rays, given as normalized pinhole coordinates.

        Args:
            x, y: float64 arrays of one shape, normalized pinhole coordinates.

        Returns:
            x, y: float64, distorted normalized coordinates.
            valid: bool, False beyond the radius where the model folds back on itself. There two
                rays share a pixel, and the polynomial does not describe the real lens.
        """
        s = x * x + y * y
        numerator = np.polynomial.Polynomial((1.0, *self.radial))
        denominator = np.polynomial.Polynomial((1.0, *self.denominator))
        # d/dr of r N(r^2) / D(r^2), times D^2: its first positive root in r^2 is the fold.
        s_poly = np.polynomial.Polynomial((0.0, 2.0))
        slope = (
            numerator + s_poly * numerator.deriv()
        ) * denominator - s_poly * numerator * denominator.deriv()
        fold = min(_first_positive_root(slope), _first_positive_root(denominator))
        if self.fisheye:
            r = np.sqrt(s)
            angle = np.arctan(r)
            angle_squared = angle * angle
            tiny = r < 1e-12
            if any(self.tangential + self.thin_prism):
                return self.fisheye_places(np.stack([x, y, np.ones_like(x)], axis=-1))
            factor = np.where(tiny, 1.0, angle / np.where(tiny, 1.0, r)) * numerator(angle_squared)
            return x * factor, y * factor, angle_squared < fold
        valid = s < fold
        n, d = numerator(s), denominator(s)
        factor = n / d
        if not any(self.tangential):
            return x * factor, y * factor, valid
        p1, p2 = self.tangential
        # Tangential terms can fold earlier than the radial ones: the Jacobian, which is
        # symmetric, stays positive definite up to there.
        slope_in_s = (numerator.deriv()(s) * d - n * denominator.deriv()(s)) / (d * d)
        mixed = 2.0 * (x * y * slope_in_s + p1 * x + p2 * y)
        along_x = factor + 2.0 * x * x * slope_in_s + 2.0 * p1 * y + 6.0 * p2 * x
        along_y = factor + 2.0 * y * y * slope_in_s + 2.0 * p2 * x + 6.0 * p1 * y
        valid &= (along_x > 0.0) & (along_x * along_y - mixed * mixed > 0.0)
        return (
            x * factor + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x),
            y * factor + 2.0 * p2 * x * y + p1 * (s + 2.0 * y * y),
            valid,
        )


def _first_positive_root(polynomial: np.polynomial.Polynomial) -> float:
    coefficients = np.trim_zeros(polynomial.coef, "b")
    if len(coefficients) < 2:
        return np.inf
    try:
        roots = np.polynomial.Polynomial(coefficients).roots()
    except np.linalg.LinAlgError:
        return 0.0
    real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0.0)]
    return float(real.min()) if real.size else np.inf


class Undistorter:
    """Resamples photos of one distorted camera to its pinhole camera.

    Args:
        lens: the distortion.
        K: float64 [3, 3], pixels; kept as the pinhole camera's intrinsics.
        width, height: the photo's size, pixels; kept.

    Attributes:
        valid: bool [H, W], True where the pinhole pixel's center lies within the photo.

    Raises:
        IgsrError: no pixel is valid.
    """

    @np.errstate(all="ignore")  # as in Lens.distort
    def __init__(self, lens: Lens, K: np.ndarray, width: int, height: int) -> None:
        """Map every pixel of the pinhole picture."""
        self._shape = (height, width)
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
        self.valid = np.empty((height, width), dtype=bool)
        # Nearest upper-left photo pixel and the position between it and its neighbors.
        self._index = np.empty((height, width), dtype=np.int64)
        self._right = np.empty((height, width), dtype=np.float32)
        self._down = np.empty((height, width), dtype=np.float32)
        x = (np.arange(width) + 0.5 - cx) / fx
        for band in self._bands():
            y = (np.arange(band.start, band.stop) + 0.5 - cy) / fy
            xd, yd, valid = lens.distort(*np.meshgrid(x, y))
            u, v = fx * xd + cx, fy * yd + cy
            # The photo covers [0, width] x [0, height]; in its outer half pixels, sampling
            # clamps to the outermost centers. NaN compares False.
            valid &= (u >= 0.0) & (u <= width) & (v >= 0.0) & (v <= height)
            self.valid[band] = valid
            column = np.clip(np.where(valid, u, 0.5) - 0.5, 0.0, width - 1)
            row = np.clip(np.where(valid, v, 0.5) - 0.5, 0.0, height - 1)
            left = np.minimum(column.astype(np.int64), max(width - 2, 0))
            up = np.minimum(row.astype(np.int64), max(height - 2, 0))
            self._index[band] = up * width + left
            self._right[band] = column - left
            self._down[band] = row - up
        if not self.valid.any():
            raise IgsrError("its distortion leaves no pixel of the photo; correct k1 .. p2")

    def _bands(self) -> Iterator[slice]:
        height, width = self._shape
        rows = max(1, _BAND_PIXELS // width)
        return (slice(top, min(top + rows, height)) for top in range(0, height, rows))

    def _taps(self, band: slice) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """The photo pixels that each pixel of a band mixes, and their bilinear weights."""
        height, width = self._shape
        index, right, down = self._index[band], self._right[band], self._down[band]
        step_right = 1 if width > 1 else 0
        step_down = width if height > 1 else 0
        yield index, (1.0 - right) * (1.0 - down)
        yield index + step_right, right * (1.0 - down)
        yield index + step_down, (1.0 - right) * down
        yield index + step_down + step_right, right * down

    def image(self, image: np.ndarray) -> np.ndarray:
        """Undistort a photo, uint8 [H, W, 3 or 4]; pixels that are not valid become 0."""
        height, width, channels = image.shape
        # Fetching a pixel as one 32-bit word is three times as fast as byte by byte.
        padded = np.zeros((height, width, 4), dtype=np.uint8)
        padded[..., :channels] = image
        words = padded.view(np.uint32).ravel()
        out = np.empty_like(image)
        for band in self._bands():
            mixed = np.zeros((*self.valid[band].shape, channels), dtype=np.float32)
            for index, weight in self._taps(band):
                pixels = words[index].view(np.uint8).reshape(*index.shape, 4)
                if channels == 4:
                    # The colors of transparent pixels have no meaning: weight them by alpha.
                    weight = weight * pixels[..., 3]
                    mixed[..., 3] += weight
                mixed[..., :3] += weight[..., None] * pixels[..., :3]
            if channels == 4:
                mixed[..., :3] /= np.maximum(mixed[..., 3:], 1e-6)
            mixed[~self.valid[band]] = 0.0
            out[band] = np.clip(np.rint(mixed), 0.0, 255.0)
        return out

    def mask(self, mask: np.ndarray) -> np.ndarray:
        """Undistort a mask, bool [H, W]: True where valid and sampled from unmasked pixels only."""
        flat = mask.ravel()
        out = self.valid.copy()
        for band in self._bands():
            for index, weight in self._taps(band):
                # Less than a thousandth of a pixel is rounding.
                out[band] &= flat[index] | (weight < 1e-3)
        return out

    def nearest(self, plane: np.ndarray) -> np.ndarray:
        """Undistort one number per pixel [H, W], each that of the nearest pixel; 0 where not valid.

        For depth: a mean over an edge is on no surface.
        """
        height, width = self._shape
        right = (self._right >= 0.5) if width > 1 else np.zeros_like(self.valid)
        down = (self._down >= 0.5) if height > 1 else np.zeros_like(self.valid)
        out = plane.ravel()[self._index + right + width * down]
        out[~self.valid] = 0
        return out
