"""Cameras made wrong on purpose: what fixed and joint poses make of them.

Twenty train views of a NeRF-Synthetic scene get noise on their poses and are fitted with poses
fixed and joint, beside a fit with the true ones. Held-out views are scored in the three ways of
``igsr.poses``, never mixed.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import _core
from ..atomic_write import atomic_write
from ..capture import Camera, Capture, View, load_capture
from ..capture.types import intrinsic_matrix
from ..errors import IgsrError
from ..evaluation import WHITE, evaluate
from ..fitting import fit_with_cameras
from ..poses import pose_errors, refine_cameras, similarity_between
from ..presets import preset_settings
from .runs import Run, finished_runs

Float64 = npt.NDArray[np.float64]

VIEW_IDS = tuple(range(0, 100, 5))
#: Of NeRF Synthetic's cameras from the origin, world units.
VIEWING_DISTANCE = 4.03
SCORES = ("psnr", "ssim", "flip")
WAYS = ("raw", "aligned", "refined")
POSES = ("fixed", "joint")
#: Kinds of noise: on all twelve numbers of camera-to-world, then made rigid again; the same with
#: the shear kept; turns about a random axis through the camera's centre.
MATRIX, AFFINE, TURN = "matrix", "raw-affine", "turn"
#: Steps of the paper's fits to photos whose cameras have noise.
PAPER_STEPS = 5000


@dataclass(frozen=True)
class Noise:
    """A kind of noise and its size: standard deviation of the numbers, or degrees of the turn."""

    kind: str
    size: float

    def __str__(self) -> str:
        """As tables and file names have it."""
        return f"{self.kind} {self.size:g}" + ("°" if self.kind == TURN else "")


CLEAN = Noise("clean", 0.0)


@dataclass(frozen=True)
class PoseFit:
    """One fit of the study; everything that its scores depend on."""

    scene: str
    noise: Noise
    poses: str
    seed: int
    backend: str


def noise_unit(views: Sequence[View]) -> float:
    """World units that stand for one of NeRF Synthetic's: noise on positions is in those.

    Its cameras stand ``VIEWING_DISTANCE`` from what they look at; these look at the point nearest
    to all their axes.
    """
    # Each axis contributes the part of an offset from it that is across it.
    across = []
    for view in views:
        axis = view.camera.viewmat[2, :3]
        across.append(np.eye(3) - np.outer(axis, axis))
    centres = np.stack([view.camera.centre for view in views])
    pulled = np.einsum("nij,nj->i", np.stack(across), centres - centres[0])
    target = centres[0] + np.linalg.lstsq(np.sum(across, axis=0), pulled, rcond=1e-6)[0]
    distance = float(np.mean(np.linalg.norm(centres - target, axis=1)))
    return distance / VIEWING_DISTANCE if distance > 0.0 else 1.0


def noisy_view(view: View, noise: Noise, random: np.random.Generator, unit: float = 1.0) -> View:
    """The view with noise on its camera; with "raw-affine" the photo is sheared as well.

    ``unit`` scales the noise on the position (``noise_unit``).

    A camera-to-world matrix with noise is no longer rigid. Its shear and stretch can be written as
    another focal length, principal point and skew of a rigid camera at the same centre; the skew
    moves each row of the photo sideways as a whole.
    """
    camera = view.camera
    to_world = np.linalg.inv(camera.viewmat)
    if noise.kind == TURN:
        axis = random.normal(size=3)
        axis *= np.radians(noise.size) / np.linalg.norm(axis)
        to_world[:3, :3] = _rotation(axis) @ to_world[:3, :3]
    elif noise.kind in (MATRIX, AFFINE):
        to_world[:3, :4] += noise.size * random.normal(size=(3, 4)) * (1.0, 1.0, 1.0, unit)
    if noise.kind != AFFINE:
        u, _, vt = np.linalg.svd(to_world[:3, :3])
        return replace(view, camera=_camera(camera, (u @ vt).T, to_world[:3, 3], camera.K))
    upper, rotation = _upper_times_rotation(camera.K @ np.linalg.inv(to_world[:3, :3]))
    upper /= upper[2, 2]
    K = intrinsic_matrix(upper[0, 0], upper[1, 1], upper[0, 2], upper[1, 2])
    slope = upper[0, 1] / upper[1, 1]
    shifts = slope * (np.arange(camera.height) + 0.5 - upper[1, 2])
    return replace(
        view,
        camera=_camera(camera, rotation, to_world[:3, 3], K),
        image=_rows_shifted(view.image, shifts),
    )


def _camera(camera: Camera, rotation: Float64, centre: Float64, K: Float64) -> Camera:
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ centre
    return replace(camera, viewmat=viewmat, K=K)


def _rotation(axis: Float64) -> Float64:
    """Rodrigues' formula; the axis' length is the angle."""
    angle = float(np.linalg.norm(axis))
    x, y, z = axis / angle if angle > 0.0 else axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Float64 = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    return rotation


def _upper_times_rotation(matrix: Float64) -> tuple[Float64, Float64]:
    """The factors of a matrix with positive determinant, the upper one's diagonal positive."""
    q, r = np.linalg.qr(matrix[::-1].T)
    upper, rotation = r.T[::-1, ::-1], q.T[::-1]
    signs = np.sign(np.diag(upper))
    return upper * signs[None, :], signs[:, None] * rotation


def _rows_shifted(image: npt.NDArray[np.uint8], shifts: Float64) -> npt.NDArray[np.uint8]:
    """Row y of the result at column x is the photo's row y at x + shifts[y]."""
    pixels = image.astype(np.float64)
    if image.shape[2] == 4:
        # Colours of transparent pixels are of no meaning and must not mix in.
        pixels[..., :3] *= pixels[..., 3:] / 255.0
    at = np.arange(image.shape[1], dtype=np.float64)
    for row, shift in zip(pixels, shifts, strict=True):
        for c in range(image.shape[2]):
            row[:, c] = np.interp(at + shift, at, row[:, c].copy())
    if image.shape[2] == 4:
        alpha = pixels[..., 3:]
        pixels[..., :3] *= np.divide(255.0, alpha, out=np.zeros_like(alpha), where=alpha > 0.0)
    return np.clip(pixels + 0.5, 0.0, 255.0).astype(np.uint8)


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
    backend: str = "cpu",
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
        for poses in (("fixed",) if kind == CLEAN else POSES)
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
    out = Path(out)
    with atomic_write(out / "study.json") as temporary:
        temporary.write_text(json.dumps(report, indent=2, allow_nan=False), encoding="utf-8")
    with atomic_write(out / "study.md") as temporary:
        temporary.write_text(markdown(report), encoding="utf-8")
    _plot(out / "study.png", report)
    return report


def compared(rows: list[dict[str, Any]], noise: str, scene: str) -> dict[str, Any]:
    """One line of the table: means over seeds (and scenes, for "mean") and what they come to.

    "recovered" is the part of the dB lost to noise, both scored aligned, that joint poses bring
    back; "short_of_clean" the dB between clean and joint, both scored refined.
    """
    mine = [row for row in rows if scene in ("mean", row["scene"])]
    sets = {
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
    """The table of the study."""
    lines = [
        f"# {report['title']}",
        "",
        f"igsr {report['igsr']}; {json.dumps(report['protocol'])}",
        "",
        "PSNR in dB, raw / aligned / refined.",
        "",
        "| noise | scene | fixed | joint | clean | recovered | short of clean "
        "| rotation, degrees | centre, world units |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for line in report["summary"]:
        cells = [
            " / ".join(f"{line[name][way]['psnr']:.2f}" for way in WAYS)
            + (f" ± {spread:.2f}" if (spread := line[name]["psnr_spread"]) is not None else "")
            for name in ("fixed", "joint", "clean")
        ]
        recovered = line["recovered"]
        cells.append("-" if recovered is None else f"{100 * recovered:.0f} %")
        cells.append(f"{line['short_of_clean']:.2f}")
        for error, digits in (("rotation", 3), ("centre", 4)):
            before, after = line[error]["before"], line[error]["after"]
            cells.append(f"{before:.{digits}f} → {after:.{digits}f} ({before / after:.1f} ×)")
        lines.append(f"| {line['noise']} | {line['scene']} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


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
