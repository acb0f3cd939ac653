"""Matchers by name."""

from __future__ import annotations

from collections.abc import Callable

from igsr.errors import IgsrError
from igsr.pose.colmap.matcher import Matcher

#: The features and matches of COLMAP itself.
SIFT = "sift"


def _loma() -> Matcher:
    from igsr.pose.colmap.loma import Loma

    return Loma()


#: By name, what can be asked for beside ``SIFT``.
MATCHERS: dict[str, Callable[[], Matcher]] = {"loma": _loma}


def matcher_of(given: str | Matcher) -> Matcher | None:
    """The matcher of a name, or the one given; None for COLMAP's own.

    Raises:
        IgsrError: there is none of that name, or it cannot run here.
    """
    if not isinstance(given, str):
        if not isinstance(getattr(given, "name", None), str):
            raise IgsrError("a matcher of one's own needs a name, which found cameras are kept by")
        return given
    if given == SIFT:
        return None
    if given not in MATCHERS:
        raise IgsrError(f"matcher must be {SIFT} or {', '.join(MATCHERS)}, not {given!r}")
    return MATCHERS[given]()
