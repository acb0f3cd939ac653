"""The estimator ``colmap``: features, matches and mapping."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr._internal.load_pycolmap import load_pycolmap
from igsr._internal.user_warning import warn_user
from igsr.cameras.colmap import aliked
from igsr.cameras.colmap.attempts import mapped
from igsr.cameras.colmap.database import image_id, list_photos
from igsr.cameras.colmap.features import MAX_SIDE_PX, find_features, usable_pixels
from igsr.cameras.colmap.mapping import without_distortion
from igsr.cameras.colmap.matcher import add_matches
from igsr.cameras.colmap.matchers import AUTO, Choice, Matchers, chosen_matchers
from igsr.cameras.colmap.matching import matched
from igsr.cameras.colmap.pairs import (
    FOLLOWING_PHOTOS,
    MAX_EXHAUSTIVE_PHOTOS,
    SIMILAR_LEARNED,
    SIMILAR_PHOTOS,
)
from igsr.cameras.colmap.result import estimate_of
from igsr.cameras.estimate import Estimate, Progress
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError

#: Warn of the time from this number of photos.
MANY_PHOTOS = 200
#: Seconds of one core for the features of a megapixel, for matching a pair of photos, and for
#: placing a photo.
FEATURES_SECONDS = 0.9
PAIR_SECONDS = 0.15
PLACE_SECONDS = 0.3
#: Of one core, for the trained matcher's features of a photo and for a pair.
LEARNED_FEATURES_SECONDS = 1.7
LEARNED_PAIR_SECONDS = 2.0


class Colmap:
    """Finds cameras with pycolmap.

    Args:
        matcher: finds and matches features; a name of ``MATCHERS`` or a ``Matcher``.

    Raises:
        IgsrError: as ``chosen_matchers``.
    """

    name = "colmap"

    def __init__(self, matcher: Choice = AUTO) -> None:
        self._matchers = chosen_matchers(matcher)

    def __call__(
        self, photos: Sequence[Photo], *, seed: int = 0, progress: Progress | None = None
    ) -> Estimate:
        """Register as many photos as possible; see ``Estimator``.

        The largest connected set of photos is kept. Deterministic for a seed on one machine.
        """
        show = progress or (lambda stage, done, total: None)
        if len(photos) > MANY_PHOTOS:
            sizes = [(photo.image.shape[1], photo.image.shape[0]) for photo in photos]
            minutes = camera_seconds(sizes) / 60.0
            warn_user(
                f"COLMAP needs about {minutes:.0f} minutes for {len(photos)} photos; every third "
                "photo is usually enough"
            )
        with tempfile.TemporaryDirectory(prefix="igsr-colmap-") as folder, guarded(seed):
            workspace = Path(folder)
            matches = matched_photos(photos, workspace, self._matchers, seed, show)
            result = mapped(
                len(photos),
                matches,
                seed,
                show,
                sift=self._matchers.sift,
                aliked=self._matchers.aliked,
                usable=usable_by_image_id(photos),
            )
            if result.model is not None:
                result = replace(result, model=without_distortion(result.model))
        found = estimate_of(photos, result)
        if self._matchers.advice and not all(found.cameras):
            found.warnings.append(self._matchers.advice)
        return found


def camera_seconds(sizes: Sequence[tuple[int, int]]) -> float:
    """Estimate the seconds that COLMAP takes on this machine, with matcher "auto".

    Args:
        sizes: width and height of each photo, pixels.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    count, pixels = len(sizes), 0.0
    for width, height in sizes:
        scale = min(1.0, MAX_SIDE_PX / max(width, height))
        pixels += width * height * scale * scale
    pairs = count * (FOLLOWING_PHOTOS + SIMILAR_PHOTOS)
    if count <= MAX_EXHAUSTIVE_PHOTOS:
        pairs = count * (count - 1) // 2
    parallel = FEATURES_SECONDS * pixels / 1e6 + PAIR_SECONDS * pairs
    if aliked.is_available():
        learned = min(count * (count - 1) // 2, count * SIMILAR_LEARNED)
        parallel += LEARNED_FEATURES_SECONDS * count + LEARNED_PAIR_SECONDS * learned
    return parallel / max(1, cores or 1) + PLACE_SECONDS * count


def matched_photos(
    photos: Sequence[Photo], workspace: Path, matchers: Matchers, seed: int, show: Progress
) -> Path:
    """Create a database of photos, features and verified matches.

    Args:
        photos: at least two.
        workspace: folder for the database.
        matchers: find and match features; all matches of a pair are verified together.
        seed: of the verification.
        show: called with a stage, done and total.

    Raises:
        IgsrError: as ``add_matches``.
    """
    database = workspace / "database.db"
    list_photos(photos, database)
    learned = matchers.learned
    if matchers.sift:
        find_features(photos, database, show)
        database = matched(len(photos), database, seed, show, verify=learned is None)
    if learned is not None:
        add_matches(learned(), photos, database, seed, show)
    return database


def usable_by_image_id(photos: Sequence[Photo]) -> dict[int, npt.NDArray[np.bool_]]:
    """Usable pixels [H, W] of photos that have unusable ones, by COLMAP's image id."""
    pixels = {image_id(i): usable_pixels(photo) for i, photo in enumerate(photos)}
    return {number: mask for number, mask in pixels.items() if mask is not None}


@contextlib.contextmanager
def guarded(seed: int) -> Iterator[None]:
    """Run pycolmap without its log, with a fixed seed, and with failures as error messages.

    Args:
        seed: random seed.

    Raises:
        IgsrError: COLMAP fails.
    """
    pycolmap = load_pycolmap()
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    pycolmap.set_random_seed(seed)
    try:
        yield
    except IgsrError:
        raise
    except (RuntimeError, ValueError) as error:
        raise IgsrError(f"COLMAP failed ({error}); remove unusual photos and try again") from error
    finally:
        pycolmap.logging.minloglevel = level
