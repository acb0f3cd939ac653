"""COLMAP's incremental mapper: map photos, extend a model, drop needless lens distortion."""

from __future__ import annotations

import copy
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from igsr._internal.load_pycolmap import load_pycolmap
from igsr.cameras.colmap.database import known_cameras
from igsr.cameras.estimate import Progress

#: Minimum number of photos to find lens distortion.
MIN_DISTORTION_PHOTOS = 4
#: Lens distortion is dropped if the squared error grows by at most this factor: photos that are not
#: resampled stay sharp, and from few photos distortion is often a wrong focal length.
MAX_ERROR_FACTOR = 1.02


@dataclass(frozen=True)
class Thresholds:
    """Thresholds for registering a photo, by COLMAP's names.

    Attributes:
        init_min_num_inliers: matches of the first pair.
        init_min_tri_angle: median angle between rays of the first pair, degrees.
        abs_pose_min_num_inliers: points that a further photo sees.
        filter_min_tri_angle: angle between the rays to a point, degrees.
        ignore_two_view_tracks: whether points that only two photos see are left out.
        guided_matching: whether more matches are searched along epipolar lines.
    """

    init_min_num_inliers: int
    init_min_tri_angle: float
    abs_pose_min_num_inliers: int
    filter_min_tri_angle: float
    ignore_two_view_tracks: bool
    guided_matching: bool


def map_photos(
    count: int, database: Path, thresholds: Thresholds, seed: int, show: Progress
) -> Any | None:
    """Return the model with most of ``count`` photos, or None if no two can be placed."""
    pycolmap = load_pycolmap()
    models = pycolmap.ReconstructionManager()
    with pycolmap.Database.open(database) as opened:
        pipeline = pycolmap.IncrementalPipeline(
            mapping_options(count, thresholds, seed, database), opened, models
        )
        _report_progress(pipeline, count, 0, show)
        pipeline.run()
    all_models = [models.get(index) for index in range(models.size())]
    return max(all_models, key=lambda m: (m.num_reg_images(), m.num_points3D()), default=None)


def map_globally(database: Path, thresholds: Thresholds, seed: int) -> Any | None:
    """Return a model of the global mapper, or None if it finds none.

    It averages the rotations of all pairs before it places any photo (Pan et al., "Global
    Structure-from-Motion Revisited", ECCV 2024), so no first pair leads it astray.
    """
    pycolmap = load_pycolmap()
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed, options.num_threads, options.multiple_models = seed, 1, False
    options.min_model_size = 2
    mapper = options.mapper
    mapper.random_seed, mapper.num_threads = seed, 1
    for part in (mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation):
        part.random_seed = seed
    # As the incremental mapper at these thresholds.
    mapper.track_min_num_views_per_track = mapper.global_positioning.min_num_view_per_track = 2
    mapper.bundle_adjustment.min_track_length = 2
    mapper.retriangulation.ignore_two_view_tracks = False
    mapper.min_tri_angle_deg = thresholds.filter_min_tri_angle
    mapper.bundle_adjustment.ceres.solver_options.num_threads = 1
    with tempfile.TemporaryDirectory() as folder:
        try:
            models = pycolmap.global_mapping(database, folder, folder, options)
        except (RuntimeError, ValueError):  # too few pairs
            return None
    return max(models.values(), key=lambda m: m.num_reg_images(), default=None)


def extend(
    model: Any, count: int, database: Path, thresholds: Thresholds, seed: int, show: Progress
) -> None:
    """Triangulate more points by new matches and add photos to a model, in place."""
    pycolmap = load_pycolmap()
    options = mapping_options(count, thresholds, seed, database)
    mapper_options, triangulation = options.get_mapper(), options.get_triangulation()
    with pycolmap.Database.open(database) as opened:
        pipeline = pycolmap.IncrementalPipeline(options, opened, pycolmap.ReconstructionManager())
        _report_progress(pipeline, count, model.num_reg_images(), show)
        mapper = pycolmap.IncrementalMapper(pipeline.database_cache)
        mapper.begin_reconstruction(model)
        for image in sorted(model.reg_image_ids()):
            mapper.triangulate_image(triangulation, image)
        mapper.filter_points(mapper_options)
        mapper.end_reconstruction(False)
        pipeline.reconstruct_sub_model(mapper, mapper_options, model)
        mapper.end_reconstruction(False)


def mapping_options(count: int, thresholds: Thresholds, seed: int, database: Path) -> Any:
    """COLMAP's options for ``count`` photos; intrinsics of panoramas' views stay fixed."""
    pycolmap = load_pycolmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    # Sums over several threads have no fixed order.
    options.num_threads = 1
    options.extract_colors = False
    options.min_model_size = 2
    options.mapper.init_min_num_inliers = thresholds.init_min_num_inliers
    options.mapper.init_min_tri_angle = thresholds.init_min_tri_angle
    options.mapper.abs_pose_min_num_inliers = thresholds.abs_pose_min_num_inliers
    options.mapper.filter_min_tri_angle = thresholds.filter_min_tri_angle
    options.triangulation.ignore_two_view_tracks = thresholds.ignore_two_view_tracks
    options.triangulation.min_angle = thresholds.filter_min_tri_angle
    # Two photos cannot improve the focal length of EXIF or of the fundamental matrix; three cannot
    # determine lens distortion.
    options.ba_refine_focal_length = count > 2
    options.ba_refine_extra_params = count >= MIN_DISTORTION_PHOTOS
    options.constant_cameras = known_cameras(database)
    options.ba_refine_sensor_from_rig = False
    return options


def _report_progress(pipeline: Any, count: int, placed: int, show: Progress) -> None:
    """Report the number of placed photos while a pipeline runs."""
    pycolmap = load_pycolmap()

    def on_first_pair() -> None:
        nonlocal placed
        placed = max(placed, 2)
        show("mapping", placed, count)

    def on_next() -> None:
        nonlocal placed
        placed = min(placed + 1, count)
        show("mapping", placed, count)

    events = pycolmap.IncrementalPipelineCallback
    pipeline.add_callback(int(events.INITIAL_IMAGE_PAIR_REG_CALLBACK), on_first_pair)
    pipeline.add_callback(int(events.NEXT_IMAGE_REG_CALLBACK), on_next)


def without_distortion(model: Any) -> Any:
    """Return the model adjusted without lens distortion if that fits nearly as well."""
    pycolmap = load_pycolmap()
    if all(camera.params[3] == 0.0 for camera in model.cameras.values()):
        return model
    pinhole = copy.deepcopy(model)
    for camera in pinhole.cameras.values():
        camera.params = [*camera.params[:3], 0.0]
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_extra_params = False
    options.refine_sensor_from_rig = False
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image in pinhole.reg_image_ids():
        config.add_image(image)
    for rig in pinhole.rigs.values():
        if rig.num_sensors() > 1:  # the views of a panorama, whose intrinsics are known
            for sensor in rig.sensor_ids():
                config.set_constant_cam_intrinsics(sensor.id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # pycolmap.bundle_adjustment writes to the log at any level.
    pycolmap.create_default_bundle_adjuster(options, config, pinhole).solve()
    is_needed = _squared_error(pinhole) > MAX_ERROR_FACTOR * _squared_error(model)
    return model if is_needed else pinhole


def _squared_error(model: Any) -> float:
    model.update_point_3d_errors()
    return float(sum(p.error**2 * len(p.track.elements) for p in model.points3D.values()))
