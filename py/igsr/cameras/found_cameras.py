"""Estimated cameras at the photos' full size, from which a capture of any size is made."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from igsr.cameras.estimate import Estimate
from igsr.capture import Camera, Capture, View
from igsr.capture.downscaling import resampled_plane, resized_camera, resized_tracks
from igsr.capture.photo_folder import Photo
from igsr.capture.undistort import Lens, Undistorter
from igsr.errors import IgsrError


@dataclass(frozen=True, eq=False)
class FoundCameras:
    """Estimated cameras of photos.

    Attributes:
        names: of all photos, in the estimator's order.
        estimate: cameras and tracks are in pixels of the upright photos at full size; depths have
            the resolution of the estimator and are 0 where they are not trusted.
        made_by: what the cameras depend on, except the photos, as JSON values.
    """

    names: list[str]
    estimate: Estimate
    made_by: dict[str, Any]

    @staticmethod
    def of(photos: Sequence[Photo], estimate: Estimate, made_by: dict[str, Any]) -> FoundCameras:
        """Scale an estimate, whose photos may have been reduced, to the photos' full size.

        Args:
            photos: photos of the estimate.
            estimate: in pixels of these photos.
            made_by: see the class.
        """
        pairs = list(zip(photos, estimate.cameras, strict=True))
        before = {photo.name: camera for photo, camera in pairs if camera is not None}
        after = {
            photo.name: resized_camera(camera, *photo.full_size)
            for photo, camera in pairs
            if camera is not None
        }
        whole = replace(
            estimate,
            cameras=[after.get(photo.name) for photo in photos],
            points=resized_tracks(estimate.points, before, after),
            depths=_trusted_depths(photos, estimate),
            grids=[],
            lenses=list(estimate.lenses) or [None] * len(photos),
            evidence=list(estimate.evidence) or [None] * len(photos),
        )
        return FoundCameras([photo.name for photo in photos], whole, made_by)

    @property
    def placed(self) -> list[str]:
        """Names of the photos whose cameras were found."""
        pairs = zip(self.names, self.estimate.cameras, strict=True)
        return [name for name, camera in pairs if camera is not None]

    @property
    def not_placed(self) -> list[str]:
        """Names of the photos whose cameras were not found."""
        pairs = zip(self.names, self.estimate.cameras, strict=True)
        return [name for name, camera in pairs if camera is None]

    @property
    def trusted(self) -> list[np.ndarray | None]:
        """Mask of confident depth for each placed photo; see ``Estimate``."""
        pairs = zip(self.estimate.trusted, self.estimate.cameras, strict=True)
        return [mask for mask, camera in pairs if camera is not None]

    @property
    def depths(self) -> list[np.ndarray | None]:
        """Depth of each placed photo, 0 where it is not trusted; see ``Estimate``."""
        pairs = zip(self.estimate.depths, self.estimate.cameras, strict=True)
        return [depth for depth, camera in pairs if camera is not None]

    def capture(self, path: Path, photos: Iterable[Photo]) -> Capture:
        """Make a capture of the placed photos, with lens distortion undone.

        Args:
            path: of the capture.
            photos: the photos at any size, in any order; photos without a camera are skipped.

        Raises:
            IgsrError: a placed photo is missing, or undistortion leaves no pixel of it.
        """
        number = {name: index for index, name in enumerate(self.names)}
        undistorters: dict[object, Undistorter] = {}
        views: dict[str, View] = {}
        for photo in photos:
            index = number.get(photo.name)
            camera = None if index is None else self.estimate.cameras[index]
            if index is None or camera is None:
                continue
            if photo.full_size != (camera.width, camera.height):
                raise IgsrError(
                    f"{photo.name} has {photo.full_size[0]}x{photo.full_size[1]} pixels, but its "
                    f"camera was estimated for {camera.width}x{camera.height}; estimate it again"
                )
            lens = self.estimate.lenses[index]
            view = _undistorted(photo, camera, lens, undistorters)
            depth = self.estimate.depths[index]
            # Networks predict depths for pinhole cameras only.
            if depth is not None and (lens is None or lens.is_pinhole):
                size = view.camera.width, view.camera.height
                view = replace(view, depth=resampled_plane(depth, *size))
            views[photo.name] = replace(view, pose_evidence=self.estimate.evidence[index])
        lost = [name for name in self.placed if name not in views]
        if lost:
            raise IgsrError(f"The photo {lost[0]} is missing or cannot be read; put it back")
        before = dict(zip(self.names, self.estimate.cameras, strict=True))
        points = resized_tracks(
            self.estimate.points,
            {name: camera for name, camera in before.items() if camera is not None},
            {name: view.camera for name, view in views.items()},
        )
        return Capture(path, [views[name] for name in self.placed], points)


def _trusted_depths(photos: Sequence[Photo], estimate: Estimate) -> list[np.ndarray | None]:
    """Depths of whole photos, 0 if unknown or not trusted."""
    kept: list[np.ndarray | None] = []
    grids = estimate.grids or [None] * len(photos)
    found = zip(photos, estimate.depths, estimate.trusted, grids, strict=True)
    for photo, depth, sure, grid in found:
        if depth is None:
            kept.append(None)
            continue
        known = np.isfinite(depth) & (depth > 0.0)
        if sure is not None:
            known &= sure
        plane = np.where(known, depth, 0.0).astype(np.float32)
        if grid is not None:
            height, width = photo.image.shape[:2]
            plane = grid.over_photo(plane, width, height)
        kept.append(plane if plane.any() else None)
    return kept


def _undistorted(
    photo: Photo, camera: Camera, lens: Lens | None, undistorters: dict[object, Undistorter]
) -> View:
    """Undistort a photo; ``undistorters`` caches the maps of lenses."""
    image, mask = photo.image, photo.mask
    camera = resized_camera(camera, image.shape[1], image.shape[0])
    if lens is not None and not lens.is_pinhole:
        key = lens, camera.K.tobytes(), camera.width, camera.height
        if key not in undistorters:
            undistorters[key] = Undistorter(lens, camera.K, camera.width, camera.height)
        undistorter = undistorters[key]
        image = undistorter.image(image)
        mask = undistorter.valid.copy() if mask is None else undistorter.mask(mask)
    if mask is not None and mask.all():
        mask = None
    rig = None if photo.place is None else photo.place.rig
    view = View(photo.name, camera, "train", image, mask, exposure_value=photo.exposure_value)
    return replace(view, rig=rig)
