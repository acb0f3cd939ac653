"""``load_photos``: a capture from photos with cameras or without; found cameras are kept."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from igsr._internal.event import CAMERAS_FOUND
from igsr._internal.name_lists import listed
from igsr._internal.part_usage import Meter
from igsr._internal.user_warning import warn_user
from igsr.cameras.cameras_file import KeptCameras, read_cameras_file, write_cameras_file
from igsr.cameras.find import AUTO, CameraSettings, estimated_cameras, photos_at
from igsr.cameras.found_cameras import FoundCameras
from igsr.cameras.registry import ESTIMATORS, NETWORKS
from igsr.capture import Capture, load_capture
from igsr.capture.downscaling import check_max_size
from igsr.capture.load import Overview, look_at
from igsr.capture.photo_folder import file_sizes
from igsr.errors import IgsrError
from igsr.run import Run

#: File of the found cameras in the folder of a run.
CAMERAS_FILE = "cameras.npz"
#: A run ends if fewer than this fraction of the photos are placed, unless it is allowed.
MIN_PLACED_FRACTION = 0.5


@dataclass(frozen=True, eq=False)
class LoadedPhotos:
    """Photos with cameras, ready to fit.

    Attributes:
        capture: the photos.
        not_placed: names of the photos whose cameras were not found.
        cameras_found: whether igsr found the cameras; else they were given.
    """

    capture: Capture
    not_placed: list[str] = field(default_factory=list)
    cameras_found: bool = False


def load_photos(
    photos: str | os.PathLike[str] | Capture,
    run: Run,
    settings: CameraSettings | None = None,
    *,
    holdout: int | None = None,
    max_size: int | None = None,
    announce: Callable[[Overview, bool], None] | None = None,
) -> LoadedPhotos:
    """Load photos; find their cameras first if they have none.

    Found cameras are kept in ``cameras.npz`` in the run's folder, and used again if photos and
    settings are the same. A run that is resumed uses them if the photos are the same.

    Args:
        photos: a capture, a folder of photos, or a video.
        run: measures "cameras" and "load".
        settings: how to find cameras.
        holdout: hold out every Nth photo for testing, or None.
        max_size: longest side of photos as loaded, pixels, or None. A capture keeps its sizes.
        announce: called before slow work with what the path holds, and whether its cameras are
            known.

    Raises:
        IgsrError: the photos cannot be loaded, too few cameras are found, or an estimator or its
            options are given for photos that have cameras.
    """
    if isinstance(photos, Capture):
        if settings is not None and (settings.options or settings.estimator != AUTO):
            raise IgsrError("photos is a capture, which has cameras; leave out the estimator")
        return LoadedPhotos(photos if holdout is None else photos.with_holdout(holdout))
    settings = settings or CameraSettings()
    path = _checked_path(photos)
    check_max_size(max_size)
    settings.check()
    seen = look_at(path, settings.frames, max_size)
    seen.train_photos(holdout)  # checks holdout
    if seen.has_cameras and (settings.options or settings.estimator != AUTO):
        raise IgsrError(f"{path} has cameras or no photos; remove the estimator and its options")
    seen.check_memory(max_size, 0)
    kept = None if seen.has_cameras else _kept_cameras(path, run, settings)
    if announce is not None:
        announce(seen, seen.has_cameras or kept is not None)
    if seen.has_cameras:
        with run.parts.measured("load"):
            capture = load_capture(path, max_size)
        return LoadedPhotos(capture if holdout is None else capture.with_holdout(holdout))
    loaded = None
    if kept is None:
        meter = Meter()
        found, loaded = estimated_cameras(path, settings, run.report, max_size)
        kept = KeptCameras(found, file_sizes(path), meter.lap())
        if run.out is not None:
            write_cameras_file(run.out / CAMERAS_FILE, kept)
            run.wrote(CAMERAS_FOUND, run.out / CAMERAS_FILE)
    elif run.out is not None:
        run.note(f"Using the cameras in {run.out / CAMERAS_FILE}; delete it to find them again.")
    run.parts.add("cameras", kept.usage)
    for sentence in kept.found.estimate.warnings:
        warn_user(sentence)
    check_enough_placed(kept.found, settings)
    with run.parts.measured("load"):
        photos_to_fit = photos_at(path, settings.frames, max_size, loaded)
        capture = kept.found.capture(path, photos_to_fit)
    if holdout is not None:
        capture = capture.with_holdout(holdout)
    return LoadedPhotos(capture, kept.found.not_placed, cameras_found=True)


def _checked_path(photos: Any) -> Path:
    if not isinstance(photos, (str, os.PathLike)):
        kind = type(photos).__name__
        raise IgsrError(f"photos must be a capture, a folder or a video, not {kind}")
    return Path(photos)


def check_enough_placed(found: FoundCameras, settings: CameraSettings) -> None:
    """Check that enough photos are placed for a fit to show the scene.

    Raises:
        IgsrError: fewer than half are, and it is not allowed; the message says what to do.
    """
    placed, count = len(found.placed), len(found.names)
    if settings.allow_missing or placed >= MIN_PLACED_FRACTION * count:
        return
    networks = [name for name in NETWORKS if ESTIMATORS[name].ready({})]
    others = [name for name in networks if name != settings.estimator]
    advice = f", try estimator {' or '.join(others)}" if others else ""
    raise IgsrError(
        f"Only {placed} of {count} photos could be placed; not placed: {listed(found.not_placed)}. "
        f"Add photos between them that overlap more, remove photos of another scene{advice}, or "
        "continue with the placed photos (--allow-missing, allow_missing=True)."
    )


def _kept_cameras(photos: Path, run: Run, settings: CameraSettings) -> KeptCameras | None:
    """The cameras in the run's folder, if they can be used.

    Raises:
        IgsrError: the run is resumed, and its cameras are of other photos or cannot be read.
    """
    if run.out is None:
        return None
    file = run.out / CAMERAS_FILE
    if not file.is_file():
        return None
    if run.resume:
        kept = read_cameras_file(file)
        if kept.photos != file_sizes(photos):
            raise IgsrError(
                f"The photos in {photos} have changed since {file} was written; restore them, "
                "or start over without resume."
            )
        return kept
    try:
        kept = read_cameras_file(file)
    except IgsrError:
        return None
    if kept.photos != file_sizes(photos) or kept.found.made_by != settings.made_by():
        return None
    could_place_more = (
        settings.estimator == AUTO
        and kept.found.not_placed
        and kept.found.estimate.weights is None
        and any(ESTIMATORS[name].ready(settings.options) for name in NETWORKS)
    )
    return None if could_place_more else kept
