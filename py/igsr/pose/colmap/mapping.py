"""A model of the photos by COLMAP's incremental mapper, from nothing or from a smaller model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from igsr._internal.load_pycolmap import load_pycolmap
from igsr.pose.colmap.database import known_cameras
from igsr.pose.colmap.evidence import Evidence
from igsr.pose.estimate import Progress


def map_photos(
    count: int, database: Path, evidence: Evidence, seed: int, show: Progress
) -> Any | None:
    """The model with most of ``count`` photos, or None if no two can be placed."""
    pycolmap = load_pycolmap()
    models = pycolmap.ReconstructionManager()
    with pycolmap.Database.open(database) as opened:
        pipeline = pycolmap.IncrementalPipeline(
            mapping_options(count, evidence, seed, database), opened, models
        )
        _tell(pipeline, _Placed(count, 0, show))
        pipeline.run()
    found = [models.get(index) for index in range(models.size())]
    return max(found, key=lambda m: (m.num_reg_images(), m.num_points3D()), default=None)


def extend(
    model: Any, count: int, database: Path, evidence: Evidence, seed: int, show: Progress
) -> None:
    """Add photos to a model, in place, with points that its own photos have by new matches."""
    pycolmap = load_pycolmap()
    options = mapping_options(count, evidence, seed, database)
    mapper_options, triangulation = options.get_mapper(), options.get_triangulation()
    with pycolmap.Database.open(database) as opened:
        pipeline = pycolmap.IncrementalPipeline(options, opened, pycolmap.ReconstructionManager())
        _tell(pipeline, _Placed(count, model.num_reg_images(), show))
        mapper = pycolmap.IncrementalMapper(pipeline.database_cache)
        mapper.begin_reconstruction(model)
        for image in sorted(model.reg_image_ids()):
            mapper.triangulate_image(triangulation, image)
        mapper.iterative_global_refinement(
            options.ba_global_max_refinements,
            options.ba_global_max_refinement_change,
            mapper_options,
            options.get_global_bundle_adjustment(),
            triangulation,
        )
        mapper.end_reconstruction(False)
        pipeline.reconstruct_sub_model(mapper, mapper_options, model)
        mapper.end_reconstruction(False)


def mapping_options(count: int, evidence: Evidence, seed: int, database: Path) -> Any:
    """COLMAP's options for ``count`` photos, with one thread so that sums come in one order.

    Intrinsics of panoramas' views, which are known, stay as they are.
    """
    pycolmap = load_pycolmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    # Sums over threads come in any order, and with them the last bits.
    options.num_threads = 1
    options.extract_colors = False
    options.min_model_size = 2
    options.mapper.init_min_num_inliers = evidence.init_min_num_inliers
    options.mapper.init_min_tri_angle = evidence.init_min_tri_angle
    options.mapper.abs_pose_min_num_inliers = evidence.abs_pose_min_num_inliers
    options.mapper.filter_min_tri_angle = evidence.filter_min_tri_angle
    options.triangulation.ignore_two_view_tracks = evidence.ignore_two_view_tracks
    options.triangulation.min_angle = evidence.filter_min_tri_angle
    # Two photos alone tell a focal length too badly to better EXIF's or the fundamental matrix's.
    options.ba_refine_focal_length = options.ba_refine_extra_params = count > 2
    options.constant_cameras = known_cameras(database)
    options.ba_refine_sensor_from_rig = False
    return options


class _Placed:
    """Counts photos as they are placed, and tells."""

    def __init__(self, count: int, placed: int, show: Progress) -> None:
        self.count, self.placed, self.show = count, placed, show

    def first_two(self) -> None:
        self.placed = max(self.placed, 2)
        self.show("mapping", self.placed, self.count)

    def one_more(self) -> None:
        self.placed = min(self.placed + 1, self.count)
        self.show("mapping", self.placed, self.count)


def _tell(pipeline: Any, placed: _Placed) -> None:
    pycolmap = load_pycolmap()
    events = pycolmap.IncrementalPipelineCallback
    pipeline.add_callback(int(events.INITIAL_IMAGE_PAIR_REG_CALLBACK), placed.first_two)
    pipeline.add_callback(int(events.NEXT_IMAGE_REG_CALLBACK), placed.one_more)
