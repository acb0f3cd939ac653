"""``find_cameras``: cameras of photos that have none."""

from __future__ import annotations

import inspect
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from igsr._internal.event import Event, Listener
from igsr._internal.user_warning import warn_user
from igsr.cameras.auto import auto_estimate
from igsr.cameras.colmap.matchers import Matchers, chosen_matchers
from igsr.cameras.estimate import Estimate
from igsr.cameras.found_cameras import FoundCameras
from igsr.cameras.registry import ESTIMATORS
from igsr.capture import Capture, load_capture
from igsr.capture.downscaling import check_max_size, reduced_size
from igsr.capture.load import holds_cameras
from igsr.capture.photo_checks import split_unfit
from igsr.capture.photo_folder import (
    FRAMES,
    MIN_PHOTOS,
    Photo,
    pixel_sizes,
    read_photos,
    reduced_photo,
)
from igsr.errors import IgsrError
from igsr.run import open_run

#: COLMAP, and a pose network for the photos that it cannot place.
AUTO = "auto"
#: Longest side of the photos that estimators are given, pixels.
MAX_SIDE_PX = 1600
#: Version of each estimator's method; raise it to find kept cameras again.
METHODS = {"colmap": 4, "da3": 3, "dust3r": 1, AUTO: 2}

Source: TypeAlias = str | os.PathLike[str] | Sequence[str | os.PathLike[str] | Photo]


@dataclass(frozen=True)
class CameraSettings:
    """How cameras are found.

    Attributes:
        estimator: a name of ``igsr.cameras.registry.ESTIMATORS``, or "auto".
        options: of the estimator.
        seed: random seed.
        frames: maximum number of frames taken from each video.
        allow_missing: whether cameras of fewer than half of the photos are enough.
    """

    estimator: str = AUTO
    options: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    frames: int = FRAMES
    allow_missing: bool = False

    def check(self) -> None:
        """Check the estimator's name and options.

        Raises:
            IgsrError: the estimator is unknown, or an option is not its own.
        """
        if self.estimator == AUTO:
            names = {name for entry in ESTIMATORS.values() for name in _parameters(entry)}
        elif self.estimator in ESTIMATORS:
            names = _parameters(ESTIMATORS[self.estimator])
        else:
            known = " or ".join(ESTIMATORS)
            raise IgsrError(f"estimator must be {AUTO}, {known}, not {self.estimator!r}")
        foreign = [name for name in self.options if name not in names]
        if foreign:
            raise IgsrError(
                f"{foreign[0]} is not an option of estimator {self.estimator}; remove it"
            )
        _ = self.matchers  # raises if the name is unknown

    @property
    def matchers(self) -> Matchers | None:
        """The matchers of the estimator; None if it has none."""
        if self.estimator != AUTO and "matcher" not in _parameters(ESTIMATORS[self.estimator]):
            return None
        return chosen_matchers(self.options.get("matcher", AUTO))

    def made_by(self) -> dict[str, Any]:
        """What the cameras depend on, except the photos, as JSON values."""
        plain = {
            name: str(value) for name, value in sorted(self.options.items()) if name != "matcher"
        }
        if self.matchers is not None:
            plain["matcher"] = self.matchers.name
        return {
            "estimator": self.estimator,
            # "auto" runs the others.
            "method": dict(METHODS) if self.estimator == AUTO else METHODS.get(self.estimator, 1),
            "seed": self.seed,
            "frames": self.frames,
            "options": plain,
        }


def find_cameras(
    photos: Source,
    estimator: str = AUTO,
    *,
    seed: int = 0,
    frames: int = FRAMES,
    max_size: int | None = None,
    progress: Listener | None = None,
    **options: Any,
) -> Capture:
    """Find the cameras of photos.

    Args:
        photos: a folder, a video, or a list of files or of ``Photo``.
        estimator: "colmap" (included), "dust3r" or "da3" (networks, whose weights you download),
            or "auto": the cameras that the folder already has, else COLMAP, and a network whose
            weights are found for the photos that COLMAP cannot place.
        seed: random seed; the result is deterministic for a given seed.
        frames: maximum number of frames taken from each video.
        max_size: longest side of the capture's photos in pixels; larger ones are reduced. None
            keeps their size. The cameras do not depend on it.
        progress: called with each ``igsr.Event``.
        options: of the estimator: COLMAP's ``matcher`` ("auto": "sift" and, if the extra
            ``matching`` is installed, "aliked"; or a ``Matcher``); DUSt3R's ``checkpoint``,
            ``graph`` and ``cameras``; Depth Anything 3's ``checkpoint``, ``cameras``,
            ``cameras_from``, ``bundle_adjustment`` and ``matcher``.

    Returns:
        The placed photos, upright and undistorted, in one world frame of unknown scale; all are
        train views. A warning names the photos that are not placed.

    Raises:
        IgsrError: fewer than two photos can be read or placed, they do not fit into memory, or an
            argument cannot be used.
    """
    check_max_size(max_size)
    if estimator == AUTO and isinstance(photos, (str, os.PathLike)) and holds_cameras(photos):
        return load_capture(photos, max_size)
    settings = CameraSettings(estimator, options, seed, frames)
    with open_run(None, progress) as run:
        found, loaded = estimated_cameras(photos, settings, run.report, max_size)
    for sentence in found.estimate.warnings:
        warn_user(sentence)
    path = Path(photos) if isinstance(photos, (str, os.PathLike)) else Path("photos")
    return found.capture(path, photos_at(photos, frames, max_size, loaded))


def estimated_cameras(
    photos: Source, settings: CameraSettings, report: Listener, max_size: int | None = None
) -> tuple[FoundCameras, list[Photo]]:
    """Estimate the cameras of photos.

    Args:
        photos: as ``find_cameras``.
        settings: how to find the cameras.
        report: called with progress.
        max_size: of the photos that will be loaded later: whether they fit into memory is checked
            before the long work.

    Returns:
        The cameras at the photos' full size, and the photos that they were estimated from.

    Raises:
        IgsrError: as ``find_cameras``.
    """
    settings.check()
    if isinstance(photos, (str, os.PathLike)):
        pixel_sizes(photos, settings.frames).check_memory(max_size)
    loaded, left_out = split_unfit(photos_of(photos, settings.frames, MAX_SIDE_PX))
    if len(loaded) < MIN_PHOTOS and left_out:
        raise IgsrError(
            f"Cameras need at least {MIN_PHOTOS} photos, but only {len(loaded)} can be used: "
            f"{' '.join(left_out)} Add photos."
        )
    found = estimate(loaded, settings, report)
    found.warnings = [*left_out, *found.warnings]
    return FoundCameras.of(loaded, found, settings.made_by()), loaded


def estimate(photos: Sequence[Photo], settings: CameraSettings, report: Listener) -> Estimate:
    """Run the estimator.

    Args:
        photos: at least two, upright.
        settings: how to find the cameras.
        report: called with progress.

    Raises:
        IgsrError: as ``find_cameras``.
    """
    seed = settings.seed
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise IgsrError(f"seed is {seed!r}; give a whole number of at least 0")
    if len(photos) < MIN_PHOTOS:
        only = f"; there is only {photos[0].name}" if photos else ""
        raise IgsrError(f"Cameras need at least {MIN_PHOTOS} photos{only}; add photos")
    settings.check()
    name = settings.estimator
    panorama = next((photo.place.rig for photo in photos if photo.place is not None), None)
    if panorama is not None:
        if name not in (AUTO, "colmap"):
            raise IgsrError(
                f"{panorama} is a panorama or wide fisheye photo, which estimator {name} does not "
                "support; use estimator colmap"
            )
        name = "colmap"

    def progress(stage: str, done: int, total: int) -> None:
        report(Event("find cameras", done, total, stage))

    if name == AUTO:
        found = auto_estimate(photos, settings.options, seed, progress)
    else:
        found = ESTIMATORS[name].make(**settings.options)(photos, seed=seed, progress=progress)
    if sum(camera is not None for camera in found.cameras) < MIN_PHOTOS:
        advice = "" if settings.matchers is None else settings.matchers.advice
        raise IgsrError(
            f"No cameras found: the {len(photos)} photos ({photos[0].name} and others) have too "
            f"few matches; take photos of one static scene that overlap more. {advice}".rstrip(". ")
        )
    return found


def photos_of(photos: Source, frames: int = FRAMES, max_size: int | None = None) -> list[Photo]:
    """Load photos as ``find_cameras`` takes them.

    Args:
        photos: a folder, a video, or a list of files or of ``Photo``.
        frames: maximum number of frames taken from each video.
        max_size: longest side of the photos as loaded, pixels, or None.

    Raises:
        IgsrError: as ``read_photos``, or the list mixes files with ``Photo`` or has a name twice.
    """
    if isinstance(photos, (str, os.PathLike)):
        return read_photos(photos, frames, max_size)
    loaded = [photo for photo in photos if isinstance(photo, Photo)]
    files = [photo for photo in photos if not isinstance(photo, Photo)]
    if loaded and files:
        raise IgsrError("photos mixes files and Photo objects; use only one kind")
    if len({photo.name for photo in loaded}) < len(loaded):
        raise IgsrError("two photos have the same name; rename one")
    if loaded:
        return [reduced_photo(photo, max_size) for photo in loaded]
    return read_photos(files, frames, max_size)


def photos_at(
    photos: Source, frames: int, max_size: int | None, loaded: list[Photo] | None = None
) -> Iterator[Photo]:
    """Yield the photos at a size, releasing each before the next.

    Args:
        photos, frames, max_size: as ``photos_of``.
        loaded: the photos at some size, used if that is the size wanted. The list is emptied.

    Raises:
        IgsrError: as ``read_photos``.
    """
    if loaded is None or not all(_is_at(photo, max_size) for photo in loaded):
        if loaded is not None:
            loaded.clear()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # given when the cameras were found
            loaded = photos_of(photos, frames, max_size)
    while loaded:
        yield loaded.pop(0)


def _is_at(photo: Photo, max_size: int | None) -> bool:
    height, width = photo.image.shape[:2]
    return (width, height) == reduced_size(*photo.full_size, max_size)


def _parameters(entry: Any) -> set[str]:
    return set(inspect.signature(entry.make).parameters)
