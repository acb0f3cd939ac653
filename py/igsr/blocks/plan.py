"""The plan of a fit in blocks: the number of blocks, their cells and their photos."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igsr._internal.available_memory import available_memory
from igsr._internal.choices import Backend
from igsr.blocks.cells import Grid, centers_of
from igsr.blocks.crops import Box
from igsr.blocks.manifest import Manifest
from igsr.blocks.visibility import splat_visibility, track_visibility, visible_boxes
from igsr.capture.downscaling import reduced_size
from igsr.capture.memory_check import LIBRARY_BYTES, USABLE_PART
from igsr.capture.photos import shot_sizes
from igsr.capture.types import Points
from igsr.splats import Splats

Bool = npt.NDArray[np.bool_]
Float64 = npt.NDArray[np.float64]

#: Maximum number of photos per block, without those shared with neighbors.
MAX_BLOCK_PHOTOS = 250
#: Photos that a block shares with its neighbors, relative to its own.
SHARED_FRACTION = 0.5
#: A block is fitted to the photos that show it in at least this fraction of the picture
#: (VastGaussian) ...
MIN_VISIBILITY = 0.25
#: ... or in this one, for photos taken inside the block.
MIN_VISIBILITY_INSIDE = 0.05
#: A photo shows a seam if each of two cells fills at least this fraction of it.
MIN_SEAM_VISIBILITY = 0.1
#: Number of splats for memory estimates if no maximum is given.
ESTIMATED_SPLATS = 200_000


@dataclass(frozen=True, eq=False)
class BlockPlan:
    """The partition of a capture of P photos into C blocks.

    Attributes:
        grid: the cells of the blocks.
        photos: bool [P, C], the photos that each block is fitted to.
        across: bool [P], the photos that show a seam.
        boxes: the part of each photo that each block is fitted to, by photo and block.
    """

    grid: Grid
    photos: Bool
    across: Bool
    boxes: list[dict[int, Box]]

    @property
    def largest_area(self) -> float:
        """Total area of the photos of the block with the most pixels, in whole photos."""
        return max(
            sum(self.boxes[photo][block].area for photo in np.flatnonzero(photos))
            for block, photos in enumerate(self.photos.T)
        )


def plan_blocks(
    manifest: Manifest, grid: Grid, coarse: Splats, points: Points | None, backend: Backend
) -> BlockPlan:
    """Assign the train photos to blocks by the coarse scene and by tracks, and find the seams."""
    cameras = [shot.camera for shot in manifest.shots]
    positions = grid.splat_positions(coarse)
    expanded = grid.inside(positions, expanded=True)
    groups = np.concatenate([grid.inside(positions), expanded], axis=1)
    visibility = splat_visibility(coarse, cameras, groups, backend)
    own, overlapping = np.split(visibility, 2, axis=1)
    xyz = np.zeros((0, 3)) if points is None else points.xyz
    tracked = track_visibility(
        points,
        [shot.name for shot in manifest.shots],
        grid.inside(grid.positions(xyz), expanded=True),
    )
    camera_positions = grid.positions(centers_of(cameras))
    photos = assign_photos(
        np.maximum(overlapping, tracked), grid.inside(camera_positions, expanded=True)
    )
    photos[[shot.split != "train" for shot in manifest.shots]] = False
    boxes = visible_boxes(coarse, cameras, expanded, photos, overlapping.argmax(axis=1), backend)
    return BlockPlan(grid, photos, photos_across_seams(own), boxes)


def assign_photos(visibility: Float64, inside: Bool) -> Bool:
    """Assign photos to blocks, bool [P, C]; each photo that shows a block is assigned to one.

    Args:
        visibility: [P, C], fraction of each photo that shows each expanded cell.
        inside: bool [P, C], whether the camera is in the expanded cell.
    """
    assigned: Bool = visibility >= MIN_VISIBILITY
    assigned |= inside & (visibility >= MIN_VISIBILITY_INSIDE)
    unassigned = ~assigned.any(axis=1) & (visibility.max(axis=1, initial=0.0) > 0.0)
    assigned[unassigned, visibility[unassigned].argmax(axis=1)] = True
    return assigned


def photos_across_seams(visibility: Float64) -> Bool:
    """Whether each of P photos shows a seam, by the visibility [P, C] of cells without overlap."""
    across: Bool = (visibility >= MIN_SEAM_VISIBILITY).sum(axis=1) >= 2
    return across


def blocks_for_memory(
    manifest: Manifest, max_size: int | None, splats: int | None, available: int | None = None
) -> int:
    """The number of blocks such that each fits into the available bytes (None: free memory)."""
    train = manifest.of_split("train")
    usable = USABLE_PART * (available_memory() if available is None else available)
    whole = memory_of(manifest, train, max_size, splats)
    per_photo = max(0, whole - LIBRARY_BYTES) / max(1, len(train))
    photos = max(1.0, (usable - LIBRARY_BYTES) / max(per_photo, 1.0) / (1.0 + SHARED_FRACTION))
    needed = math.ceil(len(train) / min(photos, MAX_BLOCK_PHOTOS))
    return min(max(1, needed), max(1, len(train)))


def memory_of(
    manifest: Manifest,
    photos: Sequence[int],
    max_size: int | None,
    splats: int | None = None,
    boxes: Sequence[Box] | None = None,
) -> int:
    """Estimate the maximum memory of a fit to photos, or to boxes in them, in bytes."""
    shots = [manifest.shots[index] for index in photos]
    headers = [manifest.headers[index] for index in photos]
    sizes = shot_sizes(shots, headers)
    if boxes is not None:
        cropped = [
            box.size(*reduced_size(*size, max_size))
            for box, size in zip(boxes, sizes.sizes, strict=True)
        ]
        sizes = replace(sizes, sizes=cropped)
    return sizes.needed_memory(max_size, ESTIMATED_SPLATS if splats is None else splats)
