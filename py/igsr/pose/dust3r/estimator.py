"""Cameras of photos by DUSt3R: the network on pairs of photos, then global alignment."""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path

import numpy as np

from igsr.capture import Camera
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError
from igsr.pose.alignment import AlignedPhoto, PhotoToAlign, Predictor, align, trusted_pixels
from igsr.pose.dust3r.pairs import pair_graph, usual_graph
from igsr.pose.estimate import Estimate
from igsr.pose.fused_points import fused_points
from igsr.pose.given_cameras import check_given_cameras
from igsr.pose.grid import Grid
from igsr.pose.photo_samples import usable


class Dust3r:
    """DUSt3R (Wang et al. 2024) as an estimator.

    Args:
        predictor: what stands where the network stands; by default the network itself.
        checkpoint: file with the network's weights; by default where they usually lie.
        graph: which pairs of photos are looked at, as in ``pair_graph``; by default all, of many
            photos those that follow each other.
        cameras: by photo name, cameras that are known; they stay as they are. Photos of the same
            camera that are not among them then have its intrinsics.
    """

    name = "dust3r"

    def __init__(
        self,
        predictor: Predictor | None = None,
        checkpoint: str | os.PathLike[str] | None = None,
        graph: str | None = None,
        cameras: Mapping[str, Camera] | None = None,
    ) -> None:
        """Keep the settings; nothing is loaded yet."""
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
            progress: called with ("pairs" or "alignment", done, all).

        Raises:
            IgsrError: there are under two photos, a known camera is of no photo or of another size,
                no checkpoint is found, or no two photos show the same thing.
        """
        pairs = pair_graph(self.graph or usual_graph(len(photos)), len(photos))
        check_given_cameras(self.cameras, photos)
        predictor = self._network() if self.predictor is None else self.predictor
        grids, predictions = predictor(photos, pairs, progress)
        alignment = align(predictions, self._known(photos, grids), seed=seed, progress=progress)
        aligned = _dense(alignment.photos, grids)
        trusted = trusted_pixels(aligned, alignment.pairs)
        for photo, placed, sure in zip(photos, aligned, trusted, strict=True):
            if placed is not None and sure is not None:
                sure &= usable(photo, placed.grid)
        # Known cameras are of one world with the rest only if some of them were aligned.
        known = self.cameras if self._any_known(photos, aligned) else {}
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

    def _any_known(self, photos: Sequence[Photo], aligned: Sequence[AlignedPhoto | None]) -> bool:
        pairs = zip(photos, aligned, strict=True)
        return any(placed is not None and photo.name in self.cameras for photo, placed in pairs)

    def _network(self) -> Predictor:
        from igsr.pose.dust3r.checkpoint import find_checkpoint, load_network
        from igsr.pose.dust3r.prediction import DustPredictor

        found = find_checkpoint(self.checkpoint)
        if found is None:
            raise IgsrError(
                "no checkpoint of DUSt3R is found where downloads usually lie; name one"
            )
        return DustPredictor(load_network(found))

    def _known(self, photos: Sequence[Photo], grids: Sequence[Grid]) -> list[PhotoToAlign]:
        given: dict[Hashable, np.ndarray] = {}
        for photo in photos:
            if photo.name in self.cameras:
                given.setdefault(_camera_key(photo), self.cameras[photo.name].K)
        known = []
        for photo, grid in zip(photos, grids, strict=True):
            height, width = photo.image.shape[:2]
            camera = self.cameras.get(photo.name)
            known.append(
                PhotoToAlign(
                    photo.name,
                    height,
                    width,
                    grid,
                    group=(photo.device, photo.focal, *sorted((height, width))),
                    viewmat=None if camera is None else camera.viewmat,
                    intrinsics=given.get(_camera_key(photo)) if camera is None else camera.K,
                )
            )
        return known


def _dense(
    photos: Sequence[AlignedPhoto | None], grids: Sequence[Grid]
) -> list[AlignedPhoto | None]:
    """The photos with depths at the network's resolution where the predictor kept that."""
    from igsr.pose.dust3r.dense_depth import with_dense_depth
    from igsr.pose.dust3r.prediction import DenseGrid

    return [
        with_dense_depth(photo, grid.dense)
        if photo is not None and isinstance(grid, DenseGrid) and grid.dense is not None
        else photo
        for photo, grid in zip(photos, grids, strict=True)
    ]


def _camera_key(photo: Photo) -> Hashable:
    """Equal for photos that one camera took, held the same way."""
    return photo.device, photo.focal, photo.image.shape[:2]
