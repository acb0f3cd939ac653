"""What photos tell of a scene: how many there are, how large, and how many see the same place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

# Presets are read by commands that must answer at once: what computes is imported where it does.
if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np

    from igsr.capture import View

#: A photo supports what another looks at if it sees that from within so many degrees of it: from
#: further round, it sees other surfaces.
SUPPORTS_WITHIN = 60.0
#: Part of all photos that stand within that angle of one, where photos are all round an object and
#: only their number is known: that part of a half-sphere, about.
SUPPORTS_OF_ALL = 0.4
#: Pixels of a photo where only the number of photos is known: NeRF Synthetic at half its size.
PIXELS = 400 * 400
#: Sides of the squares that photos are divided into, pixels, from the largest; and how much the
#: tones of a square may differ (standard deviation, of 255 levels) that counts as one tone.
SQUARES = (16, 8, 4, 2, 1)
ONE_TONE = 10.0
#: Of at most so many photos, evenly spaced.
LOOKED_AT = 16
#: Of at most so many where photos are not loaded yet: decoding one of 12 megapixels takes 0.1 s.
DECODED = 4


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
        detail: number of squares of one tone that a photo is divided into, the mean over photos.
            0 where it is not known.
        shown: part of the photos, itself included, that show what a photo looks at from any side;
            the mean over photos.
    """

    photos: int
    pixels: float
    seen_by: float
    apart: float
    detail: float = 0.0
    shown: float = 1.0

    @classmethod
    def of_number(cls, photos: int) -> PhotoSupport:
        """A guess where nothing but the number is known: small photos all round an object."""
        # The mean distance to the nearest of points that lie on a half-sphere at random.
        apart = math.degrees(0.5 * math.sqrt(2.0 * math.pi / photos))
        return cls(photos, PIXELS, max(1.0, SUPPORTS_OF_ALL * photos), apart)


def support_of(views: Sequence[View], depths: np.ndarray | None = None) -> PhotoSupport:
    """What these photos tell.

    Args:
        views: at least one.
        depths: float [V], how far what each shows in its middle is along its axis, world units;
            None: as far as the place that all look at, where they do.
    """
    import numpy as np

    from igsr.geometry.focus_point import focus_point

    centres = np.stack([view.camera.center for view in views])
    forward = np.stack([view.camera.viewmat[2, :3] for view in views])
    K = np.stack([view.camera.K for view in views])
    sizes = np.array([(view.camera.width, view.camera.height) for view in views])
    rotations = np.stack([view.camera.viewmat[:3, :3] for view in views])
    if depths is None:
        # What a photo looks at: as far along its axis as the place that all look at.
        target = focus_point([view.camera for view in views])
        reach = np.maximum(((target - centres) * forward).sum(axis=1), 1e-9)
        looked_at = centres + reach[:, None] * forward
    else:
        middle = (0.5 * sizes - K[:, :2, 2]) / K[:, [0, 1], [0, 1]]
        rays = np.concatenate([middle, np.ones((len(views), 1))], axis=1)
        rays = np.maximum(depths, 1e-9)[:, None] * rays
        looked_at = centres + np.einsum("vji,vj->vi", rotations, rays)
    shifts = np.stack([view.camera.viewmat[:3, 3] for view in views])
    seen_by, apart, shown = [], [], []
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
        shown.append(float(sees.mean()))
        apart.append(np.delete(angles, i).min(initial=180.0))
    used = [
        view.camera.width * view.camera.height if view.mask is None else int(view.mask.sum())
        for view in views
    ]
    some = views[:: -(-len(views) // LOOKED_AT)]
    return PhotoSupport(
        len(views),
        float(np.mean(used)),
        max(1.0, float(np.mean(seen_by))),
        float(np.mean(apart)),
        float(np.mean([squares_of_one_tone(view.image, view.mask) for view in some])),
        float(np.mean(shown)),
    )


def detail_of_files(files: Sequence[Path], max_size: int | None) -> float:
    """``PhotoSupport.detail`` of photos that are not loaded, from a few of them.

    Args:
        files: of the photos; those that cannot be read do not count.
        max_size: longest side in pixels of the photos as fitted, or None.
    """
    from igsr.capture.downscaling import reduced_size
    from igsr.capture.image_files import decoded, open_image
    from igsr.errors import IgsrError

    found = []
    for file in files[:: max(1, -(-len(files) // DECODED))]:
        try:
            with open_image(file) as image:
                pixels, _ = decoded(image, file, reduced_size(*image.size, max_size))
        except IgsrError:
            continue
        found.append(squares_of_one_tone(pixels))
    return sum(found) / len(found) if found else 0.0


def squares_of_one_tone(image: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Number of squares of one tone that a photo is divided into, halving the sides of the others.

    Args:
        image: uint8 [H, W, 3 or 4]; alpha is over white.
        mask: bool [H, W] of the pixels that count, or None. A square counts by its part of them.
    """
    import numpy as np

    side = SQUARES[0]
    height, width = (extent // side * side for extent in image.shape[:2])
    tones = image[:height, :width, :3].mean(axis=2, dtype=np.float32)
    if image.shape[2] == 4:
        alpha = image[:height, :width, 3].astype(np.float32) / 255.0
        tones = tones * alpha + 255.0 * (1.0 - alpha)
    counted = np.ones_like(tones) if mask is None else mask[:height, :width].astype(np.float32)
    total = 0.0
    divided = np.ones((height // side, width // side), dtype=bool)
    for side in SQUARES:
        squares = (height // side, side, width // side, side)
        means = tones.reshape(squares).mean(axis=(1, 3))
        variances = (tones.reshape(squares) ** 2).mean(axis=(1, 3)) - means**2
        of_one = divided & (variances < ONE_TONE**2)
        total += float(counted.reshape(squares).mean(axis=(1, 3))[of_one].sum())
        divided = (divided & ~of_one).repeat(2, axis=0).repeat(2, axis=1)
    return total
