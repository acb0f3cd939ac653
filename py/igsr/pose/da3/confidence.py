"""Which depths of Depth Anything 3 are confident.

Its confidence is not calibrated, so it says only which pixels of a photo are surer than others;
whether they are right, other photos tell.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from igsr.pose.alignment import AlignedPhoto

Bool = npt.NDArray[np.bool_]
Float64 = npt.NDArray[np.float64]

#: A pixel's confidence is above this, and not below this quantile of its photo's.
LEAST, QUANTILE = 1.05, 0.4
#: Depths that differ by less than this part agree; neighbours that differ by more are at an edge.
AGREES = 0.05
#: Photos, the nearest, that are asked whether they agree.
ASKED = 8
#: From so many photos on, two must agree, else one.
MANY = 5


def trusted_depths(photos: Sequence[AlignedPhoto | None]) -> list[Bool | None]:
    """The pixels, [h, w] per photo, that are sure, on no edge and where another photo agrees.

    Args:
        photos: in one world; None where one has no place.
    """
    known = [i for i, photo in enumerate(photos) if photo is not None]
    needed = 2 if len(known) >= MANY else 1
    trusted: list[Bool | None] = [None] * len(photos)
    centres = {i: photo.camera.center for i in known if (photo := photos[i]) is not None}
    for i in known:
        photo = photos[i]
        assert photo is not None
        sure = sure_pixels(photo) & ~_on_edge(photo.depth)
        others = sorted(
            (j for j in known if j != i),
            key=lambda j: float(np.linalg.norm(centres[j] - centres[i])),
        )
        xyz, index = photo.world_points()
        kept = sure.ravel()[index]
        xyz, index = xyz[kept], index[kept]
        votes = np.zeros(len(index), dtype=np.int64)
        for j in others[:ASKED]:
            other = photos[j]
            assert other is not None
            votes += _agreed(xyz, other)
        result = np.zeros(photo.depth.size, dtype=bool)
        result[index[votes >= needed]] = True
        trusted[i] = result.reshape(photo.depth.shape)
    return trusted


def sure_pixels(photo: AlignedPhoto) -> Bool:
    """The pixels [h, w] that the network is surer of than of others of the photo."""
    known = np.isfinite(photo.depth) & (photo.depth > 0.0) & (photo.confidence > 1.0)
    if not known.any():
        return known
    surer = photo.confidence >= np.quantile(photo.confidence[known], QUANTILE)
    return known & surer & (photo.confidence > LEAST)


def _on_edge(depth: npt.NDArray[np.float32]) -> Bool:
    """Pixels beside which the depth steps."""
    edge = np.zeros(depth.shape, dtype=bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis in (0, 1):
            near, far = np.moveaxis(depth, axis, 0)[:-1], np.moveaxis(depth, axis, 0)[1:]
            steps = np.abs(near - far) > AGREES * np.minimum(near, far)
            along = np.moveaxis(edge, axis, 0)
            along[:-1] |= steps
            along[1:] |= steps
    return edge


def _agreed(xyz: Float64, other: AlignedPhoto) -> Bool:
    """Which world points [M, 3] lie on the surface that another photo sees."""
    shown, z, surface, confidence = other.shown_at(xyz)
    with np.errstate(invalid="ignore"):  # the other photo's depth may be unknown
        return shown & (confidence > 1.0) & (np.abs(z - surface) < AGREES * z)
