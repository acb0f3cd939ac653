"""Triangulated matches of photos with known poses.

Such points are few but right, also in photos from far apart. SIFT features (Lowe 2004) of the
nearest photos are matched by their descriptors, and if the extra ``matching`` is installed, ALIKED
features by LightGlue. Matches must agree with the poses, by epipolar distance and reprojection
error.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr._internal.load_pycolmap import load_pycolmap
from igsr.cameras.colmap import aliked
from igsr.cameras.colmap.aliked import Aliked
from igsr.cameras.colmap.matcher import checked_matches, usable_features
from igsr.capture import Camera, View
from igsr.capture.photo_folder import Photo
from igsr.fitting.initialization.photo_pixels import by_distance, camera_centers

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Int64 = npt.NDArray[np.int64]
#: Pixel coordinates [N, 2] and descriptors [N, 128] of length 1.
Features = tuple[Float64, Float32]

#: Longer side of photos for features, pixels; bounds the time.
MAX_SIDE_PX = 1024
#: Number of nearest photos to match with.
MATCHED_PHOTOS = 8
#: Maximum number of features per photo, the largest first.
MAX_FEATURES = 4096
#: Maximum ratio of the distances to the best and second-best match (Lowe's ratio test).
MAX_RATIO = 0.85
#: Maximum reprojection error, pixels of the reduced photo.
MAX_ERROR_PX = 2.0
#: Minimum angle between two of the rays to a point.
MIN_ANGLE_DEG = 2.0
#: Points are added between a triangulated one and one of this many nearest neighbors.
NEIGHBORS = 5


def matched_points(views: list[View]) -> tuple[Float64, Float64]:
    """Return triangulated matches of photos; deterministic.

    Args:
        views: the photos; masked and fully transparent pixels have no features.

    Returns:
        Points [P, 3] in the world frame and their mean colors [P, 3] in 0..1; P may be 0.
    """
    views = [_reduced(view) for view in views]
    photo_pairs = _photo_pairs(views)
    features = [_features(view) for view in views]
    places = [pixels for pixels, _ in features]
    found = [_matches(features[a], features[b]) for a, b in photo_pairs]
    if aliked.is_available():
        matcher = Aliked()
        photos = [Photo(view.name, view.image, mask=view.mask) for view in views]
        with matcher.pool() as threads:
            learned = list(threads.map(lambda photo: usable_features(matcher, photo), photos))
            matched = threads.map(
                lambda pair: checked_matches(matcher, learned[pair[0]], learned[pair[1]]),
                photo_pairs,
            )
            found += [rows.astype(np.int64) for rows in matched]
        places += [one.xy.astype(np.float64) for one in learned]
    first = np.cumsum([0, *map(len, places)])
    matches = [np.zeros((0, 2), dtype=np.int64)]
    for k, rows in enumerate(found):
        a, b = photo_pairs[k % len(photo_pairs)]
        i, j = (len(views) * (k // len(photo_pairs)) + n for n in (a, b))
        error = _epipolar_distance(views[a], places[i][rows[:, 0]], views[b], places[j][rows[:, 1]])
        matches.append(first[[i, j]] + rows[error < 2 * MAX_ERROR_PX])
    # A corner can be two features with different orientations: use each position once.
    photo = np.repeat(np.arange(len(places)) % len(views), [len(pixels) for pixels in places])
    positions, position = np.unique(
        np.column_stack([photo, np.concatenate(places)]), axis=0, return_inverse=True
    )
    pairs = position.reshape(-1)[np.concatenate(matches)]
    track = _tracks(pairs, len(positions))
    view_of, pixels = positions[:, 0].astype(np.int64), positions[:, 1:]
    used = np.unique(pairs)
    return _triangulated(views, view_of[used], pixels[used], track[used])


def _reduced(view: View) -> View:
    """The view with at most ``MAX_SIDE_PX``; squares of pixels are used only as a whole."""
    camera = view.camera
    side = -(-max(camera.width, camera.height) // MAX_SIDE_PX)
    height, width = camera.height // side, camera.width // side
    if side == 1 or min(height, width) == 0:
        return view

    def squares(pixels: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return pixels[: height * side, : width * side].reshape(height, side, width, side, -1)

    colors = squares(view.image[..., :3]).mean(axis=(1, 3)).round().astype(np.uint8)
    visible = np.asarray(squares(_visible_pixels(view)).all(axis=(1, 3, 4)))
    K = camera.K * np.array([[1.0 / side], [1.0 / side], [1.0]])
    return View(view.name, Camera(camera.viewmat, K, width, height), view.split, colors, visible)


def _visible_pixels(view: View) -> npt.NDArray[np.bool_]:
    """Pixels [H, W] that are neither masked nor fully transparent."""
    visible = np.ones(view.image.shape[:2], dtype=bool) if view.mask is None else view.mask
    return visible & (view.image[..., 3] > 0) if view.image.shape[2] == 4 else visible


def _features(view: View) -> Features:
    """Features of visible pixels, the largest first."""
    camera = view.camera
    visible = _visible_pixels(view)
    if not visible.any():
        return np.zeros((0, 2)), np.zeros((0, 128), dtype=np.float32)
    gray = view.image[..., :3] @ np.array([0.299, 0.587, 0.114])
    gray = np.where(visible, gray, gray[visible].mean()).round().astype(np.uint8)
    keypoints, descriptors = _extract_sift(gray)
    column, row, size = keypoints[:, :3].astype(np.float64).T
    # Features on the border of hidden pixels are not on a surface.
    kept = np.ones(len(keypoints), dtype=bool)
    for right, down in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        i = np.clip(row + down * size, 0, camera.height - 1).astype(np.int64)
        j = np.clip(column + right * size, 0, camera.width - 1).astype(np.int64)
        kept &= visible[i, j]
    order = np.lexsort((row, column, -size))
    order = order[kept[order]][:MAX_FEATURES]
    vectors = descriptors[order].astype(np.float32)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.stack([column, row], axis=1)[order], vectors / np.maximum(lengths, 1e-9)


def _extract_sift(gray: npt.NDArray[np.uint8]) -> tuple[Float32, Float32]:
    """Keypoints [N, 4] (column and row in pixels, size, orientation) and descriptors [N, 128]."""
    pycolmap = load_pycolmap()

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)
    try:
        with warnings.catch_warnings():
            # Its successor takes pycolmap's own bitmaps only.
            warnings.simplefilter("ignore", DeprecationWarning)
            extractor = pycolmap.Sift(pycolmap.FeatureExtractionOptions(), pycolmap.Device.cpu)
        keypoints, descriptors = extractor.extract(gray)
    finally:
        pycolmap.logging.minloglevel = level
    return keypoints, descriptors


def _photo_pairs(views: list[View]) -> list[tuple[int, int]]:
    """Pairs of photos to match: each photo with those nearest to it."""
    centers = camera_centers(views)
    pairs = set()
    for v in range(len(views)):
        for other in by_distance(centers, v)[:MATCHED_PHOTOS]:
            pairs.add((min(v, other), max(v, other)))
    return sorted(pairs)


def _matches(features_a: Features, features_b: Features) -> Int64:
    """Pairs [M, 2] of features that are each other's best match."""
    if min(len(features_a[0]), len(features_b[0])) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    similarity = features_a[1] @ features_b[1].T
    best = similarity.argmax(axis=1)
    rows = np.arange(len(best))
    is_mutual = similarity.argmax(axis=0)[best] == rows
    best_two = np.partition(similarity, -2, axis=1)[:, -2:]
    distance = np.sqrt(np.maximum(2.0 - 2.0 * best_two, 0.0))
    rows = rows[is_mutual & (distance[:, 1] < MAX_RATIO * distance[:, 0])]
    return np.stack([rows, best[rows]], axis=1)


def _epipolar_distance(a: View, pixels_a: Float64, b: View, pixels_b: Float64) -> Float64:
    """Distance [M] in pixels of pixels of b to the epipolar lines of pixels of a."""
    relative = b.camera.viewmat @ np.linalg.inv(a.camera.viewmat)
    x, y, z = relative[:3, 3]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    essential = cross @ relative[:3, :3]
    fundamental = np.linalg.inv(b.camera.K).T @ essential @ np.linalg.inv(a.camera.K)
    lines = np.pad(pixels_a, ((0, 0), (0, 1)), constant_values=1.0) @ fundamental.T
    lengths = np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-12)
    distance: Float64 = np.abs((lines[:, :2] * pixels_b).sum(axis=1) + lines[:, 2]) / lengths
    return distance


def _tracks(pairs: Int64, count: int) -> Int64:
    """Lowest feature [count] that each feature is connected with by matches."""
    track = np.arange(count)
    while True:
        lowest = track[pairs].min(axis=1)
        joined = track.copy()
        np.minimum.at(joined, pairs[:, 0], lowest)
        np.minimum.at(joined, pairs[:, 1], lowest)
        if (joined == track).all():
            return track
        track = joined


def _triangulated(
    views: list[View], view_of: Int64, pixels: Float64, track: Int64
) -> tuple[Float64, Float64]:
    """Points nearest to the rays of their features, and their colors, if the rays agree.

    Args:
        views: V photos.
        view_of: [N], photo of each feature.
        pixels: [N, 2].
        track: [N], equal for features of one point.
    """
    names, point = np.unique(track, return_inverse=True)
    if not len(names):
        return np.zeros((0, 3)), np.zeros((0, 3))
    K = np.stack([view.camera.K for view in views])[view_of]
    viewmat = np.stack([view.camera.viewmat for view in views])[view_of]
    center = camera_centers(views)[view_of]
    local = np.ones((len(pixels), 3))
    local[:, :2] = (pixels - K[:, :2, 2]) / K[:, [0, 1], [0, 1]]
    ray = np.einsum("nij,ni->nj", viewmat[:, :3, :3], local)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    matrix, right = np.zeros((len(names), 3, 3)), np.zeros((len(names), 3))
    np.add.at(matrix, point, across)
    np.add.at(right, point, np.einsum("nij,nj->ni", across, center))
    # The lowest eigenvalue for two rays is 1 - the cosine of their angle; more rays add to it.
    kept = np.linalg.eigvalsh(matrix)[:, 0] > 1.0 - np.cos(np.radians(MIN_ANGLE_DEG))
    matrix[~kept] = np.eye(3)
    xyz = np.linalg.solve(matrix, right[..., None])[..., 0]
    local = np.einsum("nij,nj->ni", viewmat[:, :3, :3], xyz[point]) + viewmat[:, :3, 3]
    # Clipped so that points behind a camera have a large error.
    z = np.maximum(local[:, 2:], 1e-9)
    error = np.linalg.norm(local[:, :2] / z * K[:, [0, 1], [0, 1]] + K[:, :2, 2] - pixels, axis=1)
    np.logical_and.at(kept, point, error < MAX_ERROR_PX)
    colors = np.zeros((len(names), 3))
    for v, view in enumerate(views):
        column, row = pixels[view_of == v].astype(np.int64).T
        np.add.at(colors, point[view_of == v], view.image[row, column, :3] / 255.0)
    colors /= np.bincount(point)[:, None]
    return xyz[kept], colors[kept]


def with_points_between(
    xyz: Float64, colors: Float64, count: int, random: np.random.Generator
) -> tuple[Float64, Float64]:
    """Add points between the given ones and their nearest neighbors.

    Args:
        xyz: [P, 3] in any frame.
        colors: [P, 3].
        count: number of points afterward; no point is removed.
        random: draws pairs and positions between them.

    Returns:
        Points [max(P, count), 3] and their colors, the given ones first.
    """
    more = max(0, count - len(xyz))
    points = random.integers(len(xyz), size=more)
    # Relative to the median, for the precision of squared distances.
    local = xyz - np.median(xyz, axis=0)
    squares = (local**2).sum(axis=1)
    neighbors = np.empty(more, dtype=np.int64)
    for part in np.array_split(np.arange(more), 1 + more // 1024):  # bounds memory
        chosen = points[part]
        distance = squares - 2.0 * local[chosen] @ local.T
        distance[np.arange(len(chosen)), chosen] = np.inf
        near = np.argpartition(distance, NEIGHBORS, axis=1)[:, :NEIGHBORS]
        neighbors[part] = near[
            np.arange(len(chosen)), random.integers(near.shape[1], size=len(chosen))
        ]
    fraction = random.uniform(size=(more, 1))
    return (
        np.concatenate([xyz, xyz[points] + fraction * (xyz[neighbors] - xyz[points])]),
        np.concatenate([colors, colors[points] + fraction * (colors[neighbors] - colors[points])]),
    )
