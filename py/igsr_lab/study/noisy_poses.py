"""``pose_noise``: fits with noise on their cameras, with poses fixed or optimized jointly.

Held-out views are scored in the three ways of ``igsr.fitting.pose_refinement``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from igsr._internal.choices import FitBackend
from igsr.capture import Capture, load_capture
from igsr.errors import IgsrError
from igsr.evaluation.scores import WHITE, evaluate
from igsr.fitting.fit_capture import fit_capture
from igsr.fitting.pose_refinement import refine_cameras
from igsr.fitting.settings import Poses
from igsr.geometry.pose_errors import pose_errors
from igsr_lab.camera_noise import AFFINE, MATRIX, TURN, Noise, noisy_view
from igsr_lab.presets import preset_settings
from igsr_lab.report_parts import markdown_table, new_figure, save_figure
from igsr_lab.resumable_jobs import Run
from igsr_lab.study.preset_fits import REFINED
from igsr_lab.study.scoring import aligned_views
from igsr_lab.study.study import Row, Study, deviation, seed_means, with_spread

#: Indices into the train split.
VIEW_IDS = tuple(range(0, 100, 5))
SCORES = ("psnr", "ssim", "flip")
WAYS = ("raw", "aligned", "refined")
POSES: tuple[Poses, ...] = ("fixed", "joint")
#: Columns of fits in the table, and lines of the plot.
FITS = ("fixed", "joint", "clean")
CLEAN = Noise("clean", 0.0)
#: Errors of ``pose_errors``, with their headings and decimals.
ERRORS = {"rotation": ("rotation, degrees", 3), "center": ("center, world units", 4)}


@dataclass(frozen=True)
class PoseFit:
    """One fit; its scores depend on nothing else."""

    scene: str
    noise: Noise
    poses: Poses
    seed: int
    backend: FitBackend


def pose_noise(
    study: Study,
    *,
    scenes: tuple[str, ...] = ("chair", "lego"),
    noise: float = 0.01,
    turns: tuple[float, ...] = (0.5, 2.0),
    raw_affine: bool = False,
) -> Row:
    """Fit 20 views of NeRF Synthetic with noise on their cameras.

    Args:
        study: its data has ``transforms_train.json`` and ``transforms_test.json`` per scene.
        scenes: names of folders in the data.
        noise: standard deviation of the noise on the entries of camera-to-world, world units.
        turns: pure rotations, degrees; each is a kind of noise.
        raw_affine: also fit with noise whose shear is kept.

    Returns:
        The content of ``study.json``: "summary", a row per noise and scene (and "mean" over
        scenes); "runs"; "protocol".
    """
    if not all(np.isfinite(size) and size > 0.0 for size in (noise, *turns)):
        raise IgsrError("noise and turns must be positive numbers.")
    study.check_scenes(scenes, "transforms_train.json")
    kinds = [Noise(MATRIX, noise), *(Noise(TURN, degrees) for degrees in turns)]
    if raw_affine:
        kinds.append(Noise(AFFINE, noise))
    fits = [
        PoseFit(scene, kind, poses, seed, study.backend)
        for seed in range(study.seeds)
        for kind in (CLEAN, *kinds)
        for scene in scenes
        for poses in (POSES[:1] if kind == CLEAN else POSES)
    ]
    runs = [
        Run(
            f"{fit.scene}-{fit.noise.kind}{fit.noise.size:g}-{fit.poses}-seed{fit.seed}-"
            f"{fit.backend}",
            fit,
            preset_settings("default", len(VIEW_IDS), poses=fit.poses),
            scene=fit.scene,
        )
        for fit in fits
    ]
    rows = study.rows(runs, run_fit)
    report = {
        "title": "NeRF Synthetic, 20 views with noise on their poses",
        "protocol": {
            "name": "pose-noise",
            "train_views": list(VIEW_IDS),
            "seeds": study.seeds,
            "aligned": "test cameras moved by the similarity from true to fitted train cameras",
            "refined": REFINED,
            **rows[0]["protocol"],
        },
        "summary": [
            compared(rows, str(kind), scene) for kind in kinds for scene in (*scenes, "mean")
        ],
        "runs": rows,
    }
    _plot(study.out / "study.png", report)
    return study.write(report, table_lines)


def run_fit(data: str, fit: PoseFit) -> Row:
    """Fit and score; return the row."""
    capture = load_capture(Path(data) / fit.scene)
    train = capture.train_views
    if len(train) <= max(VIEW_IDS) or not capture.test_views:
        raise IgsrError(
            f"{capture.path} has {len(train)} train and {len(capture.test_views)} test views; the "
            f"protocol needs train view {max(VIEW_IDS)} and at least one test view."
        )
    true = [train[i] for i in VIEW_IDS]
    # Fixed and joint poses start from the same noise.
    random = np.random.default_rng([fit.seed, 0x905E, *str(fit.noise).encode()])
    noisy = [noisy_view(view, fit.noise, random) for view in true]
    given = Capture(capture.path, noisy + capture.test_views, capture.points)
    result = fit_capture(given, backend=fit.backend, seed=fit.seed, poses=fit.poses)
    true_cameras = [view.camera for view in true]
    cameras = [view.camera for view in result.capture.train_views]
    aligned = aligned_views(capture.test_views, true_cameras, cameras)
    refined = refine_cameras(result.splats, aligned, WHITE, backend=fit.backend)
    row: Row = {
        "scene": fit.scene,
        "noise": str(fit.noise),
        "poses": fit.poses,
        "seed": fit.seed,
        "backend": fit.backend,
        "before": pose_errors([view.camera for view in noisy], true_cameras),
        "after": pose_errors(cameras, true_cameras),
        "splats": len(result.splats),
        "seconds": round(result.seconds, 2),
    }
    for way, views in zip(WAYS, (capture.test_views, aligned, refined), strict=True):
        test = Capture(capture.path, views, None)
        scores = evaluate(result.splats, test, background=WHITE, backend=fit.backend)
        row[way] = {name: scores[name] for name in SCORES}
        row["protocol"] = scores["protocol"]
    return row


def compared(rows: list[Row], noise: str, scene: str) -> Row:
    """One line of the table: means over seeds, and over scenes if ``scene`` is "mean".

    "recovered" is the fraction of the dB lost to noise that joint poses bring back, both scored
    with aligned cameras; "short_of_clean" is clean minus joint in dB, both with refined cameras.
    """
    same = [row for row in rows if scene in ("mean", row["scene"])]
    fits: dict[str, list[Row]] = {"clean": [row for row in same if row["noise"] == str(CLEAN)]}
    for poses in POSES:
        fits[poses] = [row for row in same if (row["noise"], row["poses"]) == (noise, poses)]
    line: Row = {"noise": noise, "scene": scene}
    for name, chosen in fits.items():
        line[name] = {
            way: {score: float(np.mean([row[way][score] for row in chosen])) for score in SCORES}
            for way in WAYS
        }
        line[name]["psnr_spread"] = deviation(
            seed_means(chosen, lambda row: row["refined"]["psnr"])
        )
    for error in ERRORS:
        line[error] = {
            when: float(np.mean([row[when][error] for row in fits["joint"]]))
            for when in ("before", "after")
        }
    lost = line["clean"]["aligned"]["psnr"] - line["fixed"]["aligned"]["psnr"]
    back = line["joint"]["aligned"]["psnr"] - line["fixed"]["aligned"]["psnr"]
    line["recovered"] = back / lost if lost > 0.0 else None
    line["short_of_clean"] = line["clean"]["refined"]["psnr"] - line["joint"]["refined"]["psnr"]
    return line


def table_lines(report: Row) -> list[str]:
    """One line per noise and scene, then the means over scenes."""
    rows = [
        [
            line["noise"],
            line["scene"],
            *(_psnrs(line[name]) for name in FITS),
            "-" if line["recovered"] is None else f"{100 * line['recovered']:.0f} %",
            f"{line['short_of_clean']:.2f}",
            *(
                f"{before:.{digits}f} → {after:.{digits}f} ({before / after:.1f} ×)"
                for error, (_, digits) in ERRORS.items()
                for before, after in [(line[error]["before"], line[error]["after"])]
            ),
        ]
        for line in report["summary"]
    ]
    heads = ["noise", "scene", *FITS, "recovered", "short of clean"]
    heads += [head for head, _ in ERRORS.values()]
    return ["PSNR in dB, raw / aligned / refined.", "", *markdown_table(heads, rows, left=2)]


def _psnrs(scores: Row) -> str:
    *psnrs, refined = (scores[way]["psnr"] for way in WAYS)
    last = with_spread(refined, scores["psnr_spread"], ".2f")
    return " / ".join([*(f"{psnr:.2f}" for psnr in psnrs), last])


def _plot(path: Path, report: Row) -> None:
    """PSNR by noise and cameras of the scored views, means over scenes."""
    lines = [line for line in report["summary"] if line["scene"] == "mean"]
    figure = new_figure(2.0 + 2.2 * len(lines), 4.0)
    axis = figure.subplots()
    for k, name in enumerate(FITS):
        for w, (way, marker) in enumerate(zip(WAYS, "vo^", strict=True)):
            at = [i + 0.28 * (k - 1) + 0.07 * (w - 1) for i in range(len(lines))]
            psnrs = [line[name][way]["psnr"] for line in lines]
            axis.plot(at, psnrs, marker, color=f"C{k}", label=f"{name}, {way}")
    axis.set_xticks(range(len(lines)), [line["noise"] for line in lines])
    axis.set_ylabel("PSNR of held-out views, dB")
    axis.set_title(report["title"], fontsize=10)
    axis.grid(alpha=0.3, axis="y")
    axis.legend(fontsize=8, ncols=3)
    save_figure(figure, path)
