"""Adjust approximate cameras to matches: triangulation and bundle adjustment in turn.

Points are triangulated with error bounds that suit approximate cameras, then cameras and points
are adjusted, and again with narrower bounds. Unlike the incremental mapper, this needs no first
pair and no order of photos.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr._internal.load_pycolmap import load_pycolmap
from igsr.cameras.colmap.attempts import THRESHOLDS
from igsr.cameras.colmap.database import image_id
from igsr.cameras.colmap.mapping import mapping_options
from igsr.cameras.depth_maps import AlignedPhoto
from igsr.cameras.estimate import Progress
from igsr.cameras.prior_adjustment import (
    Bundle,
    Observations,
    Spread,
    adjusted_bundle,
    covariances,
)
from igsr.capture import Camera
from igsr.capture.photo_folder import Photo
from igsr.capture.types import PoseEvidence, intrinsic_matrix

Float64 = npt.NDArray[np.float64]

#: Bounds of each round: maximum angle between rays to a point, degrees, and maximum reprojection
#: error as a fraction of the photo's longer side. The first suit a network's cameras, the last are
#: COLMAP's for photos of 400 pixels and more.
ROUNDS = ((8.0, 0.1), (4.0, 0.03), (2.0, 0.01), (2.0, 0.005))
#: Maximum bundle adjustments per round; a round ends if at most this fraction of observations
#: changes.
MAX_ADJUSTMENTS = 3
SETTLED_FRACTION = 5e-3
#: Minimum number of points of a photo for its camera to rest on features.
MIN_POINTS = 15
#: Maximum number of photos for uncertainties: memory and time grow with its square.
MAX_COVARIANCE_PHOTOS = 100
#: Residuals beyond this fraction of a round's bound, and this many pixels, have less weight.
ROBUST_FRACTION = 0.1
MIN_ROBUST_PX = 1.0


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Adjusted cameras, by index of the photo.

    Attributes:
        model: pycolmap's reconstruction of the photos with matches.
        cameras: without lens distortion, in the world of the predictions.
        covariances: float64 [6, 6] of rotation (radians) about and translation (world units) along
            the camera's axes.
        observed: number of points that the photo sees.
    """

    model: Any
    cameras: dict[int, Camera]
    covariances: dict[int, Float64]
    observed: dict[int, int]


def adjusted(
    photos: Sequence[Photo],
    starts: Mapping[int, Camera],
    predicted: Sequence[AlignedPhoto | None],
    spread: Spread,
    matches: Path,
    lenses: Mapping[int, Sequence[float]],
    seed: int,
    show: Progress,
) -> Adjusted:
    """Adjust cameras to matches, with predicted cameras as a prior.

    Photos of one device, size and EXIF focal length share their focal length. Principal points and
    distortion are fixed.

    Args:
        photos: all photos.
        starts: initial cameras by index of the photo, at least two with matches.
        predicted: a network's prediction per photo, in the world of ``starts``; NaN for uncertain
            depths.
        spread: of the predicted cameras.
        matches: database of the photos.
        lenses: known parameters of COLMAP's cameras, by camera id.
        seed: random seed.
        show: called with "mapping", done and total.
    """
    pycolmap = load_pycolmap()
    options = mapping_options(len(starts), THRESHOLDS[-1], seed, matches)
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(matches) as opened:
        pipeline = pycolmap.IncrementalPipeline(options, opened, pycolmap.ReconstructionManager())
        model.load(pipeline.database_cache)
        _set_cameras(model, photos, starts, lenses)
        mapper = pycolmap.IncrementalMapper(pipeline.database_cache)
        mapper.begin_reconstruction(model)
        state = _State(model, starts, predicted, spread)
        longest = max(max(photo.image.shape[:2]) for photo in photos)
        for done, (angle, fraction) in enumerate(ROUNDS):
            show("mapping", done * len(photos) // len(ROUNDS), len(photos))
            triangulation, mapping = options.get_triangulation(), options.get_mapper()
            triangulation.create_max_angle_error = angle
            triangulation.continue_max_angle_error = angle
            triangulation.re_max_angle_error = angle
            triangulation.merge_max_reproj_error = fraction * longest
            triangulation.complete_max_reproj_error = fraction * longest
            mapping.filter_max_reproj_error = fraction * longest
            for image in sorted(model.reg_image_ids()):
                mapper.triangulate_image(triangulation, image)
            for _ in range(MAX_ADJUSTMENTS):
                state.refine(max(MIN_ROBUST_PX, ROBUST_FRACTION * fraction * longest))
                changed = mapper.complete_and_merge_tracks(triangulation)
                changed += mapper.filter_points(mapping)
                if changed <= SETTLED_FRACTION * model.compute_num_observations():
                    break
        state.refine(MIN_ROBUST_PX)
        mapper.end_reconstruction(False)
    model.update_point_3d_errors()
    show("mapping", len(photos), len(photos))
    return state.result()


def evidence_of_model(
    photos: Sequence[Photo], cameras: Sequence[Camera | None], model: Any | None
) -> dict[int, PoseEvidence]:
    """Return the uncertainty of the cameras of COLMAP's model, by index of the photo.

    Args:
        photos: all photos.
        cameras: pinhole cameras of the model; None for photos that are not in it.
        model: pycolmap's reconstruction or None; not evaluated for many photos.
    """
    if model is None or not 2 < model.num_reg_images() <= MAX_COVARIANCE_PHOTOS:
        return {}
    starts = {i: camera for i, camera in enumerate(cameras) if camera is not None}
    result = _State(model, starts, [None] * len(photos), Spread(1.0, 1.0)).result()
    evidence = {}
    for i, covariance in result.covariances.items():
        rotation, translation = deviations(covariance)
        evidence[i] = PoseEvidence("features", float(np.degrees(rotation)), translation)
    return evidence


def deviations(covariance: Float64) -> tuple[float, float]:
    """Standard deviation per axis of a camera's rotation (radians) and center (world units)."""
    variances = np.maximum(np.diagonal(covariance), 0.0)
    return float(np.sqrt(variances[:3].mean())), float(np.sqrt(variances[3:].mean()))


def _set_cameras(
    model: Any,
    photos: Sequence[Photo],
    starts: Mapping[int, Camera],
    lenses: Mapping[int, Sequence[float]],
) -> None:
    """Register the photos in a model without registered photos."""
    pycolmap = load_pycolmap()
    focals: dict[int, list[float]] = {}
    for i, camera in starts.items():
        if image_id(i) not in model.images:
            continue  # it has no matches
        image = model.images[image_id(i)]
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(camera.viewmat[:3, :3]), camera.viewmat[:3, 3])
        model.frames[image.frame_id].rig_from_world = pose
        model.register_frame(image.frame_id)
        if photos[i].focal is None:
            focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
            focals.setdefault(image.camera_id, []).append(focal)
    for number, values in focals.items():
        # Changes in place would be lost.
        parameters = np.array(model.cameras[number].params)
        parameters[0] = np.median(values)
        model.cameras[number].params = parameters
    for number, lens in lenses.items():
        model.cameras[number].params = np.array(lens)


class _State:
    """Converts a model to arrays for bundle adjustment, and back."""

    def __init__(
        self,
        model: Any,
        starts: Mapping[int, Camera],
        predicted: Sequence[AlignedPhoto | None],
        spread: Spread,
    ) -> None:
        self.model, self.predicted, self.spread = model, predicted, spread
        registered = set(model.reg_image_ids())
        self.indices = [i for i in sorted(starts) if image_id(i) in registered]
        self.sizes = [(starts[i].width, starts[i].height) for i in self.indices]
        self.numbers = sorted({self._image(i).camera_id for i in self.indices})
        self.scales = np.zeros(len(self.indices))
        self.priors = [None if (p := predicted[i]) is None else p.camera for i in self.indices]

    def refine(self, pixels: float) -> None:
        """Adjust the model's cameras and points."""
        pycolmap = load_pycolmap()
        bundle, seen, ids = self._arrays()
        if not len(ids):
            return
        bundle = adjusted_bundle(bundle, seen, self.priors, self.spread, pixels)
        self.scales = bundle.scales
        for i, camera in zip(self.indices, bundle.cameras, strict=True):
            image = self._image(i)
            self.model.frames[image.frame_id].rig_from_world = pycolmap.Rigid3d(
                pycolmap.Rotation3d(camera.viewmat[:3, :3]), camera.viewmat[:3, 3]
            )
            parameters = np.array(self.model.cameras[image.camera_id].params)
            parameters[0] = camera.K[0, 0]
            self.model.cameras[image.camera_id].params = parameters
        for number, xyz in zip(ids, bundle.points, strict=True):
            self.model.points3D[number].xyz = xyz

    def result(self) -> Adjusted:
        bundle, seen, ids = self._arrays()
        count = len(self.indices)
        if len(ids):
            spreads = covariances(bundle, seen, self.priors, self.spread)
            observed = np.bincount(seen.view, minlength=count)
        else:
            spreads, observed = np.zeros((count, 6, 6)), np.zeros(count, dtype=np.int64)
        return Adjusted(
            self.model,
            dict(zip(self.indices, bundle.cameras, strict=True)),
            dict(zip(self.indices, spreads, strict=True)),
            dict(zip(self.indices, observed.tolist(), strict=True)),
        )

    def _arrays(self) -> tuple[Bundle, Observations, list[int]]:
        """The bundle, its observations, and the numbers of its points."""
        ids = sorted(self.model.point3D_ids())
        row = {number: k for k, number in enumerate(ids)}
        cameras, lenses = [], []
        view, point, positions, depths = [], [], [], []
        for k, (i, size) in enumerate(zip(self.indices, self.sizes, strict=True)):
            image = self._image(i)
            camera = self.model.cameras[image.camera_id]
            focal, cx, cy, _ = (float(value) for value in camera.params)
            viewmat = np.eye(4)
            viewmat[:3] = image.cam_from_world().matrix()
            cameras.append(Camera(viewmat, intrinsic_matrix(focal, focal, cx, cy), *size))
            lenses.append(self.numbers.index(image.camera_id))
            observed = image.get_observation_points2D()
            if not len(observed):
                continue
            xy = np.stack([observation.xy for observation in observed])
            view.append(np.full(len(xy), k))
            point.append([row[observation.point3D_id] for observation in observed])
            positions.append(focal * camera.cam_from_img(xy) + [cx, cy])
            predicted = self.predicted[i]
            unknown = np.full(len(xy), np.nan)
            depths.append(unknown if predicted is None else predicted.depths_at(xy))
        points = np.array([self.model.points3D[number].xyz for number in ids]).reshape(-1, 3)
        bundle = Bundle(cameras, np.array(lenses), points, self.scales)
        seen = Observations(
            np.concatenate([np.zeros(0, np.int64), *view]).astype(np.int64),
            np.concatenate([np.zeros(0, np.int64), *point]).astype(np.int64),
            np.concatenate([np.zeros((0, 2)), *positions]),
            np.concatenate([np.zeros(0), *depths]),
        )
        return bundle, seen, ids

    def _image(self, index: int) -> Any:
        return self.model.images[image_id(index)]
