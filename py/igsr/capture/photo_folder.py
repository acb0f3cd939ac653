"""Photos without cameras: load folders, files and videos, upright.

These photos are turned by their EXIF orientation. Those of a capture are not: its cameras belong to
the pixels as stored.

Masks are in a folder ``masks`` in the folder of photos or, if that is named ``images``, beside it:
``masks/NAME.png`` with the photo's whole name, as in COLMAP (``masks/a/1.jpg.png``), or with
``.png`` in place of its suffix (``masks/a/1.png``). White pixels may be used, black ones may not. A
mask has the size of the upright photo.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from igsr.capture.exif import read_exif, upright
from igsr.capture.photos import SUFFIXES, is_file, load_pixels, mask_of, open_image, pixels_of
from igsr.capture.video_frames import VIDEO_SUFFIXES, sharpest_frames
from igsr.errors import IgsrError

#: Frames taken from each video.
FRAMES = 40
#: The fewest photos that cameras can be found from.
FEWEST = 2
#: Names shown of a long list.
_NAMED = 3


@dataclass(frozen=True, eq=False)
class Photo:
    """A photo whose camera is not known.

    Attributes:
        name: posix path relative to the folder, unique among the photos.
        image: uint8 [H, W, 3] RGB, or [H, W, 4] with straight alpha; upright.
        mask: bool [H, W], True where a pixel may be used, or None if all may.
        focal: focal length in pixels of ``image``, from EXIF, or None if it is not known.
        device: make, model and lens of the camera, or the video's name; photos of one device, size
            and focal length share their intrinsics. None if it is not known.
    """

    name: str
    image: np.ndarray
    mask: np.ndarray | None = None
    focal: float | None = None
    device: str | None = None


def load_photos(
    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]], frames: int = FRAMES
) -> list[Photo]:
    """Load photos whose cameras are not known.

    Args:
        path: a folder, a video, or a list of photos and videos. Sub-folders are read too, and files
            that are not photos are ignored. If a folder has no photos itself but ``images/``, the
            photos in that are taken.
        frames: number of frames taken from each video: the sharpest of as many equal spans.

    Returns:
        The photos, sorted by name if from a folder, else in the order given. A photo that cannot be
        read is left out; a warning names it.

    Raises:
        IgsrError: there are no photos, fewer than two can be read, a file is given twice, they need
            more memory than there is, or ``frames`` is not a whole number of at least 1.
    """
    if isinstance(frames, bool) or not isinstance(frames, int) or frames < 1:
        raise IgsrError(
            f"frames is {frames!r}; give a whole number of at least 1, such as {FRAMES}"
        )
    if isinstance(path, (str, os.PathLike)):
        given = Path(path)
        root, files, masks = _folder(given) if not is_file(given) else _files([given])
    else:
        root, files, masks = _files([Path(file) for file in path])
    names = [file.relative_to(root).as_posix() for file in files]

    def load(file: Path, name: str) -> list[Photo] | IgsrError:
        try:
            if file.suffix.lower() in VIDEO_SUFFIXES:
                return _from_video(file, name, frames)
            return [_from_file(file, name, masks)]
        except IgsrError as error:
            return error

    with warnings.catch_warnings(), ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        # Pillow warns of damaged EXIF and the like even where the pixels can be read.
        warnings.filterwarnings("ignore", module="PIL")
        _refuse_large(files)
        loaded = list(pool.map(load, files, names))
    photos = [photo for found in loaded if isinstance(found, list) for photo in found]
    broken = [found for found in loaded if isinstance(found, IgsrError)]
    if broken:
        if len(photos) < FEWEST:
            raise broken[0]
        warnings.warn(_left_out(files, loaded, broken), stacklevel=2)
    return photos


def photo_root(folder: Path) -> Path:
    """The folder that holds the photos: ``images`` if only that has any, else the folder itself."""
    inner = folder / "images"
    if inner.is_dir() and not any(_is_photo(entry) for entry in folder.iterdir()):
        return inner
    return folder


def has_photos(path: Path) -> bool:
    """Whether a path is a video, or a folder that holds photos or videos."""
    if is_file(path):
        return path.suffix.lower() in VIDEO_SUFFIXES
    try:
        return path.is_dir() and next(_walk(photo_root(path)), None) is not None
    except (OSError, ValueError):
        return False


def photo_sizes(path: Path) -> dict[str, int]:
    """The size in bytes of each photo and video that ``load_photos`` would load, by name, sorted.

    Raises:
        IgsrError: there are none.
    """
    root, files, _ = _files([path]) if is_file(path) else _folder(path)
    return {file.relative_to(root).as_posix(): file.stat().st_size for file in files}


def _is_photo(path: Path) -> bool:
    return (
        path.suffix.lower() in SUFFIXES + VIDEO_SUFFIXES
        and not path.name.startswith(".")
        and is_file(path)
    )


def _walk(root: Path) -> Iterator[Path]:
    """The photos and videos under a folder, without hidden folders and the masks."""
    for place, folders, names in os.walk(root):
        kept = [name for name in folders if not name.startswith(".")]
        folders[:] = [name for name in kept if Path(place) != root or name != "masks"]
        yield from (file for name in names if _is_photo(file := Path(place, name)))


def _folder(path: Path) -> tuple[Path, list[Path], Path]:
    try:
        if not path.is_dir():
            raise IgsrError(f"{path} does not exist or is no folder; give a folder of photos")
        root = photo_root(path)
        files = sorted(_walk(root), key=lambda file: file.relative_to(root).as_posix())
    except (OSError, ValueError) as error:
        if isinstance(error, IgsrError):
            raise
        raise IgsrError(f"{path} cannot be read; give a folder of photos") from error
    if not files:
        raise IgsrError(f"{path} holds no photos; give a folder with JPEG, PNG, WebP or HEIC files")
    masks = root / "masks"
    if not masks.is_dir() and root.resolve().name == "images":
        masks = root.resolve().parent / "masks"
    return root, files, masks


def _files(files: list[Path]) -> tuple[Path, list[Path], Path]:
    if not files:
        raise IgsrError("photos is an empty list; give at least two photos")
    for file in files:
        if not is_file(file):
            raise IgsrError(f"{file} does not exist or is no file; give photos or one folder")
        if file.suffix.lower() not in SUFFIXES + VIDEO_SUFFIXES:
            raise IgsrError(f"{file} is no photo by its name; give JPEG, PNG, WebP or HEIC files")
    files = [file.absolute() for file in files]
    double = [file for index, file in enumerate(files) if file in files[:index]]
    if double:
        raise IgsrError(f"{double[0]} is given twice; give it once")
    root = Path(os.path.commonpath([file.parent for file in files]))
    return root, files, root / "masks"


def _refuse_large(files: list[Path]) -> None:
    """Refuse photos that do not fit into memory, before any is decoded."""
    try:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # not every system has these
        return
    needed = 0
    for file in files:
        if file.suffix.lower() in SUFFIXES:
            try:
                with open_image(file) as image:
                    needed += 3 * image.width * image.height
            except IgsrError:
                continue  # loading it names it
    # Photos are held as decoded and as undistorted, and a fit copies them.
    if 3 * needed > memory:
        raise IgsrError(
            f"The {len(files)} photos need {3 * needed / 2**30:.1f} GiB of memory and this machine "
            f"has {memory / 2**30:.1f}; give fewer or smaller ones."
        )


def _from_file(file: Path, name: str, masks: Path) -> Photo:
    with open_image(file) as image:
        exif = read_exif(image)
        load_pixels(image, file)
        pixels = upright(pixels_of(image, file), exif.orientation)
    mask = None
    mask_path = next(filter(is_file, mask_paths(masks, name)), None)
    if mask_path is not None:
        with open_image(mask_path) as image:
            load_pixels(image, mask_path)
            mask = mask_of(image, mask_path)
        if mask.shape != pixels.shape[:2]:
            raise IgsrError(
                f"{mask_path} is {mask.shape[1]}x{mask.shape[0]} pixels but its photo {name} is, "
                f"upright, {pixels.shape[1]}x{pixels.shape[0]}; resize the mask"
            )
    return Photo(name, pixels, mask, exif.focal, exif.device)


def mask_paths(masks: Path, name: str) -> list[Path]:
    """Paths of a photo's mask, of which the first that exists counts; see the module."""
    return [masks / f"{name}.png", masks / PurePosixPath(name).with_suffix(".png")]


def _from_video(file: Path, name: str, frames: int) -> list[Photo]:
    return [
        Photo(f"{name}/{index:06d}.png", pixels, device=f"video {name}")
        for index, pixels in sharpest_frames(file, frames)
    ]


def _left_out(
    files: list[Path], loaded: Sequence[list[Photo] | IgsrError], broken: list[IgsrError]
) -> str:
    if len(broken) == 1:
        return f"One of {len(files)} photos is left out: {broken[0]}"
    pairs = zip(files, loaded, strict=True)
    others = [file.name for file, found in pairs if isinstance(found, IgsrError)][1:]
    more = f" and {len(others) - _NAMED} more" if len(others) > _NAMED else ""
    return (
        f"{len(broken)} of {len(files)} photos are left out: {broken[0]}; so are "
        f"{', '.join(others[:_NAMED])}{more}"
    )
