"""Cameras found in photos against cameras that were measured: how many, and how right."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from igsr import _core
from igsr._internal.resumable_jobs import Run, finished_runs
from igsr.capture import Camera, load_capture
from igsr.capture.load import holds_cameras
from igsr.capture.photo_folder import Photo, load_photos
from igsr.errors import IgsrError
from igsr.geometry.pose_errors import pose_accuracy
from igsr.pose.registry import ESTIMATORS
from igsr_lab.study.markdown_table import cell, markdown_table
from igsr_lab.study.study_files import headed, text_of, write_study_files

SCENES = (
    "strecha_fountain",
    "strecha_herzjesu",
    "sceaux",
    "fox",
    "unposed/robot",
    "unposed/espresso",
)
#: Columns of the table, with their formats; what a scene without cameras does not have is "-".
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


@dataclass(frozen=True)
class PoseRun:
    """One estimate of the study; everything that its figures depend on."""

    scene: str
    estimator: str
    seed: int


def run_estimate(data: str, one: PoseRun) -> dict[str, Any]:
    """Find the cameras of a scene and compare them; for a process of its own.

    "focal" is the mean relative error of the focal lengths, with its sign.
    """
    photos, true = _photos(Path(data) / one.scene)
    started = time.monotonic()
    found = ESTIMATORS[one.estimator].make()(photos, seed=one.seed)
    row: dict[str, Any] = {**vars(one), "seconds": round(time.monotonic() - started, 2)}
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
        return load_photos(path), None
    views = load_capture(path).views
    return [Photo(v.name, v.image, v.mask) for v in views], [v.camera for v in views]


def poses(
    data: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    scenes: tuple[str, ...] = SCENES,
    estimator: str = "colmap",
    seeds: int = 1,
    jobs: int = 1,
    on_run: Callable[[int, int, dict[str, Any]], None] | None = None,
    ray: bool = False,
) -> dict[str, Any]:
    """Find the cameras of scenes from their photos alone and compare them with the true ones.

    Args:
        data: folder that holds the scenes: captures, whose cameras are hidden, or plain folders of
            photos, of which only the number placed is told.
        out: folder for ``study.json``, ``study.md`` and ``runs/``, one file per estimate; an
            estimate whose file is there is not made again.
        scenes: names of folders in ``data``.
        estimator: a name of ``igsr.pose.registry``.
        seeds: how many seeds, from 0.
        jobs: estimates at a time, each in a process of its own with its share of the cores.
        on_run: called with (done, all, the estimate's row) after each estimate.
        ray: estimates run over a Ray cluster instead (``pip install 'igsr[ray]'``).

    Returns:
        What ``study.json`` holds: "runs", a row per scene and seed (see
        ``igsr.geometry.pose_errors``), and "protocol".

    Raises:
        IgsrError: a scene cannot be read, or an argument cannot be used.
    """
    if seeds < 1 or jobs < 1:
        raise IgsrError("seeds and jobs must be at least 1.")
    if estimator not in ESTIMATORS:
        raise IgsrError(f"estimator must be {' or '.join(ESTIMATORS)}, not {estimator!r}.")
    for scene in scenes:
        if not (Path(data) / scene).is_dir():
            raise IgsrError(f"{Path(data) / scene} does not exist; name --scene.")
    tasks = [
        Run(
            f"{scene.replace('/', '-')}-{estimator}-seed{seed}",
            PoseRun(scene, estimator, seed),
            {},
            scene=scene,
        )
        for seed in range(seeds)
        for scene in scenes
    ]
    rows = finished_runs(Path(out) / "runs", tasks, run_estimate, str(data), jobs, on_run, ray)
    report = {
        "title": "Cameras found in photos",
        "igsr": _core.__version__,
        "protocol": {"name": "poses", "estimator": estimator, "seeds": seeds},
        "runs": rows,
    }
    write_study_files(Path(out), report, markdown(report))
    return report


def markdown(report: dict[str, Any]) -> str:
    """``study.md``: one line per scene and seed."""
    rows = [
        [row["scene"], row["seed"], *(cell(row.get(name), form) for name, form in COLUMNS.items())]
        for row in report["runs"]
    ]
    heads = ["scene", "seed", *(name.replace("_", " ") for name in COLUMNS)]
    return text_of(
        [
            *headed(report),
            "RRA, RTA and mAA are parts of all pairs of photos, those not registered included; "
            "rotation is in degrees, ATE in units of the true world and relative to the cameras' "
            "spread, focal the relative error.",
            "",
            *markdown_table(heads, rows, left=1),
        ]
    )
