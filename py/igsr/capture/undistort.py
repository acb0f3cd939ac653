"""Undistort photos, into a pinhole photo and a mask of its valid pixels, and their tracks.

The pinhole camera keeps the focal lengths, principal point and size of the distorted camera. So the
middle of the picture keeps its resolution, and no crop has to be chosen. Parts of the photo outside
this frame are dropped; pixels of the frame outside the photo are masked.

Each pixel of the pinhole picture goes through the lens model, which is explicit in this direction,
and the photo is sampled there. No equation is solved iteratively, so convergence cannot fail.

Sources of the models: OpenCV ``calib3d`` (Brown-Conrady, rational and equidistant fisheye) and
COLMAP's camera models, which agree with it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from igsr.capture.types import Camera, Tracks
from igsr.errors import IgsrError

# Pixels mapped at a time, which limits the float64 temporaries to a few MB.
_BAND_PIXELS = 1 << 17

Triple = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Lens:
    """The distortion of a lens, which acts on normalized coordinates x / z, y / z.

    Perspective: radial factor (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6), with
    ``radial`` = (k1, k2, k3), ``denominator`` = (k4, k5, k6), plus the tangential p1, p2.
    Fisheye: the angle t from the axis becomes the radius t (1 + k1 t^2 + k2 t^4 + ...), with
    ``radial`` = (k1, k2, k3, k4). A thin prism fisheye adds p1, p2 and ``thin_prism`` = (sx1, sy1),
    all in terms of t. Missing trailing coefficients are 0.
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
    def fisheye_places(self, directions: np.ndarray) -> Triple:
        """Project directions through a fisheye lens, which may see beyond 90 degrees.

        Args:
            directions: float64 [..., 3], x right, y down, z forward, of any length.

        Returns:
            Distorted normalized coordinates x and y [...], and whether they are valid: not beyond
            the angle at which the model folds back on itself, nor straight behind the lens, which
            has no unique image.
        """
        x, y, z = np.moveaxis(directions, -1, 0)
        across = np.hypot(x, y)
        angle = np.arctan2(across, z)
        factor = np.polynomial.Polynomial((1.0, *self.radial))
        valid = (angle * angle < self._fold) & ((across > 0.0) | (z > 0.0))
        ratio = np.where(across > 0.0, angle / np.where(across > 0.0, across, 1.0), 0.0)
        x, y = x * ratio, y * ratio
        s = x * x + y * y
        if self._is_radial:
            return x * factor(s), y * factor(s), valid
        bent_x, bent_y, is_unfolded = self._bent(x, y, s, factor(s), factor.deriv()(s))
        return bent_x, bent_y, valid & is_unfolded

    @np.errstate(all="ignore")  # absurd coefficients overflow, and the result is not valid
    def distort(self, x: np.ndarray, y: np.ndarray) -> Triple:
        """Distort rays, given as normalized pinhole coordinates.

        Args:
            x, y: float64 arrays of one shape, normalized pinhole coordinates.

        Returns:
            Distorted normalized coordinates x and y, and whether they are valid: not beyond the
            radius at which the model folds back on itself. There two rays share a pixel, and the
            polynomial does not describe the real lens.
        """
        if self.fisheye and not self._is_radial:
            return self.fisheye_places(np.stack([x, y, np.ones_like(x)], axis=-1))
        s = x * x + y * y
        numerator = np.polynomial.Polynomial((1.0, *self.radial))
        if self.fisheye:
            r = np.sqrt(s)
            angle = np.arctan(r)
            s = angle * angle
            is_tiny = r < 1e-12
            factor = np.where(is_tiny, 1.0, angle / np.where(is_tiny, 1.0, r)) * numerator(s)
            return x * factor, y * factor, s < self._fold
        denominator = np.polynomial.Polynomial((1.0, *self.denominator))
        n, d = numerator(s), denominator(s)
        if self._is_radial:
            return x * (n / d), y * (n / d), s < self._fold
        slope = (numerator.deriv()(s) * d - n * denominator.deriv()(s)) / (d * d)
        bent_x, bent_y, is_unfolded = self._bent(x, y, s, n / d, slope)
        return bent_x, bent_y, (s < self._fold) & is_unfolded

    @property
    def _is_radial(self) -> bool:
        return not any(self.tangential + self.thin_prism)

    @property
    def _fold(self) -> float:
        """The squared radius (of a fisheye: angle) at which the radial model folds back."""
        numerator = np.polynomial.Polynomial((1.0, *self.radial))
        denominator = np.polynomial.Polynomial((1.0, *self.denominator))
        # d/dr of r N(r^2) / D(r^2), times D^2: its first positive root in r^2 is the fold.
        s = np.polynomial.Polynomial((0.0, 2.0))
        slope = (numerator + s * numerator.deriv()) * denominator
        slope -= s * numerator * denominator.deriv()
        return min(_first_positive_root(slope), _first_positive_root(denominator))

    def _bent(
        self, x: np.ndarray, y: np.ndarray, s: np.ndarray, factor: np.ndarray, slope: np.ndarray
    ) -> Triple:
        """Apply the radial factor (with its slope in s = x^2 + y^2), tangential and prism terms.

        The last result is False where the Jacobian, which stays positive definite up to a fold, is
        not: tangential and prism terms can fold earlier than the radial one.
        """
        (p1, p2), (sx, sy) = self.tangential, self.thin_prism
        along_x = factor + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x + 2.0 * sx * x
        along_y = factor + 2.0 * y * y * slope + 2.0 * p2 * x + 6.0 * p1 * y + 2.0 * sy * y
        mixed = 2.0 * (x * y * slope + p1 * x + p2 * y)
        crossed = (mixed + 2.0 * sx * y) * (mixed + 2.0 * sy * x)
        return (
            x * factor + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x) + sx * s,
            y * factor + 2.0 * p2 * x * y + p1 * (s + 2.0 * y * y) + sy * s,
            (along_x > 0.0) & (along_x * along_y - crossed > 0.0),
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


class Sampler(ABC):
    """Resamples photos bilinearly to another camera, a band of rows at a time.

    ``valid``, bool [H, W], is True for pixels of the new picture that the photo shows.
    """

    def __init__(self, height: int, width: int, weights_sum_to_one: bool = False) -> None:
        self.valid = np.ones((height, width), dtype=bool)
        self._weights_sum_to_one = weights_sum_to_one

    @abstractmethod
    def _taps(self, band: slice) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Flat indices of the photo's pixels that each pixel of a band mixes, and their weights."""

    def _bands(self) -> Iterator[slice]:
        height, width = self.valid.shape
        rows = max(1, _BAND_PIXELS // width)
        return (slice(top, min(top + rows, height)) for top in range(0, height, rows))

    def image(self, image: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
        """Resample a photo, uint8 [H, W, 3 or 4] with straight alpha; invalid pixels become 0.

        Masked pixels lend no color if others can.
        """
        channels = image.shape[2]
        # Fetching a pixel as one 32-bit word is three times as fast as byte by byte.
        padded = np.zeros((*image.shape[:2], 4), dtype=np.uint8)
        padded[..., :channels] = image
        words = padded.view(np.uint32).ravel()
        flat_mask = None if mask is None else mask.ravel()
        out = np.empty((*self.valid.shape, channels), dtype=np.uint8)
        for band in self._bands():
            mixed = np.zeros((*self.valid[band].shape, channels), dtype=np.float32)
            weights = np.zeros(self.valid[band].shape, dtype=np.float32)
            for index, weight in self._taps(band):
                pixels = words[index].view(np.uint8).reshape(*index.shape, 4)
                if flat_mask is not None:
                    weight = weight * np.maximum(flat_mask[index], np.float32(1e-6))
                weights += weight
                if channels == 4:
                    # The colors of transparent pixels have no meaning: weight them by alpha.
                    weight = weight * pixels[..., 3]
                    mixed[..., 3] += weight
                mixed[..., :3] += weight[..., None] * pixels[..., :3]
            if channels == 4:
                mixed[..., :3] /= np.maximum(mixed[..., 3:], 1e-9)
            if not self._weights_sum_to_one:
                unweighted = mixed[..., 3:] if channels == 4 else mixed
                unweighted /= np.maximum(weights, 1e-9)[..., None]
            mixed[~self.valid[band]] = 0.0
            out[band] = np.clip(np.rint(mixed), 0.0, 255.0)
        return out

    def mask(self, mask: np.ndarray) -> np.ndarray:
        """Resample a mask, bool [H, W]: True if valid and mixed from unmasked pixels only."""
        flat = mask.ravel()
        out = self.valid.copy()
        for band in self._bands():
            for index, weight in self._taps(band):
                # Less than a thousandth of a pixel is rounding.
                out[band] &= flat[index] | (weight < 1e-3)
        return out


class Undistorter(Sampler):
    """Resamples photos of one distorted camera to its pinhole camera.

    Args:
        lens: the distortion.
        K: float64 [3, 3], pixels; kept as the pinhole camera's intrinsics.
        width, height: the photo's size, pixels; kept.

    Raises:
        IgsrError: no pixel is valid.
    """

    @np.errstate(all="ignore")  # as in Lens.distort
    def __init__(self, lens: Lens, K: np.ndarray, width: int, height: int) -> None:
        super().__init__(height, width, weights_sum_to_one=True)
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
        # The upper left of the four pixels to mix, and the position between them.
        self._index = np.empty((height, width), dtype=np.int64)
        self._right = np.empty((height, width), dtype=np.float32)
        self._down = np.empty((height, width), dtype=np.float32)
        x = (np.arange(width) + 0.5 - cx) / fx
        for band in self._bands():
            y = (np.arange(band.start, band.stop) + 0.5 - cy) / fy
            xd, yd, valid = lens.distort(*np.meshgrid(x, y))
            u, v = fx * xd + cx, fy * yd + cy
            # The photo covers [0, width] x [0, height]; in its outer half pixels, sampling clamps
            # to the outermost centers. NaN compares False.
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

    def _taps(self, band: slice) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        height, width = self.valid.shape
        index, right, down = self._index[band], self._right[band], self._down[band]
        step_right = 1 if width > 1 else 0
        step_down = width if height > 1 else 0
        yield index, (1.0 - right) * (1.0 - down)
        yield index + step_right, right * (1.0 - down)
        yield index + step_down, (1.0 - right) * down
        yield index + step_down + step_right, right * down

    def nearest(self, plane: np.ndarray) -> np.ndarray:
        """Undistort one number per pixel [H, W] from the nearest pixel; 0 for invalid pixels.

        Depth is not interpolated: the mean over an edge is on no surface.
        """
        height, width = self.valid.shape
        right = (self._right >= 0.5) if width > 1 else np.zeros_like(self.valid)
        down = (self._down >= 0.5) if height > 1 else np.zeros_like(self.valid)
        out = plane.ravel()[self._index + right + width * down]
        out[~self.valid] = 0
        return out


def straightened(
    tracks: Tracks, xyz: np.ndarray, cameras: list[Camera], lenses: list[Lens | None]
) -> Tracks:
    """Move observations from photos as taken to undistorted photos.

    Lens models are explicit only from the ray to the pixel. So each observation is moved by the
    distortion at its point's projection, which keeps its reprojection error to first order.
    Observations of points behind the camera or outside the lens's view are dropped.

    Args:
        tracks: in pixels of the photos as taken.
        xyz: float64 [P, 3], the points, world frame.
        cameras: pinhole, one for each of ``tracks.names``.
        lenses: their lenses; None has no distortion.
    """
    xy = tracks.xy.copy()
    keep = np.ones(len(xy), dtype=bool)
    for index, (camera, lens) in enumerate(zip(cameras, lenses, strict=True)):
        if lens is None or lens.is_pinhole:
            continue
        rows = np.flatnonzero(tracks.view == index)
        local = xyz[tracks.point[rows]] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        in_front = local[:, 2] > 0.0
        x, y = local[:, :2].T / np.where(in_front, local[:, 2], 1.0)
        bent_x, bent_y, valid = lens.distort(x, y)
        focal = camera.K[[0, 1], [0, 1]]
        xy[rows] -= np.stack([bent_x - x, bent_y - y], axis=1) * focal
        keep[rows] = in_front & valid & np.isfinite(xy[rows]).all(axis=1)
    return Tracks(tracks.names, tracks.view[keep], tracks.point[keep], xy[keep])
