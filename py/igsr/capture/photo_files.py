"""Find the photos and videos of a folder, and skip images that are not photos of the scene."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from igsr.capture.image_files import SUFFIXES, is_file
from igsr.capture.mask_files import MASK_FOLDERS, MaskFiles, is_mask_beside
from igsr.capture.video_frames import VIDEO_SUFFIXES
from igsr.errors import IgsrError

Paths = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]

#: Subfolders that usually contain no photos, in lower case (Polycam, Record3D, nerfstudio, COLMAP
#: and others).
OTHER_FOLDERS = (
    *MASK_FOLDERS,
    *("depth", "depths", "depth_maps", "confidence", "confidences", "conf", "normal", "normals"),
    *("thumbnail", "thumbnails", "thumbs", "semantic", "semantics", "segmentation", "sparse"),
)
#: Files in the folders that igsr writes.
OWN_FILES = ("scene.ply", "checkpoint.npz", "cameras.npz", "view/run.json")
#: Photos in formats that igsr does not read.
UNREAD_SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf", ".jxl", ".jp2")
#: In the images and videos that igsr renders, and the number of first and last bytes to search.
OWN_TAG = "igsr render"
TAG_BYTES = 1 << 16


@dataclass(frozen=True)
class PhotoFiles:
    """The photos and videos of a folder.

    Attributes:
        root: folder that names are relative to.
        files: photos and videos, sorted by name.
        masks: of the photos.
        skipped: number of skipped files by reason.
    """

    root: Path
    files: list[Path]
    masks: MaskFiles
    skipped: Counter[str] = field(default_factory=Counter)

    def skipped_words(self) -> str:
        """The skipped files in words, or an empty string."""
        return ", ".join(f"{count} {what}" for what, count in self.skipped.items())

    def mask_of(self, file: Path) -> Path | None:
        """The mask of one of the files."""
        return self.masks.of(file.relative_to(self.root).as_posix())

    def mask_count(self) -> int:
        """Number of files with a mask."""
        return sum(self.mask_of(file) is not None for file in self.files)


def find_photo_files(path: Paths) -> PhotoFiles:
    """Find the photos and videos of a folder, or check a list of them.

    Raises:
        IgsrError: there are none, or a listed file is missing, no photo by its name or given twice.
    """
    if not isinstance(path, (str, os.PathLike)):
        return _listed_files([Path(file) for file in path])
    folder = Path(path)
    if is_file(folder):
        return _listed_files([folder])
    try:
        if not folder.is_dir():
            raise IgsrError(f"{folder} does not exist or is not a folder; give a folder of photos")
        found = _found(folder)
    except IgsrError:  # a ValueError, too
        raise
    except (OSError, ValueError) as error:
        raise IgsrError(f"{folder} cannot be read; give a folder of photos") from error
    if not found.files:
        skipped = f" besides {found.skipped_words()}" if found.skipped else ""
        raise IgsrError(
            f"{folder} holds no photos{skipped}; give a folder with JPEG, PNG, WebP or HEIC files"
        )
    return found


def has_photos(path: Path) -> bool:
    """Return whether a path is a video, or a folder that holds photos or videos."""
    if is_file(path):
        return path.suffix.lower() in VIDEO_SUFFIXES
    try:
        return path.is_dir() and any(place for place in _walk(path) if place.photos)
    except (OSError, ValueError):
        return False


@dataclass(frozen=True)
class _Place:
    """A folder with photos; ``other`` names it if it does not hold photos of the scene."""

    path: Path
    photos: list[str]
    unread: list[str]
    other: str | None


def _walk(root: Path) -> Iterator[_Place]:
    """Folders with photos, without hidden ones; links are followed, each folder once."""
    seen: set[str] = set()
    others: dict[Path, str | None] = {}
    for place, folders, names in os.walk(root, followlinks=True):
        path = Path(place)
        real = os.path.realpath(place)
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        other = others.pop(path, None)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in folders:
            others[path / name] = other or _other_folder(path, name, folders)
        visible = sorted(name for name in names if not name.startswith("."))
        photos = [name for name in visible if _is_photo(path / name)]
        unread = [name for name in visible if name.lower().endswith(UNREAD_SUFFIXES)]
        if photos or unread:
            yield _Place(path, photos, unread, other)


def _other_folder(path: Path, name: str, siblings: Sequence[str]) -> str | None:
    """The reason to skip a folder, or None."""
    if any(is_file(path / name / file) for file in OWN_FILES):
        return "written by igsr"
    lower = [sibling.lower() for sibling in siblings]
    is_reduced = name.lower().startswith("images_") and name[7:].isdigit() and "images" in lower
    # Polycam's undistorted photos.
    is_raw = name.lower() == "images" and "corrected_images" in lower
    is_other = name.lower() in OTHER_FOLDERS
    return f"in {name}/" if is_reduced or is_raw or is_other else None


def _is_photo(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES + VIDEO_SUFFIXES and is_file(path)


def _found(folder: Path) -> PhotoFiles:
    """The photos of the scene in a folder. If all folders would be skipped, none is."""
    places = list(_walk(folder))
    scene = [place for place in places if place.other is None and place.photos] or places
    skipped: Counter[str] = Counter()
    for place in places:
        if place not in scene and place.path.name.lower() not in MASK_FOLDERS:
            skipped[str(place.other)] += len(place.photos)
    root = folder
    inside = [place for place in scene if _is_in_images(place.path.relative_to(folder))]
    direct = sum(len(place.photos) for place in scene if place.path == folder)
    if sum(len(place.photos) for place in inside) > direct:
        root = folder / inside[0].path.relative_to(folder).parts[0]
        skipped["outside of images/"] += sum(len(place.photos) for place in scene)
        skipped["outside of images/"] -= sum(len(place.photos) for place in inside)
        scene = inside
    files = [file for place in scene for file in _of_scene(place, skipped)]
    files.sort(key=lambda file: file.relative_to(root).as_posix())
    for suffix in sorted(Path(name).suffix.lower() for place in places for name in place.unread):
        skipped[f"{suffix} (export them as JPEG)"] += 1
    return PhotoFiles(root, files, MaskFiles.beside(root), +skipped)


def _is_in_images(place: Path) -> bool:
    return bool(place.parts) and place.parts[0].lower() == "images"


def _of_scene(place: _Place, skipped: Counter[str]) -> Iterator[Path]:
    """The photos in a folder, without masks, Live Photos' videos and igsr's renders."""
    names = {name.lower() for name in place.photos}
    videos = [name for name in place.photos if name.lower().endswith(VIDEO_SUFFIXES)]
    stems = {Path(name).stem.lower() for name in place.photos if name not in videos}
    renders = [name for name in place.photos if _is_render(place.path / name)]
    for name in place.photos:
        if is_mask_beside(name, names | stems):
            continue
        if name in videos and Path(name).stem.lower() in stems:
            skipped["videos named like photos"] += 1
        elif name in renders and len(renders) < len(place.photos):
            skipped["rendered by igsr"] += 1
        else:
            yield place.path / name


def _is_render(file: Path) -> bool:
    """Whether igsr rendered an image or video."""
    if file.suffix.lower() not in (".png", *VIDEO_SUFFIXES):
        return False
    try:
        with open(file, "rb") as opened:
            ends = opened.read(TAG_BYTES)
            opened.seek(max(0, file.stat().st_size - TAG_BYTES))
            ends += opened.read(TAG_BYTES)
    except OSError:
        return False
    return OWN_TAG.encode() in ends


def _listed_files(files: list[Path]) -> PhotoFiles:
    if not files:
        raise IgsrError("photos is an empty list; give at least two photos")
    for file in files:
        if not is_file(file):
            raise IgsrError(f"{file} does not exist or is not a file; give photos or one folder")
        if file.suffix.lower() not in SUFFIXES + VIDEO_SUFFIXES:
            raise IgsrError(f"{file} is no photo by its name; give JPEG, PNG, WebP or HEIC files")
    files = [file.absolute() for file in files]
    repeated = [file for index, file in enumerate(files) if file in files[:index]]
    if repeated:
        raise IgsrError(f"{repeated[0]} is given twice; give it once")
    root = Path(os.path.commonpath([file.parent for file in files]))
    return PhotoFiles(root, files, MaskFiles.beside(root))
