"""Cameras that were found before, kept beside what was made with them."""

from __future__ import annotations

import json
from pathlib import Path, PurePosixPath

from igsr._internal.atomic_write import check_folder
from igsr.capture import Capture
from igsr.capture.load import holds_cameras
from igsr.capture.photo_folder import VIDEO_SUFFIXES, photo_sizes
from igsr.errors import IgsrError

#: In the folder of the cameras: names and bytes of the photos that were given.
GIVEN = "photos.json"


def kept_cameras(photos: Path, out: Path) -> Path:
    """Where the cameras of photos are kept that are found for what goes to ``out``.

    Raises:
        IgsrError: the photos lie there themselves, or something else that would be replaced.
    """
    kept = out / "capture"
    if kept.resolve() in (photos.resolve(), *photos.resolve().parents):
        raise IgsrError(f"{photos} lies where the fit would write {kept}; name another --out")
    check_folder(kept, replace=_given(kept) is not None)
    return kept


def photos_note(photos: Path) -> dict[str, str]:
    """What says, beside cameras that are kept, which photos they were looked for in."""
    return {GIVEN: json.dumps(photo_sizes(photos), indent=1)}


def found_before(photos: Path, kept: Path) -> bool:
    """Whether ``kept`` has cameras to go on with.

    Raises:
        IgsrError: they are of other photos.
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
    """Names of photos that no camera was found for, if cameras had to be found.

    A capture may have fewer views than were placed: what was is kept beside its cameras.
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
    """What ``photos_note`` was; None where nothing of that kind is."""
    try:
        found = json.loads((kept / GIVEN).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None
