"""Custom matchers: their interface, and their matches in COLMAP's database."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from igsr._internal.load_pycolmap import load_pycolmap
from igsr.cameras.colmap.database import image_id, photo_file
from igsr.cameras.colmap.features import usable_pixels
from igsr.cameras.colmap.pairs import MAX_EXHAUSTIVE_PHOTOS
from igsr.cameras.estimate import Progress
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError

#: Minimum number of matches of a pair for verification (COLMAP's number of inliers).
MIN_MATCHES = 15


@dataclass(frozen=True, eq=False)
class PhotoFeatures:
    """Features of a photo.

    Attributes:
        xy: float32 [N, 2] in pixels; the center of the first pixel is 0.5.
        descriptors: float32 [N, D].
        size: width and height of the photo, pixels.
    """

    xy: npt.NDArray[np.float32]
    descriptors: npt.NDArray[np.float32]
    size: tuple[int, int]

    def kept(self, rows: npt.NDArray[np.bool_]) -> PhotoFeatures:
        """Return the features of some rows, bool [N]."""
        return PhotoFeatures(self.xy[rows], self.descriptors[rows], self.size)


class Matcher(Protocol):
    """Features and matches for the estimator ``colmap``, which verifies them.

    Features of a photo are found once and matched with all photos.

    Attributes:
        name: for reports, and to recognize cameras found with it.
    """

    name: str

    def features(self, image: npt.NDArray[np.uint8]) -> PhotoFeatures:
        """Return features of a photo, RGB [H, W, 3]. Masked pixels are removed later."""

    def matches(self, first: PhotoFeatures, second: PhotoFeatures) -> npt.NDArray[np.uint32]:
        """Return pairs of feature indices [M, 2]; no feature is in two pairs."""


def checked_matcher(matcher: Matcher | None) -> Matcher | None:
    """Check that a custom matcher has a name.

    Raises:
        IgsrError: it has none.
    """
    if matcher is not None and not isinstance(getattr(matcher, "name", None), str):
        raise IgsrError("matcher needs an attribute name, by which found cameras are kept")
    return matcher


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
    pycolmap = load_pycolmap()
    count = len(photos)
    if count > MAX_EXHAUSTIVE_PHOTOS:
        raise IgsrError(
            f"matcher {matcher.name} compares every pair of photos: give at most "
            f"{MAX_EXHAUSTIVE_PHOTOS} of the {count} photos, or leave the matcher out"
        )
    features = []
    for index, photo in enumerate(photos):
        show("features", index, count)
        features.append(_features(matcher, photo))
    show("features", count, count)
    pairs = [(a, b) for a in range(count) for b in range(a + 1, count)]
    matched = []
    with pycolmap.Database.open(database) as opened:
        for index, of_photo in enumerate(features):
            opened.write_keypoints(image_id(index), of_photo.xy)
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
    """Features of a photo's usable pixels."""
    features = matcher.features(np.ascontiguousarray(photo.image[..., :3]))
    xy = np.asarray(features.xy, dtype=np.float32)
    height, width = photo.image.shape[:2]
    if xy.ndim != 2 or xy.shape[1] != 2 or len(features.descriptors) != len(xy):
        raise IgsrError(
            f"matcher {matcher.name}: features of {photo.name} must be xy [N, 2] with a descriptor "
            f"each, not {xy.shape} and {len(features.descriptors)}"
        )
    inside = np.isfinite(xy).all(axis=1) & (xy >= 0.0).all(axis=1)
    inside &= (xy[:, 0] < width) & (xy[:, 1] < height)
    column, row = np.where(inside[:, None], xy, 0.0).astype(np.int64).T
    usable = usable_pixels(photo)
    if usable is not None:
        inside &= usable[row, column]
    return PhotoFeatures(xy, features.descriptors, features.size).kept(inside)


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
