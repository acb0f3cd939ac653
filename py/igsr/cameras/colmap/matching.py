"""Matches between photos in copies of COLMAP's database, and focal lengths from them.

Photos without a focal length in EXIF get one from the fundamental matrices of all pairs (Sweeney et
al., "Optimizing the Viewing Graph for Structure-from-Motion", ICCV 2015): with few photos, a wrong
initial focal length is the most common failure.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from igsr._internal.load_pycolmap import load_pycolmap
from igsr.cameras.colmap.database import image_id, photo_file
from igsr.cameras.colmap.guided_matching import (
    Constraint,
    EpipolarLine,
    Plane,
    comparable,
    guided_matches,
)
from igsr.cameras.colmap.pairs import in_tiles, pairs_to_match
from igsr.cameras.colmap.processes import process_count, processes
from igsr.cameras.estimate import Progress

#: Features of a photo: places [N, 2] in pixels, and descriptors uint8 [N, 128].
Described: TypeAlias = tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8]]

#: Pairs between two progress reports.
PAIRS_PER_REPORT = 8
#: Begins the names of databases with estimated focal lengths.
CALIBRATED = "calibrated_"
#: Usual focal lengths, in units of the longer side (diagonal fields of view of 110 to 23 degrees).
MIN_FOCAL = 0.4
MAX_FOCAL = 3.0
#: With fewer pairs, one process is faster.
MIN_PARALLEL_PAIRS = 16
#: Maximum distance of a match to its epipolar line, pixels (COLMAP's).
MAX_DISTANCE_PX = 4.0


def matched(count: int, features: Path, seed: int, show: Progress, *, verify: bool = True) -> Path:
    """Copy a database of features and add matches.

    Args:
        count: number of photos.
        features: the database.
        seed: of the verification.
        show: called with "matching", done and total pairs.
        verify: verify the matches geometrically.

    Returns:
        The new database in the same folder, with unchanged focal lengths.
    """
    pycolmap = load_pycolmap()
    database = features.with_name("matched.db")
    shutil.copyfile(features, database)
    pairs = pairs_to_match(count, database)
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.skip_geometric_verification = not verify
    # The views of a panorama have one center and different directions.
    matching.skip_image_pairs_in_same_frame = True
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    listing = pycolmap.ImportedPairingOptions()
    listing.match_list_path = database.with_name("pairs.txt")
    done = 0
    for tile in in_tiles(pairs):
        show("matching", done, len(pairs))
        listing.match_list_path.write_text(
            "".join(f"{photo_file(a)} {photo_file(b)}\n" for a, b in tile)
        )
        pycolmap.match_image_pairs(
            database,
            matching_options=matching,
            pairing_options=listing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
        done += len(tile)
    show("matching", done, len(pairs))
    return database


def with_focal_lengths(matches: Path, seed: int) -> Path:
    """Copy a database of matches and estimate focal lengths from all its pairs.

    Pairs of a plane can give wrong estimates. Unusual focal lengths are not used: the mapper
    recovers from an initial focal length of twice the true one.
    """
    pycolmap = load_pycolmap()
    database = matches.with_name(f"{CALIBRATED}{matches.name}")
    shutil.copyfile(matches, database)
    calibration = pycolmap.ViewGraphCalibrationOptions()
    calibration.random_seed = seed
    with pycolmap.Database.open(database) as opened:
        before = {camera.camera_id: camera for camera in opened.read_all_cameras()}
    pycolmap.calibrate_view_graph(database, calibration)
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            focal = camera.params[0] / max(camera.width, camera.height)
            if not MIN_FOCAL <= focal <= MAX_FOCAL:
                opened.update_camera(before[camera.camera_id])
    return database


def with_other_focal_lengths(database: Path, focals: Sequence[float]) -> Iterator[Path]:
    """Copy a database with other focal lengths for cameras without a prior one.

    Args:
        database: from ``with_focal_lengths``.
        focals: in units of the longer side; a copy is made for each if it changes a camera.
    """
    pycolmap = load_pycolmap()
    known = known_focals(database)
    for focal in focals:
        copied = database.with_name(f"focal_{focal}_{database.name}")
        shutil.copyfile(database, copied)
        changed = False
        with pycolmap.Database.open(copied) as opened:
            for camera in opened.read_all_cameras():
                length = focal * max(camera.width, camera.height)
                if camera.camera_id not in known and length != camera.params[0]:
                    camera.params = [length, *camera.params[1:]]
                    opened.update_camera(camera)
                    changed = True
        if changed:
            yield copied


def has_usual_focals(model: Any, database: Path) -> bool:
    """Whether all focal lengths of a model are usual or from EXIF.

    A few photos from far away look alike for all long focal lengths; the mapper may end at any.
    """
    known = known_focals(database)
    return all(
        camera.camera_id in known
        or MIN_FOCAL <= camera.mean_focal_length() / max(camera.width, camera.height) <= MAX_FOCAL
        for camera in model.cameras.values()
    )


def known_focals(database: Path) -> set[int]:
    """Ids of cameras whose focal length was known before ``with_focal_lengths``."""
    pycolmap = load_pycolmap()
    source = database.with_name(database.name.partition(CALIBRATED)[2])
    with pycolmap.Database.open(source) as opened:
        return {c.camera_id for c in opened.read_all_cameras() if c.has_prior_focal_length}


def with_matches(matches: Path) -> set[int]:
    """Return the indices of photos with matches; photos without cannot be placed."""
    pycolmap = load_pycolmap()
    matched: set[int] = set()
    with pycolmap.Database.open(matches) as opened:
        for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            if len(geometry.inlier_matches):
                images = pycolmap.pair_id_to_image_pair(pair)
                matched.update(image - image_id(0) for image in images)
    return matched


def matched_along_lines(matches: Path, wanted: Collection[int], show: Progress) -> Path | None:
    """Copy a database of matches and add matches along the epipolar lines of pairs.

    Args:
        matches: the database.
        wanted: indices of photos that need more matches; only pairs with these are searched.
        show: called with "matching", done and total pairs.

    Returns:
        The new database in the same folder; None if no pair gained a match.
    """
    pycolmap = load_pycolmap()
    database = matches.with_name("guided.db")
    shutil.copyfile(matches, database)
    images = {image_id(index) for index in wanted}
    gained = False
    with pycolmap.Database.open(database) as opened:
        ids, geometries = opened.read_two_view_geometries()
        pairs = []
        for pair, geometry in sorted(zip(ids, geometries, strict=True), key=lambda row: row[0]):
            a, b = pycolmap.pair_id_to_image_pair(pair)
            constraint = _constraint(geometry)
            if constraint is not None and (a in images or b in images):
                pairs.append((a, b, geometry, constraint))
        features: dict[int, Described] = {}
        for image in {image for pair in pairs for image in pair[:2]}:
            descriptors = np.asarray(opened.read_descriptors(image).data)
            features[image] = opened.read_keypoints(image)[:, :2], descriptors
        found = _guided([(features[a], features[b], rule) for a, b, _, rule in pairs])
        for done, ((a, b, geometry, _), inliers) in enumerate(zip(pairs, found, strict=True)):
            if done % PAIRS_PER_REPORT == 0:
                show("matching", done, len(pairs))
            counts = [len(features[image][1]) for image in (a, b)]
            others = (geometry.inlier_matches >= counts).any(axis=1)
            inliers = np.vstack([inliers, geometry.inlier_matches[others]])
            if len(inliers) > len(geometry.inlier_matches):
                geometry.inlier_matches = inliers
                opened.update_two_view_geometry(a, b, geometry)
                gained = True
        show("matching", len(pairs), len(pairs))
    return database if gained else None


def _guided(
    pairs: Sequence[tuple[Described, Described, Constraint]],
) -> Iterator[npt.NDArray[np.uint32]]:
    """The guided matches of each pair, in order."""
    count = process_count()
    if count == 1 or len(pairs) < MIN_PARALLEL_PAIRS:
        yield from (_matches(*pair) for pair in pairs)
        return
    with processes(count) as call, ThreadPoolExecutor(count) as pool:
        yield from pool.map(lambda pair: call(_matches, *pair), pairs)


def _matches(first: Described, second: Described, constraint: Constraint) -> npt.NDArray[np.uint32]:
    return guided_matches(comparable(*first), comparable(*second), constraint)


def _constraint(geometry: Any) -> Constraint | None:
    """The constraint on further matches of a pair; None if its geometry is unknown."""
    pycolmap = load_pycolmap()
    kinds = pycolmap.TwoViewGeometryConfiguration
    lines = [int(kind) for kind in (kinds.CALIBRATED, kinds.UNCALIBRATED)]
    planes = [int(kind) for kind in (kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC)]
    if geometry.config in lines and geometry.F is not None:
        return EpipolarLine(np.array(geometry.F, dtype=np.float64), MAX_DISTANCE_PX)
    if geometry.config in planes and geometry.H is not None:
        return Plane(np.array(geometry.H, dtype=np.float64), MAX_DISTANCE_PX)
    return None
