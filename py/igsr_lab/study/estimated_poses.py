"""``poses``: cameras found from photos, compared with measured ones."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from igsr.cameras.registry import ESTIMATORS
from igsr.capture import Camera, load_capture
from igsr.capture.load import holds_cameras
from igsr.capture.photo_folder import Photo, read_photos
from igsr.errors import IgsrError
from igsr.geometry.pose_errors import pose_accuracy
from igsr_lab.report_parts import cell, markdown_table
from igsr_lab.resumable_jobs import Run
from igsr_lab.study.study import Row, Study

SCENES = (
    "strecha_fountain",
    "strecha_herzjesu",
    "sceaux",
    "fox",
    "unposed/robot",
    "unposed/espresso",
)
#: Columns of the table with their formats.
COLUMNS = {
    "photos": "d",
    "registered": "d",
    "RRA@5": ".3f",
    "RTA@5": ".3f",
    "RRA@15": ".3f",
    "RTA@15": ".3f",
    "mAA@30": ".3f",
    "rotation": ".3f",
    "ATE": ".4g",
    "ATE_relative": ".4f",
    "focal": ".4f",
    "seconds": ".0f",
}
COLUMNS_TEXT = (
    "RRA, RTA and mAA are fractions of all pairs of photos, including those not registered; "
    "rotation is in degrees, ATE in units of the true world and relative to the cameras' spread, "
    "focal the relative error."
)


@dataclass(frozen=True)
class PoseRun:
    """One estimate; its figures depend on nothing else."""

    scene: str
    estimator: str
    seed: int


def poses(study: Study, *, scenes: tuple[str, ...] = SCENES, estimator: str = "colmap") -> Row:
    """Find the cameras of scenes from their photos and compare them with the true ones.

    Args:
        study: its data has captures, whose cameras are hidden, or folders of photos, of which only
            the number of placed photos is reported.
        scenes: names of folders in the data.
        estimator: a name of ``igsr.cameras.registry.ESTIMATORS``.

    Returns:
        The content of ``study.json``: "runs", a row per scene and seed (see
        ``igsr.geometry.pose_errors``), and "protocol".
    """
    if estimator not in ESTIMATORS:
        raise IgsrError(f"estimator must be {' or '.join(ESTIMATORS)}, not {estimator!r}.")
    study.check_scenes(scenes)
    runs = [
        Run(
            f"{scene.replace('/', '-')}-{estimator}-seed{seed}",
            PoseRun(scene, estimator, seed),
            {},
            scene=scene,
        )
        for seed in range(study.seeds)
        for scene in scenes
    ]
    rows = study.rows(runs, run_estimate)
    report = {
        "title": "Cameras found from photos",
        "protocol": {"name": "poses", "estimator": estimator, "seeds": study.seeds},
        "runs": rows,
    }
    return study.write(report, table_lines)


def run_estimate(data: str, run: PoseRun) -> Row:
    """Find the cameras of a scene and compare them; return the row.

    "focal" is the mean relative error of the focal lengths, with its sign.
    """
    photos, true = _photos(Path(data) / run.scene)
    started = time.monotonic()
    found = ESTIMATORS[run.estimator].make()(photos, seed=run.seed)
    row: Row = {**vars(run), "seconds": round(time.monotonic() - started, 2)}
    placed = [camera is not None for camera in found.cameras]
    row.update(photos=len(photos), registered=sum(placed), warnings=found.warnings)
    row["not_placed"] = [p.name for p, there in zip(photos, placed, strict=True) if not there]
    row["points"] = 0 if found.points is None else len(found.points.xyz)
    if true is not None:
        row.update(pose_accuracy(found.cameras, true))
        ratios = [
            camera.K[0, 0] / other.K[0, 0] - 1.0
            for camera, other in zip(found.cameras, true, strict=True)
            if camera is not None
        ]
        row["focal"] = float(sum(ratios) / len(ratios)) if ratios else None
    return row


def _photos(path: Path) -> tuple[list[Photo], list[Camera] | None]:
    if not holds_cameras(path):
        return read_photos(path), None
    views = load_capture(path).views
    return [Photo(v.name, v.image, v.mask) for v in views], [v.camera for v in views]


def table_lines(report: Row) -> list[str]:
    """One line per scene and seed."""
    rows = [
        [row["scene"], row["seed"], *(cell(row.get(name), form) for name, form in COLUMNS.items())]
        for row in report["runs"]
    ]
    heads = ["scene", "seed", *(name.replace("_", " ") for name in COLUMNS)]
    return [COLUMNS_TEXT, "", *markdown_table(heads, rows, left=1)]
