"""A pose network that tells the truth with known noise: what is made of it, and not the network,
is measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera
from igsr.capture.photo_folder import Photo
from igsr.geometry.similarity import Similarity
from igsr.pose.alignment import AlignedPhoto
from igsr.pose.da3.prediction import resampling_of

Float64 = npt.NDArray[np.float64]

#: Cells of a depth map, along its longer side, that are wrong together: networks err smoothly.
CELLS = 12
#: Confidence of pixels that are sure, and of those that are not.
SURE, UNSURE = 4.0, 1.5


@dataclass(frozen=True)
class Noise:
    """How wrong the network is.

    Attributes:
        depth: standard deviation of the logarithm of depths, of a photo's scale and of cells in it.
        rotation: degrees that every camera is turned by, about an axis of its own.
        centre: distance that every camera is moved by, in units of the median depth.
        focal: standard deviation of the logarithm of focal lengths.
        wrong_confidence: part of the cells that are sure of a depth that is off by a half.
    """

    depth: float = 0.02
    rotation: float = 1.0
    centre: float = 0.02
    focal: float = 0.02
    wrong_confidence: float = 0.05


class NoisyNetwork:
    """Stands where a network stands (``igsr.pose.da3.prediction.Predictor``).

    Args:
        cameras: true ones, by photo name.
        depths: true z-depths [h, w] of whole photos in units of the cameras, NaN where not known.
        noise: how wrong it is.
        seed: of the noise, and of the world and unit that a pass has.
        most: photos of a pass.
    """

    def __init__(
        self,
        cameras: dict[str, Camera],
        depths: dict[str, npt.NDArray[np.float32]],
        noise: Noise | None = None,
        seed: int = 0,
        most: int = 32,
    ) -> None:
        """Keep the truth."""
        self.cameras, self.depths = cameras, depths
        self.noise = Noise() if noise is None else noise
        self.seed, self.most = seed, most

    def most_photos(self, photos: Sequence[Photo]) -> int:
        """As ``Predictor``."""
        return self.most

    def __call__(
        self, photos: Sequence[Photo], cameras: Sequence[Camera] | None, seed: int
    ) -> list[AlignedPhoto | None]:
        """As ``Predictor``; what is known of cameras changes nothing."""
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
        confidence = np.where(sure, SURE, np.where(known, UNSURE, 1.0)).astype(np.float32)
        # Surer and less sure pixels, as networks have them.
        confidence += np.where(known, 0.1 * random.uniform(size=depth.shape), 0.0).astype(
            np.float32
        )
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
        centre = camera.centre + noise.centre * middle * way / np.linalg.norm(way)
        viewmat[:3, 3] = -viewmat[:3, :3] @ centre
        K = camera.K.copy()
        K[[0, 1], [0, 1]] *= np.exp(noise.focal * random.normal())
        K[:2, 2] = camera.width / 2, camera.height / 2  # networks know no other
        return replace(camera, viewmat=viewmat, K=K)


def _cells(values: npt.NDArray[np.bool_], shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    """Values of cells as those of their pixels."""
    row, column = (
        np.arange(size) * count // size for size, count in zip(shape, values.shape, strict=True)
    )
    return values[np.ix_(row, column)]


def _spread(values: Float64, shape: tuple[int, ...]) -> Float64:
    """Values of cells as smooth values of pixels, linear between the cells' middles."""
    for axis, size in enumerate(shape):
        count = values.shape[axis]
        at = np.clip((np.arange(size) + 0.5) * count / size - 0.5, 0.0, count - 1.0)
        low = np.minimum(at.astype(np.int64), count - 2)
        part = np.expand_dims(at - low, 1 - axis)
        values = np.take(values, low, axis) * (1 - part) + np.take(values, low + 1, axis) * part
    return values
