"""What ``igsr fit --blocks`` reports: each block, seams, and scores of held-out photos."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from igsr import _core
from igsr._internal.choices import Backend
from igsr.blocks.manifest import Manifest
from igsr.blocks.options import BlockOptions
from igsr.blocks.plan import BlockPlan
from igsr.blocks.seams import loaded_in_parts
from igsr.blocks.task_making import name_of
from igsr.capture import Capture
from igsr.capture.exposure import Exposure
from igsr.evaluation.quick_scores import MAX_TRAIN_PHOTOS
from igsr.evaluation.scores import METRICS, default_background, evaluate
from igsr.splats import Splats


def held_out_scores(
    manifest: Manifest,
    plan: BlockPlan,
    splats: Splats,
    exposures: Mapping[str, Exposure],
    options: BlockOptions,
) -> dict[str, Any]:
    """Mean scores of held-out photos, and of those of them across seams; a few in memory at a time.

    Where none is held out, of some fitted photos.
    """
    split = "test" if manifest.of_split("test") else "train"
    photos = manifest.of_split(split)
    count = len(photos)
    if split == "train" and count > MAX_TRAIN_PHOTOS:
        photos = [photos[int(i)] for i in np.linspace(0, count - 1, MAX_TRAIN_PHOTOS).round()]
    across = {manifest.shots[index].name for index in photos if plan.across[index]}
    rows: list[dict[str, Any]] = []
    protocol: dict[str, Any] = {}
    for views in loaded_in_parts(manifest, photos, options.max_size, exposures, as_taken=True):
        capture = Capture(manifest.path, views)
        color = options.background or default_background(capture)
        backend = cast(Backend, options.backend)
        scores = evaluate(splats, capture, cast(Any, split), color, backend)
        rows += [dict(row) for row in scores.views]
        protocol = dict(scores.protocol)
    protocol |= {"views": len(rows), "holdout": options.holdout}
    if len(rows) < count:
        protocol["of"] = count
    for row in rows:
        row["across"] = row["name"] in across
    crossing = [row for row in rows if row["across"]]
    return {
        **_means(rows),
        "across_seams": {"photos": len(crossing), **_means(crossing)},
        "protocol": protocol,
        "views": rows,
    }


def _means(rows: list[dict[str, Any]]) -> dict[str, float | None]:
    """The mean of each score over the photos that have it."""
    known = {name: [row[name] for row in rows if row[name] is not None] for name in METRICS}
    return {name: float(np.mean(values)) if values else None for name, values in known.items()}


def block_report(
    path: Path,
    options: BlockOptions,
    plan: BlockPlan,
    coarse: Mapping[str, Any],
    rows: Mapping[str, Mapping[str, Any]],
    splats: Splats,
) -> dict[str, Any]:
    """What is known of the blocks, as ``report.json`` has it.

    Args:
        path: the capture.
        options: of the run.
        plan: the split.
        coarse: the row of the coarse fit.
        rows: those of the blocks that were fitted, by name.
        splats: the joined scene.
    """
    blocks = []
    for index, cell in enumerate(plan.plain()):
        name = name_of(index)
        row = {key: value for key, value in rows.get(name, {}).items() if key not in _NOT_TOLD}
        blocks.append({"name": name, **cell, "fitted": name in rows, **row})
    peaks = [row["peak_memory_bytes"] for row in rows.values() if row["peak_memory_bytes"]]
    return {
        "capture": str(path),
        "splats": len(splats),
        "coarse": {key: value for key, value in coarse.items() if key not in _NOT_TOLD},
        "blocks": blocks,
        "peak_memory_bytes": max(peaks, default=None),
        "ground": plan.ground.axes.tolist(),
        "photos": {
            "given": len(plan.photos),
            "train": int(plan.photos.any(axis=1).sum()),
            "across_seams": int(plan.across.sum()),
        },
        "hosts": sorted({row["host"] for row in rows.values()}),
        **_core.backend_info(options.backend),
        "version": _core.__version__,
        "settings": {
            **options.settings,
            "blocks": options.blocks,
            "holdout": options.holdout,
            "max_size": options.max_size,
        },
    }


_NOT_TOLD = ("settings", "across", "exposures", "igsr", "name")
