"""The estimator ``colmap``: features, matches, mapping, and again for photos that are missing."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr._internal.user_warning import warn_user
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError
from igsr.pose.colmap.attempts import mapped
from igsr.pose.colmap.database import image_id, list_photos
from igsr.pose.colmap.distortion import without_distortion
from igsr.pose.colmap.features import find_features, usable_pixels
from igsr.pose.colmap.given_matches import matched_by
from igsr.pose.colmap.matcher import Matcher, checked_matcher
from igsr.pose.colmap.matching import matched
from igsr.pose.colmap.result import estimate_of
from igsr.pose.colmap.time_estimate import camera_seconds
from igsr.pose.estimate import Estimate, Progress

#: Photos from which it is said how long they take.
MANY = 200


class Colmap:
    """Finds cameras with pycolmap; see the package.

    Args:
        matcher: finds and matches features; None is COLMAP's SIFT.

    Raises:
        IgsrError: the matcher has no name, by which found cameras are kept.
    """

    name = "colmap"

    def __init__(self, matcher: Matcher | None = None) -> None:
        self._matcher = checked_matcher(matcher)

    def __call__(
        self, photos: Sequence[Photo], *, seed: int = 0, progress: Progress | None = None
    ) -> Estimate:
        """Register as many photos as possible; see ``Estimator``.

        The largest set of photos that hang together is kept. The same photos and seed give the same
        bits on the same machine.
        """
        show = progress or (lambda stage, done, total: None)
        if len(photos) > MANY:
            sizes = [(photo.image.shape[1], photo.image.shape[0]) for photo in photos]
            minutes = camera_seconds(sizes) / 60.0
            warn_user(
                f"COLMAP needs about {minutes:.0f} minutes for {len(photos)} photos; every third "
                "is mostly enough"
            )
        with tempfile.TemporaryDirectory(prefix="igsr-colmap-") as folder, guarded(seed):
            workspace = Path(folder)
            matches = matched_photos(photos, workspace, self._matcher, seed, show)
            sift = self._matcher is None
            found = mapped(
                len(photos), matches, seed, show, sift=sift, usable=usable_by_number(photos)
            )
            if found.model is not None:
                found = replace(found, model=without_distortion(found.model))
        return estimate_of(photos, found)


def matched_photos(
    photos: Sequence[Photo], workspace: Path, matcher: Matcher | None, seed: int, show: Progress
) -> Path:
    """A database of photos, their features and verified matches.

    Args:
        photos: at least two.
        workspace: the folder that it is made in.
        matcher: what finds and matches features; None for COLMAP's SIFT.
        seed: of the verification.
        show: called with "features" and "matching", how much is done, and how much there is.

    Raises:
        IgsrError: as ``matched_by``.
    """
    database = workspace / "database.db"
    list_photos(photos, database)
    if matcher is not None:
        return matched_by(matcher, photos, database, seed, show)
    find_features(photos, database, show)
    return matched(len(photos), database, seed, show)


def usable_by_number(photos: Sequence[Photo]) -> dict[int, npt.NDArray[np.bool_]]:
    """Pixels [H, W] that have features, by COLMAP's number of the photo, where some have none."""
    pixels = {image_id(i): usable_pixels(photo) for i, photo in enumerate(photos)}
    return {number: mask for number, mask in pixels.items() if mask is not None}


@contextlib.contextmanager
def guarded(seed: int) -> Iterator[None]:
    """pycolmap without its log, with a fixed seed, and with failures as error messages.

    Args:
        seed: random seed.

    Raises:
        IgsrError: COLMAP fails.
    """
    import pycolmap

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    pycolmap.set_random_seed(seed)
    try:
        yield
    except IgsrError:
        raise
    except (RuntimeError, ValueError) as error:
        raise IgsrError(
            f"COLMAP failed ({error}); leave out unusual photos and try again"
        ) from error
    finally:
        pycolmap.logging.minloglevel = level
