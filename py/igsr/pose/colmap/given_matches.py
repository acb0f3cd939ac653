"""Put the features and matches of a matcher into COLMAP's database, and verify them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError
from igsr.pose.colmap.database import image_id, photo_file
from igsr.pose.colmap.features import usable_pixels
from igsr.pose.colmap.matcher import Matcher, PhotoFeatures
from igsr.pose.colmap.pairs import EXHAUSTIVE
from igsr.pose.estimate import Progress

#: Minimum number of matches of a pair for verification (COLMAP's number of inliers).
MIN_MATCHES = 15


def matched_by(
    matcher: Matcher, photos: Sequence[Photo], database: Path, seed: int, show: Progress
) -> Path:
    """Match all pairs of photos by a matcher, and verify the matches.

    Args:
        matcher: of features.
        photos: of the database.
        database: without features; it is changed.
        seed: of the verification.
        show: called with "features" and "matching", done and total.

    Returns:
        The database.

    Raises:
        IgsrError: there are too many photos for all pairs, or the matcher's arrays are invalid.
    """
    import pycolmap

    count = len(photos)
    if count > EXHAUSTIVE:
        raise IgsrError(
            f"matcher {matcher.name} compares every pair of photos: give at most {EXHAUSTIVE} of "
            f"the {count} photos, or use matcher sift"
        )
    features = []
    for index, photo in enumerate(photos):
        show("features", index, count)
        features.append(_features(matcher, photo))
    show("features", count, count)
    pairs = [(a, b) for a in range(count) for b in range(a + 1, count)]
    matched = []
    with pycolmap.Database.open(database) as opened:
        for index, one in enumerate(features):
            opened.write_keypoints(image_id(index), one.xy)
        for done, (a, b) in enumerate(pairs):
            show("matching", done, len(pairs))
            matches = _matches(matcher, features[a], features[b])
            if len(matches) >= MIN_MATCHES:
                opened.write_matches(image_id(a), image_id(b), matches)
                matched.append(f"{photo_file(a)} {photo_file(b)}\n")
    show("matching", len(pairs), len(pairs))
    if matched:
        listing = database.with_name("pairs.txt")
        listing.write_text("".join(matched))
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = seed
        pycolmap.verify_matches(database, listing, verification)
    return database


def _features(matcher: Matcher, photo: Photo) -> PhotoFeatures:
    """The features of a photo's usable pixels."""
    found = matcher.features(np.ascontiguousarray(photo.image[..., :3]))
    xy = np.asarray(found.xy, dtype=np.float32)
    height, width = photo.image.shape[:2]
    if xy.ndim != 2 or xy.shape[1] != 2 or len(found.descriptors) != len(xy):
        raise IgsrError(
            f"matcher {matcher.name}: features of {photo.name} must be xy [N, 2] with a descriptor "
            f"each, not {xy.shape} and {len(found.descriptors)}"
        )
    inside = np.isfinite(xy).all(axis=1) & (xy >= 0.0).all(axis=1)
    inside &= (xy[:, 0] < width) & (xy[:, 1] < height)
    column, row = np.where(inside[:, None], xy, 0.0).astype(np.int64).T
    usable = usable_pixels(photo)
    if usable is not None:
        inside &= usable[row, column]
    return PhotoFeatures(xy, found.descriptors, found.size).kept(inside)


def _matches(
    matcher: Matcher, first: PhotoFeatures, second: PhotoFeatures
) -> npt.NDArray[np.uint32]:
    """Match two photos and check the indices: COLMAP would read beyond its arrays."""
    if not len(first.xy) or not len(second.xy):
        return np.zeros((0, 2), dtype=np.uint32)
    matches = np.asarray(matcher.matches(first, second))
    if (
        matches.ndim != 2
        or matches.shape[1] != 2
        or not np.issubdtype(matches.dtype, np.integer)
        or (matches < 0).any()
        or (matches >= [len(first.xy), len(second.xy)]).any()
        or any(len(np.unique(side)) < len(side) for side in matches.T)
    ):
        raise IgsrError(
            f"matcher {matcher.name}: matches must be whole numbers [M, 2], each an index of a "
            "feature, none twice"
        )
    return matches.astype(np.uint32)
