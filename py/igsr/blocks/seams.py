"""Seams between blocks: whether they are visible, and a fit of the splats near them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from igsr.blocks.crops import cropped
from igsr.blocks.plan import BlockPlan
from igsr.blocks.tasks import SPLATS_FILE, Context, FitTask, Region, load_splats, save_splats
from igsr.blocks.visibility import visible_boxes
from igsr.evaluation.scores import BLACK, WHITE, score_views
from igsr.fitting.fingerprint import hash_of
from igsr.fitting.fitter import splat_arrays, without_exposures
from igsr.splats import Splats, joined, subset

#: Seams are visible if photos across them lose more than this by joining (mean PSNR, dB).
VISIBLE_LOSS_DB = 0.2
#: Steps of a seam fit, the last ones of a schedule.
SEAM_FIT_STEPS = 400


def seam_scores(
    context: Context, splats: Splats, tasks: Sequence[FitTask], rows: Sequence[Mapping[str, Any]]
) -> dict[str, Any] | None:
    """Mean PSNR in dB of the blocks' crops across seams, by the joined scene and by blocks alone.

    None if no photo shows a seam.
    """
    alone = {
        (task.name, name): psnr
        for task, row in zip(tasks, rows, strict=True)
        for name, psnr in row["across"].items()
    }
    if not alone:
        return None
    names = {name for _, name in alone}
    photos = [i for i, shot in enumerate(context.manifest.shots) if shot.name in names]
    has_alpha = context.manifest.has_alpha(photos)
    background = context.options.background or (WHITE if has_alpha else BLACK)
    in_joined = {}
    for views in context.loaded(photos):
        for task in tasks:
            some = [view for view in views if (task.name, view.name) in alone]
            crops = [cropped(view, task.boxes[view.name]) for view in some]
            crops = without_exposures(crops, [task.exposures.get(view.name) for view in some])
            for scored in score_views(splats, crops, background, task.backend, ("psnr",)):
                in_joined[task.name, scored.name] = scored.scores["psnr"] or 0.0
    psnr_alone = float(np.mean(list(alone.values())))
    psnr_joined = float(np.mean([in_joined[key] for key in alone]))
    return {
        "photos": len(names),
        "parts": len(alone),
        "psnr_joined": round(psnr_joined, 3),
        "psnr_alone": round(psnr_alone, 3),
        "loss_db": round(psnr_alone - psnr_joined, 3),
        "visible": psnr_alone - psnr_joined > VISIBLE_LOSS_DB,
    }


def seam_task(context: Context, plan: BlockPlan, splats: Splats) -> FitTask | None:
    """Make a short fit of the splats near seams; None if no photo shows any.

    It is not larger than the largest block, so that it needs no more memory.
    """
    scene = context.out / "blocks" / "joined" / SPLATS_FILE
    scene_hash = hash_of(splat_arrays(splats).values())
    region = Region(scene, scene_hash, plan.grid, None)
    near = region.trainable(splats)
    photos: list[int] = np.flatnonzero(plan.across & plan.photos.any(axis=1)).tolist()
    if not photos or not near.any() or near.all():
        return None
    found = visible_boxes(
        splats,
        [context.manifest.shots[index].camera for index in photos],
        near[:, None],
        wanted=np.ones((len(photos), 1), np.bool_),
        background_groups=np.full(len(photos), -1),
        backend=context.options.backend,
    )
    boxes = [by_group[0] for by_group in found]
    area = sum(box.area for box in boxes)
    if area > plan.largest_area:
        count = max(1, int(len(photos) * plan.largest_area / area))
        chosen = np.linspace(0, len(photos) - 1, count).round().astype(np.int64)
        photos = [photos[index] for index in chosen]
        boxes = [boxes[index] for index in chosen]
    save_splats(scene, splats)
    kept = ("quality", "seed", "background")
    settings = {k: v for k, v in context.options.settings.items() if k in kept}
    settings |= {
        "steps": SEAM_FIT_STEPS,
        "density": "fixed",
        "exposure": "off",
        "transients": "off",
        "remove_floaters": False,
        "coarse_to_fine": False,
    }
    by_name = dict(zip(context.names(photos), boxes, strict=True))
    return context.task("seams", photos, by_name, settings=settings, region=region)


def with_seam_fit(splats: Splats, task: FitTask) -> Splats:
    """The scene with its splats near seams replaced by the fitted ones."""
    assert task.region is not None
    near = task.region.trainable(splats)
    return joined([subset(splats, ~near), load_splats(task.folder / SPLATS_FILE)])
