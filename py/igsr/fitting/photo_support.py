"""What photos tell of a scene: how many there are, how large, and how many see the same place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

# Presets are read by commands that must answer at once: what computes is imported where it does.
if TYPE_CHECKING:
    from igsr.capture import View

#: A photo supports what another looks at if it sees that from within so many degrees of it: from
#: further round, it sees other surfaces.
SUPPORTS_WITHIN = 60.0
#: Part of all photos that stand within that angle of one, where photos are all round an object and
#: only their number is known: that part of a half-sphere, about.
SUPPORTS_OF_ALL = 0.4
#: Pixels of a photo where only the number of photos is known: NeRF Synthetic at half its size.
PIXELS = 400 * 400


@dataclass(frozen=True)
class PhotoSupport:
    """What presets go by.

    Attributes:
        photos: number of photos.
        pixels: of a photo, the mean over photos; masked ones do not count.
        seen_by: number of photos, itself included, that see what a photo looks at from within
            ``SUPPORTS_WITHIN`` degrees of it; the mean over photos.
        apart: degrees between the directions that a photo and the nearest other one see the scene
            from; the mean over photos.
    """

    photos: int
    pixels: float
    seen_by: float
    apart: float

    @classmethod
    def of_number(cls, photos: int) -> PhotoSupport:
        """A guess where nothing but the number is known: small photos all round an object."""
        # The mean distance to the nearest of points that lie on a half-sphere at random.
        apart = math.degrees(0.5 * math.sqrt(2.0 * math.pi / photos))
        return cls(photos, PIXELS, max(1.0, SUPPORTS_OF_ALL * photos), apart)


def support_of(views: Sequence[View]) -> PhotoSupport:
    """What these photos tell.

    Args:
        views: at least one.
    """
    import numpy as np

    from igsr.geometry.focus_point import focus_point

    target = focus_point([view.camera for view in views])
    centres = np.stack([view.camera.centre for view in views])
    forward = np.stack([view.camera.viewmat[2, :3] for view in views])
    # What a photo looks at: as far along its axis as the place that all look at.
    reach = np.maximum(((target - centres) * forward).sum(axis=1), 1e-9)
    looked_at = centres + reach[:, None] * forward
    K = np.stack([view.camera.K for view in views])
    sizes = np.array([(view.camera.width, view.camera.height) for view in views])
    rotations = np.stack([view.camera.viewmat[:3, :3] for view in views])
    shifts = np.stack([view.camera.viewmat[:3, 3] for view in views])
    seen_by, apart = [], []
    for i, place in enumerate(looked_at):
        rays = centres - place
        rays = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles = np.degrees(np.arccos(np.clip(rays @ rays[i], -1.0, 1.0)))
        local = rotations @ place + shifts
        ahead = local[:, 2] > 0.0
        at = local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None]
        pixel = K[:, [0, 1], [0, 1]] * at + K[:, [0, 1], [2, 2]]
        sees = ahead & ((pixel >= 0.0) & (pixel <= sizes)).all(axis=1)
        seen_by.append(int((sees & (angles < SUPPORTS_WITHIN)).sum()))
        apart.append(np.delete(angles, i).min(initial=180.0))
    used = [
        view.camera.width * view.camera.height if view.mask is None else int(view.mask.sum())
        for view in views
    ]
    return PhotoSupport(
        len(views), float(np.mean(used)), max(1.0, float(np.mean(seen_by))), float(np.mean(apart))
    )
