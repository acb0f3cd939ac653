"""Photos without cameras: load folders, files and videos, upright.

Panoramas become a rig of pinhole views each, whose intrinsics and directions are known. So do
fisheye photos of more than 120 degrees, where a file ``lens.json`` in the folder describes the lens
with the fields that it would have in a ``transforms.json``.

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
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from igsr._internal.user_warning import warn_user
from igsr.capture.downscaling import area_means, check_max_size, reduced_size
from igsr.capture.exif import TURNED, Exif, read_exif, turned_back, upright
from igsr.capture.find_panoramas import panorama_of
from igsr.capture.memory_check import check_memory, decoding_threads
from igsr.capture.photos import (
    SUFFIXES,
    decoded,
    is_file,
    load_pixels,
    mask_of,
    open_image,
    photo_header,
)
from igsr.capture.read_transforms import read_lens
from igsr.capture.rig import LEAST_SHOWN, Rig, rig_of, sampled_views, shown_part, sides_at
from igsr.capture.types import Camera
from igsr.capture.video_frames import VIDEO_SUFFIXES, sharpest_frames, video_size
from igsr.capture.wide_photos import WideFisheye, WidePhoto
from igsr.errors import IgsrError

#: Most frames taken from each video.
FRAMES = 100
#: The fewest photos that cameras can be found from.
FEWEST = 2
#: File in a folder of photos that describes their lens; see the module.
LENS = "lens.json"
#: Names shown of a long list.
_NAMED = 3


@dataclass(frozen=True, eq=False)
class RigPlace:
    """Which view of which panorama, or wide fisheye photo, a photo is.

    Attributes:
        rig: that photo's name.
        camera: of the view at its full size, in the frame of that photo's camera.
    """

    rig: str
    camera: Camera


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
        taken: width and height in pixels of the upright photo before it was reduced to ``image``;
            None if it was not.
        exposure_value: how much light the photo took, as ``View.exposure_value``.
        place: of a view of a panorama; None for other photos.
        screenshot: whether EXIF says that it is one.
    """

    name: str
    image: np.ndarray
    mask: np.ndarray | None = None
    focal: float | None = None
    device: str | None = None
    taken: tuple[int, int] | None = None
    exposure_value: float | None = None
    place: RigPlace | None = None
    screenshot: bool = False

    @property
    def full_size(self) -> tuple[int, int]:
        """Width and height in pixels of the upright photo as it was taken."""
        return self.taken or (self.image.shape[1], self.image.shape[0])


def load_photos(
    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    frames: int = FRAMES,
    max_size: int | None = None,
) -> list[Photo]:
    """Load photos whose cameras are not known.

    Args:
        path: a folder, a video, or a list of photos and videos. Sub-folders are read too, and files
            that are not photos are ignored. If a folder has no photos itself but ``images/``, the
            photos in that are taken.
        frames: most frames taken from each video: as many as its path needs, evenly along it, and
            sharp (``igsr.capture.video_frames``).
        max_size: longest side, in pixels, of photos as loaded. Larger ones are reduced with an area
            filter as they are decoded; none is enlarged. None keeps all as they are.

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
    check_max_size(max_size)
    root, files, masks = _found(path)
    names = [file.relative_to(root).as_posix() for file in files]
    lens = _lens_beside(root)

    def load(file: Path, name: str) -> list[Photo] | IgsrError:
        try:
            if file.suffix.lower() in VIDEO_SUFFIXES:
                return _from_video(file, name, frames, max_size)
            return _from_file(file, name, masks, lens, max_size)
        except IgsrError as error:
            return error

    with warnings.catch_warnings():
        # Pillow warns of damaged EXIF and the like even where the pixels can be read.
        warnings.filterwarnings("ignore", module="PIL")
        headers = _headers(files, frames, lens)
        sizes, channels, decoded = headers.sizes, headers.channels, headers.decoded
        check_memory(sizes, max_size, channels=channels, masked=masks.is_dir(), decoded=decoded)
        threads = decoding_threads(sizes, max_size, channels=channels, decoded=decoded)
        with ThreadPoolExecutor(max_workers=threads) as pool:
            loaded = list(pool.map(load, files, names))
    photos = [photo for found in loaded if isinstance(found, list) for photo in found]
    broken = [found for found in loaded if isinstance(found, IgsrError)]
    if broken:
        if len(photos) < FEWEST:
            raise broken[0]
        warn_user(_left_out(files, loaded, broken))
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

    ``lens.json`` is among them, where there is one: cameras depend on it.

    Raises:
        IgsrError: there are none.
    """
    root, files, _ = _found(path)
    files = [*files, *filter(is_file, [root / LENS])]
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


def _found(
    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
) -> tuple[Path, list[Path], Path]:
    """The root of the names, the photos and videos, and the folder of masks."""
    if not isinstance(path, (str, os.PathLike)):
        return _files([Path(file) for file in path])
    given = Path(path)
    return _files([given]) if is_file(given) else _folder(given)


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


@dataclass(frozen=True)
class PhotoHeaders:
    """What is known of photos before any is decoded.

    Attributes:
        sizes: width and height in pixels of each as stored, and as often as frames may be taken of
            each video; of a panorama, those of its views.
        channels: the most channels of one.
        exact: whether there are just as many photos.
        views: how many of ``sizes`` are of each photo.
        decoded: width and height in pixels of the files.
        plain: the files that are one photo each.
    """

    sizes: list[tuple[int, int]]
    channels: int
    exact: bool
    views: list[int]
    decoded: list[tuple[int, int]]
    plain: list[Path]


def photo_headers(path: str | os.PathLike[str], frames: int = FRAMES) -> PhotoHeaders:
    """The sizes of the photos that ``load_photos`` would load.

    Pixels are looked at only of what may be a panorama.

    Args:
        path, frames: as ``load_photos``.

    Raises:
        IgsrError: there are none.
    """
    root, files, _ = _found(path)
    return _headers(files, frames, _lens_beside(root))


def _headers(files: list[Path], frames: int, lens: WideFisheye | None) -> PhotoHeaders:
    """See ``photo_headers``; files that loading will name as broken are passed over."""
    found = PhotoHeaders([], 3, True, [], [], [])
    channels, exact = 3, True
    for file in files:
        try:
            if file.suffix.lower() in VIDEO_SUFFIXES:
                size, count = video_size(file)
                number = min(frames, count) if count else frames
                sizes, views, exact = [size] * number, [1] * number, False
            else:
                header = photo_header(file)
                size, sizes, views = header.size, [header.size], [1]
                channels = max(channels, header.channels)
                wide = _wide(file, size, lens)
                if wide is not None:
                    cameras = [side.camera for side in rig_of(wide).sides]
                    sizes = [(camera.width, camera.height) for camera in cameras]
                    views = [len(sizes)]
                else:
                    found.plain.append(file)
        except IgsrError:
            continue
        found.sizes.extend(sizes)
        found.views.extend(views)
        found.decoded.append(size)
    return replace(found, channels=channels, exact=exact)


def _lens_beside(root: Path) -> WideFisheye | None:
    """The lens that a folder's ``lens.json`` describes; None where there is no such file."""
    path = root / LENS
    return read_lens(path) if is_file(path) else None


def _wide(file: Path, size: tuple[int, int], lens: WideFisheye | None) -> WidePhoto | None:
    """What a photo of more than one pinhole is; None for others."""
    if lens is not None and size[0] * lens.height == size[1] * lens.width:
        return lens.resized(*size)
    return panorama_of(file)


def _from_file(
    file: Path, name: str, masks: Path, lens: WideFisheye | None, max_size: int | None
) -> list[Photo]:
    mask_path = next(filter(is_file, mask_paths(masks, name)), None)
    with open_image(file) as image:
        full, exif = image.size, read_exif(image)
        mask = None
        if mask_path is not None:
            mask = _mask_as_stored(mask_path, name, full, exif.orientation)
        # What lies on its side is no panorama.
        wide = _wide(file, full, lens) if exif.orientation == 1 else None
        rig = None if wide is None else rig_of(wide)
        size = reduced_size(*full, max_size) if rig is None else sides_at(rig, max_size)[1]
        pixels, mask = decoded(image, file, size, mask)
    if rig is not None:
        return _views_of(name, rig, pixels, mask, max_size, exif)
    pixels = upright(pixels, exif.orientation)
    if mask is not None:
        mask = upright(mask, exif.orientation)
    focal, taken = exif.focal, None
    if size != full:
        taken = full[::-1] if exif.orientation in TURNED else full
        focal = None if focal is None else focal * max(size) / max(full)
    photo = Photo(name, pixels, mask, focal, exif.device, taken, exif.exposure_value)
    return [replace(photo, screenshot=exif.screenshot)]


def _views_of(
    name: str,
    rig: Rig,
    pixels: np.ndarray,
    mask: np.ndarray | None,
    max_size: int | None,
    exif: Exif,
) -> list[Photo]:
    """The views of a panorama."""
    photos = []
    mask = shown_part(rig, pixels, mask)
    sampled = sampled_views(rig, pixels, mask, max_size)
    for side, (camera, image, shown) in zip(rig.sides, sampled, strict=True):
        if shown is not None and shown.mean() < LEAST_SHOWN:
            continue  # all masked
        photos.append(
            Photo(
                side.named(name),
                image,
                shown,
                float(camera.K[0, 0]),
                exif.device,
                (side.camera.width, side.camera.height),
                exif.exposure_value,
                RigPlace(name, side.camera),
            )
        )
    return photos


def _mask_as_stored(path: Path, name: str, size: tuple[int, int], orientation: int) -> np.ndarray:
    """The mask of an upright photo, turned as the photo is stored.

    Raises:
        IgsrError: it cannot be read, or has another size than the upright photo.
    """
    with open_image(path) as image:
        load_pixels(image, path)
        mask = mask_of(image, path)
    width, height = size[::-1] if orientation in TURNED else size
    if mask.shape != (height, width):
        raise IgsrError(
            f"{path} is {mask.shape[1]}x{mask.shape[0]} pixels but its photo {name} is, "
            f"upright, {width}x{height}; resize the mask"
        )
    return turned_back(mask, orientation)


def mask_paths(masks: Path, name: str) -> list[Path]:
    """Paths of a photo's mask, of which the first that exists counts; see the module."""
    return [masks / f"{name}.png", masks / PurePosixPath(name).with_suffix(".png")]


def _from_video(file: Path, name: str, frames: int, max_size: int | None) -> list[Photo]:
    photos = []
    for index, pixels in sharpest_frames(file, frames):
        photo = Photo(f"{name}/{index:06d}.png", pixels, device=f"video {name}")
        photos.append(reduced_photo(photo, max_size))
    return photos


def reduced_photo(photo: Photo, max_size: int | None) -> Photo:
    """A photo whose longest side has at most ``max_size`` pixels; None keeps it as it is."""
    height, width = photo.image.shape[:2]
    size = reduced_size(width, height, max_size)
    if size == (width, height):
        return photo
    image, mask = area_means(photo.image, *size, photo.mask)
    focal = None if photo.focal is None else photo.focal * max(size) / max(width, height)
    return replace(photo, image=image, mask=mask, focal=focal, taken=photo.full_size)


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
