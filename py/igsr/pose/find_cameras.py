"""Find the cameras of photos: load them small, run an estimator, load them at the size wanted."""

from __future__ import annotations

import inspect
import os
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from igsr.capture import Capture, load_capture
from igsr.capture.downscaling import check_max_size, reduced_size
from igsr.capture.load import holds_cameras
from igsr.capture.photo_checks import split_unfit
from igsr.capture.photo_folder import (
    FRAMES,
    MIN_PHOTOS,
    Photo,
    load_photos,
    photo_headers,
    reduced_photo,
)
from igsr.errors import IgsrError
from igsr.pose.estimate import Estimate, Progress
from igsr.pose.found_cameras import FoundCameras
from igsr.pose.registry import ESTIMATORS

#: The first of ``ESTIMATORS`` that can run here.
AUTO = "auto"

#: Longest side, in pixels, of photos that estimators are given: they look no closer.
LONGEST = 1600

#: Numbers of estimators' ways to cameras, where they have changed: what was found by another way is
#: found anew.
METHODS = {"colmap": 2, "da3": 2}

#: What photos are given as.
Source = str | os.PathLike[str] | Sequence[str | os.PathLike[str] | Photo]


def estimate_poses(
    photos: Source,
    estimator: str = AUTO,
    *,
    seed: int = 0,
    frames: int = FRAMES,
    max_size: int | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> Capture:
    """Find the cameras of photos.

    Args:
        photos: a folder, a video, or a list of files or of ``Photo``.
        estimator: "colmap" (nothing to download), "dust3r" or "da3" (networks, whose checkpoint
            the user has), or "auto": the cameras that the folder already has, else DUSt3R where a
            checkpoint is found, else Depth Anything 3 where one is, else COLMAP.
        seed: random seed; deterministic for a given seed.
        frames: how many frames are taken of each video.
        max_size: longest side, in pixels, of the capture's photos; larger ones are reduced, none is
            enlarged. None keeps all as they are. The cameras do not depend on it: they are found
            from photos of at most 1600 pixels.
        progress: called with a stage, how much of it is done, and how much there is.
        options: of the estimator alone: COLMAP's ``matcher`` ("sift", "loma" or a ``Matcher``);
            DUSt3R's ``checkpoint``, ``graph`` and ``cameras``; those of Depth Anything 3,
            ``checkpoint``, ``cameras``, ``cameras_from``, ``bundle_adjustment`` and ``matcher``.

    Returns:
        The registered photos, upright and undistorted, in one world frame of unknown scale; all are
        train views. A warning names the photos that are not registered.

    Raises:
        IgsrError: fewer than two photos can be read or registered, they need more memory than there
            is, or an argument cannot be used.
    """
    check_max_size(max_size)
    if estimator == AUTO and isinstance(photos, (str, os.PathLike)) and holds_cameras(photos):
        return load_capture(photos, max_size)
    found, loaded = find_cameras(
        photos, estimator, seed=seed, frames=frames, max_size=max_size, progress=progress, **options
    )
    for sentence in found.estimate.warnings:
        warnings.warn(sentence, stacklevel=2)
    path = Path(photos) if isinstance(photos, (str, os.PathLike)) else Path("photos")
    return found.capture(path, photos_at(photos, frames, max_size, loaded))


def find_cameras(
    photos: Source,
    estimator: str = AUTO,
    *,
    seed: int = 0,
    frames: int = FRAMES,
    max_size: int | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> tuple[FoundCameras, list[Photo]]:
    """Find the cameras of photos, from photos no larger than estimators look at.

    Args:
        photos, estimator, seed, frames, progress, options: as ``estimate_poses``.
        max_size: of the photos that will be loaded later; it is checked that they will fit into
            memory. The cameras do not depend on it.

    Returns:
        The cameras at the photos' full size, and the photos that they were found from.

    Raises:
        IgsrError: as ``estimate_poses``.
    """
    chosen_estimator(estimator, options)
    if isinstance(photos, (str, os.PathLike)):
        # Before the long work, and not when the photos are loaded at that size.
        photo_headers(photos, frames).check_memory(max_size)
    loaded, left_out = split_unfit(photos_of(photos, frames, LONGEST))
    if len(loaded) < MIN_PHOTOS and left_out:
        raise IgsrError(
            f"Cameras are found from {MIN_PHOTOS} photos at least, and {len(loaded)} is left of "
            f"those given: {' '.join(left_out)} Add photos."
        )
    name, found = estimate(loaded, estimator, seed=seed, progress=progress, **options)
    found.warnings = [*left_out, *found.warnings]
    made_by = made_by_of(name, seed, frames, options)
    return FoundCameras.of(loaded, found, made_by), loaded


def made_by_of(estimator: str, seed: int, frames: int, options: dict[str, Any]) -> dict[str, Any]:
    """What cameras depend on beside the photos, as plain values.

    Args:
        estimator: the name of the one that ran, not "auto".
        seed, frames, options: as ``estimate_poses``.
    """
    plain = {
        # A matcher of the user's own is known by its name.
        name: str(value if isinstance(value, os.PathLike) else getattr(value, "name", value))
        for name, value in sorted(options.items())
    }
    made_by = {"estimator": estimator, "seed": seed, "frames": frames, "options": plain}
    return made_by | ({"method": METHODS[estimator]} if estimator in METHODS else {})


def photos_of(photos: Source, frames: int = FRAMES, max_size: int | None = None) -> list[Photo]:
    """Photos as ``estimate_poses`` takes them, loaded.

    Args:
        photos: a folder, a video, or a list of files or of ``Photo``.
        frames: how many frames are taken of each video.
        max_size: longest side, in pixels, of photos as loaded, or None.

    Raises:
        IgsrError: as ``load_photos``, or the list mixes files with ``Photo`` or has a name twice.
    """
    if isinstance(photos, (str, os.PathLike)):
        return load_photos(photos, frames, max_size)
    given = [photo for photo in photos if isinstance(photo, Photo)]
    files = [photo for photo in photos if not isinstance(photo, Photo)]
    if given and files:
        raise IgsrError("photos mixes files and Photo objects; give one kind")
    names = [photo.name for photo in given]
    if len(set(names)) < len(names):
        raise IgsrError("photos holds two photos of one name; give each its own")
    if given:
        return [reduced_photo(photo, max_size) for photo in given]
    return load_photos(files, frames, max_size)


def photos_at(
    photos: Source, frames: int, max_size: int | None, held: list[Photo] | None = None
) -> Iterator[Photo]:
    """The photos at another size, each let go of by the time that the next is asked for.

    Args:
        photos, frames, max_size: as ``estimate_poses``.
        held: the photos at some size, which are taken as they are if that is what is wanted. The
            list is emptied.

    Raises:
        IgsrError: as ``load_photos``.
    """
    if held is None or not all(_is_at(photo, max_size) for photo in held):
        if held is not None:
            held.clear()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what is left out was said when cameras were found
            held = photos_of(photos, frames, max_size)
    while held:
        yield held.pop(0)


def _is_at(photo: Photo, max_size: int | None) -> bool:
    height, width = photo.image.shape[:2]
    return (width, height) == reduced_size(*photo.full_size, max_size)


def chosen_estimator(estimator: str, options: dict[str, Any]) -> str:
    """The name of the estimator that will run.

    Args:
        estimator: its name, or "auto".
        options: of the estimator.

    Raises:
        IgsrError: there is none of that name, or an option is not its own.
    """
    if estimator == AUTO:
        ready = (name for name, entry in ESTIMATORS.items() if entry.ready(options))
        estimator = next(ready)
        # One that stands behind it may know an option that it does not. It is asked only then: a
        # checkpoint of one network is none of another.
        if _foreign(estimator, options):
            estimator = next((n for n in ready if not _foreign(n, options)), estimator)
    elif estimator not in ESTIMATORS:
        raise IgsrError(f"estimator must be {AUTO}, {' or '.join(ESTIMATORS)}, not {estimator!r}")
    foreign = _foreign(estimator, options)
    if foreign:
        raise IgsrError(f"{foreign[0]} is no option of {estimator}; leave it out")
    return estimator


def _foreign(estimator: str, options: dict[str, Any]) -> list[str]:
    """The options that an estimator does not know."""
    known = inspect.signature(ESTIMATORS[estimator].make).parameters
    return [name for name in options if name not in known]


def estimate(
    photos: Sequence[Photo],
    estimator: str = AUTO,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    **options: Any,
) -> tuple[str, Estimate]:
    """The name of the estimator that ran, and all that it found; see ``estimate_poses``.

    Args:
        photos: at least two, upright.
        estimator: its name, or "auto".
        seed: random seed.
        progress: called with a stage, how much of it is done, and how much there is.
        options: of the estimator.

    Raises:
        IgsrError: as ``estimate_poses``.
    """
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise IgsrError(f"seed is {seed!r}; give a whole number of at least 0")
    if len(photos) < MIN_PHOTOS:
        only = f"; there is only {photos[0].name}" if photos else ""
        raise IgsrError(f"Cameras are found from {MIN_PHOTOS} photos at least{only}; add photos")
    panorama = next((photo.place.rig for photo in photos if photo.place is not None), None)
    if panorama is not None and estimator == AUTO:
        estimator = "colmap"
    estimator = chosen_estimator(estimator, options)
    if panorama is not None and estimator != "colmap":
        raise IgsrError(
            f"{panorama} is a panorama or wide fisheye photo, whose views {estimator} would place "
            "one by one; use "
            "--estimator colmap"
        )
    found = ESTIMATORS[estimator].make(**options)(photos, seed=seed, progress=progress)
    if sum(camera is not None for camera in found.cameras) < MIN_PHOTOS:
        raise IgsrError(
            f"No cameras found: the {len(photos)} photos ({photos[0].name} and others) have too "
            "few matches; take photos of one static scene that overlap more"
        )
    return estimator, found
