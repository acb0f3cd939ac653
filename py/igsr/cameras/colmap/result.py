"""Convert a COLMAP model to an ``Estimate``: cameras, lenses, colored points and tracks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.cameras.colmap.attempts import Mapped
from igsr.cameras.estimate import Estimate
from igsr.capture import Camera, Points
from igsr.capture.photo_folder import Photo
from igsr.capture.read_colmap import track_confidence
from igsr.capture.types import Tracks, intrinsic_matrix
from igsr.capture.undistort import Lens, straightened

Float64 = npt.NDArray[np.float64]


def estimate_of(photos: Sequence[Photo], mapped: Mapped) -> Estimate:
    """Return cameras, points and warnings of a model of the photos."""
    model = mapped.model
    nothing: list[Any] = [None] * len(photos)
    if model is None:
        return Estimate(nothing, None, nothing, nothing, [])
    cameras: list[Camera | None] = list(nothing)
    lenses: list[Lens | None] = list(nothing)
    index_of: dict[int, int] = {}
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        index = index_of[image_id] = int(Path(image.name).stem)
        height, width = photos[index].image.shape[:2]
        focal, cx, cy, k = (float(value) for value in image.camera.params)
        viewmat = np.eye(4)
        viewmat[:3] = image.cam_from_world().matrix()
        cameras[index] = Camera(viewmat, intrinsic_matrix(focal, focal, cx, cy), width, height)
        lenses[index] = Lens(False, (k,)) if k != 0.0 else None
    sentences = []
    missing = [photo.name for photo, camera in zip(photos, cameras, strict=True) if camera is None]
    if missing:
        cause = "not registered" if mapped.removed_pairs else "too few matches for"
        sentences.append(
            f"{len(photos) - len(missing)} of {len(photos)} photos are registered; {cause}: "
            f"{', '.join(missing)}."
        )
    for group in mapped.other_scenes:
        names = ", ".join(photos[index].name for index in group)
        sentences.append(
            f"{names} match each other, but not the registered photos: they may show another "
            "place. Find their cameras in a separate run."
        )
    if mapped.removed_pairs:
        advice = " Add photos between these and the registered ones." if missing else ""
        sentences.append(
            "Some photos show places that look alike: matches between them contradict other "
            f"matches and were not used (pairs of photos: {mapped.removed_pairs}).{advice}"
        )
    if mapped.doubtful:
        sentences.append(
            "The photos have few matches, so cameras were found with lower thresholds and may be "
            "wrong; check the plot, or add photos between them."
        )
    points = _points(photos, model, index_of)
    if points is not None:
        points.tracks = _tracks(photos, model, index_of, points.xyz, cameras, lenses)
    return Estimate(cameras, points, list(nothing), list(nothing), sentences, lenses)


def _points(photos: Sequence[Photo], model: Any, index_of: dict[int, int]) -> Points | None:
    """Points with mean colors and a confidence by number of photos and reprojection error."""
    rows = {point_id: row for row, point_id in enumerate(sorted(model.point3D_ids()))}
    if not rows:
        return None
    points = [model.points3D[point_id] for point_id in rows]
    seen = np.zeros(len(rows))
    colors = np.zeros((len(rows), 3))
    for image_id, index in index_of.items():
        observed = model.images[image_id].get_observation_points2D()
        if not observed:
            continue
        index_of_point = np.array([rows[point.point3D_id] for point in observed])
        column, row = np.array([point.xy for point in observed]).astype(np.int64).T
        height, width = photos[index].image.shape[:2]
        pixels = photos[index].image[row.clip(0, height - 1), column.clip(0, width - 1), :3]
        np.add.at(colors, index_of_point, pixels.astype(np.float64))
        np.add.at(seen, index_of_point, 1.0)
    rgb = (colors / np.maximum(seen, 1.0)[:, None]).round().astype(np.uint8)
    errors = np.array([max(point.error, 0.0) for point in points])
    return Points(
        np.stack([point.xyz for point in points]),
        rgb,
        track_confidence(np.maximum(seen, 1.0), errors),
    )


def _tracks(
    photos: Sequence[Photo],
    model: Any,
    index_of: dict[int, int],
    xyz: Float64,
    cameras: Sequence[Camera | None],
    lenses: Sequence[Lens | None],
) -> Tracks:
    """Observations of points in the registered photos, without lens distortion."""
    rows = {point_id: row for row, point_id in enumerate(sorted(model.point3D_ids()))}
    view: list[int] = []
    point: list[int] = []
    positions: list[Float64] = []
    for number, image_id in enumerate(index_of):
        for observed in model.images[image_id].get_observation_points2D():
            view.append(number)
            point.append(rows[observed.point3D_id])
            positions.append(observed.xy)
    registered = list(index_of.values())
    tracks = Tracks(
        [photos[index].name for index in registered],
        np.array(view, dtype=np.int64),
        np.array(point, dtype=np.int64),
        np.array(positions, dtype=np.float64).reshape(-1, 2),
    )
    registered_cameras = [camera for camera in cameras if camera is not None]
    return straightened(tracks, xyz, registered_cameras, [lenses[index] for index in registered])
