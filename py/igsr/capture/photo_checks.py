"""Checks of photos before a fit: warnings of what they cannot determine."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from igsr._internal.user_warning import warn_user
from igsr.capture.sharpness import blurred_photos
from igsr.capture.types import PseudoView, View
from igsr.errors import IgsrError

#: Cameras nearer to each other than this part of the largest distance are at the same place.
SAME_PLACE = 1e-6
#: Photos whose distances to all others are held at a time.
ROWS = 256
#: Rays of a photo, per side, and depths tried along them in units of the distance between cameras.
RAYS, DEPTHS = 7, np.geomspace(0.05, 1000.0, 24)


def check_photos(views: list[View]) -> None:
    """Warn of what the photos cannot determine; refuse photos that no scene can be fitted to.

    Args:
        views: the photos to fit; at least one.

    Raises:
        IgsrError: every photo is black or fully transparent, or a mask leaves no pixel of a photo.
        UserWarning: a single photo, cameras at one place, a camera given twice, photos of which no
            two see anything in common, a photo that is black, fully transparent or blurred.
    """
    for view in views:
        if view.mask is not None and not view.mask.any():
            raise IgsrError(f"{view.name}: its mask leaves no pixel to fit; leave the photo out.")
    empty = [view.name for view in views if _is_empty(view)]
    if len(empty) == len(views):
        raise IgsrError("Every photo is black or wholly transparent; there is nothing to fit.")
    if empty:
        _warn(f"{_listed(empty)}: black or wholly transparent; leave out what shows nothing.")
    shots = [view for view in views if not isinstance(view, PseudoView)]
    photos = ((view.photo, view.image, view.mask) for view in shots)
    blurred = sorted(blurred_photos(photos))
    if blurred:
        _warn(f"{_listed(blurred)}: blurred; leave out what another photo shows sharp.")
    if len(views) == 1:
        _warn(
            "There is one photo only: nothing tells how far away things are, so the scene is "
            "right from that camera alone."
        )
        return
    centres = np.stack([view.camera.centre for view in views])
    farthest = float(np.max([rows.max() for _, rows in _distances(centres)]))
    if not np.isfinite(farthest):
        return  # what such cameras do to a fit is said where its splats are placed
    if farthest == 0.0:
        _warn(
            "All cameras stand at one place: nothing tells how far away things are, so the scene "
            "is right from there alone."
        )
        return
    twice = _given_twice(views, centres, SAME_PLACE * farthest)
    if twice:
        _warn(f"{_listed(twice)} have one and the same camera: a view seen twice tells no more.")
    if not _any_two_share(views, farthest):
        _warn(
            "No two photos see anything in common, so nothing tells how far away things are; "
            "check the poses, or add photos between these."
        )


def _warn(sentence: str) -> None:
    warn_user(sentence)


def _listed(names: list[str]) -> str:
    shown = ", ".join(names[:3])
    return shown if len(names) <= 3 else f"{shown} and {len(names) - 3} more"


def _is_empty(view: View) -> bool:
    pixels = view.image if view.mask is None else view.image[view.mask]
    if pixels.shape[-1] == 4 and not (pixels[..., 3] == 255).all():
        # A black thing has an outline, which tells where it is.
        return not pixels[..., 3].any()
    return not pixels[..., :3].any()


def _distances(centres: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Distances between places [N, 3], some rows [n, N] at a time, with the first row's number."""
    for first in range(0, len(centres), ROWS):
        with np.errstate(over="ignore", invalid="ignore"):
            apart = centres[first : first + ROWS, None] - centres[None]
            yield first, np.linalg.norm(apart, axis=2)


def _given_twice(views: list[View], centres: np.ndarray, apart: float) -> list[str]:
    """Names of the first two views with the same place, direction and intrinsics."""
    for first, rows in _distances(centres):
        for i, j in np.argwhere(np.triu(rows <= apart, 1 + first)):
            a, b = views[first + i].camera, views[j].camera
            turned = np.abs(a.viewmat[:3, :3] - b.viewmat[:3, :3]).max()
            if turned < 1e-6 and np.allclose(a.K, b.K):
                return [views[first + i].name, views[j].name]
    return []


def _any_two_share(views: list[View], unit: float) -> bool:
    """Whether a point before one camera falls into another's picture, by trying many."""
    for view in views:
        camera = view.camera
        x, y = np.meshgrid(
            np.linspace(0.0, camera.width, RAYS), np.linspace(0.0, camera.height, RAYS)
        )
        rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)])  # [3, rays]
        directions = np.linalg.solve(camera.K, rays).T
        local = (directions[:, None, :] * (unit * DEPTHS)[None, :, None]).reshape(-1, 3)
        world = (local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
        for other in views:
            if other is view:
                continue
            seen = world @ other.camera.viewmat[:3, :3].T + other.camera.viewmat[:3, 3]
            before = seen[seen[:, 2] > 0.0]
            pixels = before @ other.camera.K.T
            pixels = pixels[:, :2] / pixels[:, 2:]
            inside = (pixels >= 0.0) & (pixels <= (other.camera.width, other.camera.height))
            if inside.all(axis=1).any():
                return True
    return False
