"""Find the masks of photos by their customary names.

A folder ``masks``, ``mask``, ``alpha`` or ``alphas`` is in the folder of the photo, or in a folder
above. It contains the mask of ``1.jpg`` as ``1.png``, ``1.jpg.png`` (COLMAP), ``1_mask.png``
(Metashape) or ``1.jpg.mask.png`` (RealityScan), with any image suffix. The last two may also be in
the folder of the photo. White pixels are used.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from igsr._internal.user_warning import warn_user
from igsr.capture.image_files import SUFFIXES

#: Names of folders of masks, in lower case.
MASK_FOLDERS = ("masks", "mask", "alpha", "alphas")
#: Ends of the stems of masks in the folder of their photos.
_MASK_ENDS = (".mask", "_mask")


class MaskFiles:
    """Finds the masks of photos; folders are listed once."""

    def __init__(self, top: Path, factor: int = 1) -> None:
        """List no folder yet.

        Args:
            top: the highest folder that may hold a folder of masks.
            factor: of the reduction of the photos; ``masks_K`` is preferred if it is K.
        """
        self._top = _absolute(top)
        self._names = [f"masks_{factor}", *MASK_FOLDERS] if factor > 1 else [*MASK_FOLDERS]
        self._folders: dict[Path, list[dict[str, Path]]] = {}
        self._unused: Path | None = None
        self._used = 0

    @classmethod
    def of_photos(cls, root: Path) -> MaskFiles:
        """For a folder of photos without cameras; ``images`` may have masks next to it."""
        return cls(_absolute(root).parent if _is_images(_absolute(root)) else root)

    def of(self, photo: Path) -> Path | None:
        """The mask of a photo, or None."""
        mask = next(self._candidates(photo), None)
        self._used += mask is not None
        return mask

    def _candidates(self, photo: Path) -> Iterator[Path]:
        folder, inside = _absolute(photo).parent, [photo.name]
        beside = self._indices(folder)[0]
        yield from _named(beside, photo.name)
        while True:
            for index in self._indices(folder)[1:]:
                for name in ("/".join(inside), "/".join(inside[1:])):
                    if name:
                        yield from _named(index, name)
            is_inside = folder != self._top and folder.is_relative_to(self._top)
            is_outside = not folder.is_relative_to(self._top)
            if not is_inside and not (is_outside and _is_images(folder)):
                return
            folder, inside = folder.parent, [folder.name, *inside]

    def _indices(self, folder: Path) -> list[dict[str, Path]]:
        """Masks in a folder of photos, and masks in each of its mask folders."""
        if folder not in self._folders:
            try:
                entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
            except OSError:
                entries = []
            beside = [Path(entry.path) for entry in entries if _is_mask_name(entry.name)]
            found = {entry.name.lower(): Path(entry.path) for entry in entries if entry.is_dir()}
            indices = [_index(folder, beside)]
            for name in self._names:
                if name in found:
                    indices.append(_index(found[name], _images(found[name])))
                    if indices[-1] and self._unused is None:
                        self._unused = found[name]
            self._folders[folder] = indices
        return self._folders[folder]

    def warn_unless_used(self) -> None:
        """Warn if there are masks, and none has the name of a photo."""
        if self._unused is not None and not self._used:
            warn_user(
                f"No mask in {self._unused} has the name of a photo, so none is used: name the "
                "mask of 1.jpg 1.png or 1.jpg.png."
            )


def is_mask_beside(name: str, others: set[str]) -> bool:
    """Whether a file is the mask of a photo in the same folder.

    Args:
        name: of the file.
        others: names and stems of the files in the folder, in lower case.
    """
    stem = PurePosixPath(name).stem.lower()
    return any(stem.endswith(end) and stem[: -len(end)] in others for end in _MASK_ENDS)


def _is_images(folder: Path) -> bool:
    return folder.name.lower().split("_")[0] == "images"


def _absolute(path: Path) -> Path:
    """The path from the root on; links stay."""
    return Path(os.path.abspath(path))


def _is_mask_name(name: str) -> bool:
    return name.lower().endswith(SUFFIXES) and PurePosixPath(name).stem.lower().endswith(_MASK_ENDS)


def _index(root: Path, files: list[Path]) -> dict[str, Path]:
    """Masks by the names of their photos relative to ``root``, in lower case, without suffix."""
    index = {}
    for path in files:
        name = path.relative_to(root).with_suffix("").as_posix().lower()
        for end in _MASK_ENDS:
            name = name.removesuffix(end)
        index[name] = path
    return index


def _named(index: dict[str, Path], name: str) -> Iterator[Path]:
    for key in (name.lower(), PurePosixPath(name.lower()).with_suffix("").as_posix()):
        if key in index:
            yield index[key]


def _images(folder: Path) -> list[Path]:
    """Files with the suffix of an image in a folder and its subfolders, in their order."""
    return sorted(
        Path(place, name)
        for place, _, names in os.walk(folder)
        for name in names
        if name.lower().endswith(SUFFIXES) and not name.startswith(".")
    )
