"""A stand-in for pose networks: the truth with known noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igsr.cameras.alignment import AlignedPhoto
from igsr.cameras.da3.preprocessing import resampling_of
from igsr.capture import Camera
from igsr.capture.photo_folder import Photo
from igsr.geometry.similarity import Similarity

Float64 = npt.NDArray[np.float64]

#: Cells along the longer side of a depth map whose errors are correlated.
CELLS = 12
#: Confidence of confident pixels and of other pixels.
HIGH_CONFIDENCE, LOW_CONFIDENCE = 4.0, 1.5


@dataclass(frozen=True)
class Noise:
    """Errors of the network."""

    depth: float = 0.02  # standard deviation of the logarithm of depths, per photo and per cell
    rotation: float = 1.0  # rotation of every camera about a random axis, degrees
    center: float = 0.02  # shift of every camera, in units of the median depth
    focal: float = 0.02  # standard deviation of the logarithm of focal lengths
    wrong_confidence: float = 0.05  # fraction of the cells with a wrong depth of high confidence


class NoisyNetwork:
    """A predictor (``igsr.cameras.da3.passes.Predictor``).

    Args:
        cameras: true cameras by photo name.
        depths: true z-depths [h, w] of whole photos, NaN if unknown.
        noise: the errors.
        seed: of the noise, and of each pass's world and scale.
        most: maximum number of photos in a pass.
    """

    def __init__(
        self,
        cameras: dict[str, Camera],
        depths: dict[str, npt.NDArray[np.float32]],
        noise: Noise | None = None,
        seed: int = 0,
        most: int = 32,
    ) -> None:
        self.cameras, self.depths = cameras, depths
        self.noise = Noise() if noise is None else noise
        self.seed, self.most = seed, most

    def most_photos(self, photos: Sequence[Photo]) -> int:
        """As ``Predictor``."""
        return self.most

    def __call__(
        self, photos: Sequence[Photo], cameras: Sequence[Camera] | None, seed: int
    ) -> list[AlignedPhoto | None]:
        """As ``Predictor``; known cameras are ignored."""
        random = np.random.default_rng([self.seed, len(photos)])
        turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
        turn *= np.sign(np.linalg.det(turn))
        world = Similarity(float(random.uniform(0.2, 5.0)), turn, random.normal(size=3))
        return [self._noisy(photo, random).mapped(world) for photo in photos]

    def _noisy(self, photo: Photo, random: np.random.Generator) -> AlignedPhoto:
        camera, whole = self.cameras[photo.name], self.depths[photo.name]
        grid = resampling_of(camera.width, camera.height).grid()
        row, column = (
            ((np.arange(count) + 0.5) * size / count).astype(np.int64)
            for count, size in zip((grid.height, grid.width), whole.shape, strict=True)
        )
        depth = whole[np.ix_(row, column)].astype(np.float64)
        known = np.isfinite(depth) & (depth > 0.0)
        middle = float(np.median(depth[known])) if known.any() else 1.0
        shape = (
            max(2, round(CELLS * grid.height / max(grid.height, grid.width))),
            max(2, round(CELLS * grid.width / max(grid.height, grid.width))),
        )
        noise = self.noise
        log = noise.depth * (random.normal() + _spread(random.normal(size=shape), depth.shape))
        wrong = _cells(random.uniform(size=shape) < noise.wrong_confidence, depth.shape)
        log = np.where(wrong, log + 0.5 * random.choice([-1.0, 1.0]), log)
        sure = known & (wrong | (random.uniform(size=depth.shape) > 0.1))
        shown = np.where(known, depth * np.exp(log), 10.0 * middle).astype(np.float32)
        low = np.where(known, LOW_CONFIDENCE, 1.0)
        confidence = np.where(sure, HIGH_CONFIDENCE, low).astype(np.float32)
        # Vary it between pixels, as networks do.
        variation = np.where(known, 0.1 * random.uniform(size=depth.shape), 0.0)
        confidence += variation.astype(np.float32)
        return AlignedPhoto(self._moved(camera, middle, random), grid, shown, confidence)

    def _moved(self, camera: Camera, middle: float, random: np.random.Generator) -> Camera:
        noise = self.noise
        axis, way = random.normal(size=(2, 3))
        x, y, z = axis / np.linalg.norm(axis)
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        angle = np.radians(noise.rotation)
        turn = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
        viewmat = np.eye(4)
        viewmat[:3, :3] = turn @ camera.viewmat[:3, :3]
        center = camera.center + noise.center * middle * way / np.linalg.norm(way)
        viewmat[:3, 3] = -viewmat[:3, :3] @ center
        K = camera.K.copy()
        K[[0, 1], [0, 1]] *= np.exp(noise.focal * random.normal())
        K[:2, 2] = camera.width / 2, camera.height / 2  # networks assume it
        return replace(camera, viewmat=viewmat, K=K)


def _cells(values: npt.NDArray[np.bool_], shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    """Repeat values of cells for their pixels."""
    row, column = (
        np.arange(size) * count // size for size, count in zip(shape, values.shape, strict=True)
    )
    return values[np.ix_(row, column)]


def _spread(values: Float64, shape: tuple[int, ...]) -> Float64:
    """Interpolate values of cells linearly for all pixels."""
    for axis, size in enumerate(shape):
        count = values.shape[axis]
        at = np.clip((np.arange(size) + 0.5) * count / size - 0.5, 0.0, count - 1.0)
        low = np.minimum(at.astype(np.int64), count - 2)
        part = np.expand_dims(at - low, 1 - axis)
        values = np.take(values, low, axis) * (1 - part) + np.take(values, low + 1, axis) * part
    return values
