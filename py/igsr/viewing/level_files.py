"""Scenes in levels of detail for the page, which does not draw by distance."""

from __future__ import annotations

import os
from dataclasses import fields

from igsr import _core
from igsr.errors import IgsrError
from igsr.splats import Splats

#: The file that lists cells and levels.
INDEX = "lod-meta.json"
#: Most splats that the page is given of such a scene: about 10 MB.
MOST = 300_000


def level_within(path: str | os.PathLike[str], most: int = MOST) -> Splats:
    """The finest level of a scene that has at most so many splats.

    Args:
        path: a ``lod-meta.json``.
        most: the largest number of splats.

    Raises:
        IgsrError: a file cannot be read, or the coarsest level has more.
    """
    try:
        read = _core.read_level(os.fspath(path), most)
    except (OSError, ValueError) as error:
        raise IgsrError(f"{error}.") from error
    return Splats(**{part.name: read[part.name] for part in fields(Splats)})
