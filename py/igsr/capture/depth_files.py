"""Read and write depth files: a sensor's or program's depth of each pixel of a photo."""

from __future__ import annotations

import posixpath
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.capture.image_files import load_pixels, open_image
from igsr.errors import IgsrError

Numbers = npt.NDArray[Any]

#: Default world units of a whole number: depth cameras write millimeters.
UNIT_OF_WHOLE_NUMBERS = 1e-3
#: Depths outside these limits count as unknown; products with them would overflow float32.
MIN_DEPTH = 1e-20
MAX_DEPTH = 1e20
#: Folder of depths, for cameras that do not name their depth files.
FOLDER = "depths"
_SUFFIXES = (".npy", ".exr", ".png", ".tif", ".tiff")


def find_depth(folder: Path, name: str) -> Path | None:
    """Return the depth file of the photo ``name`` in a folder, or None.

    It has the photo's whole name, or its name without suffix, and a suffix of a depth file.
    """
    stems = (name, posixpath.splitext(name)[0])
    files = (folder / f"{stem}{suffix}" for stem in stems for suffix in _SUFFIXES)
    return next((file for file in files if file.is_file()), None)


def write_depth(path: Path, depth: Numbers) -> None:
    """Write depth [h, w] in world units as float32 ``.npy``; a missing folder is created."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, depth.astype(np.float32), allow_pickle=False)


def read_depth(path: Path, unit: float | None) -> npt.NDArray[np.float32]:
    """Read a depth file.

    Args:
        path: an ``.npy``, an OpenEXR (channel Z, or else its only one), a 16-bit picture or a
            32-bit float TIFF. 0, negative and non-finite numbers mean that the depth is unknown.
        unit: world units of one number in the file; None is 0.001 for whole numbers and 1 for
            floats.

    Returns:
        Camera-space z [h, w] in world units, 0 for unknown depths.

    Raises:
        IgsrError: the file cannot be read, or holds something else.
    """
    suffix = path.suffix.lower()
    stored = _npy(path) if suffix == ".npy" else _exr(path) if suffix == ".exr" else _picture(path)
    if unit is None:
        unit = UNIT_OF_WHOLE_NUMBERS if np.issubdtype(stored.dtype, np.integer) else 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        depth = stored.astype(np.float64) * unit
    is_known = np.isfinite(depth) & (depth > MIN_DEPTH) & (depth < MAX_DEPTH)
    return np.where(is_known, depth, 0.0).astype(np.float32)


def _picture(path: Path) -> Numbers:
    with open_image(path) as image:
        load_pixels(image, path)
        if image.mode not in ("I", "I;16", "I;16B", "F"):
            raise IgsrError(
                f"{path} is an 8-bit picture, which cannot hold depth; give a 16-bit PNG, .npy or "
                "EXR"
            )
        return np.asarray(image).astype(np.float32 if image.mode == "F" else np.int64)


def _exr(path: Path) -> Numbers:
    try:
        return _core.read_exr_depth(str(path))
    except (OSError, ValueError) as error:
        raise IgsrError(f"{path} cannot be read as depth: {error}") from error


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
