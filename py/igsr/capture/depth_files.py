"""Files of depth: what a sensor or another program measured for each pixel of a photo."""

from __future__ import annotations

import posixpath
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr import _core
from igsr.errors import IgsrError

Numbers = npt.NDArray[Any]

#: World units of a whole number, where the capture does not say: depth cameras write millimeters.
UNIT_OF_WHOLE_NUMBERS = 1e-3
#: Depths beyond these are no measurement; they would leave float32 when they are multiplied.
LEAST, MOST = 1e-20, 1e20


#: Folder of depths beside cameras that do not name their files, and what these end in.
FOLDER = "depths"
SUFFIXES = (".npy", ".exr", ".png", ".tif", ".tiff")


def depth_beside(folder: Path, name: str) -> Path | None:
    """The file of depth of the photo ``name`` in a folder of such files, or None.

    It has the photo's whole name, or the name without what it ends in, and ends in one of
    ``SUFFIXES``.
    """
    stems = (name, posixpath.splitext(name)[0])
    files = (folder / f"{stem}{end}" for stem in stems for end in SUFFIXES)
    return next((file for file in files if file.is_file()), None)


def write_depth(path: Path, depth: Numbers) -> None:
    """Write depth [h, w] in world units as float32 ``.npy``; a missing folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, depth.astype(np.float32), allow_pickle=False)


def holds_array(path: Path) -> bool:
    """Whether a file of depth is an array (``.npy``, OpenEXR), and no picture that Pillow reads."""
    return path.suffix.lower() in (".npy", ".exr")


def depth_array(path: Path) -> Numbers:
    """The numbers [h, w] of an ``.npy`` or OpenEXR file (channel Z, else its only one).

    Raises:
        IgsrError: the file cannot be read, or holds something else.
    """
    if path.suffix.lower() == ".npy":
        return _npy(path)
    try:
        return _core.read_exr_depth(str(path))
    except (OSError, ValueError) as error:
        raise IgsrError(f"{path} cannot be read as depth: {error}") from error


def depth_of(image: Image.Image, path: Path) -> Numbers:
    """The numbers [h, w] of a 16-bit picture or a 32-bit float TIFF, whose pixels are loaded.

    Raises:
        IgsrError: it is an 8-bit picture.
    """
    if image.mode not in ("I", "I;16", "I;16B", "F"):
        raise IgsrError(
            f"{path} is an 8-bit picture, which cannot hold depth; give a 16-bit PNG, .npy or EXR"
        )
    return np.asarray(image).astype(np.float32 if image.mode == "F" else np.int64)


def in_world_units(stored: Numbers, unit: float | None) -> npt.NDArray[np.float32]:
    """Camera-space z [h, w] in world units, 0 where it is not known.

    Args:
        stored: [h, w], the file's numbers; 0, negative ones and those that are not finite say that
            the depth is not known.
        unit: world units of one of them; None is 0.001 for whole numbers and 1 for floats.
    """
    if unit is None:
        unit = UNIT_OF_WHOLE_NUMBERS if np.issubdtype(stored.dtype, np.integer) else 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        depth = stored.astype(np.float64) * unit
    known = np.isfinite(depth) & (depth > LEAST) & (depth < MOST)
    return np.where(known, depth, 0.0).astype(np.float32)


def _npy(path: Path) -> Numbers:
    try:
        # Mapped, so that a header that claims more than the file holds reserves no memory.
        stored = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise IgsrError(f"{path} cannot be read as depth: {error}") from error
    if not isinstance(stored, np.ndarray) or stored.dtype.kind not in "uif":
        raise IgsrError(f"{path} holds no numbers; give depth as a .npy array of [H, W]")
    if stored.ndim == 3 and 1 in (stored.shape[0], stored.shape[2]):
        stored = stored[0] if stored.shape[0] == 1 else stored[..., 0]
    if stored.ndim != 2 or 0 in stored.shape:
        raise IgsrError(f"{path} has shape {list(stored.shape)}; give depth as [H, W]")
    return np.array(stored)
