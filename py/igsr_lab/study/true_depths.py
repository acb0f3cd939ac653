"""``depths``: depth maps by stereo, compared with the true ones of synthetic captures."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr.capture import View, load_capture
from igsr.fitting.initialization.depth_maps import MAX_SIDE_PX, depth_maps
from igsr.fitting.initialization.photo_pixels import (
    pixel_rays,
    project,
    reduced,
    to_world,
    usable_pixels,
)
from igsr_lab.report_parts import cell, markdown_table
from igsr_lab.resumable_jobs import Run
from igsr_lab.study.study import Row, Study

Float32 = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]

#: Maximum relative error of a right depth, and of one that shows the same surface.
RIGHT = 0.01
#: Columns of the table with their formats.
COLUMNS = {"photos": "d", "right": ".3f", "covered": ".3f", "confirmed": "d", "seconds": ".1f"}
COLUMNS_TEXT = (
    "right is the fraction of confirmed pixels within 1 % of the true depth; covered the fraction "
    "of the pixels that at least two photos see that are confirmed."
)


@dataclass(frozen=True)
class DepthRun:
    """The depth maps of a capture."""

    scene: str


def depths(study: Study, *, scenes: tuple[str, ...] = ("scene_00000", "scene_00001")) -> Row:
    """Compare depth maps by stereo with the true ones.

    Args:
        study: its data has captures of ``synth``; the number of seeds does not matter.
        scenes: names of folders in the data.

    Returns:
        The content of ``study.json``: "runs", a row per scene, and "protocol".
    """
    study.check_scenes(scenes, "transforms_train.json")
    runs = [Run(scene.replace("/", "-"), DepthRun(scene), {}, scene=scene) for scene in scenes]
    report = {
        "title": "Depth maps by stereo",
        "protocol": {"name": "depths", "max_side_px": MAX_SIDE_PX, "right": RIGHT},
        "runs": study.rows(runs, run_depths),
    }
    return study.write(report, table_lines)


def run_depths(data: str, run: DepthRun) -> Row:
    """Make the depth maps of a capture and compare them; return the row."""
    folder = Path(data) / run.scene
    views = load_capture(folder).train_views
    started = time.monotonic()
    maps = {one.view.name: one.depth for one in depth_maps(views)}
    row: Row = {**vars(run), "seconds": round(time.monotonic() - started, 2)}
    small = [reduced(view, MAX_SIDE_PX) for view in views]
    true = [_true_depth(folder, view) for view in small]
    confirmed = right = seen = covered = 0
    for k, view in enumerate(small):
        found = maps.get(view.name, np.zeros_like(true[k]))
        both = (found > 0.0) & (true[k] > 0.0) & usable_pixels(view)
        confirmed += int(both.sum())
        right += int((np.abs(found[both] / true[k][both] - 1.0) <= RIGHT).sum())
        of_two = _seen_by_two(small, true, k) & usable_pixels(view)
        seen += int(of_two.sum())
        covered += int((of_two & (found > 0.0)).sum())
    row.update(photos=len(views), confirmed=confirmed)
    row["right"] = right / confirmed if confirmed else None
    row["covered"] = covered / seen if seen else None
    return row


def _true_depth(folder: Path, view: View) -> Float32:
    """The true depth at the centers of a photo's pixels, 0 for none."""
    depth = np.load(folder / "depth" / Path(view.name).with_suffix(".npy"))
    indices = [
        ((np.arange(count) + 0.5) * of / count).astype(np.int64)
        for count, of in zip((view.camera.height, view.camera.width), depth.shape, strict=True)
    ]
    return np.asarray(np.nan_to_num(depth[np.ix_(*indices)]), dtype=np.float32)


def _seen_by_two(views: list[View], true: list[Float32], k: int) -> Bool:
    """Pixels [H, W] of photo ``k`` whose surface another photo sees."""
    rows, columns = np.nonzero(true[k])
    rays = pixel_rays(views[k].camera, columns, rows)
    world = to_world(views[k].camera, rays * true[k][rows, columns, None])
    seen = np.zeros(len(rows), dtype=np.bool_)
    for other, view in enumerate(views):
        row, column, depth, inside = project(view.camera, world)
        same = np.abs(true[other][row, column] / depth - 1.0) < RIGHT
        seen |= inside & same & (other != k)
    out = np.zeros(true[k].shape, dtype=np.bool_)
    out[rows, columns] = seen
    return out


def table_lines(report: Row) -> list[str]:
    """One line per scene."""
    rows = [
        [row["scene"], *(cell(row[name], form) for name, form in COLUMNS.items())]
        for row in report["runs"]
    ]
    return [COLUMNS_TEXT, "", *markdown_table(["scene", *COLUMNS], rows, left=1)]
