"""Warn before a fit about anything that its photos cannot determine."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import numpy as np

from igsr.capture.photo_folder import listed
from igsr.capture.sharpness import blurred_photos
from igsr.capture.types import View
from igsr.errors import IgsrError

#: Cameras at one place are closer than this part of the largest distance between cameras.
_ONE_PLACE = 1e-6
#: Cameras whose distances to all others are held at a time.
_DISTANCE_ROWS = 256
#: Rays per side of a photo that are tested for being seen by other photos.
_RAYS_PER_SIDE = 7
#: Tested depths, in units of the largest distance between cameras.
_DEPTHS = np.geomspace(0.05, 1000.0, 24)


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
        _warn(f"{listed(empty)}: black or fully transparent; leave such photos out.")
    photos = ((view.photo, view.image, view.mask) for view in views if view.weights is None)
    blurred = sorted(blurred_photos(photos))
    if blurred:
        _warn(f"{listed(blurred)}: blurred; leave out photos that others show sharp.")
    if len(views) == 1:
        _warn(
            "There is one photo only, which does not determine distances: the scene is right from "
            "that camera alone."
        )
        return
    centers = np.stack([view.camera.center for view in views])
    farthest = float(np.max([rows.max() for _, rows in _distances(centers)]))
    if not np.isfinite(farthest):
        return  # reported when the splats are placed
    if farthest == 0.0:
        _warn(
            "All cameras are at one place, which does not determine distances: the scene is right "
            "from there alone."
        )
        return
    pair = _same_cameras(views, centers, _ONE_PLACE * farthest)
    if pair:
        _warn(f"{listed(pair)} have the same camera; the second photo adds nothing.")
    if not _any_two_share(views, farthest):
        _warn(
            "No two photos see anything in common, which leaves distances open; check the poses, "
            "or add photos between these."
        )


def _warn(sentence: str) -> None:
    # To the caller of ``fit``.
    warnings.warn(sentence, stacklevel=5)


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
