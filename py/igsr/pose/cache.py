"""Cache of estimated cameras, in the output folder of the fit that uses them.

The folder is a capture, with the photos at the size of the fit. Beside it are the cameras as they
were found, at the photos' full size, from which the capture is made anew where the size changes.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from igsr._internal.atomic_write import check_folder
from igsr._internal.part_usage import Parts, Usage
from igsr.capture import Capture, load_capture
from igsr.capture.downscaling import check_max_size, reduced_size
from igsr.capture.load import describe_capture, holds_cameras, look_at
from igsr.capture.photo_folder import FRAMES, LENS, VIDEO_SUFFIXES, photo_sizes
from igsr.capture.write_colmap import write_colmap
from igsr.errors import IgsrError
from igsr.pose.estimate import Progress
from igsr.pose.find_cameras import AUTO, chosen_estimator, find_cameras, made_by_of, photos_at
from igsr.pose.found_cameras import FoundCameras, read_found
from igsr.pose.registry import ESTIMATORS

#: File in the cache: names and sizes in bytes of the photos that cameras were estimated for.
GIVEN = "photos.json"
#: File in the cache: the cameras, see ``igsr.pose.found_cameras``.
FOUND = "found.npz"
#: File in the cache: what finding the cameras took.
USAGE = "usage.json"
#: Fewer registered photos than this part of all end a fit that does not allow it.
ENOUGH = 0.5
#: Estimators that need fewer matches between photos than COLMAP does.
NETWORKS = ("dust3r", "da3")
#: Names shown of a long list.
_NAMED = 5


def kept_capture(
    photos: Path,
    out: Path,
    *,
    estimator: str = AUTO,
    seed: int = 0,
    frames: int = FRAMES,
    options: Mapping[str, Any] | None = None,
    max_size: int | None = None,
    resume: bool = False,
    allow_missing: bool = False,
    progress: Progress | None = None,
    say: Callable[[str], None] = lambda sentence: None,
    warn: Callable[[str], None] = warnings.warn,
    parts: Parts | None = None,
) -> Capture:
    """The capture of photos without cameras, which are found only if the cache has none.

    Cameras that were found before are taken if photos, estimator, seed, frames and options are the
    same; with ``resume``, if the photos are.

    Args:
        photos: a folder of photos, or a video.
        out: output folder of the fit; ``out/capture`` is the cache.
        estimator, seed, frames, options, progress: as ``igsr.estimate_poses``.
        max_size: longest side in pixels of the capture's photos; None keeps them as they are.
        resume: whether a fit goes on that began with these cameras.
        allow_missing: whether fewer than half of the photos may be registered.
        say: takes sentences about what is done.
        warn: takes warnings.
        parts: count what "cameras" and "load" take, or None. Cameras that were found before count
            with what finding them took.

    Raises:
        IgsrError: as ``igsr.estimate_poses``; too few photos are registered (the cameras are kept);
            ``resume`` with cameras of other photos; or the cache cannot be written.
    """
    check_max_size(max_size)
    options = dict(options or {})
    parts = Parts() if parts is None else parts
    kept = kept_cameras(photos, out)
    name = chosen_estimator(estimator, options)
    found = _before(photos, kept, made_by_of(name, seed, frames, options), resume)
    if found is None:
        with parts.measured("cameras"):
            found, held = find_cameras(
                photos,
                name,
                seed=seed,
                frames=frames,
                max_size=max_size,
                progress=progress,
                **options,
            )
        usage = parts.used["cameras"]
        for sentence in found.estimate.warnings:
            warn(sentence)
        with parts.measured("load"):
            # The capture is let go of before it is loaded.
            views = photos_at(photos, frames, max_size, held)
            _write(kept, photos, found, found.capture(kept, views), usage)
        say(
            f"Cameras of {len(found.placed)} of {len(found.names)} photos were found by {name} "
            f"and are kept in {kept}"
        )
        check_enough_placed(found, options, allow_missing)
    else:
        say(f"The cameras found before are used, from {kept}; delete it to find them anew")
        for sentence in found.estimate.warnings:
            warn(sentence)
        check_enough_placed(found, options, allow_missing)
        before = read_usage(kept)
        if before is not None:
            parts.add("cameras", before)
        if not _is_at(kept, found, max_size):
            look_at(photos, frames).check_memory(max_size)
            with parts.measured("load"):
                views = photos_at(photos, frames, max_size)
                _write(kept, photos, found, found.capture(kept, views), before)
    with parts.measured("load"):
        return load_capture(kept)


def check_enough_placed(
    found: FoundCameras, options: Mapping[str, Any], allow_missing: bool
) -> None:
    """End where so few photos are registered that a fit would not show the scene.

    Args:
        found: the cameras.
        options: of the estimator, by which it is known whether another one could run.
        allow_missing: whether that is allowed.

    Raises:
        IgsrError: fewer than half are, and it is not allowed; the message says what to do.
    """
    placed, count = len(found.placed), len(found.names)
    if allow_missing or placed >= ENOUGH * count:
        return
    lost = found.not_placed
    more = f" and {len(lost) - _NAMED} more" if len(lost) > _NAMED else ""
    used = found.made_by.get("estimator")
    # A checkpoint that was named is that of the network which ran.
    known = {} if used in NETWORKS else options
    ready = [name for name in NETWORKS if name != used and ESTIMATORS[name].ready(known)]
    network = f", try --estimator {' or '.join(ready)}" if ready else ""
    raise IgsrError(
        f"Only {placed} of {count} photos could be placed, not {', '.join(lost[:_NAMED])}{more}: "
        f"take photos between them that overlap more, leave out what shows another scene{network}, "
        "or go on with those that are placed by --allow-missing (allow_missing=True)."
    )


def _before(photos: Path, kept: Path, made_by: dict[str, Any], resume: bool) -> FoundCameras | None:
    """The cameras in the cache, if they can be used."""
    if resume:
        return read_found(kept / FOUND) if found_before(photos, kept) else None
    if _given(kept) != photo_sizes(photos):
        return None
    try:
        found = read_found(kept / FOUND)
    except IgsrError:
        return None
    return found if found.made_by == made_by else None


def _write(
    kept: Path, photos: Path, found: FoundCameras, capture: Capture, usage: Usage | None
) -> None:
    used = {} if usage is None else {USAGE: json.dumps(usage.plain())}
    write_colmap(
        capture,
        kept,
        replace=True,
        depths=found.depths,
        further_masks={"trusted": found.trusted},
        notes={**photos_note(photos), **used, FOUND: found.to_bytes()},
    )


def _is_at(kept: Path, found: FoundCameras, max_size: int | None) -> bool:
    """Whether the capture in the cache has its photos at a size."""
    try:
        shots = describe_capture(kept).shots
    except IgsrError:
        return False
    wanted = [
        reduced_size(camera.width, camera.height, max_size)
        for camera in found.estimate.cameras
        if camera is not None
    ]
    return sorted((shot.camera.width, shot.camera.height) for shot in shots) == sorted(wanted)


def kept_cameras(photos: Path, out: Path) -> Path:
    """The folder that caches the estimated cameras of ``photos`` for the output folder ``out``.

    Args:
        photos: folder or file of photos.
        out: output folder of the fit.

    Raises:
        IgsrError: the photos themselves lie there, or other files that would be replaced.
    """
    kept = out / "capture"
    if kept.resolve() in (photos.resolve(), *photos.resolve().parents):
        raise IgsrError(f"{photos} lies where the fit would write {kept}; name another --out")
    check_folder(kept, replace=_given(kept) is not None)
    return kept


def photos_note(photos: Path) -> dict[str, str]:
    """The note in the cache that says which photos the cameras were estimated for.

    Args:
        photos: folder or file of photos.
    """
    return {GIVEN: json.dumps(photo_sizes(photos), indent=1)}


def has_found(photos: Path, out: Path) -> bool:
    """Whether the output folder ``out`` holds cameras of ``photos``; files are not read whole.

    Args:
        photos: folder or file of photos.
        out: output folder of the fit.
    """
    kept = out / "capture"
    return (kept / FOUND).is_file() and _given(kept) == photo_sizes(photos)


def found_before(photos: Path, kept: Path) -> bool:
    """Whether the cache ``kept`` holds cameras of ``photos``.

    Args:
        photos: folder or file of photos.
        kept: the cache, of ``kept_cameras``.

    Raises:
        IgsrError: it holds cameras of other photos.
    """
    if not holds_cameras(kept):
        return False
    if _given(kept) != photo_sizes(photos):
        raise IgsrError(
            f"{kept} has the cameras of other photos than {photos} holds now; resume with the same "
            "ones or leave --resume out."
        )
    return True


def not_placed(capture: Capture) -> list[str]:
    """Names of the photos that are not registered, if the cameras were estimated.

    They come from the cache, since a capture may hold fewer views than were registered.

    Args:
        capture: the photos that were fitted.
    """
    given = _given(capture.path) or {}
    photos = capture.path / "images"
    files = [path.relative_to(photos) for path in photos.rglob("*") if path.is_file()]
    placed = {path.with_suffix("").as_posix() for path in files}
    # The views of a panorama are in a folder of its name.
    panoramas = {path.parent.as_posix() for path in files}
    return [
        name
        for name in given
        if PurePosixPath(name).suffix.lower() not in VIDEO_SUFFIXES
        and name != LENS
        and _without_suffix(name) not in placed
        and name not in panoramas
    ]


def _without_suffix(name: str) -> str:
    return PurePosixPath(name).with_suffix("").as_posix()


def _given(kept: Path) -> dict[str, int] | None:
    """The content of ``photos_note``; None where there is none."""
    try:
        found = json.loads((kept / GIVEN).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def read_usage(kept: Path) -> Usage | None:
    """What finding the cameras in the cache took; None where that is not known.

    It is there for reports, also of runs that find the cameras kept.

    Args:
        kept: the cache, or another capture.
    """
    try:
        found = json.loads((kept / USAGE).read_text(encoding="utf-8"))
        return Usage.of(found)
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return None
