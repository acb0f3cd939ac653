"""Predictions as the alignment sees them: usable ones only, thinned, and gathered by photo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr.geometry.similarity import is_spread
from igsr.pose.alignment.predictions import PairPrediction, PhotoToAlign
from igsr.pose.grid import kept

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

#: Points of all pointmaps together that are aligned; grids are thinned down to it. Bounds time.
MOST_POINTS = 4_000_000
#: A pair of photos has something in common where, in both, at least this share of the pixels has a
#: raw confidence above this.
SHARE, SURE = 0.05, 1.5
#: Points further than this from their camera, in units of the median, are no surface.
FARTHEST = 1e4
#: Through every so many-th row and column of a pair is looked to tell what it is worth.
LOOK = 4


@dataclass(frozen=True, eq=False)
class Edge:
    """A prediction that says something of both its photos.

    Attributes:
        prediction: of the pair.
        score: mean confidence of the first photo times that of the second, as in DUSt3R.
    """

    prediction: PairPrediction
    score: float


@dataclass(eq=False)
class PhotoObservations:
    """What all edges say of one photo's pixels.

    Attributes:
        points: float32 [K, 3, P], each in the stored frame of its edge.
        confidence: float32 [K, P], raw; 1 where a point is not to be used.
        edges: [K], which edge each row is of.
        is_first: [K], whether the photo is the edge's first.
        pixels: float64 [P, 2], photo coordinates.
    """

    points: Float32
    confidence: Float32
    edges: npt.NDArray[np.int64]
    is_first: npt.NDArray[np.bool_]
    pixels: Float64


@dataclass(eq=False)
class Observations:
    """Photos and the edges between them.

    Points of an edge are stored as (point - centre) / unit: similarities then turn about the middle
    of what they turn, and scales and translations have a common size.

    Attributes:
        edges: [E, 2], the photos of each edge, first and second.
        rows: [E, 2], the row that each edge has in ``photos[first]`` and ``photos[second]``.
        scores: [E].
        centres: float64 [E, 3], in the unit of the prediction.
        units: float64 [E], positive.
        photos: by the index of the photo; only of photos with an edge.
    """

    edges: npt.NDArray[np.int64]
    rows: npt.NDArray[np.int64]
    scores: Float64
    centres: Float64
    units: Float64
    photos: dict[int, PhotoObservations]

    def camera(self, edge: int) -> Float64:
        """The camera centre [3] of an edge's first photo, in the edge's stored frame."""
        centre: Float64 = -self.centres[edge] / self.units[edge]
        return centre

    def side(self, edge: int, side: int) -> tuple[Float64, Float64]:
        """An edge's points [3, P] of its first (0) or second (1) photo, and their confidence."""
        photo, row = self.photos[int(self.edges[edge, side])], self.rows[edge, side]
        return photo.points[row].astype(np.float64), photo.confidence[row].astype(np.float64)


def usable_confidence(points: Float32, confidence: Float32) -> Float32:
    """Raw confidence [...], at least 1, and 1 where the point [..., 3] or it is not usable."""
    with np.errstate(invalid="ignore"):
        distance = np.abs(points).max(axis=-1)
        usable = np.isfinite(distance) & np.isfinite(confidence)
        if usable.any():
            usable &= distance <= FARTHEST * np.median(distance[usable])
        result: Float32 = np.where(usable, np.maximum(confidence, 1.0), 1.0).astype(np.float32)
    return result


def strong_edges(predictions: Sequence[PairPrediction]) -> list[Edge]:
    """Those predictions whose photos have something in common, as far as these can tell."""
    edges = []
    for prediction in predictions:
        score = 1.0
        for points, confidence in sides(prediction):
            look = tuple(kept(size, LOOK) for size in confidence.shape)
            sure = usable_confidence(points[look], confidence[look]).ravel()
            flat = np.where(sure > 1.0, points[look].reshape(-1, 3).T, 0.0).astype(np.float64)
            if (sure > SURE).mean() < SHARE or not is_spread(flat, np.log(sure)):
                break
            score *= float(sure.mean(dtype=np.float64))
        else:
            edges.append(Edge(prediction, score))
    return edges


def sides(prediction: PairPrediction) -> list[tuple[Float32, Float32]]:
    """Points [h, w, 3] and raw confidence [h, w] of the first and of the second photo."""
    return [
        (prediction.first_points, prediction.first_confidence),
        (prediction.second_points, prediction.second_confidence),
    ]


def observe(edges: Sequence[Edge], photos: Sequence[PhotoToAlign]) -> Observations:
    """Gather what edges say; the arrays are copies, thinned to ``MOST_POINTS`` in all.

    Args:
        edges: to be aligned.
        photos: all photos.
    """
    predictions = [edge.prediction for edge in edges]
    points_in_all = sum(p.first_confidence.size + p.second_confidence.size for p in predictions)
    stride = max(1, int(np.ceil(np.sqrt(points_in_all / MOST_POINTS))))
    of_photo: dict[int, list[tuple[int, int]]] = {}
    rows = np.zeros((len(predictions), 2), dtype=np.int64)
    for e, prediction in enumerate(predictions):
        for side, photo in enumerate((prediction.first, prediction.second)):
            rows[e, side] = len(of_photo.setdefault(photo, []))
            of_photo[photo].append((e, side))
    seen: dict[int, PhotoObservations] = {}
    for photo in sorted(of_photo):
        pixels = photos[photo].grid.photo_pixels(stride)
        on_edges, of_side = (np.array(column) for column in zip(*of_photo[photo], strict=True))
        seen[photo] = PhotoObservations(
            np.empty((len(on_edges), 3, len(pixels)), dtype=np.float32),
            np.empty((len(on_edges), len(pixels)), dtype=np.float32),
            on_edges,
            of_side == 0,
            pixels,
        )
    centres, units = np.zeros((len(predictions), 3)), np.ones(len(predictions))
    for e, prediction in enumerate(predictions):
        parts = []
        for side, (photo, (points, confidence)) in enumerate(
            zip((prediction.first, prediction.second), sides(prediction), strict=True)
        ):
            taken = tuple(kept(size, stride) for size in confidence.shape)
            usable = usable_confidence(points[taken], confidence[taken]).ravel()
            flat = np.where(usable > 1.0, points[taken].reshape(-1, 3).T, 0.0).astype(np.float64)
            seen[photo].confidence[rows[e, side]] = usable
            parts.append((seen[photo].points[rows[e, side]], flat, usable))
        weights = np.log(np.concatenate([usable for _, _, usable in parts]).astype(np.float64))
        weights /= max(float(weights.sum()), np.finfo(np.float64).tiny)
        both = np.concatenate([flat for _, flat, _ in parts], axis=1)
        centres[e] = both @ weights
        unit = float(np.linalg.norm(both - centres[e][:, None], axis=0) @ weights)
        units[e] = unit if unit > 0.0 else 1.0
        for stored, flat, usable in parts:
            stored[:] = np.where(usable > 1.0, (flat - centres[e][:, None]) / units[e], 0.0)
    ends = np.array([(p.first, p.second) for p in predictions], dtype=np.int64).reshape(-1, 2)
    scores = np.array([edge.score for edge in edges])
    return Observations(ends, rows, scores, centres, units, seen)
