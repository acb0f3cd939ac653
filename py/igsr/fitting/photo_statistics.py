"""Statistics of photos that presets depend on: number, size, overlap and detail."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

# The command line imports presets: numpy is imported where it is used.
if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np

    from igsr.capture import View

#: Photos overlap if they see a point from within this angle; from further apart they see other
#: surfaces.
OVERLAP_ANGLE_DEG = 60.0
#: Fraction of photos all around an object that overlap: about that part of a half-sphere.
OVERLAP_ALL_AROUND = 0.4
#: Pixels of a photo if only the number of photos is known (NeRF Synthetic at half size).
DEFAULT_PIXELS = 400 * 400
#: Sides of the squares that photos are divided into, pixels, and the maximum standard deviation of
#: the tones in a square of one tone (of 255 levels).
SQUARE_SIDES = (16, 8, 4, 2, 1)
MAX_TONE_DEVIATION = 10.0
#: Detail is measured in at most this many photos, evenly spaced.
MAX_DETAIL_PHOTOS = 16
#: The same if photos are not loaded yet: decoding one of 12 megapixels takes 0.1 s.
MAX_DETAIL_FILES = 4


@dataclass(frozen=True)
class PhotoStatistics:
    """Statistics of photos.

    Attributes:
        photos: number of photos.
        pixels: unmasked pixels of a photo, mean over photos.
        overlap: number of photos, itself included, that see what a photo looks at from within
            ``OVERLAP_ANGLE_DEG``, mean over photos.
        spacing_deg: angle between the directions from which a photo and the nearest other one see
            the scene, mean over photos.
        detail: number of squares of one tone that a photo divides into, mean over photos; 0 if
            unknown.
        visible_fraction: fraction of the photos, itself included, that show what a photo looks at
            from any side, mean over photos.
    """

    photos: int
    pixels: float
    overlap: float
    spacing_deg: float
    detail: float = 0.0
    visible_fraction: float = 1.0

    @classmethod
    def of_number(cls, photos: int) -> PhotoStatistics:
        """Return typical statistics of a number of small photos all around an object."""
        # Mean distance to the nearest of random points on a half-sphere.
        spacing = math.degrees(0.5 * math.sqrt(2.0 * math.pi / photos))
        return cls(photos, DEFAULT_PIXELS, max(1.0, OVERLAP_ALL_AROUND * photos), spacing)


def photo_statistics(views: Sequence[View], depths: np.ndarray | None = None) -> PhotoStatistics:
    """Measure photos.

    Args:
        views: at least one.
        depths: float [V], depth of what each photo shows in its middle, world units; by default
            that of the cameras' focus point.
    """
    import numpy as np

    centers = np.stack([view.camera.center for view in views])
    sizes = np.array([(view.camera.width, view.camera.height) for view in views])
    K = np.stack([view.camera.K for view in views])
    rotations = np.stack([view.camera.viewmat[:3, :3] for view in views])
    translations = np.stack([view.camera.viewmat[:3, 3] for view in views])
    overlap, spacing, visible_fraction = [], [], []
    for i, target in enumerate(_targets(views, depths)):
        rays = centers - target
        rays = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles = np.degrees(np.arccos(np.clip(rays @ rays[i], -1.0, 1.0)))
        local = rotations @ target + translations
        in_front = local[:, 2] > 0.0
        ray = local[:, :2] / np.where(in_front, local[:, 2], 1.0)[:, None]
        pixel = K[:, [0, 1], [0, 1]] * ray + K[:, [0, 1], [2, 2]]
        visible = in_front & ((pixel >= 0.0) & (pixel <= sizes)).all(axis=1)
        overlap.append(int((visible & (angles < OVERLAP_ANGLE_DEG)).sum()))
        visible_fraction.append(float(visible.mean()))
        spacing.append(np.delete(angles, i).min(initial=180.0))
    pixels = [
        view.camera.width * view.camera.height if view.mask is None else int(view.mask.sum())
        for view in views
    ]
    some = views[:: -(-len(views) // MAX_DETAIL_PHOTOS)]
    return PhotoStatistics(
        len(views),
        float(np.mean(pixels)),
        max(1.0, float(np.mean(overlap))),
        float(np.mean(spacing)),
        float(np.mean([count_squares(view.image, view.mask) for view in some])),
        float(np.mean(visible_fraction)),
    )


def _targets(views: Sequence[View], depths: np.ndarray | None) -> np.ndarray:
    """World point [V, 3] that each photo looks at."""
    import numpy as np

    from igsr.geometry.focus_point import focus_point

    centers = np.stack([view.camera.center for view in views])
    if depths is None:
        forward = np.stack([view.camera.viewmat[2, :3] for view in views])
        focus = focus_point([view.camera for view in views])
        distance = np.maximum(((focus - centers) * forward).sum(axis=1), 1e-9)
        return np.asarray(centers + distance[:, None] * forward)
    sizes = np.array([(view.camera.width, view.camera.height) for view in views])
    K = np.stack([view.camera.K for view in views])
    rotations = np.stack([view.camera.viewmat[:3, :3] for view in views])
    middle = (0.5 * sizes - K[:, :2, 2]) / K[:, [0, 1], [0, 1]]
    rays = np.concatenate([middle, np.ones((len(views), 1))], axis=1)
    rays = np.maximum(depths, 1e-9)[:, None] * rays
    return np.asarray(centers + np.einsum("vji,vj->vi", rotations, rays))


def detail_of_files(files: Sequence[Path], max_size: int | None) -> float:
    """Return ``PhotoStatistics.detail`` of photos that are not loaded, from a few of them.

    Args:
        files: photos; those that cannot be read are left out.
        max_size: longest side of photos as fitted, pixels, or None.
    """
    from igsr.capture.downscaling import reduced_size
    from igsr.capture.image_files import decoded, open_image
    from igsr.errors import IgsrError

    details = []
    for file in files[:: max(1, -(-len(files) // MAX_DETAIL_FILES))]:
        try:
            with open_image(file) as image:
                pixels, _ = decoded(image, file, reduced_size(*image.size, max_size))
        except IgsrError:
            continue
        details.append(count_squares(pixels))
    return sum(details) / len(details) if details else 0.0


def count_squares(image: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Count the squares of one tone that a photo divides into; other squares are divided by four.

    Args:
        image: uint8 [H, W, 3 or 4]; alpha is over white.
        mask: bool [H, W] of pixels that count, or None. A square counts by its fraction of them.
    """
    import numpy as np

    side = SQUARE_SIDES[0]
    height, width = (extent // side * side for extent in image.shape[:2])
    tones = image[:height, :width, :3].mean(axis=2, dtype=np.float32)
    if image.shape[2] == 4:
        alpha = image[:height, :width, 3].astype(np.float32) / 255.0
        tones = tones * alpha + 255.0 * (1.0 - alpha)
    weight = np.ones_like(tones) if mask is None else mask[:height, :width].astype(np.float32)
    total = 0.0
    remaining = np.ones((height // side, width // side), dtype=bool)
    for side in SQUARE_SIDES:
        squares = (height // side, side, width // side, side)
        means = tones.reshape(squares).mean(axis=(1, 3))
        variances = (tones.reshape(squares) ** 2).mean(axis=(1, 3)) - means**2
        one_tone = remaining & (variances < MAX_TONE_DEVIATION**2)
        total += float(weight.reshape(squares).mean(axis=(1, 3))[one_tone].sum())
        remaining = (remaining & ~one_tone).repeat(2, axis=0).repeat(2, axis=1)
    return total
