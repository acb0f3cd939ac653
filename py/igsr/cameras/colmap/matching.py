"""Matches between photos in copies of COLMAP's database, and focal lengths from them.

Photos without a focal length in EXIF get one from the fundamental matrices of all pairs (Sweeney et
al., "Optimizing the Viewing Graph for Structure-from-Motion", ICCV 2015): with few photos, a wrong
initial focal length is the most common failure.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.load_pycolmap import load_pycolmap
from igsr.cameras.colmap.database import image_id, photo_file
from igsr.cameras.colmap.guided_matching import (
    Constraint,
    EpipolarLine,
    Features,
    Plane,
    comparable,
    guided_matches,
)
from igsr.cameras.colmap.pairs import in_tiles, pairs_to_match
from igsr.cameras.estimate import Progress

#: Pairs between two progress reports.
PAIRS_PER_REPORT = 8
#: Number of links of each photo that are kept as its strongest.
STRONGEST_LINKS = 2
#: Begins the names of databases with estimated focal lengths.
CALIBRATED = "calibrated_"
#: Usual focal lengths, in units of the longer side (diagonal fields of view of 110 to 23 degrees).
MIN_FOCAL = 0.4
MAX_FOCAL = 3.0
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

    Where pairs show little but a plane, the estimate may be far off. Focal lengths that no usual
    lens has stay as they were: the mapper starts from twice the right one without harm.
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
    known = _known_focals(database)
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


def with_strongest_links(database: Path) -> Iterator[Path]:
    """Copy a database with only the strongest links of each photo, if it has others.

    Sides of an object that look alike have fewer matches than neighboring photos.
    """
    pycolmap = load_pycolmap()
    with pycolmap.Database.open(database) as opened:
        ids, geometries = opened.read_two_view_geometries()
        numbers = sorted(zip(ids, map(_inliers, geometries), strict=True), key=lambda x: -x[1])
        used: dict[int, int] = {}
        weak = []
        for pair, _ in numbers:
            images = pycolmap.pair_id_to_image_pair(pair)
            if min(used.get(image, 0) for image in images) >= STRONGEST_LINKS:
                weak.append(images)
            for image in images:
                used[image] = used.get(image, 0) + 1
    if not weak:
        return
    copied = database.with_name(f"strongest_{database.name}")
    shutil.copyfile(database, copied)
    with pycolmap.Database.open(copied) as opened:
        for images in weak:
            opened.delete_two_view_geometry(*images)
    yield copied


def _inliers(geometry: Any) -> int:
    return len(geometry.inlier_matches)


def has_usual_focals(model: Any, database: Path) -> bool:
    """Whether a model's focal lengths are usual ones, except those of EXIF.

    A few photos from far away look alike for all long focal lengths; the mapper may end at any.
    """
    known = _known_focals(database)
    return all(
        camera.camera_id in known
        or MIN_FOCAL <= camera.mean_focal_length() / max(camera.width, camera.height) <= MAX_FOCAL
        for camera in model.cameras.values()
    )


def _known_focals(database: Path) -> set[int]:
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
        features: dict[int, Features] = {}
        for done, (a, b, geometry, constraint) in enumerate(pairs):
            if done % PAIRS_PER_REPORT == 0:
                show("matching", done, len(pairs))
            for image in {a, b} - features.keys():
                features[image] = comparable(
                    opened.read_keypoints(image)[:, :2], opened.read_descriptors(image).data
                )
            of_sift = [len(features[a].xy), len(features[b].xy)]
            before = geometry.inlier_matches
            inliers = np.vstack(
                [
                    guided_matches(features[a], features[b], constraint),
                    before[(before >= of_sift).any(axis=1)],
                ]
            )
            if len(inliers) > len(before):
                geometry.inlier_matches = inliers
                opened.update_two_view_geometry(a, b, geometry)
                gained = True
            # Bounds memory: pairs are ordered by their first photo.
            features = {image: kept for image, kept in features.items() if image == a}
        show("matching", len(pairs), len(pairs))
    return database if gained else None


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
