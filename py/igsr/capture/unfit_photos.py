"""Photos of a folder that are none of the scene: screenshots, and further ones of a burst.

Photos of something else are found where cameras are: they are not registered.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np
import numpy.typing as npt

from igsr.capture.downscaling import plane_area_means, reduced_size
from igsr.capture.photo_folder import Photo
from igsr.capture.sharpness import blur
from igsr.capture.video_frames import VIDEO_SUFFIXES

Float64 = npt.NDArray[np.float64]

#: Photos show one place from one place where their detail correlates so much: at so many pixels of
#: the longer side, small ones first. Silhouettes of an object alone may reach the first from two
#: sides; hands that move by a percent of the width leave the second.
_SAME = ((64, 0.98), (256, 0.9))
#: Pixels of the squares whose mean is taken away to leave detail.
_SQUARE = 8
#: A row of a screenshot has one color: this part of its pixels, within so many levels. Rows between
#: have more than that.
_FLAT, _LEVELS, _BUSY = 0.98, 2, 0.9
#: Changes from flat rows to others: a screenshot has lines of text and bars, a photo of an object
#: before a plain ground has the ground above and below.
_CHANGES = 6
_NAMED = re.compile(
    r"screen[ _-]?shot|bildschirmfoto|capture[ _]d.[ée]cran|captura[ _]de[ _]pantalla"
)


def split_unfit(photos: Sequence[Photo]) -> tuple[list[Photo], list[str]]:
    """The photos that cameras are to be found of, and why others are left out.

    Args:
        photos: upright, at any size.

    Returns:
        The photos in their order, and a sentence for each reason that others are left out for.
    """
    sentences = []
    shots = {photo.name for photo in photos if is_screenshot(photo)}
    named = {photo.name for photo in photos if _is_named_screenshot(photo)}
    # A few among photos are no photos, whatever they show; a whole folder may be views of a game.
    if len(named | shots) <= len(photos) // 2:
        shots |= named
    if shots:
        sentences.append(f"{_listed(shots)}: left out, a screenshot and no photo.")
    kept = [photo for photo in photos if photo.name not in shots]
    twice = _further_of_bursts(kept)
    for best, others in twice.items():
        sentences.append(f"{_listed(others)}: left out, the same view as {best}, which is sharper.")
    dropped = {name for others in twice.values() for name in others}
    return [photo for photo in kept if photo.name not in dropped], sentences


def is_screenshot(photo: Photo) -> bool:
    """Whether a photo has the bars and lines of text of a screen; see the module."""
    if photo.device is not None or photo.place is not None:
        return False
    gray = photo.image[..., :3].astype(np.int16)
    common = np.median(gray, axis=1, keepdims=True)
    flat = (np.abs(gray - common) <= _LEVELS).all(axis=2).mean(axis=1)
    states = np.where(flat >= _FLAT, 1, np.where(flat < _BUSY, -1, 0))
    states = states[states != 0]
    return bool((np.diff(states) == 2).sum() >= _CHANGES)


def _is_named_screenshot(photo: Photo) -> bool:
    name = PurePosixPath(photo.name).name.lower()
    return photo.screenshot or (photo.device is None and _NAMED.search(name) is not None)


def _further_of_bursts(photos: Sequence[Photo]) -> dict[str, list[str]]:
    """Photos that show the same from the same place, by the name of the sharpest of each."""
    details = [
        [None if _has_own_path(photo) else _detail(photo, size) for size, _ in _SAME]
        for photo in photos
    ]
    group = list(range(len(photos)))
    for i in range(len(photos)):
        for j in range(i):
            if photos[i].device == photos[j].device and _are_same(details[i], details[j]):
                group[i] = group[j]
                break
    found: dict[str, list[str]] = {}
    for first in sorted(set(group)):
        members = [photos[k] for k in range(len(photos)) if group[k] == first]
        if len(members) > 1:
            best = min(members, key=lambda photo: blur(photo.image, photo.mask))
            found[best.name] = [photo.name for photo in members if photo is not best]
    return found


def _are_same(one: list[Float64 | None], other: list[Float64 | None]) -> bool:
    for a, b, (_, least) in zip(one, other, _SAME, strict=True):
        if a is None or b is None or a.shape != b.shape or float((a * b).sum()) < least:
            return False
    return True


def _has_own_path(photo: Photo) -> bool:
    """Whether a photo is of a video, whose frames are chosen by motion, or of a panorama."""
    parent = PurePosixPath(photo.name).parent
    return photo.place is not None or parent.suffix.lower() in VIDEO_SUFFIXES


def _detail(photo: Photo, longest: int) -> Float64 | None:
    """The reduced photo without what varies slowly, of length 1; None where nothing is left."""
    height, width = photo.image.shape[:2]
    size = reduced_size(width, height, longest)
    gray = plane_area_means(photo.image[..., :3].mean(axis=2), *size)
    down, right = (-(-length // _SQUARE) for length in gray.shape)
    padded = np.pad(
        gray, ((0, down * _SQUARE - len(gray)), (0, right * _SQUARE - gray.shape[1])), mode="edge"
    )
    means = padded.reshape(down, _SQUARE, right, _SQUARE).mean(axis=(1, 3))
    detail = padded - np.repeat(np.repeat(means, _SQUARE, axis=0), _SQUARE, axis=1)
    detail = detail[: len(gray), : gray.shape[1]]
    length = float(np.linalg.norm(detail))
    # Less than a level of detail is noise, and no evidence.
    return detail / length if length > np.sqrt(detail.size) else None


def _listed(names: set[str] | list[str]) -> str:
    ordered = sorted(names)
    more = f" and {len(ordered) - 3} more" if len(ordered) > 3 else ""
    return ", ".join(ordered[:3]) + more
