"""Estimate cameras by DUSt3R: the network on pairs of photos, then global alignment."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr.cameras.alignment import PhotoToAlign, Predictor, align
from igsr.cameras.checkpoint_search import find_checkpoint
from igsr.cameras.depth_maps import AlignedPhoto, fused_points, trusted_pixels
from igsr.cameras.dust3r.checkpoint import load_network
from igsr.cameras.dust3r.prediction import DenseGrid, DenseMap, DustPredictor
from igsr.cameras.estimate import Estimate
from igsr.cameras.given_cameras import check_given_cameras
from igsr.cameras.grid import Grid
from igsr.capture import Camera
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError

Float64 = npt.NDArray[np.float64]

#: Up to this number of photos all pairs are predicted.
MAX_COMPLETE_PHOTOS = 20
#: Default window of the pair graph for more photos.
WINDOW = 8
#: Default window if a graph names none.
DEFAULT_WINDOW = 3

_GRAPH = re.compile(r"(complete)|(swin|logwin)(?:-(\d{1,9}))?(-noncyclic)?|(oneref)(?:-(\d{1,9}))?")


class Dust3r:
    """DUSt3R (Wang et al. 2024) as an estimator.

    Args:
        predictor: predicts pointmaps; by default the network.
        checkpoint: file with the network's weights; by default it is searched for.
        graph: which pairs of photos are predicted, see ``pair_graph``; by default all pairs, of
            more than 20 photos "swin-8".
        cameras: known cameras by photo name, which are kept. Other photos of the same device, size
            and EXIF focal length get their intrinsics.
    """

    name = "dust3r"

    def __init__(
        self,
        predictor: Predictor | None = None,
        checkpoint: str | os.PathLike[str] | None = None,
        graph: str | None = None,
        cameras: Mapping[str, Camera] | None = None,
    ) -> None:
        self.predictor = predictor
        self.checkpoint = None if checkpoint is None else Path(checkpoint)
        self.graph = graph
        self.cameras = dict(cameras or {})

    def __call__(
        self,
        photos: Sequence[Photo],
        *,
        seed: int = 0,
        progress: Callable[[str, int, int], None] | None = None,
    ) -> Estimate:
        """Find the cameras of photos.

        Photos of one device, size and EXIF focal length, upright or not, share their focal length.

        Args:
            photos: at least two.
            seed: of RANSAC.
            progress: called as progress("pairs" or "alignment", done, total).

        Raises:
            IgsrError: there are fewer than two photos, a known camera is of no photo or of another
                size, no checkpoint is found, or no two photos overlap.
        """
        pairs = pair_graph(self.graph or default_graph(len(photos)), len(photos))
        check_given_cameras(self.cameras, photos)
        predictor = self._network() if self.predictor is None else self.predictor
        grids, predictions = predictor(photos, pairs, progress)
        alignment = align(predictions, self._to_align(photos, grids), seed=seed, progress=progress)
        aligned = [
            with_dense_depth(photo, grid.dense)
            if photo is not None and isinstance(grid, DenseGrid) and grid.dense is not None
            else photo
            for photo, grid in zip(alignment.photos, grids, strict=True)
        ]
        trusted = trusted_pixels(aligned, alignment.pairs)
        known: Mapping[str, Camera] = {}
        for photo, placed, mask in zip(photos, aligned, trusted, strict=True):
            if placed is None or mask is None:
                continue
            mask &= placed.grid.usable(photo)
            # Known cameras are in the world of the rest only if at least one was aligned.
            if photo.name in self.cameras:
                known = self.cameras
        return Estimate(
            cameras=[
                known.get(photo.name) if placed is None else placed.camera
                for photo, placed in zip(photos, aligned, strict=True)
            ],
            points=fused_points(photos, aligned, trusted),
            depths=[None if photo is None else photo.depth for photo in aligned],
            trusted=list(trusted),
            warnings=alignment.warnings,
            grids=[None if photo is None else photo.grid for photo in aligned],
        )

    def _network(self) -> Predictor:
        path = find_checkpoint("dust3r", self.checkpoint)
        if path is None:
            raise IgsrError("no checkpoint of DUSt3R is found in the usual places; name one")
        return DustPredictor(load_network(path))

    def _to_align(self, photos: Sequence[Photo], grids: Sequence[Grid]) -> list[PhotoToAlign]:
        def camera_key(photo: Photo) -> Hashable:
            return photo.device, photo.focal, photo.image.shape[:2]

        intrinsics: dict[Hashable, np.ndarray] = {}
        for photo in photos:
            if photo.name in self.cameras:
                intrinsics.setdefault(camera_key(photo), self.cameras[photo.name].K)
        to_align = []
        for photo, grid in zip(photos, grids, strict=True):
            height, width = photo.image.shape[:2]
            camera = self.cameras.get(photo.name)
            to_align.append(
                PhotoToAlign(
                    photo.name,
                    height,
                    width,
                    grid,
                    group=(photo.device, photo.focal, *sorted((height, width))),
                    viewmat=None if camera is None else camera.viewmat,
                    intrinsics=intrinsics.get(camera_key(photo)) if camera is None else camera.K,
                )
            )
        return to_align


def default_graph(photos: int) -> str:
    """The pair graph for a number of photos.

    The number of all pairs grows with the square of the photos: 20 photos have 380 predictions.
    Beyond that each photo is paired with the 8 after it, 16 predictions a photo, which relies on
    names in the order of capture. The window wraps around; for a path that is not closed, those few
    pairs have low confidence and are ignored.
    """
    return "complete" if photos <= MAX_COMPLETE_PHOTOS else f"swin-{WINDOW}"


def pair_graph(graph: str, photos: int) -> list[tuple[int, int]]:
    """List the pairs of photos in both orders, sorted; DUSt3R's code has the same graphs.

    Args:
        graph: "complete": all pairs; "swin-K": each photo with the next K, wrapping around;
            "logwin-K": each with those 1, 2, 4, ... 2^(K-1) after it; "oneref-K": all with photo K,
            counted from 0. K defaults to 3, for oneref to 0. "-noncyclic" after swin and logwin
            does not wrap around.
        photos: number of photos, at least 2.

    Raises:
        IgsrError: the graph is unknown, its number is 0 or names no photo, or there are too few
            photos.
    """
    match = _GRAPH.fullmatch(graph)
    if match is None:
        raise IgsrError(
            f"the pair graph {graph!r} is unknown; give complete, swin-K, logwin-K or oneref-K, "
            "and -noncyclic after swin-K or logwin-K if the path is not closed"
        )
    if photos < 2:
        raise IgsrError(f"poses need at least two photos, not {photos}; add some")
    _, window, number, noncyclic, oneref, reference = match.groups()
    if oneref:
        center = int(reference or 0)
        if center >= photos:
            raise IgsrError(f"{graph} names photo {center} of {photos}; count from 0")
        joined = {(min(i, center), max(i, center)) for i in range(photos) if i != center}
    elif window:
        steps = int(number or DEFAULT_WINDOW)
        if steps < 1:
            raise IgsrError(f"{graph} pairs no photos; give a number of at least 1")
        # Larger windows repeat pairs, and 2 to a larger power would only be large.
        steps = min(steps, photos)
        offsets = [2**k for k in range(steps)] if window == "logwin" else range(1, steps + 1)
        reached = [(i, i + step) for i in range(photos) for step in offsets]
        if noncyclic:
            reached = [(i, j) for i, j in reached if j < photos]
        wrapped = [(i, j % photos) for i, j in reached]
        joined = {(min(pair), max(pair)) for pair in wrapped if pair[0] != pair[1]}
    else:
        joined = {(i, j) for j in range(photos) for i in range(j)}
    return [pair for i, j in sorted(joined) for pair in ((i, j), (j, i))]


def with_dense_depth(photo: AlignedPhoto, dense: DenseMap) -> AlignedPhoto:
    """Replace a photo's depths by its own dense map, scaled to the aligned depths.

    Both have the same edges, so their ratio is smooth: it is interpolated between the samples, and
    edges stay as sharp as the network predicts them.
    """
    own = np.where(dense.confidence > 1.0, dense.depth, 0.0).astype(np.float64)
    at_samples = own[np.ix_(dense.rows, dense.columns)]
    known = np.isfinite(photo.depth) & (at_samples > 0.0)
    ratio = np.divide(photo.depth, at_samples, out=np.zeros_like(at_samples), where=known)
    down, across = map(_interpolation, (dense.rows, dense.columns), own.shape)
    share = down @ known @ across.T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (own * (down @ ratio @ across.T) / share).astype(np.float32)
    depth[~((share > 0.0) & (own > 0.0))] = np.nan
    highest = np.maximum(dense.confidence, down @ photo.confidence @ across.T)
    confidence = np.where(own > 0.0, highest, 1.0).astype(np.float32)
    return replace(photo, grid=dense.grid, depth=depth, confidence=confidence)


def _interpolation(samples: range, size: int) -> Float64:
    """Linear interpolation [size, samples] from samples to ``size`` pixels."""
    position = (np.arange(size) - samples.start) / samples.step
    position = np.clip(position, 0.0, len(samples) - 1.0)
    return np.maximum(1.0 - np.abs(position[:, None] - np.arange(len(samples))), 0.0)
