"""Pose estimation: cameras for photos that have none, by COLMAP or a pose network.

>>> import igsr
>>> capture = igsr.estimate_poses("photos")
"""

from __future__ import annotations

import inspect
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from igsr.capture import Capture, View, load_capture
from igsr.capture.load import holds_cameras
from igsr.capture.photo_folder import FEWEST, FRAMES, Photo, load_photos
from igsr.capture.undistort import Undistorter
from igsr.errors import IgsrError
from igsr.pose.cache import found_before, kept_cameras, not_placed, photos_note
from igsr.pose.estimate import Estimate, Estimator, Progress
from igsr.pose.registry import ESTIMATORS

__all__ = [
    "AUTO",
    "Estimate",
    "Estimator",
    "capture_of",
    "estimate",
    "estimate_poses",
    "found_before",
    "kept_cameras",
    "not_placed",
    "photos_note",
]


#: The first of ``ESTIMATORS`` that can run here.
AUTO = "auto"


def estimate_poses(
    photos: str | os.PathLike[str] | Sequence[str | os.PathLike[str] | Photo],
    estimator: str = AUTO,
    *,
    seed: int = 0,
    frames: int = FRAMES,
    progress: Progress | None = None,
    **options: Any,
) -> Capture:
    """Find the cameras of photos.

    Args:
        photos: a folder, a video, or a list of files or of ``Photo``.
        estimator: "colmap" (nothing to download), "dust3r" (a network, whose checkpoint the user
            has), or "auto": the cameras that the folder already has, else DUSt3R where a checkpoint
            is found, else COLMAP.
        seed: random seed; deterministic for a given seed.
        frames: how many frames are taken of each video.
        progress: called with a stage, how much of it is done, and how much there is.
        options: of the estimator alone: DUSt3R's ``checkpoint``, ``graph`` and ``cameras``.

    Returns:
        The registered photos, upright and undistorted, in one world frame of unknown scale; all are
        train views. A warning names the photos that are not registered.

    Raises:
        IgsrError: fewer than two photos can be read or registered, or an argument cannot be used.
    """
    if estimator == AUTO and isinstance(photos, (str, os.PathLike)) and holds_cameras(photos):
        return load_capture(photos)
    loaded = photos_of(photos, frames)
    _, found = estimate(loaded, estimator, seed=seed, progress=progress, **options)
    for sentence in found.warnings:
        warnings.warn(sentence, stacklevel=2)
    path = Path(photos) if isinstance(photos, (str, os.PathLike)) else Path("photos")
    return capture_of(path, loaded, found)


def photos_of(
    photos: str | os.PathLike[str] | Sequence[str | os.PathLike[str] | Photo], frames: int = FRAMES
) -> list[Photo]:
    """Photos as ``estimate_poses`` takes them, loaded; see there."""
    if isinstance(photos, (str, os.PathLike)):
        return load_photos(photos, frames)
    given = [photo for photo in photos if isinstance(photo, Photo)]
    files = [photo for photo in photos if not isinstance(photo, Photo)]
    if given and files:
        raise IgsrError("photos mixes files and Photo objects; give one kind")
    names = [photo.name for photo in given]
    if len(set(names)) < len(names):
        raise IgsrError("photos holds two photos of one name; give each its own")
    return given or load_photos(files, frames)


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
    if len(photos) < FEWEST:
        only = f"; there is only {photos[0].name}" if photos else ""
        raise IgsrError(f"Cameras are found from {FEWEST} photos at least{only}; add photos")
    if estimator == AUTO:
        estimator = next(name for name, entry in ESTIMATORS.items() if entry.ready(options))
    elif estimator not in ESTIMATORS:
        raise IgsrError(f"estimator must be {AUTO}, {' or '.join(ESTIMATORS)}, not {estimator!r}")
    make = ESTIMATORS[estimator].make
    foreign = [name for name in options if name not in inspect.signature(make).parameters]
    if foreign:
        raise IgsrError(f"{foreign[0]} is no option of {estimator}; leave it out")
    found = make(**options)(photos, seed=seed, progress=progress)
    if sum(camera is not None for camera in found.cameras) < FEWEST:
        raise IgsrError(
            f"No cameras found: the {len(photos)} photos ({photos[0].name} and others) have too "
            "few matches; take photos of one static scene that overlap more"
        )
    return estimator, found


def capture_of(path: Path, photos: Sequence[Photo], found: Estimate) -> Capture:
    """The registered photos of an estimate as a capture, with lens distortion undone.

    Args:
        path: that the capture has.
        photos: those that cameras were estimated for.
        found: the estimate, of as many photos.

    Raises:
        IgsrError: a lens bends so much that nothing of its photo is left.
    """
    undistorters: dict[object, Undistorter] = {}
    views = []
    lenses = found.lenses or [None] * len(photos)
    for photo, camera, lens in zip(photos, found.cameras, lenses, strict=True):
        if camera is None:
            continue
        image, mask = photo.image, photo.mask
        if lens is not None and not lens.is_pinhole:
            key = lens, camera.K.tobytes(), camera.width, camera.height
            if key not in undistorters:
                undistorters[key] = Undistorter(lens, camera.K, camera.width, camera.height)
            undistorter = undistorters[key]
            image = undistorter.image(image)
            mask = undistorter.valid.copy() if mask is None else undistorter.mask(mask)
        if mask is not None and mask.all():
            mask = None
        views.append(View(photo.name, camera, "train", image, mask))
    return Capture(path, views, found.points)
