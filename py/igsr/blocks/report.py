"""``report.json`` and ``report.html`` of a fit in blocks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from igsr import _core
from igsr._internal.choices import Split
from igsr.blocks.manifest import Manifest
from igsr.blocks.plan import BlockPlan
from igsr.blocks.tasks import Context, block_name
from igsr.capture import Capture
from igsr.evaluation.quick_scores import MAX_TRAIN_PHOTOS
from igsr.evaluation.report_page import (
    ADDED,
    PHOTO,
    drawn_cameras,
    number,
    part_rows,
    photos_and_renders,
    scene_frame,
    write_template,
)
from igsr.evaluation.scores import METRICS, ScoredView, default_background, evaluate
from igsr.rendering.scene_page import PageCamera, PageModel
from igsr.splats import Splats

#: Maximum number of photos on the page, and of cameras.
MAX_PAGE_PHOTOS = 6
MAX_PAGE_CAMERAS = 500
#: Fields of rows that the report leaves out.
OMITTED_FIELDS = ("across", "exposures", "key", "name")


def score_photos(
    context: Context, plan: BlockPlan, splats: Splats
) -> tuple[dict[str, Any], list[ScoredView]]:
    """Score held-out photos, or some train photos if none is held out; for report and page."""
    options, manifest = context.options, context.manifest
    split: Split = "test" if manifest.of_split("test") else "train"
    photos = manifest.of_split(split)
    count = len(photos)
    if split == "train":
        photos = _evenly_spaced(photos, MAX_TRAIN_PHOTOS)
    across = [index for index in photos if plan.across[index]]
    page_names = context.names(_evenly_spaced(across or photos, MAX_PAGE_PHOTOS))
    page_views: list[ScoredView] = []

    def keep_for_page(scored: ScoredView) -> None:
        if scored.name in page_names:
            page_views.append(scored)

    rows: list[dict[str, Any]] = []
    protocol: dict[str, Any] = {}
    for views in context.loaded(photos):
        views = [replace(view, exposure=context.exposures.get(view.name)) for view in views]
        capture = Capture(manifest.path, views)
        background = options.background or default_background(capture)
        scores = evaluate(splats, capture, split, background, options.backend, keep_for_page)
        rows += [dict(row) for row in scores.views]
        protocol = dict(scores.protocol)
    protocol |= {"views": len(rows), "holdout": options.holdout}
    if len(rows) < count:
        protocol["of"] = count
    across_names = set(context.names(across))
    for row in rows:
        row["across"] = row["name"] in across_names
    rows_across = [row for row in rows if row["across"]]
    report = {
        **_means(rows),
        "across_seams": {"photos": len(rows_across), **_means(rows_across)},
        "protocol": protocol,
        "views": rows,
    }
    return report, page_views


def _evenly_spaced(indices: Sequence[int], count: int) -> list[int]:
    chosen = np.linspace(0, len(indices) - 1, min(count, len(indices))).round()
    return [indices[int(index)] for index in chosen]


def _means(rows: list[dict[str, Any]]) -> dict[str, float | None]:
    known = {name: [row[name] for row in rows if row[name] is not None] for name in METRICS}
    return {name: float(np.mean(values)) if values else None for name, values in known.items()}


def block_report(
    context: Context,
    plan: BlockPlan,
    coarse: Mapping[str, Any],
    rows: Sequence[Mapping[str, Any]],
    splats: Splats,
) -> dict[str, Any]:
    """The report, from the rows of the coarse fit and of the blocks, without scores."""
    options, row_of = context.options, {row["name"]: row for row in rows}
    blocks = []
    for index, cell in enumerate(plan.grid.cells):
        name = block_name(index)
        blocks.append(
            {
                "name": name,
                **cell.plain(),
                "photos": int(plan.photos[:, index].sum()),
                "fitted": name in row_of,
                **_reported_fields(row_of.get(name, {})),
            }
        )
    peaks = [row["peak_memory_bytes"] for row in rows if row["peak_memory_bytes"]]
    return {
        "capture": str(context.manifest.path),
        "splats": len(splats),
        "coarse": _reported_fields(coarse),
        "blocks": blocks,
        "background_splats": len(splats) - sum(row["splats"] for row in rows),
        "peak_memory_bytes": max(peaks, default=None),
        "ground": plan.grid.axes.tolist(),
        "photos": {
            "given": len(plan.photos),
            "train": int(plan.photos.any(axis=1).sum()),
            "across_seams": int(plan.across.sum()),
        },
        "hosts": sorted({row["host"] for row in rows}),
        **_core.backend_info(options.backend),
        "version": _core.__version__,
        "settings": {
            **options.settings,
            "blocks": options.blocks,
            "holdout": options.holdout,
            "max_size": options.max_size,
        },
    }


def _reported_fields(row: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in row.items() if name not in OMITTED_FIELDS}


def write_block_page(
    path: Path,
    report: Mapping[str, Any],
    manifest: Manifest,
    splats: Splats,
    views: Sequence[ScoredView],
) -> None:
    """Write ``report.html``, a single file that shows the scene and some scored views."""
    cameras = {
        split: [
            PageCamera(manifest.shots[index].name, manifest.shots[index].camera)
            for index in _evenly_spaced(manifest.of_split(split), MAX_PAGE_CAMERAS)
        ]
        for split in ("train", "test")
    }
    train, test = ([camera.camera for camera in of_split] for of_split in cameras.values())
    held_out = report["protocol"]["split"] == "test"
    background = report["protocol"]["background"]
    capture = Path(report["capture"]).resolve()
    name = (capture.parent.name if capture.name == "images" else capture.name) or "photos"
    text = "Held-out photos" if held_out else "Fitted photos; none is held out"
    across = report["across_seams"]
    views_label = f"{report['protocol']['views']} {'held out' if held_out else 'fitted'}"
    score_rows = [_score_row(views_label, report)]
    if across["photos"]:
        text += ", across borders"
        score_rows.append(_score_row(f"{across['photos']} of them across borders", across))
    variables = {
        **report,
        "name": name,
        "limit": None,
        "scene": scene_frame([PageModel(name, splats)], cameras["train"], background, name),
        "score_rows": score_rows,
        "held_out": bool(test),
        "pictures_text": f"{text}.",
        "pictures": photos_and_renders(views),
        "cameras": drawn_cameras([(PHOTO, train), (ADDED, test)], train),
        "not_placed": [],
        "parts": part_rows(report["parts"], {}),
        "peak_memory": report["peak_memory_bytes"],
        "backend": f"{report['backend']} ({report['instruction_set']})",
        "seed": report["settings"].get("seed", 0),
    }
    write_template(path, Path(__file__).with_name("templates"), "blocks.html.jinja", variables)


def _score_row(label: str, scores: Mapping[str, Any]) -> dict[str, str]:
    digits = {"psnr": 2, "ssim": 4, "ms_ssim": 4, "flip": 4}
    values = {name: number(scores.get(name), places) for name, places in digits.items()}
    return {"label": label, **values}
