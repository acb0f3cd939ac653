"""What denoisers make of renders of poor fits, before and after: the paper's Table 1.

Scenes are fitted from 3, 6 and 9 photos and from 20 with noise on their cameras. Held-out views are
rendered, cleaned and scored, so that a denoiser is judged on what it is for.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr._internal.resumable_jobs import Run, file_hash, finished_runs
from igsr.capture import Capture, load_capture
from igsr.capture.load import holds_cameras
from igsr.denoiser.cleaning import DOUBT, UNSEEN_CHANGE, NetworkDenoiser
from igsr.denoiser.training.pair_files import OFFSET, SCALE, Pairs, read_pairs, write_pairs
from igsr.denoiser.training.pair_renders import check_one_size, rendered_pairs
from igsr.denoiser.training.perceptual_distance import (
    SMALLEST_SIDE,
    SqueezeNetDistance,
    picture_distance,
)
from igsr.denoiser.weights import SHIPPED, load_network
from igsr.errors import IgsrError
from igsr.evaluation.metrics import PSNR_CAP, score
from igsr.evaluation.scores import known_background
from igsr.fitting.presets import PAPER_STEPS, preset_settings
from igsr.fitting.run import fit_with_cameras
from igsr.geometry.camera_noise import AFFINE, MATRIX, Noise, noise_unit, noisy_view
from igsr.study.artifact_likeness import likeness, plot_likeness
from igsr.study.pictures import plot_confidence, plot_gains, write_sheet
from igsr.study.real_captures import is_dtu
from igsr.study.splits import dtu_views, llff_views

Float64 = npt.NDArray[np.float64]

#: Kinds of poor fits: numbers of photos; noise on the cameras of 20, made rotations again; and the
#: same as the paper has it, matrices as they come and 5 000 steps.
FEW = ("3", "6", "9")
NOISE, PAPER = "noise", "paper"
USUAL = (*FEW, NOISE)
KINDS = (*USUAL, PAPER)
NOISY_PHOTOS, CAMERA_NOISE = 20, 0.01
#: Held-out views scored per fit, at most; evenly spaced ones where there are more.
SCORED_VIEWS = 8
#: The denoiser that comes with igsr, as tables call it.
OURS = "igsr"
BEFORE = "before"
#: Scores by the row; the lower is the better in the last two. "best_quarter" is the PSNR of the
#: quarter of each view's pixels that were nearest to the truth before.
SCORES = ("psnr", "ssim", "ms_ssim", "best_quarter", "flip", "perceptual")
#: Edges of the confidence's bins.
CONFIDENCE_EDGES = np.linspace(0.0, 1.0, 21)


@dataclass(frozen=True)
class PoorFit:
    """One fit of the study; everything that its renders depend on.

    Attributes:
        scene: name of the scene's folder in the data, with "/" between folders.
        kind: of ``KINDS``.
        seed: of the fit and of the noise.
        backend: what fits and renders.
    """

    scene: str
    kind: str
    seed: int
    backend: str

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.scene.replace('/', '-')}-{self.kind}-seed{self.seed}-{self.backend}"


@dataclass(frozen=True)
class Cleaning:
    """One denoiser on the renders of one fit.

    Attributes:
        pairs: the renders' file.
        weights: the denoiser's file; None scores the renders as they are.
        features: SqueezeNet's arrays, for "perceptual"; None leaves that out.
    """

    pairs: str
    weights: str | None
    features: str | None


def scenes_in(data: Path) -> tuple[str, ...]:
    """Folders of ``data``, and folders in those, that hold photos with cameras.

    Raises:
        IgsrError: there are none.
    """
    found: list[str] = []
    for pattern in ("*", "*/*"):
        for folder in sorted(data.glob(pattern)):
            name = folder.relative_to(data)
            # A capture's folder of photos is one too, of the same photos.
            if name.parent.as_posix() not in found and folder.is_dir() and holds_cameras(folder):
                found.append(name.as_posix())
    if not found:
        raise IgsrError(f"{data} holds no folder of photos with cameras; name another DATA.")
    return tuple(found)


def poor_capture(capture: Capture, one: PoorFit) -> Capture:
    """The photos that a poor fit has, their cameras as it has them, and the views to score.

    A capture with test views is fitted from evenly spaced train views. Others are split as in the
    few-photos study, and a fit with noise has all photos that are not scored, if fewer than 20.

    Raises:
        IgsrError: the capture has too few photos.
    """
    noisy = one.kind in (NOISE, PAPER)
    if capture.test_views:
        train = capture.train_views
        count = min(NOISY_PHOTOS, len(train)) if noisy else int(one.kind)
        if count > len(train):
            raise IgsrError(f"{capture.path} has {len(train)} photos to fit, not {count}.")
        at = np.linspace(0, len(train) - 1, count).round().astype(int)
        train, test = [train[i] for i in at], capture.test_views
    else:
        few_dtu = is_dtu(one.scene) and not noisy
        rest = len(capture.views) - -(-len(capture.views) // 8)
        count = min(NOISY_PHOTOS, rest) if noisy else int(one.kind)
        chosen = (dtu_views if few_dtu else llff_views)(capture, count)
        train, test = chosen.train_views, chosen.test_views
    if len(test) > SCORED_VIEWS:
        at = np.linspace(0, len(test) - 1, SCORED_VIEWS).round().astype(int)
        test = [test[i] for i in at]
    if not noisy:
        return Capture(capture.path, train + test, capture.points)
    random = np.random.default_rng([one.seed, 0x7AB1, *one.scene.encode()])
    noise, unit = _noise(one.kind), noise_unit(train)
    # Points would tell a fit where the cameras were.
    return Capture(capture.path, [noisy_view(v, noise, random, unit) for v in train] + test, None)


def _noise(kind: str) -> Noise:
    return Noise(AFFINE if kind == PAPER else MATRIX, CAMERA_NOISE)


def _steps(kind: str) -> int | None:
    return PAPER_STEPS if kind == PAPER else None


def run_fit(out: Path, data: str, one: PoorFit) -> dict[str, Any]:
    """Fit, and keep the renders of the held-out views beside the true pictures."""
    capture = poor_capture(load_capture(Path(data) / one.scene), one)
    seconds = 0.0

    def progress(now: Any) -> None:
        nonlocal seconds
        seconds = now.seconds

    splats, _ = fit_with_cameras(
        capture,
        backend=one.backend,
        seed=one.seed,
        steps=_steps(one.kind),
        # Silhouettes of wrong cameras take away what is there.
        hull=None if one.kind in FEW else False,
        progress=progress,
    )
    background = known_background(capture.views)
    pairs = rendered_pairs(splats, capture.train_views, capture.test_views, background, one.backend)
    write_pairs(out / "renders" / f"{one.name}.npz", pairs)
    return {
        **vars(one),
        "photos": len(capture.train_views),
        "renders": len(pairs.truth),
        "splats": len(splats),
        "seconds": round(seconds, 2),
    }


def run_cleaning(data: str, one: Cleaning) -> dict[str, Any]:
    """Clean the renders of one fit and score them; ``data`` is unused."""
    pairs = read_pairs(one.pairs)
    denoiser = None if one.weights is None else NetworkDenoiser(load_network(one.weights))
    distance = None if one.features is None else SqueezeNetDistance(one.features)
    rows = []
    sums = np.zeros((3, len(CONFIDENCE_EDGES) - 1))
    weighted = np.zeros(3)
    for k in range(len(pairs.truth)):
        before, truth = _picture(pairs.inputs[k, :3]), _picture(pairs.truth[k])
        after, mask = before, pairs.masks[k]
        if not mask.any():
            continue
        if denoiser is not None:
            inputs = pairs.inputs[k] * SCALE[:, None, None] + OFFSET[:, None, None]
            picture, confidence = denoiser.clean(inputs.astype(np.float32))
            after = np.rint(255.0 * picture).astype(np.uint8)
            error = np.abs(picture - truth / 255.0).mean(axis=-1)[mask]
            sure = confidence[mask].astype(np.float64)
            at = np.clip(np.digitize(sure, CONFIDENCE_EDGES) - 1, 0, sums.shape[1] - 1)
            for row, weight in zip(sums, (np.ones_like(sure), sure, error), strict=True):
                row += np.bincount(at, weight, minlength=sums.shape[1])
            weighted += (error.mean(), np.sum(sure * error) / np.sum(sure), 1.0)
        scores: dict[str, float | None] = dict(score(after, truth, None if mask.all() else mask))
        scores["best_quarter"] = _best_quarter(before, after, truth, mask)
        if distance is not None and min(mask.shape) >= SMALLEST_SIDE:
            shown = mask[..., None]
            scores["perceptual"] = picture_distance(distance, after * shown, truth * shown)
        rows.append(scores)
    out: dict[str, Any] = {"views": rows}
    for name in SCORES:
        known = [value for row in rows if (value := row.get(name)) is not None]
        out[name] = float(np.mean(known)) if known else None
    if denoiser is not None:
        out["confidence"] = {
            "pixels": sums[0].tolist(),
            "confidence": sums[1].tolist(),
            "error": sums[2].tolist(),
            "mean_error": weighted[0] / max(weighted[2], 1.0),
            "weighted_error": weighted[1] / max(weighted[2], 1.0),
        }
    return out


def _picture(channels: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    return np.ascontiguousarray(np.moveaxis(channels, 0, -1))


def _best_quarter(
    before: npt.NDArray[np.uint8],
    after: npt.NDArray[np.uint8],
    truth: npt.NDArray[np.uint8],
    mask: npt.NDArray[np.bool_],
) -> float:
    """PSNR after of the quarter of the pixels that were nearest to the truth before."""

    def squares(picture: npt.NDArray[np.uint8]) -> Float64:
        difference = picture.astype(np.float64) - truth
        return np.square(difference / 255.0).mean(axis=-1)[mask]

    was = squares(before)
    best = was <= np.quantile(was, 0.25)
    error = float(squares(after)[best].mean())
    return PSNR_CAP if error == 0.0 else min(PSNR_CAP, -10.0 * float(np.log10(error)))


def denoiser_table(
    data: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    scenes: tuple[str, ...] | None = None,
    kinds: tuple[str, ...] = USUAL,
    denoisers: Mapping[str, str | os.PathLike[str]] | None = None,
    features: str | os.PathLike[str] | None = None,
    pairs: str | os.PathLike[str] | None = None,
    seeds: int = 1,
    backend: str = "cpu",
    jobs: int = 1,
    on_run: Callable[[int, int, dict[str, Any]], None] | None = None,
    ray: bool = False,
) -> dict[str, Any]:
    """Clean renders of poor fits with igsr's denoiser and others, and write what they score.

    Args:
        data: folder that holds the scenes, or folders of scenes.
        out: folder for ``study.json``, ``study.md``, ``study.png``, ``confidence.png``, a sheet of
            truth, render and cleaned pictures for each scene, ``renders/`` and ``runs/``; what is
            there is not done again.
        scenes: names of folders in ``data``; None is all that hold photos with cameras.
        kinds: of poor fits, of ``KINDS``.
        denoisers: further ones, weights by name: the paper's losses trained on the same pairs.
        features: SqueezeNet's arrays (.npz), to score by ``SqueezeNetDistance`` as well.
        pairs: folder of the training pairs, to compare their errors with those of the renders from
            few photographs here (of scenes without alpha, if there are any; see
            ``artifact_likeness``); also writes ``artifacts.png``.
        seeds: how many seeds, from 0.
        backend: what fits and renders.
        jobs: fits at a time, each in a process of its own with its share of the cores.
        on_run: called with (done, all, the fit's row) after each fit.
        ray: fits run over a Ray cluster instead (``pip install 'igsr[ray]'``).

    Returns:
        What ``study.json`` holds: "scenes" by the folder's name with "before", "after" (igsr's
        denoiser), "others" by name, each a mean over kinds and seeds, and "kinds" with the same for
        each; "mean" over scenes of "sparse" and "noise"; "confidence"; "artifacts" if ``pairs`` is
        given; "runs"; "protocol".

    Raises:
        IgsrError: a scene cannot be read or has too few photos, a denoiser cannot be read, or a fit
            fails.
    """
    if seeds < 1 or jobs < 1:
        raise IgsrError("seeds and jobs must be at least 1.")
    unknown = [kind for kind in kinds if kind not in KINDS]
    if unknown or not kinds:
        raise IgsrError(f"kinds must be of {', '.join(KINDS)}, not {(*unknown, 'none')[0]!r}.")
    data, out = Path(data), Path(out)
    scenes = scenes or scenes_in(data)
    short = {scene: scene.rsplit("/", 1)[-1] for scene in scenes}
    twice = [name for name in short.values() if list(short.values()).count(name) > 1]
    if twice:
        raise IgsrError(f"two scenes are called {twice[0]}; name the scenes to study.")
    weights = {OURS: SHIPPED, **{name: Path(path) for name, path in (denoisers or {}).items()}}
    if BEFORE in weights or len(weights) <= len(denoisers or {}):
        raise IgsrError(f"denoisers cannot be called {OURS} or {BEFORE}; choose another name.")
    for path in weights.values():
        load_network(path)
    if features is not None:
        SqueezeNetDistance(features)
    training = [] if pairs is None else sorted(Path(pairs).glob("[!.]*-sparse-*.npz"))
    if pairs is not None and not training:
        raise IgsrError(f"{pairs} holds no pairs of recipe sparse; make some.")
    fits = [
        PoorFit(scene, kind, seed, backend)
        for scene in scenes
        for seed in range(seeds)
        for kind in kinds
    ]
    names = [one.name for one in fits]
    if len(set(names)) < len(names):
        twice = [one.scene for one in fits if names.count(one.name) > 1]
        raise IgsrError(f"files of {twice[0]} and {twice[-1]} would have one name; rename one.")
    tasks = []
    made_up = set()
    for scene in scenes:
        # Read before the first fit: what is wrong with the last scene must not come up hours later.
        capture = load_capture(data / scene)
        if known_background(capture.views) is not None:
            made_up.add(scene)
        for one in (one for one in fits if one.scene == scene):
            poor = poor_capture(capture, one)
            check_one_size(poor.test_views)
            photos = len(poor.train_views)
            settings = preset_settings("default", photos, steps=_steps(one.kind))
            settings |= {"scored": SCORED_VIEWS}
            tasks.append(Run(one.name, one, settings, out / "renders" / f"{one.name}.npz", scene))
    rows = finished_runs(out / "runs", tasks, partial(run_fit, out), str(data), jobs, on_run, ray)
    perceptual = None if features is None else file_hash(Path(features))
    columns: dict[str, Path | None] = {BEFORE: None, **weights}
    for name, file in columns.items():
        hashed = None if file is None else file_hash(file)
        cleanings = [
            Run(
                f"{one.name}-{name}",
                Cleaning(
                    str(out / "renders" / f"{one.name}.npz"),
                    None if file is None else str(file),
                    None if features is None else str(features),
                ),
                {
                    "weights": hashed,
                    "doubt": DOUBT,
                    "unseen_change": UNSEEN_CHANGE,
                    "perceptual": perceptual,
                    "renders": file_hash(out / "renders" / f"{one.name}.npz"),
                },
            )
            for one in fits
        ]
        cleaned = finished_runs(out / "runs", cleanings, run_cleaning, "", jobs, None, False)
        for row, scores in zip(rows, cleaned, strict=True):
            row[name] = scores
    report = _report(rows, short, kinds, tuple(weights), seeds, features is not None)
    if training:
        # Photographs have no alpha; without any of those the others must do.
        photographed = [scene for scene in scenes if scene not in made_up] or scenes
        few = [
            read_pairs(out / "renders" / f"{one.name}.npz")
            for one in fits
            if one.kind in FEW and one.scene in photographed
        ]
        synthetic = [read_pairs(path) for path in training]
        report["artifacts"] = likeness(few, synthetic)
        plot_likeness(out / "artifacts.png", report["artifacts"], few, synthetic)
    with atomic_write(out / "study.json") as temporary:
        temporary.write_text(json.dumps(report, indent=2, allow_nan=False), encoding="utf-8")
    with atomic_write(out / "study.md") as temporary:
        temporary.write_text(markdown(report), encoding="utf-8")
    plot_gains(out / "study.png", report)
    plot_confidence(out / "confidence.png", report["confidence"])
    for scene, name in short.items():
        shown = {
            one.kind: read_pairs(out / "renders" / f"{one.name}.npz")
            for one in fits
            if one.scene == scene and one.seed == 0
        }
        write_sheet(out / f"{name}.png", _sheet(shown, weights))
    return report


def _sheet(
    shown: dict[str, Pairs], weights: Mapping[str, Path]
) -> dict[str, dict[str, npt.NDArray[np.uint8]]]:
    """For each kind of fit the middle view: truth, render, and what each denoiser makes of it."""
    out: dict[str, dict[str, npt.NDArray[np.uint8]]] = {}
    denoisers = {name: NetworkDenoiser(load_network(path)) for name, path in weights.items()}
    for kind, pairs in shown.items():
        k = len(pairs.truth) // 2
        inputs = pairs.inputs[k] * SCALE[:, None, None] + OFFSET[:, None, None]
        out[kind] = {"truth": _picture(pairs.truth[k]), "render": _picture(pairs.inputs[k, :3])}
        for name, denoiser in denoisers.items():
            picture, _ = denoiser.clean(inputs.astype(np.float32))
            out[kind][name] = np.rint(255.0 * picture).astype(np.uint8)
    return out


def _means(rows: Sequence[dict[str, Any]], column: str) -> dict[str, float | None]:
    out: dict[str, float | None] = {}
    for name in SCORES:
        known = [value for row in rows if (value := row[column][name]) is not None]
        out[name] = float(np.mean(known)) if known else None
    return out


def _columns(rows: Sequence[dict[str, Any]], denoisers: Sequence[str]) -> dict[str, Any]:
    return {
        "before": _means(rows, BEFORE),
        "after": _means(rows, OURS),
        "others": {name: _means(rows, name) for name in denoisers if name != OURS},
    }


def _noisy(kind: str) -> str:
    steps = f", {PAPER_STEPS} steps" if kind == PAPER else ""
    return f"at most {NOISY_PHOTOS} photos, {_noise(kind)}{steps}"


def _report(
    rows: list[dict[str, Any]],
    short: Mapping[str, str],
    kinds: Sequence[str],
    denoisers: Sequence[str],
    seeds: int,
    perceptual: bool,
) -> dict[str, Any]:
    scenes: dict[str, Any] = {}
    for scene, name in short.items():
        mine = [row for row in rows if row["scene"] == scene]
        scenes[name] = _columns(mine, denoisers) | {
            "kinds": {
                kind: _columns([row for row in mine if row["kind"] == kind], denoisers)
                for kind in kinds
            }
        }
    groups = {"sparse": [k for k in kinds if k in FEW]} | {
        kind: [k for k in kinds if k == kind] for kind in (NOISE, PAPER)
    }
    bins = [row[OURS]["confidence"] for row in rows]
    pixels, sure, error = (
        np.sum([one[key] for one in bins], axis=0) for key in ("pixels", "confidence", "error")
    )
    filled = pixels > 0
    return {
        "title": "Renders of poor fits, before and after denoising",
        "igsr": _core.__version__,
        "protocol": {
            "name": "denoiser-table",
            "kinds": {kind: f"{kind} photos" if kind in FEW else _noisy(kind) for kind in kinds},
            "views": f"at most {SCORED_VIEWS} held-out views of each scene",
            "seeds": seeds,
            "perceptual": SqueezeNetDistance.name if perceptual else None,
            "best_quarter": "PSNR of the quarter of each view's pixels nearest the truth before",
            "pixels": "8-bit sRGB",
        },
        "scenes": scenes,
        "mean": {
            group: _columns([row for row in rows if row["kind"] in members], denoisers)
            for group, members in groups.items()
            if members
        },
        "confidence": {
            "confidence": (sure[filled] / pixels[filled]).tolist(),
            "error": (error[filled] / pixels[filled]).tolist(),
            "pixels": pixels[filled].tolist(),
            "mean_error": float(np.mean([one["mean_error"] for one in bins])),
            "weighted_error": float(np.mean([one["weighted_error"] for one in bins])),
        },
        "runs": [
            {
                key: (
                    {name: s for name, s in value.items() if name in SCORES}
                    if isinstance(value, dict) and key != "settings"
                    else value
                )
                for key, value in row.items()
            }
            for row in rows
        ],
    }


def markdown(report: dict[str, Any]) -> str:
    """The table of the study: one line per scene and kind of fit, then the means."""
    formats = {name: ".2f" if name in ("psnr", "best_quarter") else ".4f" for name in SCORES}
    heads = {"psnr": "PSNR", "ssim": "SSIM", "ms_ssim": "MS-SSIM", "flip": "FLIP"}
    heads |= {"best_quarter": "best quarter", "perceptual": "perceptual"}
    lines = [f"# {report['title']}", "", f"igsr {report['igsr']}; {json.dumps(report['protocol'])}"]
    lines += ["", "| scene | fit | denoiser | " + " | ".join(heads[n] for n in SCORES) + " |"]
    lines.append("| --- | --- | --- |" + " ---: |" * len(SCORES))

    def add(scene: str, kind: str, columns: dict[str, Any]) -> None:
        named = {BEFORE: columns["before"], OURS: columns["after"], **columns["others"]}
        for name, scores in named.items():
            cells = [
                "-" if scores[key] is None else format(scores[key], formats[key]) for key in SCORES
            ]
            lines.append(f"| {scene} | {kind} | {name} | {' | '.join(cells)} |")

    for scene, columns in report["scenes"].items():
        for kind, of_kind in columns["kinds"].items():
            add(scene, kind, of_kind)
    for group, columns in report["mean"].items():
        add("mean", group, columns)
    sure = report["confidence"]
    lines += [
        "",
        f"Mean absolute error of cleaned pixels {sure['mean_error']:.4f}, weighted by their "
        f"confidence {sure['weighted_error']:.4f}.",
    ]
    if "artifacts" in report:
        found = {
            name: "unknown" if (apart := report["artifacts"][name]) is None else f"{apart:.2f}"
            for name in ("distance", "within", "noise")
        }
        lines += [
            "",
            f"Errors of renders from few photos are {found['distance']} octaves from the training "
            f"pairs' (two halves of those {found['within']} apart, white noise {found['noise']}).",
        ]
    return "\n".join(lines) + "\n"
