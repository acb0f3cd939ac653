"""From the coarse scene to what each block is fitted to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr._internal.choices import Backend
from igsr.blocks.assignment import photos_across_seams, photos_of_blocks
from igsr.blocks.cells import Cell, Ground, ground_of, split_into_cells
from igsr.blocks.manifest import Manifest
from igsr.blocks.photo_parts import ALL, Box, boxes_of
from igsr.blocks.shares import shown_shares, tracked_shares
from igsr.capture.downscaling import reduced_size
from igsr.capture.memory_check import LIBRARY_BYTES, USABLE_PART, available_memory
from igsr.capture.photos import shot_sizes
from igsr.capture.types import Points
from igsr.splats import Splats

#: Photos of a block where nothing else bounds their number.
PHOTOS_PER_BLOCK = 250
#: Part of the photos of neighbouring cells that a block has beside its own.
SHARED = 0.5


@dataclass(frozen=True, eq=False)
class BlockPlan:
    """The split of a capture into C blocks.

    Attributes:
        ground: the plane of the cells.
        cells: C cells proper; every place lies in one.
        photos: bool [P, C], which photos of the capture each block is fitted to.
        across: bool [P], which photos show a seam.
        shown: float64 [P, C], part of each photo that the coarse splats of each cell proper are.
        boxes: for each photo, by block, the part of it that the block is fitted to.
    """

    ground: Ground
    cells: list[Cell]
    photos: npt.NDArray[np.bool_]
    across: npt.NDArray[np.bool_]
    shown: npt.NDArray[np.float64]
    boxes: list[dict[int, Box]]

    def box(self, photo: int, block: int) -> Box:
        """The part of a photo that a block is fitted to."""
        return self.boxes[photo].get(block, ALL)

    @property
    def largest_part(self) -> float:
        """The pixels of the block that has most, in whole photos."""
        return max(
            sum(self.box(int(photo), block).part for photo in np.flatnonzero(photos))
            for block, photos in enumerate(self.photos.T)
        )

    def plain(self) -> list[dict[str, Any]]:
        """As reports have it: each cell with its number of photos."""
        return [
            {**cell.plain(), "photos": int(count)}
            for cell, count in zip(self.cells, self.photos.sum(axis=0), strict=True)
        ]


def cells_of(manifest: Manifest, count: int) -> tuple[Ground, list[Cell]]:
    """The ground plane of a capture, and its cells by the photos to fit.

    Raises:
        IgsrError: there are more cells than photos, or too many photos stand at one place.
    """
    cameras = [manifest.shots[index].camera for index in manifest.of_split("train")]
    ground = ground_of(cameras)
    places = ground.places(np.stack([camera.center for camera in cameras]))
    return ground, split_into_cells(places, count)


def plan_blocks(
    manifest: Manifest,
    ground: Ground,
    cells: list[Cell],
    coarse: Splats,
    points: Points | None,
    backend: Backend,
) -> BlockPlan:
    """Assign photos to blocks.

    Held-out photos are assigned to none, but it is told whether they show a seam.

    Args:
        manifest: the capture's photos.
        ground, cells: of ``cells_of``.
        coarse: the coarse scene.
        points: of the capture, with tracks; or None.
        backend: "cpu" or "gpu".
    """
    cameras = [shot.camera for shot in manifest.shots]
    widened = [cell.widened() for cell in cells]
    count = len(cells)
    shares = shown_shares(coarse, cameras, [*cells, *widened], ground, backend)
    names = [shot.name for shot in manifest.shots]
    tracked = tracked_shares(points, names, widened, ground)
    places = ground.places(np.stack([camera.center for camera in cameras]))
    near = np.stack([cell.holds(places) for cell in widened], axis=1)
    photos = photos_of_blocks(shares[:, count:], tracked, near)
    photos[[shot.split != "train" for shot in manifest.shots]] = False
    proper, wide = shares[:, :count], shares[:, count:]
    places = ground.places(coarse.means.astype(np.float64) + coarse.origin)
    inside = np.stack([cell.holds(places) for cell in widened], axis=1)
    boxes = boxes_of(coarse, cameras, inside, photos, wide.argmax(axis=1), backend)
    return BlockPlan(ground, cells, photos, photos_across_seams(proper), proper, boxes)


def blocks_for_memory(
    manifest: Manifest, max_size: int | None, splats: int | None, available: int | None = None
) -> int:
    """How many blocks a capture needs so that each fits into memory.

    Args:
        manifest: the capture's photos.
        max_size: longest side in pixels of photos as loaded, or None.
        splats: most splats of the whole scene, where that is given.
        available: bytes; None: what this machine has free.
    """
    train = manifest.of_split("train")
    usable = USABLE_PART * (available_memory() if available is None else available)
    whole = memory_of(manifest, train, max_size, splats)
    per_photo = max(0, whole - LIBRARY_BYTES) / max(1, len(train))
    photos = max(1.0, (usable - LIBRARY_BYTES) / max(per_photo, 1.0) / (1.0 + SHARED))
    needed = math.ceil(len(train) / min(photos, PHOTOS_PER_BLOCK))
    return min(max(1, needed), max(1, len(train)))


def memory_of(
    manifest: Manifest,
    photos: list[int],
    max_size: int | None,
    splats: int | None = None,
    boxes: Sequence[Box] | None = None,
) -> int:
    """Bytes that a fit to these photos takes at most.

    Args:
        manifest: the capture's photos.
        photos: their numbers in it.
        max_size: longest side in pixels of photos as loaded, or None.
        splats: most splats of the fit; None: what presets would have for them.
        boxes: parts of the photos that are fitted; None: all of each.
    """
    shots = [manifest.shots[index] for index in photos]
    headers = [manifest.headers[index] for index in photos]
    sizes = shot_sizes(shots, headers)
    if boxes is not None:
        parts = [
            box.size(*reduced_size(*size, max_size))
            for box, size in zip(boxes, sizes.sizes, strict=True)
        ]
        sizes = replace(sizes, sizes=parts)
    return sizes.needed_memory(max_size, 200_000 if splats is None else splats)
