"""Points from the photos themselves: SIFT features, matched and triangulated at given poses.

Such points are few but right, also where photos look from far apart. Features (Lowe 2004) are
matched between the nearest photos by their descriptors alone; the poses then say which matches can
be true, by epipolar distance and by reprojection error.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera, View

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Int64 = npt.NDArray[np.int64]

#: Pixels of a photo's longer side, beyond which it is reduced; bounds time.
LONGEST = 1024
#: Photos that each is matched with, the nearest: more cost time and look from further apart.
MATCHED = 8
#: Largest features used per photo; bounds time and memory.
FEATURES = 4096
#: Second-best matches must be less alike than this (Lowe's ratio of distances).
RATIO = 0.85
#: Pixels, of the reduced photo, that a feature may be from its point.
MAX_ERROR = 2.0
#: Degrees between the rays to a point, at least; with less its depth is a guess.
MIN_ANGLE = 2.0
#: Points are put between a triangulated one and one of so many nearest neighbours.
NEIGHBOURS = 5


def sift_points(views: list[View]) -> tuple[Float64, Float64]:
    """Triangulated features of photos; nothing is random.

    Args:
        views: the photos; masked and wholly transparent pixels have no features.

    Returns:
        Points [P, 3] in the world frame and their mean colors [P, 3] in 0..1; P may be 0.
    """
    views = [_reduced(view) for view in views]
    features = [_features(view) for view in views]
    counts = [len(pixels) for pixels, _ in features]
    first = np.cumsum([0, *counts])
    matches = [
        first[[a, b]] + _matches(views[a], features[a], views[b], features[b])
        for a, b in _pairs(views)
    ]
    # A corner can be a feature twice, turned two ways: what counts are the places in each photo.
    places, place = np.unique(
        np.column_stack(
            [np.repeat(np.arange(len(views)), counts), np.concatenate([p for p, _ in features])]
        ),
        axis=0,
        return_inverse=True,
    )
    pairs = place.reshape(-1)[np.concatenate([np.zeros((0, 2), dtype=np.int64), *matches])]
    track = _tracks(pairs, len(places))
    view_of, pixels = places[:, 0].astype(np.int64), places[:, 1:]
    used = np.unique(pairs)
    return _triangulated(views, view_of[used], pixels[used], track[used])


def _reduced(view: View) -> View:
    """The view at ``LONGEST`` pixels or less, averaged over squares that are usable as a whole."""
    camera = view.camera
    side = -(-max(camera.width, camera.height) // LONGEST)
    height, width = camera.height // side, camera.width // side
    if side == 1 or min(height, width) == 0:
        return view

    def squares(pixels: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return pixels[: height * side, : width * side].reshape(height, side, width, side, -1)

    colors = squares(view.image[..., :3]).mean(axis=(1, 3)).round().astype(np.uint8)
    usable = np.asarray(squares(_usable(view)).all(axis=(1, 3, 4)))
    K = camera.K * np.array([[1.0 / side], [1.0 / side], [1.0]])
    return View(view.name, Camera(camera.viewmat, K, width, height), view.split, colors, usable)


def _usable(view: View) -> npt.NDArray[np.bool_]:
    """Which pixels [H, W] are neither masked nor wholly transparent."""
    shown = np.ones(view.image.shape[:2], dtype=bool) if view.mask is None else view.mask
    return shown & (view.image[..., 3] > 0) if view.image.shape[2] == 4 else shown


def _features(view: View) -> tuple[Float64, Float32]:
    """Pixel coordinates [N, 2] and descriptors [N, 128] of length 1, the largest first."""
    camera = view.camera
    usable = _usable(view)
    if not usable.any():
        return np.zeros((0, 2)), np.zeros((0, 128), dtype=np.float32)
    grey = view.image[..., :3] @ np.array([0.299, 0.587, 0.114])
    # What is hidden must not matter.
    grey = np.where(usable, grey, grey[usable].mean()).round().astype(np.uint8)
    keypoints, descriptors = _sift(grey)
    column, row, size = keypoints[:, :3].astype(np.float64).T
    # Features of the border between shown and hidden are no places on a surface.
    kept = np.ones(len(keypoints), dtype=bool)
    for right, down in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        i = np.clip(row + down * size, 0, camera.height - 1).astype(np.int64)
        j = np.clip(column + right * size, 0, camera.width - 1).astype(np.int64)
        kept &= usable[i, j]
    order = np.lexsort((row, column, -size))
    order = order[kept[order]][:FEATURES]
    vectors = descriptors[order].astype(np.float32)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.stack([column, row], axis=1)[order], vectors / np.maximum(lengths, 1e-9)


def _sift(grey: npt.NDArray[np.uint8]) -> tuple[Float32, Float32]:
    """Keypoints [N, 4] (column and row in pixels, size, turn) and descriptors [N, 128]."""
    # It takes longer to import than all of igsr, and only this initialization needs it.
    import pycolmap

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)
    try:
        with warnings.catch_warnings():
            # In favour of a class that takes pycolmap's own bitmaps only.
            warnings.simplefilter("ignore", DeprecationWarning)
            extractor = pycolmap.Sift(pycolmap.FeatureExtractionOptions(), pycolmap.Device.cpu)
        keypoints, descriptors = extractor.extract(grey)
    finally:
        pycolmap.logging.minloglevel = level
    return keypoints, descriptors


def _pairs(views: list[View]) -> list[tuple[int, int]]:
    """The pairs of photos to match, each photo with those taken nearest to it."""
    centres = np.stack([view.camera.center for view in views])
    pairs = set()
    for v in range(len(views)):
        near = np.argsort(np.linalg.norm(centres - centres[v], axis=1), kind="stable")
        pairs |= {(min(v, int(o)), max(v, int(o))) for o in near[: MATCHED + 1] if o != v}
    return sorted(pairs)


def _matches(
    a: View, of_a: tuple[Float64, Float32], b: View, of_b: tuple[Float64, Float32]
) -> Int64:
    """Pairs [M, 2] of features of two photos that are each other's best and fit the poses."""
    if min(len(of_a[0]), len(of_b[0])) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    alike = of_a[1] @ of_b[1].T
    best = alike.argmax(axis=1)
    rows = np.arange(len(best))
    mutual = alike.argmax(axis=0)[best] == rows
    two = np.partition(alike, -2, axis=1)[:, -2:]
    distance = np.sqrt(np.maximum(2.0 - 2.0 * two, 0.0))
    rows = rows[mutual & (distance[:, 1] < RATIO * distance[:, 0])]
    matches = np.stack([rows, best[rows]], axis=1)
    fits = _off_epipolar(a, of_a[0][matches[:, 0]], b, of_b[0][matches[:, 1]]) < 2 * MAX_ERROR
    return matches[fits]


def _off_epipolar(a: View, in_a: Float64, b: View, in_b: Float64) -> Float64:
    """Pixels [M] that features of b are off the epipolar lines of those of a."""
    relative = b.camera.viewmat @ np.linalg.inv(a.camera.viewmat)
    x, y, z = relative[:3, 3]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    essential = cross @ relative[:3, :3]
    fundamental = np.linalg.inv(b.camera.K).T @ essential @ np.linalg.inv(a.camera.K)
    lines = np.pad(in_a, ((0, 0), (0, 1)), constant_values=1.0) @ fundamental.T
    lengths = np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-12)
    off: Float64 = np.abs((lines[:, :2] * in_b).sum(axis=1) + lines[:, 2]) / lengths
    return off


def _tracks(pairs: Int64, count: int) -> Int64:
    """Per feature [count] the lowest feature that matches join it with."""
    track = np.arange(count)
    while True:
        least = track[pairs].min(axis=1)
        joined = track.copy()
        np.minimum.at(joined, pairs[:, 0], least)
        np.minimum.at(joined, pairs[:, 1], least)
        if (joined == track).all():
            return track
        track = joined


def _triangulated(
    views: list[View], view_of: Int64, pixels: Float64, track: Int64
) -> tuple[Float64, Float64]:
    """Points nearest to their features' rays, and their colors, where the rays agree.

    Args:
        views: V photos.
        view_of: [N], each feature's photo.
        pixels: [N, 2].
        track: [N], equal for features of one point.
    """
    names, point = np.unique(track, return_inverse=True)
    if not len(names):
        return np.zeros((0, 3)), np.zeros((0, 3))
    K = np.stack([view.camera.K for view in views])[view_of]
    viewmat = np.stack([view.camera.viewmat for view in views])[view_of]
    centre = np.stack([view.camera.center for view in views])[view_of]
    local = np.ones((len(pixels), 3))
    local[:, :2] = (pixels - K[:, :2, 2]) / K[:, [0, 1], [0, 1]]
    ray = np.einsum("nij,ni->nj", viewmat[:, :3, :3], local)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    matrix, right = np.zeros((len(names), 3, 3)), np.zeros((len(names), 3))
    np.add.at(matrix, point, across)
    np.add.at(right, point, np.einsum("nij,nj->ni", across, centre))
    # Of two rays that part by an angle the least eigenvalue is 1 - its cosine; more rays add to it.
    sure = np.linalg.eigvalsh(matrix)[:, 0] > 1.0 - np.cos(np.radians(MIN_ANGLE))
    matrix[~sure] = np.eye(3)
    xyz = np.linalg.solve(matrix, right[..., None])[..., 0]
    seen = np.einsum("nij,nj->ni", viewmat[:, :3, :3], xyz[point]) + viewmat[:, :3, 3]
    # What is behind a photo falls far outside it so.
    z = np.maximum(seen[:, 2:], 1e-9)
    off = np.linalg.norm(seen[:, :2] / z * K[:, [0, 1], [0, 1]] + K[:, :2, 2] - pixels, axis=1)
    np.logical_and.at(sure, point, off < MAX_ERROR)
    colors = np.zeros((len(names), 3))
    for v, view in enumerate(views):
        column, row = pixels[view_of == v].astype(np.int64).T
        np.add.at(colors, point[view_of == v], view.image[row, column, :3] / 255.0)
    colors /= np.bincount(point)[:, None]
    return xyz[sure], colors[sure]


def with_points_between(
    xyz: Float64, colors: Float64, count: int, random: np.random.Generator
) -> tuple[Float64, Float64]:
    """The points, and more between them and their nearest neighbours, ``count`` in all.

    Args:
        xyz: [P, 3] in any frame.
        colors: [P, 3].
        count: number of points asked for; no point is taken away.
        random: what draws pairs and places between them.

    Returns:
        Points [max(P, count), 3] and their colors, the given ones first.
    """
    more = max(0, count - len(xyz))
    points = random.integers(len(xyz), size=more)
    # From the middle, where products of coordinates are small enough to tell points apart.
    local = xyz - np.median(xyz, axis=0)
    squares = (local**2).sum(axis=1)
    others = np.empty(more, dtype=np.int64)
    # In parts, which bounds memory.
    for part in np.array_split(np.arange(more), 1 + more // 1024):
        own = points[part]
        apart = squares - 2.0 * local[own] @ local.T
        apart[np.arange(len(own)), own] = np.inf
        near = np.argpartition(apart, NEIGHBOURS, axis=1)[:, :NEIGHBOURS]
        others[part] = near[np.arange(len(own)), random.integers(near.shape[1], size=len(own))]
    way = random.uniform(size=(more, 1))
    return (
        np.concatenate([xyz, xyz[points] + way * (xyz[others] - xyz[points])]),
        np.concatenate([colors, colors[points] + way * (colors[others] - colors[points])]),
    )
