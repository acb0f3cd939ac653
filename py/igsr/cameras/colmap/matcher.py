"""Matchers other than SIFT: their interface, and their matches in COLMAP's database."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from igsr._internal.load_pycolmap import load_pycolmap
from igsr.cameras.colmap.database import image_id, photo_file
from igsr.cameras.colmap.features import usable_pixels
from igsr.cameras.colmap.pairs import similar_pairs
from igsr.cameras.estimate import Progress
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError

#: Number of a photo's first features with which each pair of photos is matched.
BEST_FEATURES = 1024
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


def add_matches(
    matcher: Matcher, photos: Sequence[Photo], database: Path, seed: int, show: Progress
) -> None:
    """Match photos by a matcher; verify its matches and the database's together.

    Args:
        matcher: of features.
        photos: of the database.
        database: without verified matches; it is changed. New keypoints follow SIFT's.
        seed: of the verification.
        show: called with "learned features" and "learned matches", done and total.

    Raises:
        IgsrError: the matcher's arrays are invalid.
    """
    pycolmap = load_pycolmap()
    count = len(photos)
    features: list[PhotoFeatures] = []
    with _mapping(matcher) as in_order:
        for one in in_order(lambda photo: usable_features(matcher, photo), photos):
            show("learned features", len(features), count)
            features.append(one)
    show("learned features", count, count)
    pairs = [
        (a, b)
        for a, b in similar_pairs([one.descriptors for one in features])
        # The views of a panorama have one center.
        if (place := photos[a].place) is None or place.rig != getattr(photos[b].place, "rig", None)
    ]
    with pycolmap.Database.open(database) as opened, _mapping(matcher) as in_order:
        first = [_add_keypoints(opened, i, one.xy) for i, one in enumerate(features)]
        found = in_order(lambda p: checked_matches(matcher, features[p[0]], features[p[1]]), pairs)
        for done, ((a, b), matches) in enumerate(zip(pairs, found, strict=True)):
            show("learned matches", done, len(pairs))
            if len(matches):
                ids = image_id(a), image_id(b)
                matches += np.array([first[a], first[b]], dtype=np.uint32)
                if opened.exists_matches(*ids):
                    matches = np.vstack([opened.read_matches(*ids), matches])
                    opened.delete_matches(*ids)
                opened.write_matches(*ids, matches)
        matched = sorted(opened.read_all_matches()[0])
    show("learned matches", len(pairs), len(pairs))
    if matched:
        listing = database.with_name("pairs.txt")
        names = [
            " ".join(photo_file(n - image_id(0)) for n in pycolmap.pair_id_to_image_pair(pair))
            for pair in matched
        ]
        listing.write_text("\n".join(names) + "\n")
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = seed
        pycolmap.verify_matches(database, listing, verification)


@contextlib.contextmanager
def _mapping(matcher: Matcher) -> Iterator[Callable[..., Iterable[Any]]]:
    """``map``, in the threads of a matcher's ``pool`` if it has one."""
    pool = getattr(matcher, "pool", None)
    if pool is None:
        yield map
    else:
        with pool() as threads:
            yield threads.map


def _add_keypoints(opened: Any, index: int, xy: npt.NDArray[np.float32]) -> int:
    """Add keypoints [N, 2] to a photo's; return the number it had before."""
    number = image_id(index)
    if not opened.exists_keypoints(number):
        opened.write_keypoints(number, xy)
        return 0
    before = opened.read_keypoints(number)
    added = np.zeros((len(xy), before.shape[1]), dtype=np.float32)
    added[:, :2] = xy
    opened.update_keypoints(number, np.vstack([before, added]))
    return len(before)


def usable_features(matcher: Matcher, photo: Photo) -> PhotoFeatures:
    """Features of a photo's usable pixels."""
    image = np.ascontiguousarray(photo.image[..., :3])
    usable = usable_pixels(photo)
    if usable is not None:
        # Features of masked pixels would count toward the maximum.
        image = image.copy()
        image[~usable] = image[usable].mean(axis=0).round() if usable.any() else 0
    features = matcher.features(image)
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
    if usable is not None:
        inside &= usable[row, column]
    return PhotoFeatures(xy, features.descriptors, features.size).kept(inside)


def checked_matches(
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
