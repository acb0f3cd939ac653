"""Predictions for pairs of photos: their interface and checks, and the pixels that are used."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from igsr.cameras.grid import Grid, thinned
from igsr.capture.photo_folder import Photo
from igsr.capture.types import intrinsic_matrix
from igsr.geometry.similarity import is_spread

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

#: Maximum number of aligned points of all pointmaps; grids are thinned to it, which bounds time.
MAX_POINTS = 4_000_000
#: Two photos overlap if at least this fraction of the pixels of both is confident.
MIN_CONFIDENT_FRACTION = 0.05
#: Raw confidence above which a pixel is confident.
CONFIDENT = 1.5
#: Points further than this many median distances are not on a surface.
MAX_MEDIANS = 1e4
#: Stride of the rows and columns that decide whether photos overlap.
SCORE_STRIDE = 4


@dataclass(frozen=True, eq=False)
class PairPrediction:
    """Pointmaps of an ordered pair of photos (DUSt3R, Wang et al. 2024).

    All points are in the camera frame of ``first``, OpenCV axes, in an arbitrary unit per pair.
    Raw confidence is above 1, where 1 means none. Values that are not finite are ignored.
    """

    first: int  # index of the photo whose camera frame this is
    second: int  # index of the other photo
    first_points: np.ndarray  # float32 [h, w, 3], on the grid of photo ``first``
    first_confidence: np.ndarray  # float32 [h, w]
    second_points: np.ndarray  # float32 [h2, w2, 3], on the grid of photo ``second``
    second_confidence: np.ndarray  # float32 [h2, w2]

    @property
    def photos(self) -> tuple[int, int]:
        """Indices of both photos."""
        return self.first, self.second

    @property
    def sides(self) -> tuple[tuple[Float32, Float32], tuple[Float32, Float32]]:
        """Points [h, w, 3] and raw confidence [h, w] of the first photo and of the second."""
        return (
            (self.first_points, self.first_confidence),
            (self.second_points, self.second_confidence),
        )


class Predictor(Protocol):
    """Predicts pointmaps of pairs of photos, as a network does."""

    def __call__(
        self,
        photos: Sequence[Photo],
        pairs: Sequence[tuple[int, int]],
        progress: Callable[[str, int, int], None] | None = None,
    ) -> tuple[list[Grid], list[PairPrediction]]:
        """The grid of every photo, and predictions for pairs of their indices (first, second).

        ``progress`` is called with "pairs", done and total.
        """
        ...


@dataclass(frozen=True, eq=False)
class PhotoToAlign:
    """A photo before the alignment.

    Photos of one group (None is a group, too) without intrinsics share their focal length; their
    principal points are in the center.
    """

    name: str  # for messages
    height: int
    width: int
    grid: Grid  # position of its predictions in the photo
    group: Hashable = None
    viewmat: np.ndarray | None = None  # float64 [4, 4], world to camera, fixed; or None
    intrinsics: np.ndarray | None = None  # float64 [3, 3], pixels, fixed; or None

    def centered(self, focal: float) -> Float64:
        """Intrinsics [3, 3] with a focal length in pixels, principal point in the center."""
        return intrinsic_matrix(focal, focal, self.width / 2, self.height / 2)


@dataclass(frozen=True, eq=False)
class Edge:
    """A prediction for two photos that overlap."""

    prediction: PairPrediction
    score: float  # product of the photos' mean confidences, as in DUSt3R


@dataclass(eq=False)
class PhotoObservations:
    """Predictions of K edges for P pixels of one photo."""

    points: Float32  # [K, 3, P], each in the stored frame of its edge
    confidence: Float32  # [K, P], raw; 1 for points that must not be used
    edges: npt.NDArray[np.int64]  # [K]
    is_first: npt.NDArray[np.bool_]  # [K], whether the photo is the edge's first
    pixels: Float64  # [P, 2], photo coordinates


@dataclass(eq=False)
class Observations:
    """Photos and the edges between them.

    Points of an edge are stored as (point - center) / unit, so that similarities rotate about the
    middle of the points, and all scales and translations are of about one size.
    """

    edges: npt.NDArray[np.int64]  # [E, 2], first and second photo of each edge
    rows: npt.NDArray[np.int64]  # [E, 2], rows of each edge in ``photos[first]`` and ``[second]``
    scores: Float64  # [E]
    centers: Float64  # [E, 3], in the unit of the prediction
    units: Float64  # [E], positive
    photos: dict[int, PhotoObservations]  # by index; only photos with an edge

    def camera(self, edge: int) -> Float64:
        """The camera center [3] of an edge's first photo, in the edge's stored frame."""
        center: Float64 = -self.centers[edge] / self.units[edge]
        return center

    def side(self, edge: int, side: int) -> tuple[Float64, Float64]:
        """Points [3, P] and confidence [P] of an edge's first (0) or second (1) photo."""
        photo, row = self.photos[int(self.edges[edge, side])], self.rows[edge, side]
        return photo.points[row].astype(np.float64), photo.confidence[row].astype(np.float64)


def usable_confidence(points: Float32, confidence: Float32) -> Float32:
    """Raw confidence [...] of points [..., 3], at least 1; 1 for points that must not be used."""
    with np.errstate(invalid="ignore"):
        distance = np.abs(points).max(axis=-1)
        usable = np.isfinite(distance) & np.isfinite(confidence)
        if usable.any():
            usable &= distance <= MAX_MEDIANS * np.median(distance[usable])
        result: Float32 = np.where(usable, np.maximum(confidence, 1.0), 1.0).astype(np.float32)
    return result


def _usable(points: Float32, confidence: Float32, stride: int) -> tuple[Float64, Float32]:
    """Thinned points [3, P], 0 if they must not be used, and their usable confidence [P]."""
    taken = tuple(thinned(size, stride) for size in confidence.shape)
    usable = usable_confidence(points[taken], confidence[taken]).ravel()
    xyz = np.where(usable > 1.0, points[taken].reshape(-1, 3).T, 0.0)
    return xyz.astype(np.float64), usable


def overlapping_edges(predictions: Sequence[PairPrediction]) -> list[Edge]:
    """The predictions for photos that overlap, according to their confidences."""
    edges = []
    for prediction in predictions:
        score = 1.0
        for points, confidence in prediction.sides:
            xyz, usable = _usable(points, confidence, SCORE_STRIDE)
            confident = (usable > CONFIDENT).mean()
            if confident < MIN_CONFIDENT_FRACTION or not is_spread(xyz, np.log(usable)):
                break
            score *= float(usable.mean(dtype=np.float64))
        else:
            edges.append(Edge(prediction, score))
    return edges


def observe(edges: Sequence[Edge], photos: Sequence[PhotoToAlign]) -> Observations:
    """Gather the predictions of edges by photo, as copies thinned to ``MAX_POINTS`` in all."""
    predictions = [edge.prediction for edge in edges]
    total = sum(confidence.size for p in predictions for _, confidence in p.sides)
    stride = max(1, int(np.ceil(np.sqrt(total / MAX_POINTS))))
    of_photo: dict[int, list[tuple[int, int]]] = {}
    rows = np.zeros((len(predictions), 2), dtype=np.int64)
    for e, prediction in enumerate(predictions):
        for side, photo in enumerate(prediction.photos):
            rows[e, side] = len(of_photo.setdefault(photo, []))
            of_photo[photo].append((e, side))
    observed: dict[int, PhotoObservations] = {}
    for photo in sorted(of_photo):
        pixels = photos[photo].grid.photo_pixels(stride)
        on_edges, sides = (np.array(column) for column in zip(*of_photo[photo], strict=True))
        observed[photo] = PhotoObservations(
            np.empty((len(on_edges), 3, len(pixels)), dtype=np.float32),
            np.empty((len(on_edges), len(pixels)), dtype=np.float32),
            on_edges,
            sides == 0,
            pixels,
        )
    centers, units = np.zeros((len(predictions), 3)), np.ones(len(predictions))
    for e, prediction in enumerate(predictions):
        parts = [_usable(points, confidence, stride) for points, confidence in prediction.sides]
        weights = np.log(np.concatenate([usable for _, usable in parts]).astype(np.float64))
        weights /= max(float(weights.sum()), np.finfo(np.float64).tiny)
        both = np.concatenate([xyz for xyz, _ in parts], axis=1)
        centers[e] = both @ weights
        unit = float(np.linalg.norm(both - centers[e][:, None], axis=0) @ weights)
        units[e] = unit if unit > 0.0 else 1.0
        for side, photo in enumerate(prediction.photos):
            xyz, usable = parts[side]
            observed[photo].confidence[rows[e, side]] = usable
            observed[photo].points[rows[e, side]] = np.where(
                usable > 1.0, (xyz - centers[e][:, None]) / units[e], 0.0
            )
    ends = np.array([p.photos for p in predictions], dtype=np.int64).reshape(-1, 2)
    scores = np.array([edge.score for edge in edges])
    return Observations(ends, rows, scores, centers, units, observed)
