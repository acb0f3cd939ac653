"""Cameras as an estimator found them, at the photos' full size: a capture is made at any size."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.untrusted_npz import DAMAGE, stored_arrays
from igsr.capture import Camera, Capture, Points, View
from igsr.capture.downscaling import resampled_plane, resized_camera, resized_tracks
from igsr.capture.photo_folder import Photo
from igsr.capture.types import PoseEvidence, Tracks
from igsr.capture.undistort import Lens, Undistorter
from igsr.errors import IgsrError
from igsr.pose.estimate import Estimate

#: Of the file; a newer program may write another.
FORMAT = 2
_ABOUT = "about"


@dataclass(frozen=True, eq=False)
class FoundCameras:
    """What was found about the cameras of photos.

    Attributes:
        names: of all photos, in the estimator's order.
        estimate: cameras and tracks are in pixels of the upright photos as they were taken; depths
            are at the resolution that they were found at, 0 where they are not trusted.
        made_by: what the cameras depend on beside the photos, as plain values.
    """

    names: list[str]
    estimate: Estimate
    made_by: dict[str, Any]

    @staticmethod
    def of(photos: Sequence[Photo], estimate: Estimate, made_by: dict[str, Any]) -> FoundCameras:
        """From an estimate in the pixels of photos that may have been reduced.

        Args:
            photos: that the estimate is of.
            estimate: of as many photos.
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
        """Names of the others."""
        pairs = zip(self.names, self.estimate.cameras, strict=True)
        return [name for name, camera in pairs if camera is None]

    @property
    def trusted(self) -> list[np.ndarray | None]:
        """Per registered photo, where its depth is confident; see ``Estimate``."""
        pairs = zip(self.estimate.trusted, self.estimate.cameras, strict=True)
        return [mask for mask, camera in pairs if camera is not None]

    @property
    def depths(self) -> list[np.ndarray | None]:
        """Per registered photo its depth, 0 where it is not trusted; see ``Estimate``."""
        pairs = zip(self.estimate.depths, self.estimate.cameras, strict=True)
        return [depth for depth, camera in pairs if camera is not None]

    def capture(self, path: Path, photos: Iterable[Photo]) -> Capture:
        """The registered photos as a capture, with lens distortion undone at the photos' size.

        Args:
            path: that the capture has.
            photos: the photos at any size, in any order; those that are not registered are passed
                over.

        Raises:
            IgsrError: a registered photo is missing, or a lens bends so much that nothing of its
                photo is left.
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
                    f"{photo.name} is {photo.full_size[0]}x{photo.full_size[1]} pixels and was "
                    f"{camera.width}x{camera.height} when its camera was found; find it anew"
                )
            lens = self.estimate.lenses[index]
            view = _undistorted(photo, camera, lens, undistorters)
            depth = self.estimate.depths[index]
            # Networks know pinhole cameras only.
            if depth is not None and (lens is None or lens.is_pinhole):
                size = view.camera.width, view.camera.height
                view = replace(view, depth=resampled_plane(depth, *size))
            views[photo.name] = replace(view, pose_evidence=self.estimate.evidence[index])
        lost = [name for name in self.placed if name not in views]
        if lost:
            raise IgsrError(f"The photo {lost[0]} is gone or cannot be read; put it back")
        before = dict(zip(self.names, self.estimate.cameras, strict=True))
        points = resized_tracks(
            self.estimate.points,
            {name: camera for name, camera in before.items() if camera is not None},
            {name: view.camera for name, view in views.items()},
        )
        return Capture(path, [views[name] for name in self.placed], points)

    def to_bytes(self) -> bytes:
        """The content of a file that ``read_found`` reads."""
        found, points = self.estimate, self.estimate.points
        arrays: dict[str, Any] = {}
        for index, (camera, trusted) in enumerate(zip(found.cameras, found.trusted, strict=True)):
            if camera is not None:
                arrays[f"viewmat_{index}"], arrays[f"K_{index}"] = camera.viewmat, camera.K
            if trusted is not None:
                arrays[f"trusted_{index}"] = trusted
            depth = found.depths[index]
            if depth is not None:
                arrays[f"depth_{index}"] = depth
        if points is not None:
            arrays |= {"xyz": points.xyz, "rgb": points.rgb}
            if points.confidence is not None:
                arrays["confidence"] = points.confidence
            if points.tracks is not None:
                tracks = points.tracks
                arrays |= {"seen_by": tracks.view, "point": tracks.point, "xy": tracks.xy}
        about = {
            "format": FORMAT,
            "names": self.names,
            "sizes": [camera and [camera.width, camera.height] for camera in found.cameras],
            "lenses": [lens and vars(lens) for lens in found.lenses],
            "warnings": found.warnings,
            "track_names": points.tracks.names if points and points.tracks else [],
            "made_by": self.made_by,
            "weights": found.weights,
            "evidence": [one and vars(one) for one in found.evidence],
        }
        arrays[_ABOUT] = np.frombuffer(json.dumps(about).encode(), dtype=np.uint8)
        file = io.BytesIO()
        plain: dict[str, Any] = {name: np.ascontiguousarray(one) for name, one in arrays.items()}
        np.savez(file, **plain)
        return file.getvalue()


def read_found(path: Path) -> FoundCameras:
    """Read cameras that were kept.

    Args:
        path: of the file.

    Raises:
        IgsrError: the file is missing, damaged or of another format.
    """
    try:
        arrays = stored_arrays(path)
        about = json.loads(arrays[_ABOUT].tobytes())
        if about["format"] != FORMAT:
            raise ValueError(f"it is not of format {FORMAT}")
        names = _texts(about["names"])
        count = len(names)
        cameras = [_camera(arrays, index, about["sizes"][index]) for index in range(count)]
        lenses = [_lens(about["lenses"][index]) for index in range(count)]
        trusted = [arrays.get(f"trusted_{index}") for index in range(count)]
        depths = [_depth(arrays.get(f"depth_{index}")) for index in range(count)]
        points = _points(arrays, _texts(about["track_names"]))
        estimate = Estimate(cameras, points, depths, trusted, _texts(about["warnings"]), lenses)
        estimate.weights = _weights(about.get("weights"))
        estimate.evidence = [_evidence(one) for one in about.get("evidence", [None] * count)]
        if len(estimate.evidence) != count:
            raise ValueError("it has not as many reasons for cameras as photos")
        if len(set(names)) < count or not isinstance(about["made_by"], dict):
            raise ValueError("its names or settings are wrong")
        return FoundCameras(names, estimate, about["made_by"])
    except (*DAMAGE, IndexError, AttributeError, RecursionError, IgsrError) as error:
        raise IgsrError(
            f"{path} cannot be read ({error}); delete {path.parent} to find the cameras anew"
        ) from error


def _trusted_depths(photos: Sequence[Photo], estimate: Estimate) -> list[np.ndarray | None]:
    """Depths of whole photos, as they are kept: 0 where they are not known or not trusted."""
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


def _depth(stored: np.ndarray | None) -> np.ndarray | None:
    if stored is None:
        return None
    if stored.ndim != 2 or 0 in stored.shape or stored.dtype != np.float32:
        raise ValueError("it has a depth of another shape or type than depths")
    if not (np.isfinite(stored) & (stored >= 0.0)).all():
        raise ValueError("a depth is negative or not finite")
    return stored


def _texts(value: Any) -> list[str]:
    if not isinstance(value, list) or not all(isinstance(one, str) for one in value):
        raise ValueError("it has something else where texts belong")
    return value


def _weights(value: Any) -> dict[str, str] | None:
    if value is None:
        return None
    if not isinstance(value, dict):
        raise ValueError("it has something else where weights belong")
    return dict(zip(_texts(list(value)), _texts(list(value.values())), strict=True))


def _evidence(fields: Any) -> PoseEvidence | None:
    if fields is None:
        return None
    return PoseEvidence(fields["rests_on"], float(fields["rotation"]), float(fields["center"]))


def _camera(arrays: dict[str, np.ndarray], index: int, size: Any) -> Camera | None:
    if size is None:
        return None
    return Camera(arrays[f"viewmat_{index}"], arrays[f"K_{index}"], size[0], size[1])


def _lens(fields: Any) -> Lens | None:
    if fields is None:
        return None
    radial, denominator, tangential = (
        tuple(float(value) for value in fields[name])
        for name in ("radial", "denominator", "tangential")
    )
    p1, p2 = tangential
    sx, sy = (float(value) for value in fields.get("thin_prism", (0.0, 0.0)))
    return Lens(bool(fields["fisheye"]), radial, denominator, (p1, p2), (sx, sy))


def _points(arrays: dict[str, np.ndarray], track_names: list[str]) -> Points | None:
    if "xyz" not in arrays:
        return None
    xyz, rgb = arrays["xyz"].astype(np.float64), arrays["rgb"]
    if xyz.ndim != 2 or xyz.shape[1] != 3 or rgb.shape != xyz.shape or rgb.dtype != np.uint8:
        raise ValueError("its points have another shape or type than points")
    if not np.isfinite(xyz).all():
        raise ValueError("a point is not finite")
    tracks = None
    if "seen_by" in arrays:
        view, point = (arrays[name].astype(np.int64) for name in ("seen_by", "point"))
        tracks = Tracks(track_names, view, point, arrays["xy"].astype(np.float64))
    return Points(xyz, rgb, arrays.get("confidence"), tracks)


def _undistorted(
    photo: Photo, camera: Camera, lens: Lens | None, undistorters: dict[object, Undistorter]
) -> View:
    """A view of a photo at its size; ``undistorters`` keeps the maps of lenses."""
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
