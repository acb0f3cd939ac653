"""Cameras by incremental structure from motion, through pycolmap: SIFT features, matches, mapping.

Nothing is downloaded. Photos with too few matches are not registered. Of few photos all pairs are
matched; of many, those near in the order of names and those whose largest features match (Wu,
"Towards Linear-time Incremental Structure from Motion", 3DV 2013, section 3).

Photos that EXIF gives no focal length get one from the fundamental matrices of all pairs together
(Sweeney et al., "Optimizing the Viewing Graph for Structure-from-Motion", ICCV 2015) before the
first is registered: with few photos, a wrong initial focal length is the most common failure.
"""

from __future__ import annotations

import contextlib
import copy
import shutil
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr.capture import Camera, Points
from igsr.capture.photo_folder import Photo
from igsr.capture.tracks import straightened, track_confidence
from igsr.capture.types import Tracks, intrinsic_matrix
from igsr.capture.undistort import Lens
from igsr.errors import IgsrError
from igsr.pose.estimate import Estimate, Progress

Float64 = npt.NDArray[np.float64]

#: Pixels of a photo's longer side at which features are found; bounds time.
LONGEST = 1600
#: Up to this many photos, every pair is matched.
EXHAUSTIVE = 60
#: Of more photos, each is matched with those that follow it by name and those most similar to it.
FOLLOWING = 8
MOST_SIMILAR = 16
#: Number of largest features by which similar photos are found, and least matches of them.
PRESELECTION_FEATURES = 128
LEAST_SIMILAR = 4
#: Where nothing is known: the focal length over the longer side; 42 degrees, COLMAP's own.
GUESSED_FOCAL = 1.2
#: Photos and pairs done between two calls of progress; Ctrl-C is heard then.
FEATURES_AT_ONCE, PAIRS_AT_ONCE = 4, 40
#: Up to this many photos, unregistered ones are tried again with lower thresholds.
FEW = 60
#: Squared errors may grow by this factor for lenses to count as free of distortion: photos that are
#: not resampled stay sharp, and from few photos a distortion is often no more than a wrong focal.
DISTORTION_WORTH = 1.02
#: Seconds of one core that a photo takes, and photos from which that is said; by our measurements.
SECONDS_A_PHOTO = 8.0
MANY = 200


@dataclass(frozen=True)
class Evidence:
    """Thresholds for registering a photo, by COLMAP's names; the first set has COLMAP's values.

    Attributes:
        init_min_num_inliers: matches of the first pair.
        init_min_tri_angle: degrees that the rays of the first pair part by, in the median.
        abs_pose_min_num_inliers: points that a further photo sees.
        filter_min_tri_angle: degrees that the rays to a point part by.
        ignore_two_view_tracks: whether points that two photos alone see are left out.
        guided_matching: whether more matches are looked for along the epipolar lines of a pair.
    """

    init_min_num_inliers: int
    init_min_tri_angle: float
    abs_pose_min_num_inliers: int
    filter_min_tri_angle: float
    ignore_two_view_tracks: bool
    guided_matching: bool


STEPS = (
    Evidence(100, 16.0, 30, 1.5, True, False),
    Evidence(100, 16.0, 30, 1.5, False, False),
    Evidence(100, 16.0, 30, 1.5, False, True),
    Evidence(40, 6.0, 15, 1.0, False, True),
    Evidence(15, 2.0, 10, 0.5, False, True),
)
#: Steps before this one are no reason to doubt.
DOUBTFUL = 3


class Colmap:
    """Finds cameras with pycolmap; see the module."""

    name = "colmap"

    def __call__(
        self, photos: Sequence[Photo], *, seed: int = 0, progress: Progress | None = None
    ) -> Estimate:
        """Register as many photos as possible; see ``Estimator``.

        The largest set of photos that hang together is kept. The same photos and seed give the same
        bits on the same machine.
        """
        show = progress or (lambda stage, done, total: None)
        if len(photos) > MANY:
            minutes = SECONDS_A_PHOTO * len(photos) / 60.0
            warnings.warn(
                f"COLMAP needs about {minutes:.0f} minutes for {len(photos)} photos; every third "
                "is mostly enough",
                stacklevel=2,
            )
        with tempfile.TemporaryDirectory(prefix="igsr-colmap-") as folder, _guarded(seed):
            workspace = Path(folder)
            database = workspace / "database.db"
            _list_photos(photos, database)
            _find_features(photos, workspace, database, show)
            model, step = _mapped(photos, database, seed, show)
            if model is not None:
                model = _without_distortion(model)
        return _estimate(photos, model, step)


@contextlib.contextmanager
def _guarded(seed: int) -> Iterator[None]:
    """pycolmap without its log, with a fixed seed, and with failures as error messages."""
    import pycolmap

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    pycolmap.set_random_seed(seed)
    try:
        yield
    except (RuntimeError, ValueError) as error:
        raise IgsrError(
            f"COLMAP failed ({error}); leave out unusual photos and try again"
        ) from error
    finally:
        pycolmap.logging.minloglevel = level


def _file(index: int) -> str:
    """The name of a photo in COLMAP's database: COLMAP is never given the users' file names."""
    return f"{index:06d}.png"


def _groups(photos: Sequence[Photo]) -> list[list[int]]:
    """Indices of photos that share their intrinsics."""
    groups: dict[object, list[int]] = {}
    for index, photo in enumerate(photos):
        key = (photo.device, photo.image.shape[:2], photo.focal)
        groups.setdefault(key, []).append(index)
    return list(groups.values())


def _find_features(
    photos: Sequence[Photo], workspace: Path, database: Path, show: Progress
) -> None:
    import pycolmap

    images, masks = workspace / "images", workspace / "masks"
    images.mkdir()
    masks.mkdir()
    masked = any(_hides(photo) for photo in photos)
    reader = pycolmap.ImageReaderOptions()
    if masked:
        reader.mask_path = masks
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = LONGEST
    extraction.use_gpu = False
    for start in range(0, len(photos), FEATURES_AT_ONCE):
        show("features", start, len(photos))
        chunk = range(start, min(start + FEATURES_AT_ONCE, len(photos)))
        for index in chunk:
            mask_path = masks / f"{_file(index)}.png" if masked else None
            _write(photos[index], images / _file(index), mask_path)
        pycolmap.extract_features(
            database,
            images,
            [_file(index) for index in chunk],
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )
        for index in chunk:
            (images / _file(index)).unlink()
    show("features", len(photos), len(photos))


def _list_photos(photos: Sequence[Photo], database: Path) -> None:
    """Number photos and cameras in the database.

    Left to feature extraction, they are numbered as its threads end, and nothing after comes out
    the same twice.
    """
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        for number, group in enumerate(_groups(photos), start=1):
            first = photos[group[0]]
            height, width = first.image.shape[:2]
            focal = first.focal if first.focal is not None else GUESSED_FOCAL * max(width, height)
            camera = pycolmap.Camera.create_from_model_name(
                number, "SIMPLE_RADIAL", focal, width, height
            )
            camera.has_prior_focal_length = first.focal is not None
            opened.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=number)
            rig.add_ref_sensor(camera.sensor_id)
            opened.write_rig(rig, use_rig_id=True)
            for index in group:
                image = pycolmap.Image(name=_file(index), camera_id=number, image_id=index + 1)
                opened.write_image(image, use_image_id=True)
                frame = pycolmap.Frame(frame_id=index + 1, rig_id=number)
                frame.add_data_id(image.data_id)
                opened.write_frame(frame, use_frame_id=True)


def _hides(photo: Photo) -> bool:
    return photo.mask is not None or photo.image.shape[2] == 4


def _write(photo: Photo, path: Path, mask_path: Path | None) -> None:
    image = photo.image
    grey = (image[..., :3] @ np.array([0.299, 0.587, 0.114])).round().astype(np.uint8)
    if mask_path is not None:
        usable = np.ones(grey.shape, dtype=bool) if photo.mask is None else photo.mask
        if image.shape[2] == 4:
            usable = usable & (image[..., 3] > 0)
        # Masked pixels must not influence the features next to them.
        grey[~usable] = round(grey[usable].mean()) if usable.any() else 0
        Image.fromarray(255 * usable.astype(np.uint8)).save(mask_path)
    Image.fromarray(grey).save(path, compress_level=1)


def _matched(
    photos: Sequence[Photo], features: Path, guided: bool, seed: int, show: Progress
) -> Path:
    """A copy of the database of features, with matches and with focal lengths by them."""
    import pycolmap

    database = features.with_name("guided.db" if guided else "matched.db")
    shutil.copyfile(features, database)
    pairs = _pairs(len(photos), database)
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.guided_matching = guided
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    listing = pycolmap.ImportedPairingOptions()
    listing.match_list_path = database.with_name("pairs.txt")
    for start in range(0, len(pairs), PAIRS_AT_ONCE):
        show("matching", start, len(pairs))
        listing.match_list_path.write_text(
            "".join(f"{_file(a)} {_file(b)}\n" for a, b in pairs[start : start + PAIRS_AT_ONCE])
        )
        pycolmap.match_image_pairs(
            database,
            matching_options=matching,
            pairing_options=listing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
    show("matching", len(pairs), len(pairs))
    calibration = pycolmap.ViewGraphCalibrationOptions()
    calibration.random_seed = seed
    pycolmap.calibrate_view_graph(database, calibration)
    return database


def _pairs(count: int, database: Path) -> list[tuple[int, int]]:
    """The pairs of photos to match, as indices; see the module."""
    if count <= EXHAUSTIVE:
        return [(a, b) for a in range(count) for b in range(a + 1, count)]
    pairs = {(a, b) for a in range(count) for b in range(a + 1, min(a + 1 + FOLLOWING, count))}
    similar = _similarity(_largest_features(count, database))
    for a in range(count):
        best = np.argsort(-similar[a], kind="stable")[:MOST_SIMILAR]
        pairs |= {(min(a, int(b)), max(a, int(b))) for b in best if similar[a, b] >= LEAST_SIMILAR}
    return sorted(pairs)


def _largest_features(count: int, database: Path) -> list[npt.NDArray[np.float32]]:
    """Descriptors of length 1 of each photo's largest features."""
    import pycolmap

    largest_of = []
    with pycolmap.Database.open(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        for index in range(count):
            image_id = ids.get(_file(index))
            if image_id is None:
                largest_of.append(np.zeros((0, 128), dtype=np.float32))
                continue
            keypoints = opened.read_keypoints(image_id)
            descriptors = opened.read_descriptors(image_id).data.astype(np.float32)
            # The determinant of a feature's affine shape is the square of its size.
            size = np.abs(np.linalg.det(keypoints[:, 2:6].reshape(-1, 2, 2)))
            largest = descriptors[np.argsort(-size, kind="stable")[:PRESELECTION_FEATURES]]
            lengths = np.linalg.norm(largest, axis=1, keepdims=True)
            largest_of.append(largest / np.maximum(lengths, 1e-9))
    return largest_of


def _similarity(descriptors: list[npt.NDArray[np.float32]]) -> npt.NDArray[np.int64]:
    """How many of the largest features of each two photos are each other's clear best, [N, N]."""
    count, most = len(descriptors), max(len(features) for features in descriptors)
    padded = np.zeros((count, most, 128), dtype=np.float32)
    for index, features in enumerate(descriptors):
        padded[index, : len(features)] = features
    counts = np.zeros((count, count), dtype=np.int64)
    rows = np.arange(most)
    for a in range(count - 1):
        others = padded[a + 1 :]
        similar = (others @ padded[a].T).swapaxes(1, 2)  # [photo, feature of a, feature of photo]
        best = similar.argmax(axis=2)
        mutual = np.take_along_axis(similar.argmax(axis=1), best, axis=1) == rows
        first = np.take_along_axis(similar, best[..., None], axis=2)[..., 0]
        np.put_along_axis(similar, best[..., None], -1.0, axis=2)
        near, next_near = (np.maximum(2.0 - 2.0 * s, 0.0) for s in (first, similar.max(axis=2)))
        # Of squared distances, Lowe's ratio is 0.8 squared.
        counts[a, a + 1 :] = (mutual & (near < 0.64 * next_near)).sum(axis=1)
    return counts + counts.T


def _mapped(
    photos: Sequence[Photo], features: Path, seed: int, show: Progress
) -> tuple[Any | None, int]:
    """The model with most photos, and which of ``STEPS`` it needed."""
    best, best_step = None, 0
    databases: dict[bool, Path] = {}
    for step, evidence in enumerate(STEPS):
        guided = evidence.guided_matching
        if guided not in databases:
            databases[guided] = _matched(photos, features, guided, seed, show)
        model = _map(len(photos), databases[guided], evidence, seed, show)
        if model is not None and (best is None or model.num_reg_images() > best.num_reg_images()):
            best, best_step = model, step
        if best is not None and (best.num_reg_images() == len(photos) or len(photos) > FEW):
            break
    show("mapping", len(photos), len(photos))
    return best, best_step


def _map(count: int, database: Path, evidence: Evidence, seed: int, show: Progress) -> Any | None:
    import pycolmap

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
    registered = 0

    def start() -> None:
        nonlocal registered
        registered = 2
        show("mapping", registered, count)

    def next_photo() -> None:
        nonlocal registered
        registered = min(registered + 1, count)
        show("mapping", registered, count)

    models = pycolmap.ReconstructionManager()
    with pycolmap.Database.open(database) as opened:
        pipeline = pycolmap.IncrementalPipeline(options, opened, models)
        events = pycolmap.IncrementalPipelineCallback
        pipeline.add_callback(int(events.INITIAL_IMAGE_PAIR_REG_CALLBACK), start)
        pipeline.add_callback(int(events.NEXT_IMAGE_REG_CALLBACK), next_photo)
        pipeline.run()
    found = [models.get(index) for index in range(models.size())]
    return max(found, key=lambda m: (m.num_reg_images(), m.num_points3D()), default=None)


def _without_distortion(model: Any) -> Any:
    """The model adjusted to lenses without distortion where that fits nearly as well."""
    import pycolmap

    if all(camera.params[3] == 0.0 for camera in model.cameras.values()):
        return model
    pinhole = copy.deepcopy(model)
    for camera in pinhole.cameras.values():
        camera.params = [*camera.params[:3], 0.0]
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_extra_params = False
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in pinhole.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # pycolmap.bundle_adjustment writes to the log whatever its level.
    pycolmap.create_default_bundle_adjuster(options, config, pinhole).solve()
    needed = _squared_error(pinhole) > DISTORTION_WORTH * _squared_error(model)
    return model if needed else pinhole


def _squared_error(model: Any) -> float:
    model.update_point_3d_errors()
    return float(sum(p.error**2 * len(p.track.elements) for p in model.points3D.values()))


def _estimate(photos: Sequence[Photo], model: Any | None, step: int) -> Estimate:
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
    lost = [photo.name for photo, camera in zip(photos, cameras, strict=True) if camera is None]
    if lost:
        sentences.append(
            f"{len(photos) - len(lost)} of {len(photos)} photos are registered; too few "
            f"matches for: {', '.join(lost)}."
        )
    if step >= DOUBTFUL:
        sentences.append(
            "The photos have few matches, so cameras were found with lower thresholds and may be "
            "wrong; check the plot, or add photos between those that you have."
        )
    points = _points(photos, model, index_of)
    if points is not None:
        points.tracks = _tracks(photos, model, index_of, points.xyz, cameras, lenses)
    return Estimate(cameras, points, list(nothing), list(nothing), sentences, lenses)


def _points(photos: Sequence[Photo], model: Any, index_of: dict[int, int]) -> Points | None:
    """Points with their mean colour; confident where many photos see them in nearly one place."""
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
        at = np.array([rows[point.point3D_id] for point in observed])
        column, row = np.array([point.xy for point in observed]).astype(np.int64).T
        height, width = photos[index].image.shape[:2]
        pixels = photos[index].image[row.clip(0, height - 1), column.clip(0, width - 1), :3]
        np.add.at(colors, at, pixels.astype(np.float64))
        np.add.at(seen, at, 1.0)
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
    """Where the registered photos see the points, with lens distortion undone."""
    rows = {point_id: row for row, point_id in enumerate(sorted(model.point3D_ids()))}
    view: list[int] = []
    point: list[int] = []
    places: list[Float64] = []
    for number, image_id in enumerate(index_of):
        for observed in model.images[image_id].get_observation_points2D():
            view.append(number)
            point.append(rows[observed.point3D_id])
            places.append(observed.xy)
    registered = list(index_of.values())
    tracks = Tracks(
        [photos[index].name for index in registered],
        np.array(view, dtype=np.int64),
        np.array(point, dtype=np.int64),
        np.array(places, dtype=np.float64).reshape(-1, 2),
    )
    registered_cameras = [camera for camera in cameras if camera is not None]
    return straightened(tracks, xyz, registered_cameras, [lenses[index] for index in registered])
