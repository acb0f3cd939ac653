"""Where seams show: a short fit of the splats near them, together, with all others as they are."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.blocks.cells import EVERYWHERE, near_borders
from igsr.blocks.manifest import Manifest
from igsr.blocks.options import BlockOptions
from igsr.blocks.photo_parts import Box, boxes_of
from igsr.blocks.plan import BlockPlan
from igsr.blocks.tasks import SPLATS, BlockPart, FitTask, key_of, save_splats
from igsr.capture.exposure import Exposure
from igsr.fitting.fingerprint import hash_of
from igsr.fitting.fitter import splat_arrays
from igsr.splats import Splats

#: Splats within this part of a cell's sides of its border are fitted again.
BAND = 0.1
#: Steps of that fit, the last ones of a whole schedule.
STEPS = 400


def near_seams(plan: BlockPlan, splats: Splats) -> npt.NDArray[np.bool_]:
    """Which splats lie near a border between two cells, bool [N]."""
    places = plan.ground.places(splats.means.astype(np.float64) + splats.origin)
    return near_borders(plan.cells, places, BAND)


def mending_task(
    manifest: Manifest,
    plan: BlockPlan,
    joined: Splats,
    exposures: Mapping[str, Exposure],
    out: Path,
    options: BlockOptions,
) -> tuple[FitTask, dict[str, Any]] | None:
    """The task, which goes on from the joined scene, and its key; None where nothing lies there.

    It has the parts of photos that show what is near seams, as many pixels of them as the largest
    block has, and so takes no more memory.

    Raises:
        IgsrError: the joined scene cannot be written.
    """
    across = np.flatnonzero(plan.across & plan.photos.any(axis=1))
    near = near_seams(plan, joined)
    if not len(across) or not near.any() or near.all():
        return None
    boxes = _boxes(manifest, across, joined, near, options.backend)
    pixels, most = sum(box.part for box in boxes), plan.largest_part
    if pixels > most:
        some = max(1, int(len(across) * most / pixels))
        chosen = np.linspace(0, len(across) - 1, some).round().astype(np.int64)
        across, boxes = across[chosen], [boxes[index] for index in chosen]
    folder = out / "blocks" / "seams"
    scene = out / "blocks" / "joined" / SPLATS
    save_splats(scene, joined)
    shots = [manifest.shots[index] for index in across]
    settings: dict[str, Any] = {
        name: options.settings[name]
        for name in ("quality", "seed", "background")
        if name in options.settings
    }
    task = FitTask(
        name="seams",
        capture=manifest.path,
        folder=folder,
        shots=shots,
        marks=[manifest.marks[index] for index in across],
        max_size=options.max_size,
        settings={
            **settings,
            "steps": STEPS,
            "density": "fixed",
            "exposure": "off",
            "transients": "off",
            "remove_floaters": False,
            "coarse_to_fine": False,
        },
        backend=options.backend,
        exposures={shot.name: exposures[shot.name] for shot in shots if shot.name in exposures},
        boxes={shot.name: box for shot, box in zip(shots, boxes, strict=True)},
        block=BlockPart(
            scene=scene,
            ground=plan.ground,
            cell=EVERYWHERE,
            fitted=EVERYWHERE,
            cells=tuple(plan.cells),
            band=BAND,
        ),
    )
    return task, key_of(task, scene=hash_of(splat_arrays(joined).values()))


def _boxes(
    manifest: Manifest,
    photos: npt.NDArray[np.int64],
    joined: Splats,
    near: npt.NDArray[np.bool_],
    backend: str,
) -> list[Box]:
    """The parts of photos that show splats near seams."""
    cameras = [manifest.shots[index].camera for index in photos]
    every = np.ones((len(photos), 1), np.bool_)
    none = np.full(len(photos), -1)
    found = boxes_of(joined, cameras, near[:, None], every, none, backend)
    return [boxes[0] for boxes in found]
