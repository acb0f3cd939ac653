"""Find the masks of photos by their customary names.

A folder of photos contains its masks in ``masks``, ``mask``, ``alpha`` or ``alphas``, or has that
folder next to it. The mask of ``a/1.jpg`` is ``a/1.png``, ``a/1.jpg.png`` (COLMAP),
``a/1_mask.png`` (Metashape) or ``a/1.jpg.mask.png`` (RealityScan), with any image suffix. The last
two may also be in the folder of the photo. Pixels are used where the mask is white.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from igsr._internal.user_warning import warn_user
from igsr.capture.image_files import SUFFIXES

#: Names of folders of masks, in lower case.
MASK_FOLDERS = ("masks", "mask", "alpha", "alphas")
#: Ends of the stems of masks in the folder of their photos.
_MASK_ENDS = (".mask", "_mask")


class MaskFiles:
    """The masks in some folders, by the names of their photos."""

    def __init__(self, folders: Iterable[Path], photos: Path | None = None) -> None:
        """List the masks.

        Args:
            folders: the folder of masks is the first that exists.
            photos: the folder of photos, which may contain masks, too.
        """
        self.folder = next((folder for folder in folders if folder.is_dir()), None)
        self._files: dict[str, Path] = {}
        if photos is not None:
            for path in _images(photos):
                if path.stem.lower().endswith(_MASK_ENDS):
                    self._add(path, photos)
        if self.folder is not None:
            for path in _images(self.folder):
                self._add(path, self.folder)

    @classmethod
    def beside(cls, photos: Path, factor: int = 1, capture: Path | None = None) -> MaskFiles:
        """The masks of a folder of photos.

        Args:
            photos: a folder ``images`` or ``images_K`` may have the folder of masks next to it.
            factor: of the reduction of the photos; ``masks_K`` is preferred if it is K.
            capture: another folder that may have the folder of masks.
        """
        places = [photos]
        if capture is not None:
            places.append(capture)
        elif photos.resolve().name.lower().split("_")[0] == "images":
            places.append(photos.resolve().parent)
        names = [f"masks_{factor}"] if factor > 1 else []
        folders = [place / name for place in places for name in names]
        folders += [place / found for place in places for found in _mask_folders(place)]
        return cls(folders, photos)

    def _add(self, path: Path, root: Path) -> None:
        relative = path.relative_to(root).with_suffix("").as_posix()
        for end in _MASK_ENDS:
            if relative.lower().endswith(end):
                relative = relative[: -len(end)]
        self._files[relative.lower()] = path

    def of(self, name: str) -> Path | None:
        """The mask of a photo.

        Args:
            name: posix path relative to the folder of photos.
        """
        stem = PurePosixPath(name).with_suffix("").as_posix()
        return self._files.get(name.lower()) or self._files.get(stem.lower())

    def __bool__(self) -> bool:
        return bool(self._files)

    def warn_unless_used(self, masks: int) -> None:
        """Warn if there are masks, and none has the name of a photo.

        Args:
            masks: number of photos with a mask.
        """
        if self._files and not masks and self.folder is not None:
            example = min(self._files.values()).name
            warn_user(
                f"No mask in {self.folder} has the name of a photo ({example}), so none is used: "
                "name the mask of 1.jpg 1.png or 1.jpg.png."
            )


def is_mask_beside(name: str, stems: set[str]) -> bool:
    """Whether a file is the mask of a photo in the same folder.

    Args:
        name: of the file.
        stems: of the files in the folder, and their names, in lower case.
    """
    stem = PurePosixPath(name).stem.lower()
    return any(stem.endswith(end) and stem[: -len(end)] in stems for end in _MASK_ENDS)


def _mask_folders(place: Path) -> list[str]:
    """Names of folders of masks in a folder."""
    try:
        names = sorted(entry.name for entry in os.scandir(place) if entry.is_dir())
    except OSError:
        return []
    found = [name for name in names if name.lower() in MASK_FOLDERS]
    return sorted(found, key=lambda name: MASK_FOLDERS.index(name.lower()))


def _images(folder: Path) -> list[Path]:
    """Files with the suffix of an image in a folder and its subfolders, in their order."""
    return sorted(
        Path(place, name)
        for place, _, names in os.walk(folder)
        for name in names
        if name.lower().endswith(SUFFIXES) and not name.startswith(".")
    )
