"""Load photos without cameras: folders, files and videos, upright.

Panoramas become a rig of pinhole views each, whose intrinsics and directions are known. So do
fisheye photos of more than 120 degrees, if a file ``lens.json`` in the folder describes the lens
with the fields that it would have in a ``transforms.json``.

These photos are turned by their EXIF orientation. Those of a capture are not: its cameras refer to
the pixels as stored.

The masks of photos (see ``igsr.capture.mask_files``) have the size of the upright photo.
"""

from __future__ import annotations

import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from igsr._internal.name_lists import listed
from igsr._internal.user_warning import warn_user
from igsr.capture.downscaling import area_means, check_max_size, reduced_size
from igsr.capture.exif import TURNED, Exif, read_exif, turned_back, upright
from igsr.capture.image_files import decoded, is_file, mask_of, open_image, photo_header
from igsr.capture.mask_files import MaskFiles
from igsr.capture.memory_check import PhotoSizes
from igsr.capture.photo_files import MIN_PHOTOS, Paths, find_photo_files
from igsr.capture.read_transforms import read_lens
from igsr.capture.rig import Rig, decoded_size, rig_of, sampled_views
from igsr.capture.types import Camera
from igsr.capture.video_frames import VIDEO_SUFFIXES, sharpest_frames, video_size
from igsr.capture.wide_photos import WideFisheye, WidePhoto, panorama_of
from igsr.errors import IgsrError

#: Default maximum number of frames taken from each video.
FRAMES = 100
#: File in a folder of photos that describes their lens; see the module.
LENS = "lens.json"


@dataclass(frozen=True, eq=False)
class RigPlace:
    """A view's place in a panorama or wide fisheye photo.

    Attributes:
        rig: that photo's name.
        camera: of the view at its full size, in the frame of that photo's camera.
    """

    rig: str
    camera: Camera


@dataclass(frozen=True, eq=False)
class Photo:
    """A photo without a camera.

    Attributes:
        name: posix path relative to the folder, unique among the photos.
        image: uint8 [H, W, 3] RGB, or [H, W, 4] with straight alpha; upright.
        mask: bool [H, W], True for pixels that may be used, or None if all may.
        focal: focal length in pixels of ``image``, from EXIF, or None if it is unknown.
        device: make, model and lens of the camera, or the video's name, or None if it is unknown.
            Photos of one device, size and focal length share their intrinsics.
        taken: width and height in pixels of the upright photo before it was reduced to ``image``;
            None if it was not.
        exposure_value: as ``View.exposure_value``.
        place: of a view of a panorama; None for other photos.
        screenshot: whether EXIF marks a screenshot.
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
        """Width and height in pixels of the upright photo before it was reduced."""
        return self.taken or (self.image.shape[1], self.image.shape[0])


def read_photos(path: Paths, frames: int = FRAMES, max_size: int | None = None) -> list[Photo]:
    """Load photos without cameras.

    Args:
        path: a folder, a video, or a list of photos and videos. Subfolders are read too, and files
            that are not photos are ignored (see ``igsr.capture.photo_files``). If most photos are
            in ``images/``, only those are loaded.
        frames: maximum number of frames taken from each video; fewer if the camera moves little
            (see ``igsr.capture.video_frames``).
        max_size: longest side, in pixels, of photos as loaded. Larger ones are reduced with an area
            filter as they are decoded; none is enlarged. None keeps all as they are.

    Returns:
        The photos, sorted by name if from a folder, else in the order given. A photo that cannot be
        read is left out; a warning names it.

    Raises:
        IgsrError: there are no photos, fewer than two can be read, a file is given twice, they need
            more memory than is available, or ``frames`` is not a whole number of at least 1.
    """
    if isinstance(frames, bool) or not isinstance(frames, int) or frames < 1:
        raise IgsrError(
            f"frames is {frames!r}; give a whole number of at least 1, such as {FRAMES}"
        )
    check_max_size(max_size)
    found = find_photo_files(path)
    root, files = found.root, found.files
    lens = _read_lens(root)

    def load(file: Path) -> list[Photo] | IgsrError:
        name = file.relative_to(root).as_posix()
        try:
            if file.suffix.lower() in VIDEO_SUFFIXES:
                return _photos_of_video(file, name, frames, max_size)
            return _photos_of_file(file, name, found.masks, lens, max_size)
        except IgsrError as error:
            return error

    with warnings.catch_warnings():
        # Pillow warns of damaged EXIF and the like even if the pixels can be read.
        warnings.filterwarnings("ignore", module="PIL")
        sizes = replace(_sizes_of(files, frames, lens), masked=found.mask_count() > 0)
        sizes.check_memory(max_size)
        with ThreadPoolExecutor(max_workers=sizes.decoding_threads(max_size)) as pool:
            results = list(pool.map(load, files))
    photos = [photo for result in results if isinstance(result, list) for photo in result]
    found.masks.warn_unless_used()
    errors = [result for result in results if isinstance(result, IgsrError)]
    if errors:
        if len(photos) < MIN_PHOTOS:
            raise errors[0]
        broken = [f.name for f, r in zip(files, results, strict=True) if isinstance(r, IgsrError)]
        message = f"One of {len(files)} photos is left out: {errors[0]}"
        if len(errors) > 1:
            message = (
                f"{len(errors)} of {len(files)} photos are left out: {errors[0]}; so are "
                f"{listed(broken[1:])}"
            )
        warn_user(message)
    return photos


def file_sizes(path: Path) -> dict[str, int]:
    """Return the size in bytes of each photo and video that ``read_photos`` would load, by name.

    A ``lens.json`` counts too, since cameras depend on it.
    """
    found = find_photo_files(path)
    files = [*found.files, *filter(is_file, [found.root / LENS])]
    return {file.relative_to(found.root).as_posix(): file.stat().st_size for file in files}


def pixel_sizes(path: Paths, frames: int = FRAMES) -> PhotoSizes:
    """Return the sizes of the photos that ``read_photos`` would load.

    Pixels are decoded only of photos that may be panoramas. The photos count as masked, since it is
    unknown whether their lenses distort.
    """
    found = find_photo_files(path)
    return replace(_sizes_of(found.files, frames, _read_lens(found.root)), masked=True)


def _sizes_of(files: list[Path], frames: int, lens: WideFisheye | None) -> PhotoSizes:
    """Sizes of photos; files are skipped if loading will report them as broken."""
    found, channels = PhotoSizes(sizes=[]), 3
    for file in files:
        try:
            if file.suffix.lower() in VIDEO_SUFFIXES:
                size, count = video_size(file)
                number = min(frames, count) if count else frames
                sizes, views = [size] * number, [1] * number
            else:
                header = photo_header(file)
                size, sizes, views = header.size, [header.size], [1]
                channels = max(channels, header.channels)
                wide = _wide_photo(file, size, lens)
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
    return replace(found, channels=channels)


def _read_lens(root: Path) -> WideFisheye | None:
    path = root / LENS
    return read_lens(path) if is_file(path) else None


def _wide_photo(file: Path, size: tuple[int, int], lens: WideFisheye | None) -> WidePhoto | None:
    """The panorama or wide fisheye photo in a file; None for other photos."""
    if lens is not None and size[0] * lens.height == size[1] * lens.width:
        return lens.resized(*size)
    return panorama_of(file)


def _photos_of_file(
    file: Path, name: str, masks: MaskFiles, lens: WideFisheye | None, max_size: int | None
) -> list[Photo]:
    """A photo, or the views of a wide one."""
    mask_path = masks.of(file)
    with open_image(file) as image:
        full, exif = image.size, read_exif(image)
        mask = None
        if mask_path is not None:
            mask = _mask_as_stored(mask_path, name, full, exif.orientation)
        # A turned photo is no panorama.
        wide = _wide_photo(file, full, lens) if exif.orientation == 1 else None
        rig = None if wide is None else rig_of(wide)
        size = reduced_size(*full, max_size) if rig is None else decoded_size(rig, full, max_size)
        pixels, mask = decoded(image, file, size, mask)
    if rig is not None:
        return _views_of(name, rig, pixels, mask, max_size, exif)
    photo = Photo(
        name,
        upright(pixels, exif.orientation),
        None if mask is None else upright(mask, exif.orientation),
        exif.focal,
        exif.device,
        exposure_value=exif.exposure_value,
        screenshot=exif.screenshot,
    )
    if size != full:
        taken = full[::-1] if exif.orientation in TURNED else full
        photo = replace(photo, focal=_reduced_focal(photo.focal, full, size), taken=taken)
    return [photo]


def _reduced_focal(
    focal: float | None, size: tuple[int, int], reduced: tuple[int, int]
) -> float | None:
    return None if focal is None else focal * max(reduced) / max(size)


def _views_of(
    name: str,
    rig: Rig,
    pixels: np.ndarray,
    mask: np.ndarray | None,
    max_size: int | None,
    exif: Exif,
) -> list[Photo]:
    """The views of a wide photo, without those that its mask hides."""
    photos = []
    for index, (camera, image, shown) in sampled_views(rig, pixels, mask, max_size).items():
        side = rig.sides[index]
        photo = Photo(
            side.named(name),
            image,
            shown,
            float(camera.K[0, 0]),
            exif.device,
            (side.camera.width, side.camera.height),
            exif.exposure_value,
            RigPlace(name, side.camera),
        )
        photos.append(photo)
    return photos


def _mask_as_stored(path: Path, name: str, size: tuple[int, int], orientation: int) -> np.ndarray:
    """The mask of an upright photo, turned as the photo is stored."""
    width, height = size[::-1] if orientation in TURNED else size
    with open_image(path) as image:
        if image.size != (width, height):
            raise IgsrError(
                f"{path} is {image.width}x{image.height} pixels but its photo {name} is, "
                f"upright, {width}x{height}; resize the mask"
            )
        return turned_back(mask_of(image, path), orientation)


def _photos_of_video(file: Path, name: str, frames: int, max_size: int | None) -> list[Photo]:
    return [
        reduced_photo(Photo(f"{name}/{index:06d}.png", pixels, device=f"video {name}"), max_size)
        for index, pixels in sharpest_frames(file, frames)
    ]


def reduced_photo(photo: Photo, max_size: int | None) -> Photo:
    """Return a photo with at most ``max_size`` pixels on its longest side; None keeps its size."""
    full = photo.image.shape[1], photo.image.shape[0]
    size = reduced_size(*full, max_size)
    if size == full:
        return photo
    image, mask = area_means(photo.image, *size, photo.mask)
    focal = _reduced_focal(photo.focal, full, size)
    return replace(photo, image=image, mask=mask, focal=focal, taken=photo.full_size)
