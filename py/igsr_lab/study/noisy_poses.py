"""Noise on camera poses: fits with poses fixed and with joint poses, scored side by side.

Twenty train views of a NeRF-Synthetic scene get noise on their poses and are fitted with poses
fixed and joint, beside a fit with the true ones. Held-out views are scored in the three ways of
``igsr.fitting.pose_refinement``, never mixed.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr._internal.choices import FitBackend
from igsr._internal.resumable_jobs import Run, finished_runs
from igsr.capture import Capture, load_capture
from igsr.errors import IgsrError
from igsr.evaluation.scores import WHITE, evaluate
from igsr.fitting.fit_capture import fit_with_cameras
from igsr.fitting.pose_refinement import refine_cameras
from igsr.fitting.presets import preset_settings
from igsr.fitting.settings import Poses
from igsr.geometry.pose_errors import pose_errors
from igsr.geometry.similarity import similarity_between
from igsr_lab.camera_noise import AFFINE, MATRIX, TURN, Noise, noisy_view
from igsr_lab.study.markdown_table import markdown_table
from igsr_lab.study.study_files import headed, text_of, write_study_files

Float64 = npt.NDArray[np.float64]

VIEW_IDS = tuple(range(0, 100, 5))
SCORES = ("psnr", "ssim", "flip")
WAYS = ("raw", "aligned", "refined")
POSES: tuple[Poses, ...] = ("fixed", "joint")


CLEAN = Noise("clean", 0.0)


@dataclass(frozen=True)
class PoseFit:
    """One fit of the study; everything that its scores depend on."""

    scene: str
    noise: Noise
    poses: Poses
    seed: int
    backend: FitBackend


def run_fit(data: str, one: PoseFit) -> dict[str, Any]:
    """Fit and score; for a process of its own."""
    capture = load_capture(Path(data) / one.scene)
    train = capture.train_views
    if len(train) <= max(VIEW_IDS) or not capture.test_views:
        raise IgsrError(
            f"{capture.path} has {len(train)} train and {len(capture.test_views)} test views; the "
            f"protocol needs train view {max(VIEW_IDS)} and at least one test view."
        )
    true = [train[i] for i in VIEW_IDS]
    # Fixed and joint poses start from the same noise.
    random = np.random.default_rng([one.seed, 0x905E, *str(one.noise).encode()])
    noisy = [noisy_view(view, one.noise, random) for view in true]
    given = Capture(capture.path, noisy + capture.test_views, capture.points)
    seconds = 0.0

    def progress(now: Any) -> None:
        nonlocal seconds
        seconds = now.seconds

    splats, fitted = fit_with_cameras(
        given, backend=one.backend, seed=one.seed, poses=one.poses, progress=progress
    )
    true_cameras = [view.camera for view in true]
    cameras = [view.camera for view in fitted.train_views]
    to_fitted = similarity_between(true_cameras, cameras)
    aligned = [replace(v, camera=to_fitted.camera(v.camera)) for v in capture.test_views]
    refined = refine_cameras(splats, aligned, WHITE, backend=one.backend)
    row: dict[str, Any] = {
        "scene": one.scene,
        "noise": str(one.noise),
        "poses": one.poses,
        "seed": one.seed,
        "backend": one.backend,
        "before": pose_errors([view.camera for view in noisy], true_cameras),
        "after": pose_errors(cameras, true_cameras),
        "splats": len(splats),
        "seconds": round(seconds, 2),
    }
    for way, views in zip(WAYS, (capture.test_views, aligned, refined), strict=True):
        scores = evaluate(
            splats, Capture(capture.path, views, None), background=WHITE, backend=one.backend
        )
        row[way] = {name: scores[name] for name in SCORES}
        row["protocol"] = scores["protocol"]
    return row


def pose_noise(
    data: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    scenes: tuple[str, ...] = ("chair", "lego"),
    noise: float = 0.01,
    turns: tuple[float, ...] = (0.5, 2.0),
    raw_affine: bool = False,
    seeds: int = 3,
    backend: FitBackend = "cpu",
    jobs: int = 1,
    on_run: Callable[[int, int, dict[str, Any]], None] | None = None,
    ray: bool = False,
) -> dict[str, Any]:
    """Fit scenes whose cameras have noise, with poses fixed and joint, and write what they score.

    Args:
        data: folder that holds the scenes, each with ``transforms_train.json`` and
            ``transforms_test.json``.
        out: folder for ``study.json``, ``study.md``, ``study.png`` and ``runs/``, one file per fit;
            a fit whose file is there is not done again.
        scenes: names of folders in ``data``.
        noise: standard deviation of the noise on each number of camera-to-world, world units.
        turns: degrees of pure rotation, each a kind of noise of its own.
        raw_affine: also the noise that keeps its shear.
        seeds: how many seeds, from 0.
        backend: what fits and renders.
        jobs: fits at a time, each in a process of its own with its share of the cores.
        on_run: called with (done, all, the fit's row) after each fit.
        ray: fits run over a Ray cluster instead (``pip install 'igsr[ray]'``).

    Returns:
        What ``study.json`` holds: "summary", one row per noise and scene (and "mean" over scenes);
        "runs"; "protocol".

    Raises:
        IgsrError: a scene cannot be read, an argument cannot be used, or a fit fails.
    """
    if seeds < 1 or jobs < 1:
        raise IgsrError("seeds and jobs must be at least 1.")
    if not all(np.isfinite(size) and size > 0.0 for size in (noise, *turns)):
        raise IgsrError("noise and turns must be positive numbers.")
    for scene in scenes:
        if not (Path(data) / scene / "transforms_train.json").is_file():
            raise IgsrError(f"{Path(data) / scene} holds no transforms_train.json; name --scene.")
    kinds = [Noise(MATRIX, noise), *(Noise(TURN, degrees) for degrees in turns)]
    if raw_affine:
        kinds.append(Noise(AFFINE, noise))
    fits = [
        PoseFit(scene, kind, poses, seed, backend)
        for seed in range(seeds)
        for kind in (CLEAN, *kinds)
        for scene in scenes
        for poses in (POSES[:1] if kind == CLEAN else POSES)
    ]
    tasks = [
        Run(
            f"{one.scene}-{one.noise.kind}{one.noise.size:g}-{one.poses}-seed{one.seed}-{backend}",
            one,
            preset_settings("default", len(VIEW_IDS), poses=one.poses),
            scene=one.scene,
        )
        for one in fits
    ]
    rows = finished_runs(Path(out) / "runs", tasks, run_fit, str(data), jobs, on_run, ray)
    report = {
        "title": "NeRF Synthetic, 20 views with noise on their poses",
        "igsr": _core.__version__,
        "protocol": {
            "name": "pose-noise",
            "train_views": list(VIEW_IDS),
            "seeds": seeds,
            "aligned": "test cameras moved by the similarity from true to fitted train cameras",
            "refined": "aligned, then each test camera fitted to its photo, splats frozen",
            **rows[0]["protocol"],
        },
        "summary": [
            compared(rows, str(kind), scene) for kind in kinds for scene in (*scenes, "mean")
        ],
        "runs": rows,
    }
    write_study_files(Path(out), report, markdown(report))
    _plot(Path(out) / "study.png", report)
    return report


def compared(rows: list[dict[str, Any]], noise: str, scene: str) -> dict[str, Any]:
    """One line of the table: means over seeds (and scenes, for "mean").

    "recovered" is the part of the dB lost to noise, both scored aligned, that joint poses bring
    back; "short_of_clean" the dB between clean and joint, both scored refined.
    """
    mine = [row for row in rows if scene in ("mean", row["scene"])]
    sets: dict[str, list[dict[str, Any]]] = {
        "clean": [row for row in mine if row["noise"] == str(CLEAN)],
        **{
            poses: [row for row in mine if (row["noise"], row["poses"]) == (noise, poses)]
            for poses in POSES
        },
    }
    line: dict[str, Any] = {"noise": noise, "scene": scene}
    for name, chosen in sets.items():
        line[name] = {
            way: {score: float(np.mean([row[way][score] for row in chosen])) for score in SCORES}
            for way in WAYS
        }
        line[name]["psnr_spread"] = _spread(chosen)
    joint = sets["joint"]
    for error in ("rotation", "centre"):
        before = float(np.mean([row["before"][error] for row in joint]))
        after = float(np.mean([row["after"][error] for row in joint]))
        line[error] = {"before": before, "after": after}
    lost = line["clean"]["aligned"]["psnr"] - line["fixed"]["aligned"]["psnr"]
    back = line["joint"]["aligned"]["psnr"] - line["fixed"]["aligned"]["psnr"]
    line["recovered"] = back / lost if lost > 0.0 else None
    line["short_of_clean"] = line["clean"]["refined"]["psnr"] - line["joint"]["refined"]["psnr"]
    return line


def _spread(rows: list[dict[str, Any]]) -> float | None:
    """Standard deviation over seeds of the refined PSNR, each seed's rows averaged first."""
    seeds = sorted({row["seed"] for row in rows})
    means = [np.mean([r["refined"]["psnr"] for r in rows if r["seed"] == seed]) for seed in seeds]
    return float(np.std(means, ddof=1)) if len(means) > 1 else None


def markdown(report: dict[str, Any]) -> str:
    """``study.md``: one line per noise and scene, then the means over scenes."""
    fits = ("fixed", "joint", "clean")
    rows = [
        [
            line["noise"],
            line["scene"],
            *(_psnrs(line[name]) for name in fits),
            "-" if line["recovered"] is None else f"{100 * line['recovered']:.0f} %",
            f"{line['short_of_clean']:.2f}",
            *(
                f"{before:.{digits}f} → {after:.{digits}f} ({before / after:.1f} ×)"
                for error, digits in (("rotation", 3), ("centre", 4))
                for before, after in [(line[error]["before"], line[error]["after"])]
            ),
        ]
        for line in report["summary"]
    ]
    heads = ["noise", "scene", *fits, "recovered", "short of clean"]
    heads += ["rotation, degrees", "centre, world units"]
    note = "PSNR in dB, raw / aligned / refined."
    return text_of([*headed(report), note, "", *markdown_table(heads, rows, left=2)])


def _psnrs(scores: dict[str, Any]) -> str:
    spread = scores["psnr_spread"]
    psnrs = " / ".join(f"{scores[way]['psnr']:.2f}" for way in WAYS)
    return psnrs + ("" if spread is None else f" ± {spread:.2f}")


def _plot(path: Path, report: dict[str, Any]) -> None:
    """PSNR by noise and way of scoring, means over scenes."""
    from matplotlib.figure import Figure

    lines = [line for line in report["summary"] if line["scene"] == "mean"]
    figure = Figure(figsize=(2.0 + 2.2 * len(lines), 4.0), layout="constrained")
    axis = figure.subplots()
    markers = {"raw": "v", "aligned": "o", "refined": "^"}
    for k, name in enumerate(("fixed", "joint", "clean")):
        for w, way in enumerate(WAYS):
            at = [i + 0.28 * (k - 1) + 0.07 * (w - 1) for i in range(len(lines))]
            axis.plot(
                at,
                [line[name][way]["psnr"] for line in lines],
                markers[way],
                color=f"C{k}",
                label=f"{name}, {way}",
            )
    axis.set_xticks(range(len(lines)), [line["noise"] for line in lines])
    axis.set_ylabel("PSNR of held-out views, dB")
    axis.set_title(report["title"], fontsize=10)
    axis.grid(alpha=0.3, axis="y")
    axis.legend(fontsize=8, ncols=3)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
