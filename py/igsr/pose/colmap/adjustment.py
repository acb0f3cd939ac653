"""Points and cameras from matches and from cameras that are known roughly.

Points are triangulated with the cameras as they are, under bounds that are as wide as such cameras
are wrong, and bundle adjustment moves cameras and points; then again under narrower bounds. Unlike
the incremental mapper this places no photo: it needs no first pair and no order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr._internal.load_pycolmap import load_pycolmap
from igsr.capture import Camera
from igsr.capture.photo_folder import Photo
from igsr.capture.types import PoseEvidence, intrinsic_matrix
from igsr.pose.alignment import AlignedPhoto
from igsr.pose.colmap.database import image_id
from igsr.pose.colmap.evidence import STEPS
from igsr.pose.colmap.mapping import mapping_options
from igsr.pose.estimate import Progress
from igsr.pose.prior_adjustment import (
    Bundle,
    Observations,
    Spread,
    adjusted_bundle,
    covariances,
)

Float64 = npt.NDArray[np.float64]

#: Bounds of each round: degrees between rays that make a point, and the part of the photo's longer
#: side that an observation may be off. The first are those of a network's cameras, the last
#: COLMAP's for photos of 400 pixels and more.
ROUNDS = ((8.0, 0.1), (4.0, 0.03), (2.0, 0.01), (2.0, 0.005))
#: Bundle adjustments within each round, and the part of the observations that changes at the end.
REFINEMENTS, SETTLED = 3, 5e-3
#: Points of a photo, at least, for its camera to rest on features.
FEWEST_POINTS = 15
#: Photos of which uncertainties are told at most: memory and time grow with their square.
MOST_TOLD = 100
#: Part of a round's bound, in pixels, beyond which an observation weighs less; pixels at least.
ROBUST, LEAST_ROBUST = 0.1, 1.0


@dataclass(frozen=True, eq=False)
class Adjusted:
    """What matches say of cameras, by the index of the photo.

    Attributes:
        model: pycolmap's, of the photos with matches.
        cameras: without the lenses' distortion, in the world of the predictions.
        covariances: float64 [6, 6], of rotation (radians) about and translation (world units) along
            the camera's axes.
        observed: number of points that a photo sees.
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
    """Adjust cameras to matches, with the prediction as a prior.

    Photos of one device, size and EXIF focal length share their focal length. Principal points and
    distortion stay.

    Args:
        photos: all.
        starts: cameras by the index of the photo, at least two that have matches.
        predicted: per photo what a network says of it, in the world of ``starts``; depths that it
            is not sure of are NaN.
        spread: of the predicted cameras.
        matches: database of the photos.
        lenses: parameters of COLMAP's cameras, by their numbers, where they are known.
        seed: random seed.
        show: called with "mapping", how much is done, and how much there is.
    """
    pycolmap = load_pycolmap()
    options = mapping_options(len(starts), STEPS[-1], seed, matches)
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(matches) as opened:
        pipeline = pycolmap.IncrementalPipeline(options, opened, pycolmap.ReconstructionManager())
        model.load(pipeline.database_cache)
        _set_cameras(model, photos, starts, lenses)
        mapper = pycolmap.IncrementalMapper(pipeline.database_cache)
        mapper.begin_reconstruction(model)
        state = _State(model, starts, predicted, spread)
        longest = max(max(photo.image.shape[:2]) for photo in photos)
        for done, (angle, part) in enumerate(ROUNDS):
            show("mapping", done * len(photos) // len(ROUNDS), len(photos))
            triangulation, mapping = options.get_triangulation(), options.get_mapper()
            triangulation.create_max_angle_error = angle
            triangulation.continue_max_angle_error = angle
            triangulation.re_max_angle_error = angle
            triangulation.merge_max_reproj_error = part * longest
            triangulation.complete_max_reproj_error = part * longest
            mapping.filter_max_reproj_error = part * longest
            for image in sorted(model.reg_image_ids()):
                mapper.triangulate_image(triangulation, image)
            for _ in range(REFINEMENTS):
                state.refine(max(LEAST_ROBUST, ROBUST * part * longest))
                changed = mapper.complete_and_merge_tracks(triangulation)
                changed += mapper.filter_points(mapping)
                if changed <= SETTLED * model.compute_num_observations():
                    break
        state.refine(LEAST_ROBUST)
        mapper.end_reconstruction(False)
    model.update_point_3d_errors()
    show("mapping", len(photos), len(photos))
    return state.result()


def evidence_of_model(
    photos: Sequence[Photo], cameras: Sequence[Camera | None], model: Any | None
) -> dict[int, PoseEvidence]:
    """How well features alone know the cameras of COLMAP's model, by the index of the photo.

    Args:
        photos: all.
        cameras: of the model, pinhole; None where a photo is not in it.
        model: pycolmap's, or None. Of one with many photos nothing is told.
    """
    if model is None or not 2 < model.num_reg_images() <= MOST_TOLD:
        return {}
    starts = {i: one for i, one in enumerate(cameras) if one is not None}
    nothing = [None] * len(photos)
    known = _State(model, starts, nothing, Spread(1.0, 1.0)).result()
    return {
        i: PoseEvidence("features", float(np.degrees(turn)), move)
        for i, covariance in known.covariances.items()
        for turn, move in [deviations(covariance)]
    }


def deviations(covariance: Float64) -> tuple[float, float]:
    """Standard deviations per axis of a camera's rotation (radians) and centre (world units)."""
    variances = np.maximum(np.diagonal(covariance), 0.0)
    return float(np.sqrt(variances[:3].mean())), float(np.sqrt(variances[3:].mean()))


def _set_cameras(
    model: Any,
    photos: Sequence[Photo],
    starts: Mapping[int, Camera],
    lenses: Mapping[int, Sequence[float]],
) -> None:
    """Place the photos in a model that has none placed."""
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
        # An array that is changed in place would not be the camera's.
        parameters = np.array(model.cameras[number].params)
        parameters[0] = np.median(values)
        model.cameras[number].params = parameters
    for number, known in lenses.items():
        model.cameras[number].params = np.array(known)


class _State:
    """The model as a bundle of arrays, and back."""

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
        self.wanted = [None if (one := predicted[i]) is None else one.camera for i in self.indices]

    def refine(self, pixels: float) -> None:
        """Move the model's cameras and points to where they fit best."""
        pycolmap = load_pycolmap()
        bundle, seen, ids = self._arrays()
        if not len(ids):
            return
        bundle = adjusted_bundle(bundle, seen, self.wanted, self.spread, pixels)
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
            spreads = covariances(bundle, seen, self.wanted, self.spread)
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
        view, point, places, depths = [], [], [], []
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
            taken = np.stack([one.xy for one in observed])
            view.append(np.full(len(taken), k))
            point.append([row[one.point3D_id] for one in observed])
            places.append(focal * camera.cam_from_img(taken) + [cx, cy])
            predicted = self.predicted[i]
            nothing = np.full(len(taken), np.nan)
            depths.append(nothing if predicted is None else predicted.depths_at(taken))
        points = np.array([self.model.points3D[number].xyz for number in ids]).reshape(-1, 3)
        bundle = Bundle(cameras, np.array(lenses), points, self.scales)
        seen = Observations(
            np.concatenate([np.zeros(0, np.int64), *view]).astype(np.int64),
            np.concatenate([np.zeros(0, np.int64), *point]).astype(np.int64),
            np.concatenate([np.zeros((0, 2)), *places]),
            np.concatenate([np.zeros(0), *depths]),
        )
        return bundle, seen, ids

    def _image(self, index: int) -> Any:
        return self.model.images[image_id(index)]
