"""Check dropped photos and videos before a run."""

from __future__ import annotations

import os
import shutil
import tempfile
import threading
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from igsr._internal.name_lists import listed
from igsr.capture.image_files import SUFFIXES, photo_header
from igsr.capture.photo_checks import split_unfit
from igsr.capture.photo_files import MIN_PHOTOS
from igsr.capture.photo_folder import Photo, read_photos
from igsr.capture.sharpness import blurred_photos
from igsr.capture.video_frames import VIDEO_SUFFIXES, video_size
from igsr.capture.write_files import unique_stems
from igsr.errors import IgsrError

#: Limits of one run.
MAX_FILES = 300
MAX_BYTES = 2 << 30
MAX_PIXELS = 100_000_000
#: Longest side of thumbnails, pixels; the checks use them, too.
THUMBNAIL_PX = 320
#: A photo is dark if its 90th percentile is below this level of 255.
_DARK_LEVEL = 50
#: Fewer photos get the advice below.
_FEW = 5
HOW_TO = "Walk around the subject and take a photo every 10 to 15 degrees, all of them sharp."

_reading = threading.Lock()


@dataclass(frozen=True)
class Intake:
    """The dropped files that a run would use.

    Attributes:
        taken: photos and videos by their names in the run, which are unique.
        thumbnails: of the photos, by name.
        left_out: a sentence for each reason to leave files out.
        advice: sentences about photos that are taken.
    """

    taken: dict[str, Path] = field(default_factory=dict)
    thumbnails: list[tuple[np.ndarray, str]] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    advice: list[str] = field(default_factory=list)

    @property
    def videos(self) -> int:
        """The number of videos."""
        return sum(map(_is_video, self.taken.values()))

    @property
    def can_run(self) -> bool:
        """Whether there are enough photos."""
        return len(self.thumbnails) >= MIN_PHOTOS or self.videos > 0


def check_files(files: Sequence[Path]) -> Intake:
    """Check dropped files, which are untrusted.

    Raises:
        IgsrError: there are too many files, or they are too large.
    """
    if len(files) > MAX_FILES:
        raise IgsrError(f"These are {len(files)} files; choose at most {MAX_FILES}.")
    total = sum(file.stat().st_size for file in files)
    if total > MAX_BYTES:
        raise IgsrError(
            f"The files have {total / 1e9:.1f} GB in all; choose at most {MAX_BYTES / 1e9:.1f} GB."
        )
    intake, others = Intake(), list[str]()
    suffixes = {file.suffix for file in files} or {""}
    stems = unique_stems([file.name for file in files], *suffixes)
    with tempfile.TemporaryDirectory(prefix="igsr-app-") as folder:
        for file, stem in zip(files, stems, strict=True):
            name = stem + file.suffix
            if file.suffix.lower() not in SUFFIXES + VIDEO_SUFFIXES:
                others.append(name)
                continue
            try:
                _check_size(file)
            except IgsrError as error:
                intake.left_out.append(str(error).replace(str(file), name))
            else:
                intake.taken[name] = file
                if not _is_video(file):
                    (Path(folder) / name).parent.mkdir(exist_ok=True)
                    shutil.copyfile(file, Path(folder) / name)
        photos = _read(Path(folder), intake)
    if others:
        intake.left_out.append(f"{listed(others)}: not a photo or video that igsr can read.")
    intake.thumbnails.extend((photo.image, photo.name) for photo in photos)
    kept, unfit = split_unfit(photos)
    intake.left_out.extend(unfit)
    intake.advice.extend(_advice(kept))
    if not intake.can_run:
        have = "Only one photo can be used" if intake.taken else "No photo can be used"
        intake.advice.insert(0, f"{have}; a scene needs at least two that overlap. {HOW_TO}")
    elif len(kept) < _FEW and not intake.videos:
        intake.advice.append(f"{len(kept)} photos are few. {HOW_TO}")
    return intake


def _read(folder: Path, intake: Intake) -> list[Photo]:
    """Read the photos in a folder as thumbnails; the run will leave out damaged ones, too."""
    # One at a time: warnings are caught for the whole process, and decoding takes memory.
    with _reading, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            photos = read_photos(folder, max_size=THUMBNAIL_PX)
        except IgsrError as error:
            photos = []
            if len(list(folder.iterdir())) >= MIN_PHOTOS:
                intake.left_out.append(str(error).replace(f"{folder}{os.sep}", ""))
    for warning in caught:
        if issubclass(warning.category, UserWarning):
            intake.left_out.append(str(warning.message).replace(f"{folder}{os.sep}", ""))
    return photos


def _is_video(file: Path) -> bool:
    return file.suffix.lower() in VIDEO_SUFFIXES


def _check_size(file: Path) -> None:
    width, height = video_size(file)[0] if _is_video(file) else photo_header(file).size
    if width * height > MAX_PIXELS:
        raise IgsrError(
            f"{file.name} has {width}x{height} pixels; make it smaller than "
            f"{MAX_PIXELS // 1_000_000} megapixels."
        )


def _advice(photos: Sequence[Photo]) -> list[str]:
    advice = []
    blurred = blurred_photos((photo.name, photo.image, photo.mask) for photo in photos)
    if blurred:
        advice.append(f"{listed(sorted(blurred))}: blurred; take sharp ones instead.")
    levels = {photo.name: np.percentile(photo.image[..., :3], 90) for photo in photos}
    dark = [name for name, level in levels.items() if level < _DARK_LEVEL]
    if dark:
        advice.append(f"{listed(sorted(dark))}: dark; add light, or expose longer.")
    return advice
