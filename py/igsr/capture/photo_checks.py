"""Check photos: leave out those that do not show the scene, and warn about open questions.

Screenshots and repetitions in bursts are left out before cameras are found. Photos of something
else are excluded when cameras are found: they are not registered.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import PurePosixPath

import numpy as np
import numpy.typing as npt

from igsr._internal.name_lists import listed
from igsr._internal.user_warning import warn_user
from igsr.capture.downscaling import plane_area_means, reduced_size
from igsr.capture.photo_folder import Photo
from igsr.capture.sharpness import blur, blurred_photos
from igsr.capture.types import PseudoView, View
from igsr.capture.video_frames import VIDEO_SUFFIXES
from igsr.errors import IgsrError

Float64 = npt.NDArray[np.float64]

#: Pixels of the longer side, and minimum correlation of detail at that size, of two photos of one
#: view. Silhouettes of an object can pass the first test from two sides; hands that move by a
#: percent of the width fail the second.
_SAME_VIEW = ((64, 0.98), (256, 0.9))
#: Side of the squares whose mean is subtracted to leave detail.
_SQUARE_PX = 8
#: A row has one color if this part of its pixels is within ``_FLAT_LEVELS`` of its median ...
_MIN_FLAT_PART = 0.98
_FLAT_LEVELS = 2
#: ... and detail if less than this part is.
_MAX_BUSY_PART = 0.9
#: Minimum changes from detailed to flat rows in a screenshot, by bars and lines of text. A photo of
#: an object on a plain ground has the ground above and below.
_MIN_CHANGES = 6
_SCREENSHOT_NAME = re.compile(
    r"screen[ _-]?shot|bildschirmfoto|capture[ _]d.[ée]cran|captura[ _]de[ _]pantalla"
)
#: Cameras at one place are closer than this part of the largest distance between cameras.
_ONE_PLACE = 1e-6
#: Cameras whose distances to all others are held at a time.
_DISTANCE_ROWS = 256
#: Rays per side of a photo that are tested for being seen by other photos.
_RAYS_PER_SIDE = 7
#: Tested depths, in units of the largest distance between cameras.
_DEPTHS = np.geomspace(0.05, 1000.0, 24)


def split_unfit(photos: Sequence[Photo]) -> tuple[list[Photo], list[str]]:
    """Remove screenshots, and all but the sharpest photo of each burst.

    Returns:
        The other photos in their order, and a sentence for each reason to leave photos out.
    """
    sentences = []
    screenshots = {photo.name for photo in photos if is_screenshot(photo)}
    by_name = {photo.name for photo in photos if _is_named_screenshot(photo)}
    # Names count if they are few: a whole folder may be views of a game.
    if len(by_name | screenshots) <= len(photos) // 2:
        screenshots |= by_name
    if screenshots:
        names = listed(sorted(screenshots))
        sentences.append(f"{names}: left out, a screenshot and no photo.")
    kept = [photo for photo in photos if photo.name not in screenshots]
    for best, repetitions in _bursts(kept).items():
        names = listed(sorted(repetitions))
        sentences.append(f"{names}: left out, the same view as {best}, which is sharper.")
        kept = [photo for photo in kept if photo.name not in repetitions]
    return kept, sentences


def is_screenshot(photo: Photo) -> bool:
    """Return whether a photo has the bars and lines of text of a screen."""
    if photo.device is not None or photo.place is not None:
        return False
    levels = photo.image[..., :3].astype(np.int16)
    median = np.median(levels, axis=1, keepdims=True)
    flat = (np.abs(levels - median) <= _FLAT_LEVELS).all(axis=2).mean(axis=1)
    states = np.where(flat >= _MIN_FLAT_PART, 1, np.where(flat < _MAX_BUSY_PART, -1, 0))
    states = states[states != 0]
    return bool((np.diff(states) == 2).sum() >= _MIN_CHANGES)


def _is_named_screenshot(photo: Photo) -> bool:
    name = PurePosixPath(photo.name).name.lower()
    return photo.screenshot or (photo.device is None and _SCREENSHOT_NAME.search(name) is not None)


def _bursts(photos: Sequence[Photo]) -> dict[str, list[str]]:
    """Repetitions of the same view, by the name of the sharpest photo of it."""
    details = [
        [None if _is_one_of_a_series(photo) else _detail(photo, size) for size, _ in _SAME_VIEW]
        for photo in photos
    ]
    group = list(range(len(photos)))
    for i in range(len(photos)):
        for j in range(i):
            if photos[i].device == photos[j].device and _show_same(details[i], details[j]):
                group[i] = group[j]
                break
    bursts: dict[str, list[str]] = {}
    for first in sorted(set(group)):
        members = [photos[k] for k in range(len(photos)) if group[k] == first]
        if len(members) > 1:
            best = min(members, key=lambda photo: blur(photo.image, photo.mask))
            bursts[best.name] = [photo.name for photo in members if photo is not best]
    return bursts


def _show_same(one: list[Float64 | None], other: list[Float64 | None]) -> bool:
    for a, b, (_, min_correlation) in zip(one, other, _SAME_VIEW, strict=True):
        if a is None or b is None or a.shape != b.shape or (a * b).sum() < min_correlation:
            return False
    return True


def _is_one_of_a_series(photo: Photo) -> bool:
    """Whether a photo is a frame of a video, which are chosen by motion, or a panorama's view."""
    parent = PurePosixPath(photo.name).parent
    return photo.place is not None or parent.suffix.lower() in VIDEO_SUFFIXES


def _detail(photo: Photo, longest: int) -> Float64 | None:
    """The reduced photo without slow variations, of length 1; None without detail."""
    height, width = photo.image.shape[:2]
    gray = plane_area_means(
        photo.image[..., :3].mean(axis=2), *reduced_size(width, height, longest)
    )
    down, right = (-(-length // _SQUARE_PX) for length in gray.shape)
    rest = (0, down * _SQUARE_PX - gray.shape[0]), (0, right * _SQUARE_PX - gray.shape[1])
    padded = np.pad(gray, rest, mode="edge")
    squares = padded.reshape(down, _SQUARE_PX, right, _SQUARE_PX)
    detail = (squares - squares.mean(axis=(1, 3), keepdims=True)).reshape(padded.shape)
    detail = detail[: gray.shape[0], : gray.shape[1]]
    length = float(np.linalg.norm(detail))
    # Less than one level of detail is noise.
    return detail / length if length > np.sqrt(detail.size) else None


def check_photos(views: list[View]) -> None:
    """Warn about photos that do not determine the scene; refuse photos that no fit can use.

    Args:
        views: the photos to fit; at least one.

    Raises:
        IgsrError: every photo is black or fully transparent, or a mask leaves no pixel of a photo.
        UserWarning: a single photo, cameras at one place, a camera given twice, no two photos that
            see anything in common, a photo that is black, fully transparent or blurred.
    """
    for view in views:
        if view.mask is not None and not view.mask.any():
            raise IgsrError(f"{view.name}: its mask leaves no pixel to fit; leave the photo out.")
    empty = [view.name for view in views if _is_empty(view)]
    if len(empty) == len(views):
        raise IgsrError("Every photo is black or fully transparent; there is nothing to fit.")
    if empty:
        warn_user(f"{listed(empty)}: black or fully transparent; leave these photos out.")
    shots = [view for view in views if not isinstance(view, PseudoView)]
    photos = ((view.photo, view.image, view.mask) for view in shots)
    blurred = sorted(blurred_photos(photos))
    if blurred:
        warn_user(f"{listed(blurred)}: blurred; leave out photos that others show sharp.")
    if len(views) == 1:
        warn_user(
            "There is one photo only, which does not determine distances: the scene is right from "
            "that camera alone."
        )
        return
    centers = np.stack([view.camera.center for view in views])
    farthest = float(np.max([rows.max() for _, rows in _distances(centers)]))
    if not np.isfinite(farthest):
        return  # reported when the splats are placed
    if farthest == 0.0:
        warn_user(
            "All cameras are at one place, which does not determine distances: the scene is right "
            "from there alone."
        )
        return
    pair = _same_cameras(views, centers, _ONE_PLACE * farthest)
    if pair:
        warn_user(f"{listed(pair)} have the same camera; the second photo adds nothing.")
    if not _any_two_share(views, farthest):
        warn_user(
            "No two photos see anything in common, which leaves distances open; check the poses, "
            "or add photos between these."
        )


def _is_empty(view: View) -> bool:
    pixels = view.image if view.mask is None else view.image[view.mask]
    if pixels.shape[-1] == 4 and not (pixels[..., 3] == 255).all():
        # The outline of a black object is enough to fit it.
        return not pixels[..., 3].any()
    return not pixels[..., :3].any()


def _distances(centers: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Distances between places [N, 3], some rows [n, N] at a time, with the first row's number."""
    for first in range(0, len(centers), _DISTANCE_ROWS):
        with np.errstate(over="ignore", invalid="ignore"):
            offsets = centers[first : first + _DISTANCE_ROWS, None] - centers[None]
            yield first, np.linalg.norm(offsets, axis=2)


def _same_cameras(views: list[View], centers: np.ndarray, tolerance: float) -> list[str]:
    """Names of the first two views with the same place, direction and intrinsics."""
    for first, rows in _distances(centers):
        for i, j in np.argwhere(np.triu(rows <= tolerance, 1 + first)):
            a, b = views[first + i].camera, views[j].camera
            turned = np.abs(a.viewmat[:3, :3] - b.viewmat[:3, :3]).max()
            if turned < 1e-6 and np.allclose(a.K, b.K):
                return [views[first + i].name, views[j].name]
    return []


def _any_two_share(views: list[View], unit: float) -> bool:
    """Whether any of many points in front of one camera falls into another's picture."""
    for view in views:
        camera = view.camera
        x, y = np.meshgrid(
            np.linspace(0.0, camera.width, _RAYS_PER_SIDE),
            np.linspace(0.0, camera.height, _RAYS_PER_SIDE),
        )
        pixels = np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
        rays = np.linalg.solve(camera.K, pixels).T
        local = (rays[:, None, :] * (unit * _DEPTHS)[None, :, None]).reshape(-1, 3)
        world = (local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
        for other in views:
            if other is view:
                continue
            points = world @ other.camera.viewmat[:3, :3].T + other.camera.viewmat[:3, 3]
            projected = points[points[:, 2] > 0.0] @ other.camera.K.T
            xy = projected[:, :2] / projected[:, 2:]
            inside = (xy >= 0.0) & (xy <= (other.camera.width, other.camera.height))
            if inside.all(axis=1).any():
                return True
    return False
