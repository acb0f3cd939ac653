"""What part of each photo shows which cell: by the coarse splats, and by tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from igsr.blocks.cells import Cell, Ground
from igsr.capture.downscaling import reduced_size, resized_camera
from igsr.capture.types import Camera, Points
from igsr.rendering.splat_weights import splat_weights
from igsr.splats import Splats

Float64 = npt.NDArray[np.float64]

#: Longest side of the pictures that are asked what they show, pixels.
ASKED_SIZE = 32


def shown_shares(
    splats: Splats, cameras: Sequence[Camera], cells: Sequence[Cell], ground: Ground, backend: str
) -> Float64:
    """The part of what each camera shows that are splats of each cell.

    What other splats hide is not shown.

    Args:
        splats: the coarse scene.
        cameras: P cameras.
        cells: C cells, which may overlap.
        ground: the plane of the cells.
        backend: "cpu" or "gpu".

    Returns:
        float64 [P, C] in [0, 1]; 0 for a camera that shows nothing.
    """
    places = ground.places(splats.means.astype(np.float64) + splats.origin)
    inside = np.stack([cell.holds(places) for cell in cells], axis=1).astype(np.float64)
    # Geometry alone: what colors splats have counts for nothing here.
    plain = replace(splats, sh=np.ascontiguousarray(splats.sh[:, :1]))
    shares = np.zeros((len(cameras), len(cells)))
    for row, camera in zip(shares, cameras, strict=True):
        small = resized_camera(camera, *reduced_size(camera.width, camera.height, ASKED_SIZE))
        # Gradients may be negative by rounding.
        weights = np.maximum(splat_weights(plain, small, backend).astype(np.float64), 0.0)
        seen = np.flatnonzero(weights)  # few of a large scene's
        row[:] = weights[seen] @ inside[seen] / max(float(weights[seen].sum()), 1e-9)
    return np.clip(shares, 0.0, 1.0)


def tracked_shares(
    points: Points | None, names: Sequence[str], cells: Sequence[Cell], ground: Ground
) -> Float64:
    """The part of the points that each photo sees that lie in each cell.

    Args:
        points: with tracks, or None.
        names: of P photos.
        cells: C cells, which may overlap.
        ground: the plane of the cells.

    Returns:
        float64 [P, C] in [0, 1]; 0 for a photo without tracks.
    """
    shares = np.zeros((len(names), len(cells)))
    if points is None or points.tracks is None:
        return shares
    tracks = points.tracks
    number = {name: index for index, name in enumerate(names)}
    photo = np.array([number.get(name, -1) for name in tracks.names], np.int64)[tracks.view]
    known = photo >= 0
    photo, seen = photo[known], tracks.point[known]
    total = np.maximum(np.bincount(photo, minlength=len(names)), 1)
    places = ground.places(points.xyz)
    for index, cell in enumerate(cells):
        inside = cell.holds(places)[seen]
        shares[:, index] = np.bincount(photo[inside], minlength=len(names)) / total
    return shares
