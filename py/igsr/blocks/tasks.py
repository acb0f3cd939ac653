"""The tasks of a fit in blocks: a coarse fit of the whole scene, and a fit of each block."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr._internal.choices import FitBackend
from igsr._internal.untrusted_npz import DAMAGE, stored_arrays
from igsr._internal.user_warning import warn_user
from igsr.blocks.cells import OVERLAP_FRACTION, Grid
from igsr.blocks.crops import Box
from igsr.blocks.manifest import Manifest, loaded_batches
from igsr.blocks.plan import BlockPlan, memory_of
from igsr.capture.downscaling import reduced_size, resized_camera, resized_tracks
from igsr.capture.exposure import Exposure
from igsr.capture.memory_check import SPLAT_BYTES
from igsr.capture.photos import Shot
from igsr.capture.types import Points, View
from igsr.errors import IgsrError
from igsr.fitting.fingerprint import hash_of
from igsr.fitting.fitter import splat_arrays
from igsr.splats import Splats

#: Files in the folder of a task.
SPLATS_FILE = "splats.npz"
CHECKPOINT_FILE = "checkpoint.npz"
PROGRESS_FILE = "progress.json"
#: Size of the photos in the coarse fit, relative to the blocks' photos.
COARSE_SCALE = 1 / 3
#: Limits of their longest side, pixels.
MIN_COARSE_SIDE_PX = 96
MAX_COARSE_SIDE_PX = 400
#: Maximum number of pixels of all photos of the coarse fit.
MAX_COARSE_PIXELS = 600_000_000
#: The coarse fit may have at least this many splats: blocks that start with few stay worse.
MIN_COARSE_SPLATS = 100_000
#: A seam fit optimizes the splats within this fraction of a cell's sides of its inner borders.
SEAM_FRACTION = 0.1


@dataclass(frozen=True, kw_only=True)
class BlockOptions:
    """Options of a fit in blocks.

    Attributes:
        blocks: number of blocks; None chooses it by the available memory.
        ray: address of a Ray cluster; None fits one block after another on this machine.
        holdout: hold out every ``holdout``-th photo; None keeps the capture's split.
        max_size: longest side in pixels of the photos when loaded; None keeps their size.
        backend: "cpu" or "gpu".
        settings: keywords of ``igsr.fit``: quality and settings.
        background: RGB in [0, 1] behind renders; None is white if photos have alpha, else black.
    """

    blocks: int | None = None
    ray: str | None = None
    holdout: int | None = None
    max_size: int | None = None
    backend: FitBackend = "cpu"
    settings: dict[str, Any]
    background: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Context:
    """Inputs of all steps of a run.

    Attributes:
        out: folder of the run.
        options: of the run.
        manifest: the capture's photos.
        exposures: of photos, by name; empty before the coarse fit.
    """

    out: Path
    options: BlockOptions
    manifest: Manifest
    exposures: Mapping[str, Exposure] = field(default_factory=dict)

    def names(self, photos: Sequence[int]) -> list[str]:
        """The names of photos, by their indices."""
        return [self.manifest.shots[index].name for index in photos]

    def loaded(self, photos: Sequence[int]) -> Iterator[list[View]]:
        """Decode photos, a few at a time."""
        shots = [self.manifest.shots[index] for index in photos]
        return loaded_batches(self.manifest.path, shots, self.options.max_size)

    def task(
        self,
        name: str,
        photos: Sequence[int],
        boxes: Mapping[str, Box] | None = None,
        **fields: Any,
    ) -> FitTask:
        """Make a task for photos; ``fields`` are other fields of ``FitTask``."""
        names = self.names(photos)
        return FitTask(
            name=name,
            capture=self.manifest.path,
            folder=self.out / "blocks" / name,
            shots=[self.manifest.shots[index] for index in photos],
            marks=[self.manifest.marks[index] for index in photos],
            backend=self.options.backend,
            exposures={name: self.exposures[name] for name in names if name in self.exposures},
            boxes=boxes or {},
            **{"max_size": self.options.max_size, **fields},
        )


@dataclass(frozen=True, eq=False)
class Region:
    """The part of a scene that a task fits.

    Attributes:
        scene: file of the scene's splats.
        scene_hash: hash of these splats.
        grid: the cells of all blocks.
        block: index of the block; None for a fit of the splats near the seams.
        across: names of the task's photos that show a seam; they are scored.
    """

    scene: Path
    scene_hash: str
    grid: Grid
    block: int | None
    across: frozenset[str] = frozenset()

    def trainable(self, scene: Splats) -> npt.NDArray[np.bool_]:
        """The splats of the scene that are fitted, bool [N]; all others are frozen."""
        if self.block is None:
            return self.grid.near_borders(scene, SEAM_FRACTION)
        cell = self.grid.cells[self.block].expanded()
        return cell.contains(self.grid.splat_positions(scene)) & ~self.grid.spanning(scene)

    def kept(self, fitted: Splats) -> npt.NDArray[np.bool_]:
        """The fitted splats that the joined scene takes, bool [N]: no overlap with other blocks."""
        if self.block is None:
            return np.ones(len(fitted), np.bool_)
        cell = self.grid.cells[self.block]
        return cell.contains(self.grid.splat_positions(fitted)) & ~self.grid.spanning(fitted)


@dataclass(frozen=True, eq=False, kw_only=True)
class FitTask:
    """One fit of a run in blocks.

    Attributes:
        name: "coarse", "block-003" ..., the name of its folder.
        capture: folder of the capture, for messages.
        folder: folder of the task's files.
        shots: the photos.
        marks: checksums of their files, from the manifest.
        max_size: longest side in pixels of the photos when loaded, or None.
        settings: keywords of ``igsr.fit``.
        backend: "cpu" or "gpu".
        exposures: known exposures by the photo's name; they are removed before the fit.
        boxes: the part of a photo that is fitted, by the photo's name; whole photos are absent.
        splats_part: fraction of the maximum number of splats, below 1 after memory ran out.
        was_lost: whether the process of an earlier attempt was lost.
        memory: estimated memory in bytes, or None.
        points: points of the capture, for the coarse fit only.
        region: the part of the scene that is fitted; None for the coarse fit.
    """

    name: str
    capture: Path
    folder: Path
    shots: list[Shot]
    marks: list[str]
    max_size: int | None
    settings: dict[str, Any]
    backend: FitBackend
    exposures: Mapping[str, Exposure] = field(default_factory=dict)
    boxes: Mapping[str, Box] = field(default_factory=dict)
    splats_part: float = 1.0
    was_lost: bool = False
    memory: int | None = None
    points: Points | None = None
    region: Region | None = None

    @property
    def row_file(self) -> Path:
        """The file of the task's row of the report."""
        return self.folder.with_suffix(".json")

    def key(self) -> str:
        """A hash of everything that the result depends on."""
        about: list[Any] = [_core.__version__, _core.backend_info(self.backend)["instruction_set"]]
        about += [self.backend, self.max_size, sorted(self.settings.items())]
        if self.region is not None:
            grid, across = self.region.grid, sorted(self.region.across)
            about += [self.region.scene_hash, self.region.block, across, grid.axes.tolist()]
            about += [grid.cells]
        for shot, mark in zip(self.shots, self.marks, strict=True):
            camera = shot.camera
            about += [shot.name, shot.split, mark, shot.lens, shot.side, camera.width]
            about += [camera.height, camera.viewmat.tolist(), camera.K.tolist()]
            about += [self.exposures.get(shot.name), self.boxes.get(shot.name)]
        return hashlib.sha256(repr(about).encode()).hexdigest()


def block_name(index: int) -> str:
    """The name of a block."""
    return f"block-{index:03d}"


def coarse_task(context: Context, points: Points | None, blocks: int) -> FitTask:
    """Make the coarse fit: all photos, reduced so that it needs no more memory than a block."""
    manifest, options = context.manifest, context.options
    photos = manifest.of_split("train")
    size = _coarse_size(manifest, photos, options.max_size, blocks)
    # The search for transient objects holds all photos in memory; blocks do it.
    settings = {**options.settings, "transients": "off"}
    max_splats = settings.get("max_splats")
    if max_splats is not None:
        block_splats = max(1, round((1.0 + OVERLAP_FRACTION) * max_splats / blocks))
        block_photos = max(1, round((1.0 + OVERLAP_FRACTION) * len(photos) / blocks))
        left = memory_of(manifest, photos[:block_photos], options.max_size, block_splats)
        left -= memory_of(manifest, photos, size, 0)
        allowed = max(block_splats, MIN_COARSE_SPLATS, left // SPLAT_BYTES)
        settings["max_splats"] = min(max_splats, allowed)
    cameras = {manifest.shots[index].name: manifest.shots[index].camera for index in photos}
    reduced = {
        name: resized_camera(camera, *reduced_size(camera.width, camera.height, size))
        for name, camera in cameras.items()
    }
    points = resized_tracks(points, cameras, reduced)
    return context.task("coarse", photos, settings=settings, max_size=size, points=points)


def _coarse_size(
    manifest: Manifest, photos: Sequence[int], max_size: int | None, blocks: int
) -> int:
    """Longest side in pixels such that all photos have no more pixels than those of a block."""
    longest = max(max(manifest.headers[index].size) for index in photos)
    longest = min(longest, max_size or longest)
    block_pixels = 0.75 * longest**2 * len(photos) * (1.0 + OVERLAP_FRACTION) / blocks
    side = int((min(MAX_COARSE_PIXELS, block_pixels) / (0.75 * len(photos))) ** 0.5)
    side = min(MAX_COARSE_SIDE_PX, side, round(COARSE_SCALE * longest))
    return min(longest, max(MIN_COARSE_SIDE_PX, side))


def block_tasks(context: Context, plan: BlockPlan, coarse: Splats) -> list[FitTask]:
    """Make the tasks of the blocks that have photos and splats.

    Raises:
        IgsrError: no block has any.
        UserWarning: a block has none.
    """
    manifest, options = context.manifest, context.options
    settings = {k: v for k, v in options.settings.items() if k != "start"} | {"exposure": "off"}
    if settings.get("max_splats") is not None:
        own = settings["max_splats"] / len(plan.grid.cells)
        settings["max_splats"] = max(1, round(own * (1.0 + OVERLAP_FRACTION)))
    scene = context.out / "blocks" / "coarse" / SPLATS_FILE
    scene_hash = hash_of(splat_arrays(coarse).values())
    inside = plan.grid.inside(plan.grid.splat_positions(coarse), expanded=True)
    is_local = ~plan.grid.spanning(coarse)
    tasks = []
    for index in range(len(plan.grid.cells)):
        photos = [int(photo) for photo in np.flatnonzero(plan.photos[:, index])]
        name = block_name(index)
        if not photos or not (is_local & inside[:, index]).any():
            missing = "splats" if photos else "photos"
            warn_user(f"{name} has no {missing}; it keeps the splats of the coarse fit.")
            continue
        boxes = [plan.boxes[photo][index] for photo in photos]
        across = frozenset(context.names([photo for photo in photos if plan.across[photo]]))
        tasks.append(
            context.task(
                name,
                photos,
                dict(zip(context.names(photos), boxes, strict=True)),
                settings=settings,
                memory=memory_of(manifest, photos, options.max_size, boxes=boxes),
                region=Region(scene, scene_hash, plan.grid, index, across),
            )
        )
    if not tasks:
        raise IgsrError(f"No block of {manifest.path} has photos and splats; give fewer --blocks.")
    return tasks


def save_splats(path: Path, splats: Splats) -> None:
    """Write splats without loss."""
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        arrays: dict[str, Any] = splat_arrays(splats)
        np.savez(file, **arrays)


def load_splats(path: Path) -> Splats:
    """Read splats from ``save_splats``."""
    try:
        arrays: dict[str, Any] = stored_arrays(path)
        return Splats(**arrays)
    except (*DAMAGE, IgsrError) as error:
        raise IgsrError(
            f"{path} cannot be read ({error}); delete its folder to fit it again."
        ) from error
