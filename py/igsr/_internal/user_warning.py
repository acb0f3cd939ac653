"""Warnings that point to the user's line, however deep in igsr they are raised."""

from __future__ import annotations

import sys
import warnings


def warn_user(message: str) -> None:
    """Give a ``UserWarning`` at the innermost frame outside the package igsr."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and _is_own(frame.f_globals.get("__name__", "")):
        frame = frame.f_back
        level += 1
    warnings.warn(message, stacklevel=level)


def _is_own(module: str) -> bool:
    return module == "igsr" or module.startswith("igsr.") or module == "contextlib"
