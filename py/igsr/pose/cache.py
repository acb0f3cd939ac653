"""Cache of estimated cameras, in the output folder of the fit that uses them."""

from __future__ import annotations

import json
from pathlib import Path, PurePosixPath

from igsr._internal.atomic_write import check_folder
from igsr._internal.json_file import write_json
from igsr._internal.part_usage import Usage
from igsr.capture import Capture
from igsr.capture.load import holds_cameras
from igsr.capture.photo_folder import VIDEO_SUFFIXES, photo_sizes
from igsr.errors import IgsrError

#: File in the cache: names and sizes in bytes of the photos that cameras were estimated for.
GIVEN = "photos.json"
#: File in the cache: what finding the cameras took.
USAGE = "usage.json"


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
    placed = {
        path.relative_to(photos).with_suffix("").as_posix()
        for path in photos.rglob("*")
        if path.is_file()
    }
    return [
        name
        for name in given
        if PurePosixPath(name).suffix.lower() not in VIDEO_SUFFIXES
        and _without_suffix(name) not in placed
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


def write_usage(kept: Path, usage: Usage) -> None:
    """Write into the cache what finding its cameras took, for reports, also of resumed runs.

    Args:
        kept: the cache, with cameras.
        usage: what finding them took.

    Raises:
        IgsrError: it cannot be written.
    """
    write_json(kept / USAGE, usage.plain())


def read_usage(kept: Path) -> Usage | None:
    """What finding the cameras in the cache took; None where that is not known.

    Args:
        kept: the cache, or another capture.
    """
    try:
        found = json.loads((kept / USAGE).read_text(encoding="utf-8"))
        return Usage.of(found)
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return None
