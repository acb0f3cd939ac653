"""A scene of two spheres on a floor in a dome, its cameras, and exact pointmaps of pairs."""

from __future__ import annotations

import numpy as np

from igsr.cameras.alignment import PairPrediction, PhotoToAlign
from igsr.cameras.grid import Grid
from igsr.capture import Camera

CONFIDENCE = 8.0


def camera_at(eye, target, focal, width, height):
    """A camera at ``eye`` looking at ``target``, y of the world downwards."""
    z = np.asarray(target) - eye
    z = z / np.linalg.norm(z)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([x, np.cross(z, x), z])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    K = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(viewmat, K, width, height)


class PointmapScene:
    """Cameras on an arc, each with a grid, and exact predictions for them."""

    def __init__(self, count=6, arc=1.2, sizes=((96, 128),), focals=(1.2,), seed=0):
        random = np.random.default_rng(seed)
        self.cameras, self.grids = [], []
        for i in range(count):
            angle = arc * (i / max(count - 1, 1) - 0.5) + 0.03 * random.normal()
            eye = np.array([4 * np.sin(angle), -1 + 0.4 * random.normal(), -4 * np.cos(angle)])
            target = np.array([0.0, 0.2, 0.0]) + 0.2 * random.normal(size=3)
            height, width = sizes[i % len(sizes)]
            focal = focals[i % len(focals)] * max(height, width)
            self.cameras.append(camera_at(eye, target, focal, width, height))
            # Grids of 4 pixels with unequal borders, so that offsets matter.
            grid = Grid(height // 4 - 1, width // 4 - 2, 4.0, 4.0, 5.0, 1.0)
            self.grids.append(grid)
        self.worlds = [
            surface(camera, grid.photo_pixels())
            for camera, grid in zip(self.cameras, self.grids, strict=True)
        ]

    def photos(self, **fields):
        """The photos; ``fields`` are functions of the index."""
        return [
            PhotoToAlign(
                f"{i}.jpg",
                camera.height,
                camera.width,
                self.grids[i],
                **{name: field(i) for name, field in fields.items()},
            )
            for i, camera in enumerate(self.cameras)
        ]

    def points(self, first, photo):
        """Points [h, w, 3] of a photo in the frame of camera ``first``."""
        viewmat, grid = self.cameras[first].viewmat, self.grids[photo]
        local = self.worlds[photo] @ viewmat[:3, :3].T + viewmat[:3, 3]
        return local.reshape(grid.height, grid.width, 3)

    def predictions(self, pairs=None, seed=0, spoil=None):
        """Exact predictions, each with a different scale.

        Args:
            pairs: all by default.
            seed: of the scales.
            spoil: called with (points, confidence, first, photo), returns changed ones.
        """
        random = np.random.default_rng(seed)
        count = len(self.cameras)
        result = []
        for first, second in all_pairs(count) if pairs is None else pairs:
            scale, maps = np.exp(random.normal()), []
            for photo in (first, second):
                points = self.points(first, photo)
                confidence = np.full(points.shape[:2], CONFIDENCE)
                if spoil is not None:
                    points, confidence = spoil(points, confidence, first, photo)
                maps += [(scale * points).astype(np.float32), confidence.astype(np.float32)]
            result.append(PairPrediction(first, second, *maps))
        return result


def all_pairs(count):
    return [(i, j) for i in range(count) for j in range(count) if i != j]


def surface(camera, pixels):
    """World points [P, 3] that pixels [P, 2] see."""
    center = camera.center
    rays = np.ones((len(pixels), 3))
    rays[:, :2] = (pixels - camera.K[[0, 1], 2]) / camera.K[[0, 1], [0, 1]]
    rays = rays @ camera.viewmat[:3, :3]
    distance = np.full(len(pixels), np.inf)
    for middle, radius, inside in (
        ([0.0, 0.0, 0.0], 1.0, False),
        ([1.5, 0.5, 0.6], 0.5, False),
        ([0.0, 0.0, 0.0], 8.0, True),
    ):
        offset = center - middle
        a, b = (rays * rays).sum(axis=1), rays @ offset
        root = b * b - a * (offset @ offset - radius**2)
        hit = (-b + (1 if inside else -1) * np.sqrt(np.maximum(root, 0.0))) / a
        distance = np.where((root > 0) & (hit > 0) & (hit < distance), hit, distance)
    floor = (1.0 - center[1]) / np.where(np.abs(rays[:, 1]) > 1e-12, rays[:, 1], 1e-12)
    distance = np.where((floor > 0) & (floor < distance), floor, distance)
    return center + rays * distance[:, None]
