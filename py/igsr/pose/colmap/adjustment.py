"""Bundle adjustment of cameras that are known roughly, with COLMAP's features and matches.

Points are triangulated with the cameras as they are given, under bounds that are as wide as such
cameras are wrong, and bundle adjustment moves cameras and points; then again under narrower bounds.
Unlike the incremental mapper this places no photo: it needs no first pair and no order.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera
from igsr.capture.photo_folder import Photo
from igsr.capture.types import intrinsic_matrix
from igsr.pose.colmap.database import image_id, list_photos
from igsr.pose.colmap.estimator import guarded
from igsr.pose.colmap.evidence import STEPS
from igsr.pose.colmap.features import find_features
from igsr.pose.colmap.mapping import mapping_options
from igsr.pose.colmap.matching import matched, matched_along_lines, with_matches
from igsr.pose.estimate import Progress

Float64 = npt.NDArray[np.float64]

#: Bounds of each round: degrees between rays that make a point, and the part of the photo's longer
#: side that an observation may be off. The first are those of a network's cameras, the last
#: COLMAP's for photos of 400 pixels and more.
ROUNDS = ((8.0, 0.1), (4.0, 0.03), (2.0, 0.01), (2.0, 0.005))
#: Rounds of bundle adjustment within each, and the change that ends them.
REFINEMENTS, SETTLED = 5, 5e-4
#: Points of a photo, at least, for its camera to count as adjusted.
FEWEST_POINTS = 15


@dataclass(frozen=True, eq=False)
class AdjustedPhoto:
    """A photo's camera after bundle adjustment.

    Attributes:
        camera: in a world of any unit, in pixels of the photo.
        pixels: float64 [M, 2], where the photo sees points.
        depths: float64 [M], z-depth of these points in units of the world.
    """

    camera: Camera
    pixels: Float64
    depths: Float64


def adjusted(
    photos: Sequence[Photo], cameras: Sequence[Camera | None], seed: int, show: Progress
) -> dict[int, AdjustedPhoto]:
    """The cameras that matches of features bear out, by index; others are left out.

    Photos of one device, size and EXIF focal length share their focal length. Principal points
    stay, and lenses are taken to be without distortion.

    Args:
        photos: at least two.
        cameras: roughly right, in pixels of the photos; None where nothing is known.
        seed: random seed.
        show: called with "matching" and "mapping", how much is done, and how much there is.

    Raises:
        IgsrError: COLMAP fails.
    """
    with tempfile.TemporaryDirectory(prefix="igsr-colmap-") as folder, guarded(seed):
        database = Path(folder) / "database.db"
        list_photos(photos, database)
        find_features(photos, Path(folder), database, show)
        matches = matched(len(photos), database, seed, show)
        found = with_matches(matches)
        known = {i: one for i, one in enumerate(cameras) if one is not None and i in found}
        if len(known) < 2:
            return {}
        matches = matched_along_lines(matches, set(known), show) or matches
        model = _adjusted_model(photos, known, matches, seed, show)
        return {i: one for i in known if (one := _photo(model, i, known[i])) is not None}


def _adjusted_model(
    photos: Sequence[Photo], known: dict[int, Camera], matches: Path, seed: int, show: Progress
) -> Any:
    import pycolmap

    options = mapping_options(len(known), STEPS[-1], seed, matches)
    options.ba_refine_extra_params = False
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(matches) as opened:
        pipeline = pycolmap.IncrementalPipeline(options, opened, pycolmap.ReconstructionManager())
        model.load(pipeline.database_cache)
        _set_cameras(model, photos, known)
        mapper = pycolmap.IncrementalMapper(pipeline.database_cache)
        mapper.begin_reconstruction(model)
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
            bundle_adjustment = options.get_global_bundle_adjustment()
            # Matches are wrong too, and bounds this wide let them in.
            bundle_adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
            mapper.iterative_global_refinement(
                REFINEMENTS, SETTLED, mapping, bundle_adjustment, triangulation
            )
        mapper.end_reconstruction(False)
    show("mapping", len(photos), len(photos))
    return model


def _set_cameras(model: Any, photos: Sequence[Photo], known: dict[int, Camera]) -> None:
    """Place the known photos in a model that has none placed."""
    import pycolmap

    focals: dict[int, list[float]] = {}
    for i, camera in known.items():
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


def _photo(model: Any, index: int, before: Camera) -> AdjustedPhoto | None:
    """What the model says of a photo, or None if that stands on too little."""
    if image_id(index) not in model.reg_image_ids():
        return None
    image = model.images[image_id(index)]
    observed = image.get_observation_points2D()
    if len(observed) < FEWEST_POINTS:
        return None
    viewmat = np.eye(4)
    viewmat[:3] = image.cam_from_world().matrix()
    focal, cx, cy, _ = (float(value) for value in image.camera.params)
    if not (np.isfinite(viewmat).all() and np.isfinite(focal) and focal > 0.0):
        return None
    camera = Camera(viewmat, intrinsic_matrix(focal, focal, cx, cy), before.width, before.height)
    points = np.stack([model.points3D[point.point3D_id].xyz for point in observed])
    depths = points @ viewmat[2, :3] + viewmat[2, 3]
    pixels = np.stack([point.xy for point in observed])
    ahead = depths > 0.0
    return AdjustedPhoto(camera, pixels[ahead], depths[ahead])
