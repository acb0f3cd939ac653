"""Add noise to camera poses, for studies and for training pairs of the denoiser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera, View
from igsr.capture.types import intrinsic_matrix

Float64 = npt.NDArray[np.float64]

#: Distance of NeRF Synthetic's cameras from the origin, world units.
VIEWING_DISTANCE = 4.03

#: Noise on all twelve numbers of camera-to-world, which is then made rigid again.
MATRIX = "matrix"
#: The same, keeping the shear.
AFFINE = "raw-affine"
#: Rotation about a random axis through the camera's center.
TURN = "turn"


@dataclass(frozen=True)
class Noise:
    """A kind of noise and its size: standard deviation of the numbers, or degrees of the turn."""

    kind: str
    size: float

    def __str__(self) -> str:
        """As in tables and file names."""
        return f"{self.kind} {self.size:g}" + ("°" if self.kind == TURN else "")


def noise_unit(views: Sequence[View]) -> float:
    """Unit of length for noise on positions: the length of one unit of NeRF Synthetic.

    NeRF Synthetic's cameras are ``VIEWING_DISTANCE`` from their focus point, the point nearest to
    all optical axes.
    """
    across = []
    for view in views:
        axis = view.camera.viewmat[2, :3]
        across.append(np.eye(3) - np.outer(axis, axis))
    centers = np.stack([view.camera.centre for view in views])
    pulled = np.einsum("nij,nj->i", np.stack(across), centers - centers[0])
    target = centers[0] + np.linalg.lstsq(np.sum(across, axis=0), pulled, rcond=1e-6)[0]
    distance = float(np.mean(np.linalg.norm(centers - target, axis=1)))
    return distance / VIEWING_DISTANCE if distance > 0.0 else 1.0


def noisy_view(view: View, noise: Noise, random: np.random.Generator, unit: float = 1.0) -> View:
    """Add noise to a view's camera; "raw-affine" also shears the photo.

    ``unit`` scales the noise on the position (``noise_unit``).

    A camera-to-world matrix with noise is not rigid. Its shear and stretch are equivalent to other
    focal lengths, principal point and skew of a rigid camera at the same center; the skew shifts
    each row of the photo sideways.
    """
    camera = view.camera
    to_world = np.linalg.inv(camera.viewmat)
    if noise.kind == TURN:
        axis = random.normal(size=3)
        axis *= np.radians(noise.size) / np.linalg.norm(axis)
        to_world[:3, :3] = _rotation(axis) @ to_world[:3, :3]
    elif noise.kind in (MATRIX, AFFINE):
        to_world[:3, :4] += noise.size * random.normal(size=(3, 4)) * (1.0, 1.0, 1.0, unit)
    if noise.kind != AFFINE:
        u, _, vt = np.linalg.svd(to_world[:3, :3])
        return replace(view, camera=_camera(camera, (u @ vt).T, to_world[:3, 3], camera.K))
    upper, rotation = _upper_times_rotation(camera.K @ np.linalg.inv(to_world[:3, :3]))
    upper /= upper[2, 2]
    K = intrinsic_matrix(upper[0, 0], upper[1, 1], upper[0, 2], upper[1, 2])
    slope = upper[0, 1] / upper[1, 1]
    shifts = slope * (np.arange(camera.height) + 0.5 - upper[1, 2])
    return replace(
        view,
        camera=_camera(camera, rotation, to_world[:3, 3], K),
        image=_rows_shifted(view.image, shifts),
    )


def _camera(camera: Camera, rotation: Float64, center: Float64, K: Float64) -> Camera:
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ center
    return replace(camera, viewmat=viewmat, K=K)


def _rotation(axis: Float64) -> Float64:
    """Rodrigues' formula; the axis' length is the angle."""
    angle = float(np.linalg.norm(axis))
    x, y, z = axis / angle if angle > 0.0 else axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Float64 = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    return rotation


def _upper_times_rotation(matrix: Float64) -> tuple[Float64, Float64]:
    """Factor a matrix with positive determinant; the diagonal of the upper factor is positive."""
    q, r = np.linalg.qr(matrix[::-1].T)
    upper, rotation = r.T[::-1, ::-1], q.T[::-1]
    signs = np.sign(np.diag(upper))
    return upper * signs[None, :], signs[:, None] * rotation


def _rows_shifted(image: npt.NDArray[np.uint8], shifts: Float64) -> npt.NDArray[np.uint8]:
    """Row y of the result at column x is the photo's row y at x + shifts[y]."""
    pixels = image.astype(np.float64)
    if image.shape[2] == 4:
        # Premultiplied, so that colors of transparent pixels do not mix in.
        pixels[..., :3] *= pixels[..., 3:] / 255.0
    at = np.arange(image.shape[1], dtype=np.float64)
    for row, shift in zip(pixels, shifts, strict=True):
        for c in range(image.shape[2]):
            row[:, c] = np.interp(at + shift, at, row[:, c].copy())
    if image.shape[2] == 4:
        alpha = pixels[..., 3:]
        pixels[..., :3] *= np.divide(255.0, alpha, out=np.zeros_like(alpha), where=alpha > 0.0)
    return np.clip(pixels + 0.5, 0.0, 255.0).astype(np.uint8)
