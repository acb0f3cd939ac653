"""Photos with cameras and depth maps: their points, and the depths that can be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igsr.cameras.grid import Grid, ray_slopes
from igsr.capture import Camera, Points
from igsr.capture.photo_folder import Photo
from igsr.geometry.similarity import Similarity

Bool = npt.NDArray[np.bool_]
Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

#: Maximum number of points of an estimate; more are thinned evenly over all photos.
MAX_POINTS = 100_000
#: DUSt3R: minimum raw confidence of a trusted depth; 1 means none.
MIN_CONFIDENCE = 3.0
#: DUSt3R: a pixel is in front of another photo's surface below this fraction of its depth.
IN_FRONT = 0.95
#: Depth Anything 3: minimum confidence of a trusted depth, and its quantile in the photo.
DA3_MIN_CONFIDENCE = 1.05
DA3_MIN_QUANTILE = 0.4
#: Relative difference of depths that agree; neighbors that differ by more are at an edge.
MAX_DEPTH_DIFFERENCE = 0.05
#: Number of nearest photos whose depths are compared.
COMPARED_PHOTOS = 8
#: From this number of photos on, two must agree on a depth, else one.
MIN_PHOTOS_FOR_TWO = 5


@dataclass(frozen=True, eq=False)
class AlignedPhoto:
    """A photo with its camera and depth map."""

    camera: Camera  # in pixels of the photo
    grid: Grid  # position of depth and confidence in the photo
    depth: Float32  # [h, w], z-depth in world units, NaN if unknown
    confidence: Float32  # [h, w], raw confidence of the network; 1 means none

    def world_points(self) -> tuple[Float64, Int64]:
        """World points [M, 3] of the pixels with known depth, and their flat indices [M]."""
        index = np.flatnonzero(np.isfinite(self.depth))
        viewmat = self.camera.viewmat
        slopes = ray_slopes(self.grid.photo_pixels()[index], self.camera.K)
        rays = np.pad(slopes, ((0, 0), (0, 1)), constant_values=1.0)
        local = rays * self.depth.ravel()[index, None]
        return (local - viewmat[:3, 3]) @ viewmat[:3, :3], index

    def shown_at(self, xyz: Float64) -> tuple[Bool, Float64, Float32, Float32]:
        """Project world points [M, 3] into the depth map.

        Returns:
            Whether each point is in front of the camera and in the grid, bool [M]; its z-depth [M];
            depth and confidence [M] of its pixel, arbitrary for points that are not in the grid.
        """
        local = xyz @ self.camera.viewmat[:3, :3].T + self.camera.viewmat[:3, 3]
        z, K = local[:, 2], self.camera.K
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            pixels = local[:, :2] / z[:, None] * K[[0, 1], [0, 1]] + K[[0, 1], 2]
            row, column, inside = self.grid.cells(pixels)
        return inside & (z > 0.0), z, self.depth[row, column], self.confidence[row, column]

    def depths_at(self, pixels: Float64) -> Float64:
        """Depths [M] at pixels [M, 2] of the photo, NaN if unknown."""
        row, column, inside = self.grid.cells(pixels)
        depth = np.where(inside, self.depth[row, column], np.nan).astype(np.float64)
        return np.where(depth > 0.0, depth, np.nan)

    def mapped(self, similarity: Similarity) -> AlignedPhoto:
        """Move the photo to another world by the similarity to that world."""
        depth = (self.depth * np.float64(similarity.scale)).astype(np.float32)
        return replace(self, camera=similarity.camera(self.camera), depth=depth)


def trusted_pixels(
    photos: Sequence[AlignedPhoto | None], pairs: Sequence[tuple[int, int]]
) -> list[Bool | None]:
    """Find the confident pixels of DUSt3R that do not float in front of other photos' surfaces.

    A pixel in front of another photo's surface is wrong if it is the less confident of the two
    (``clean_pointcloud`` of DUSt3R's code). Confidences are the original ones, so the order of
    photos does not matter.

    Args:
        photos: None for photos without a camera.
        pairs: indices of photos to compare, in both directions.
    """
    trusted = [
        None
        if photo is None
        else np.isfinite(photo.depth) & (photo.depth > 0.0) & (photo.confidence > MIN_CONFIDENCE)
        for photo in photos
    ]
    for i, photo in enumerate(photos):
        mask = trusted[i]
        if photo is None or mask is None:
            continue
        xyz, index = photo.world_points()
        confidence = photo.confidence.ravel()[index]
        for j in sorted({a + b - i for a, b in pairs if i in (a, b)}):
            if (other := photos[j]) is None:
                continue
            shown, z, surface, other_confidence = other.shown_at(xyz)
            with np.errstate(invalid="ignore", over="ignore"):  # the surface may be unknown
                floats = shown & (z < IN_FRONT * surface) & (confidence < other_confidence)
            mask.ravel()[index[floats]] = False
    return trusted


def trusted_depths(photos: Sequence[AlignedPhoto | None]) -> list[Bool | None]:
    """Find the confident pixels of Depth Anything 3, off edges, on which other photos agree.

    Its confidence is not calibrated: it only ranks the pixels of a photo.
    """
    known = {i: photo for i, photo in enumerate(photos) if photo is not None}
    needed = 2 if len(known) >= MIN_PHOTOS_FOR_TWO else 1
    centers = {i: photo.camera.center for i, photo in known.items()}
    trusted: list[Bool | None] = [None] * len(photos)
    for i, photo in known.items():
        confident = confident_pixels(photo) & ~_edges(photo.depth)
        others = sorted(
            known.keys() - {i}, key=lambda j: (float(np.linalg.norm(centers[j] - centers[i])), j)
        )
        xyz, index = photo.world_points()
        kept = confident.ravel()[index]
        xyz, index = xyz[kept], index[kept]
        votes = np.zeros(len(index), dtype=np.int64)
        for j in others[:COMPARED_PHOTOS]:
            shown, z, surface, confidence = known[j].shown_at(xyz)
            with np.errstate(invalid="ignore"):  # the surface may be unknown
                near = np.abs(z - surface) < MAX_DEPTH_DIFFERENCE * z
            votes += shown & (confidence > 1.0) & near
        mask = np.zeros(photo.depth.size, dtype=bool)
        mask[index[votes >= needed]] = True
        trusted[i] = mask.reshape(photo.depth.shape)
    return trusted


def confident_pixels(photo: AlignedPhoto) -> Bool:
    """Pixels [h, w] that Depth Anything 3 is more confident of than of most of the photo."""
    known = np.isfinite(photo.depth) & (photo.depth > 0.0) & (photo.confidence > 1.0)
    if not known.any():
        return known
    least = np.quantile(photo.confidence[known], DA3_MIN_QUANTILE)
    return known & (photo.confidence >= least) & (photo.confidence > DA3_MIN_CONFIDENCE)


def _edges(depth: Float32) -> Bool:
    """Pixels on both sides of a step in depth."""
    edge = np.zeros(depth.shape, dtype=bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis in (0, 1):
            near, far = np.moveaxis(depth, axis, 0)[:-1], np.moveaxis(depth, axis, 0)[1:]
            steps = np.abs(near - far) > MAX_DEPTH_DIFFERENCE * np.minimum(near, far)
            along = np.moveaxis(edge, axis, 0)
            along[:-1] |= steps
            along[1:] |= steps
    return edge


def fused_points(
    photos: Sequence[Photo],
    aligned: Sequence[AlignedPhoto | None],
    trusted: Sequence[Bool | None],
) -> Points | None:
    """Fuse the trusted pixels of all photos to at most ``MAX_POINTS`` points."""
    xyz, rgb, confidence = [], [], []
    for photo, placed, mask in zip(photos, aligned, trusted, strict=True):
        if placed is None or mask is None:
            continue
        points, index = placed.world_points()
        kept = mask.ravel()[index]
        column, row = np.floor(placed.grid.photo_pixels()[index[kept]]).astype(np.int64).T
        height, width = photo.image.shape[:2]
        row, column = np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)
        xyz.append(points[kept])
        rgb.append(photo.image[row, column, :3])
        confidence.append(placed.confidence.ravel()[index[kept]])
    count = sum(len(points) for points in xyz)
    if count == 0:
        return None
    taken = np.linspace(0, count - 1, min(count, MAX_POINTS)).round().astype(np.int64)
    return Points(
        np.concatenate(xyz)[taken], np.concatenate(rgb)[taken], np.concatenate(confidence)[taken]
    )


def joined_points(tracked: Points | None, fused: Points | None) -> Points | None:
    """Join points of features, with tracks, and points of depth maps, with confidence.

    Only the order of confidences counts; points of features rank above points of depth maps.
    """
    if tracked is None or fused is None or fused.confidence is None:
        return fused if tracked is None else tracked
    highest = float(fused.confidence.max())
    own = tracked.confidence
    own = np.ones(len(tracked.xyz)) if own is None else own / own.max()
    return Points(
        np.concatenate([tracked.xyz, fused.xyz]),
        np.concatenate([tracked.rgb, fused.rgb]),
        np.concatenate([highest * (1.0 + own), fused.confidence]),
        tracked.tracks,
    )
