"""Find the photos and videos of a folder, and skip images that are not photos of the scene."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from igsr._internal.input_files import open_file
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
#: Files in the folders that igsr writes, and the folders and pictures that it writes there.
OWN_FILES = ("scene.ply", "checkpoint.npz", "cameras.npz", "view/run.json")
OWN_FOLDERS = ("view", "rounds", "blocks", "checkpoints")
OWN_PICTURES = ("views.png", "poses.png", "matches.png", "scene.compact.png")
OWN = "written by igsr"
#: Minimum number of photos to find cameras from.
MIN_PHOTOS = 2
#: Photos in formats that igsr does not read.
UNREAD_SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf", ".jxl", ".jp2")
#: In the images and videos that igsr renders: in their first bytes or, of videos, the last ones.
OWN_TAG = "igsr render"
TAG_BYTES = 1 << 10
VIDEO_TAG_BYTES = 1 << 16


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

    def mask_count(self) -> int:
        """Number of files with a mask."""
        return sum(self.masks.of(file) is not None for file in self.files)


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
        return path.is_dir() and any(True for _ in _walk(path))
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
        is_run = any(is_file(path / file) for file in OWN_FILES)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in folders:
            is_own = is_run and name in OWN_FOLDERS
            others[path / name] = other or (OWN if is_own else _other_folder(path, name, folders))
        visible = sorted(name for name in names if not name.startswith("."))
        photos = [name for name in visible if _is_photo(path / name)]
        own = [name for name in photos if is_run and name in OWN_PICTURES]
        unread = [name for name in visible if name.lower().endswith(UNREAD_SUFFIXES)]
        if own:
            yield _Place(path, own, [], OWN)
        if len(photos) > len(own) or unread:
            yield _Place(path, [name for name in photos if name not in own], unread, other)


def _other_folder(path: Path, name: str, siblings: Sequence[str]) -> str | None:
    """The reason to skip a folder, or None."""
    folder, lower = path / name, [sibling.lower() for sibling in siblings]
    if is_file(folder / "transforms.json") or (folder / "sparse").is_dir():
        return f"in the capture {name}/"
    is_reduced = name.lower().startswith("images_") and name[7:].isdigit() and "images" in lower
    # Polycam's undistorted photos.
    is_raw = name.lower() == "images" and "corrected_images" in lower
    is_other = name.lower() in OTHER_FOLDERS
    return f"in {name}/" if is_reduced or is_raw or is_other else None


def _is_photo(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES + VIDEO_SUFFIXES and is_file(path)


def _found(folder: Path) -> PhotoFiles:
    """The photos of the scene in a folder. Folders are not skipped if all photos are in them."""
    places = list(_walk(folder))
    skipped: Counter[str] = Counter()
    scene = [place for place in places if place.other is None and place.photos]
    if not scene:
        scene = [place for place in places if place.other != OWN]
    for place in places:
        if place not in scene and place.path.name.lower() not in MASK_FOLDERS:
            skipped[str(place.other)] += len(place.photos)
    files = [file for place in scene for file in _of_scene(place, skipped)]
    renders = set(filter(_is_render, files))
    if len(renders) < len(files):
        skipped["rendered by igsr"] += len(renders)
        files = [file for file in files if file not in renders]
    root = folder
    first = [file.relative_to(folder).parts[0] for file in files]
    images = Counter(name for name in first if name.lower() == "images").most_common(1)
    if images and images[0][1] > sum(file.parent == folder for file in files):
        root = folder / images[0][0]
        inside = [file for file in files if root in file.parents]
        skipped["outside of images/"] += len(files) - len(inside)
        files = inside
    files.sort(key=lambda file: file.relative_to(root).as_posix())
    for suffix in sorted(Path(name).suffix.lower() for place in places for name in place.unread):
        skipped[f"{suffix} (export them as JPEG)"] += 1
    return PhotoFiles(root, files, MaskFiles.of_photos(root), +skipped)


def _of_scene(place: _Place, skipped: Counter[str]) -> Iterator[Path]:
    """The photos in a folder, without masks and the videos of Live Photos."""
    names = {name.lower() for name in place.photos}
    videos = [name for name in place.photos if name.lower().endswith(VIDEO_SUFFIXES)]
    stems = {Path(name).stem.lower() for name in place.photos if name not in videos}
    for name in place.photos:
        if is_mask_beside(name, names | stems):
            continue
        # A single image next to a video is its thumbnail.
        if name in videos and Path(name).stem.lower() in stems and len(stems) >= MIN_PHOTOS:
            skipped["videos named like photos"] += 1
        else:
            yield place.path / name


def _is_render(file: Path) -> bool:
    """Whether igsr rendered an image or video."""
    is_image = file.suffix.lower() == ".png"
    if not is_image and file.suffix.lower() not in VIDEO_SUFFIXES:
        return False
    try:
        with open_file(file) as opened:
            ends = opened.read(TAG_BYTES)
            if not is_image:
                opened.seek(max(0, file.stat().st_size - VIDEO_TAG_BYTES))
                ends += opened.read(VIDEO_TAG_BYTES)
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
    return PhotoFiles(root, files, MaskFiles.of_photos(root))
