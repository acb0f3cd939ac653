"""The paper's experiments with its loop (Tables 2 and 3, Figure 7's sweep), and our ablation."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr._internal.choices import FitBackend
from igsr._internal.resumable_jobs import Run, finished_runs
from igsr.capture import load_capture
from igsr.denoiser.weights import load_network
from igsr.errors import IgsrError
from igsr.fitting.presets import default_max_size, preset_settings
from igsr.refinement.stages import SELECTED
from igsr_lab.denoiser.perceptual_distance import SqueezeNetDistance
from igsr_lab.study.loop_gains import gains_table, mean_gains, paired_gains
from igsr_lab.study.loop_methods import METHODS, OURS, PAPER, Method
from igsr_lab.study.loop_runs import FAR, NEAR, RunSpec, StudySpec, run_refinement, split
from igsr_lab.study.loop_tables import plot_rounds, summarized, write_run_sheet, write_table
from igsr_lab.study.splits import HOLDOUT

PathLike = str | os.PathLike[str]
OnRun = Callable[[int, int, dict[str, Any]], None]

#: What the paper reports (PSNR / SSIM / LPIPS), to stand beside ours.
TABLE2_PAPER = (
    "chair, 10 localized: 11.259 / .567 / .427; Top-2 improvement 12.555 / .590 / .448; "
    "Top-2 absolute 11.140 / .561 / .431",
    "chair, 10 scattered: 12.523 / .752 / .312; Top-2 improvement 12.402 / .731 / .343; "
    "Top-2 absolute 12.236 / .727 / .344",
    "its yardstick, InstantSplat's averages: 28.58 / .89 / .13",
)
TABLE3_PAPER = (
    "a real object, 4 localized photos, Top-1 absolute, rounds 0, 1, 2: 15.448 / .707 / .573, "
    "15.216 / .724 / .575, 14.195 / .677 / .597",
    "its yardstick, InstantSplat's averages: 28.58 / .89 / .13",
)
TABLE2_METHODS = ("improvement", "absolute", "ours")
TABLE3_METHODS = ("absolute", "ours")
SWEPT_PHOTOS, SWEPT_VIEWS, SWEPT_ROUNDS = ("4", "6", "10", "15"), (1, 2, 4), 4
#: Photos that are fitted of photographs, and what stands for all that are not held out.
ALL = "all"
PHOTOGRAPHS = ("3", "6")
#: Size in pixels that photos have where they are only counted.
READ_SIZE = 32
#: Photos of the captures that the ablation is made on; others have 10.
ABLATION_PHOTOS = {"tankard": 6, "fern": 3}
ABLATION_METHODS = (*OURS, "improvement")


@dataclass(frozen=True)
class _Options:
    """What every study takes; see ``table2``."""

    weights: PathLike | None
    features: PathLike | None
    steps: int | None
    seeds: int
    backend: FitBackend
    jobs: int
    on_run: OnRun | None
    ray: bool
    max_size: int | None = None


def table2(
    data: PathLike,
    out: PathLike,
    *,
    scenes: tuple[str, ...] = ("chair",),
    methods: tuple[str, ...] = TABLE2_METHODS,
    weights: PathLike | None = None,
    features: PathLike | None = None,
    steps: int | None = None,
    seeds: int = 3,
    backend: FitBackend = "cpu",
    jobs: int = 1,
    on_run: OnRun | None = None,
    ray: bool = False,
) -> dict[str, Any]:
    """One round of the paper's from 10 photos, localized and scattered, and two rounds of ours.

    Args:
        data: folder that holds the scenes.
        out: folder for ``study.json``, ``study.md``, ``study.png``, a sheet of a held-out view by
            round for each choice of photos, ``runs/``, and ``rounds/`` for the files of each loop.
            Finished runs are not done again.
        scenes: names of folders in ``data``.
        methods: of ``igsr_lab.study.loop_methods.METHODS``; the paper's add their best 2.
        weights: the denoiser's file; None is igsr's own.
        features: SqueezeNet's arrays (.npz), for the perceptual distance.
        steps: of each fit; None is the default preset's.
        seeds: how many seeds, from 0.
        backend: what fits and renders.
        jobs: runs at the same time, each in its own process with its share of the cores.
        on_run: called with (done, all, the run's row) after each run.
        ray: runs go over a Ray cluster instead (``pip install 'igsr[ray]'``).

    Returns:
        What ``study.json`` holds: "localized" and "scattered" (over all scenes) and "scenes" (by
        the folder's name and "localized 10" or "scattered 10"), each by method with "rounds", 0 the
        fit to the photos alone; "runs"; "protocol"; "paper".

    Raises:
        IgsrError: a scene cannot be read or has too few photos, or a fit fails.
    """
    kinds = [(scene, layout, 10) for scene in scenes for layout in ("localized", "scattered")]
    chosen = [
        Method(name, name, SELECTED, 2, True) if name in OURS else Method(name, name, 2, 1, True)
        for name in methods
    ]
    title = "Table 2: 10 photos, one round of the paper's and two of ours"
    options = _Options(weights, features, steps, seeds, backend, jobs, on_run, ray)
    return _study(title, TABLE2_PAPER, data, out, kinds, chosen, options)


def table3(
    data: PathLike,
    out: PathLike,
    *,
    scenes: tuple[str, ...] = ("tankard",),
    methods: tuple[str, ...] = TABLE3_METHODS,
    weights: PathLike | None = None,
    features: PathLike | None = None,
    steps: int | None = None,
    seeds: int = 3,
    backend: FitBackend = "cpu",
    jobs: int = 1,
    on_run: OnRun | None = None,
    ray: bool = False,
) -> dict[str, Any]:
    """Two rounds from 4 localized photos of a real object; arguments are those of ``table2``.

    The paper's methods add their best one. Raises as ``table2``.
    """
    kinds = [(scene, "localized", 4) for scene in scenes]
    chosen = [Method(name, name, SELECTED if name in OURS else 1, 2, True) for name in methods]
    title = "Table 3: two rounds, 4 localized photos"
    options = _Options(weights, features, steps, seeds, backend, jobs, on_run, ray)
    return _study(title, TABLE3_PAPER, data, out, kinds, chosen, options)


def sweep(
    data: PathLike,
    out: PathLike,
    *,
    scenes: tuple[str, ...] = ("chair",),
    views: tuple[str, ...] = SWEPT_PHOTOS,
    weights: PathLike | None = None,
    features: PathLike | None = None,
    steps: int | None = None,
    seeds: int = 1,
    backend: FitBackend = "cpu",
    jobs: int = 1,
    on_run: OnRun | None = None,
    ray: bool = False,
) -> dict[str, Any]:
    """4, 6, 10 and 15 scattered photos; four rounds of 1, 2 and 4 views, none cross-validated.

    Arguments are those of ``table2``; ``views`` are the numbers of photos. Raises as ``table2``.
    """
    if not views or not all(text.isdecimal() and int(text) > 0 for text in views):
        raise IgsrError(f"views must be numbers of photos, not {', '.join(views) or 'none'}.")
    kinds = [(scene, "scattered", int(text)) for scene in scenes for text in views]
    chosen = [Method(f"ours-{count}", "ours", count, SWEPT_ROUNDS, False) for count in SWEPT_VIEWS]
    title = "Photos, rounds and views added per round"
    options = _Options(weights, features, steps, seeds, backend, jobs, on_run, ray)
    return _study(title, (), data, out, kinds, chosen, options)


def photographs(
    data: PathLike,
    out: PathLike,
    *,
    scenes: tuple[str, ...] = ("fern",),
    views: tuple[str, ...] = PHOTOGRAPHS,
    max_size: int | None = None,
    weights: PathLike | None = None,
    features: PathLike | None = None,
    steps: int | None = None,
    seeds: int = 3,
    backend: FitBackend = "cpu",
    jobs: int = 1,
    on_run: OnRun | None = None,
    ray: bool = False,
) -> dict[str, Any]:
    """Two rounds from few photos of real captures, as ``igsr.refine`` does them.

    Every 8th photo is held out, as in LLFF's protocol; those that are fitted are evenly spaced
    among the others.

    Args:
        data, out, scenes, weights, features, steps, seeds, backend, jobs, on_run, ray: as in
            ``table2``.
        views: numbers of photos; "all" are all that are not held out.
        max_size: longest side of the photos in pixels; larger ones are reduced. None is what a fit
            by this backend takes.

    Returns:
        As ``table2``; "gains" and "mean_gains" say what the kept rounds gained, paired.

    Raises:
        IgsrError: as ``table2``.
    """
    if max_size is None:
        max_size = default_max_size(backend)
    kinds = [
        (scene, "even", count) for scene in scenes for count in _numbers(views, Path(data) / scene)
    ]
    title = "Photographs: two rounds, each done only if it helps folds"
    options = _Options(weights, features, steps, seeds, backend, jobs, on_run, ray, max_size)
    return _study(title, (), data, out, kinds, [Method("ours", "ours", SELECTED, 2, True)], options)


def _numbers(views: Sequence[str], scene: Path) -> list[int]:
    """Numbers of photos of a scene.

    Raises:
        IgsrError: one is neither a number nor "all", or the scene cannot be read.
    """
    if not views or not all(text == ALL or (text.isdecimal() and int(text)) for text in views):
        raise IgsrError(
            f'views must be numbers of photos or "{ALL}", not {", ".join(views) or "none"}.'
        )
    if ALL not in views:
        return [int(text) for text in views]
    capture = load_capture(scene, max_size=READ_SIZE)
    fitted = len(capture.train_views)
    if not capture.test_views:
        fitted -= -(-fitted // HOLDOUT)
    return list(dict.fromkeys(fitted if text == ALL else int(text) for text in views))


def refinement_ablation(
    data: PathLike,
    out: PathLike,
    *,
    scenes: tuple[str, ...] = tuple(ABLATION_PHOTOS),
    methods: tuple[str, ...] = ABLATION_METHODS,
    weights: PathLike | None = None,
    features: PathLike | None = None,
    steps: int | None = None,
    seeds: int = 1,
    backend: FitBackend = "cpu",
    jobs: int = 1,
    on_run: OnRun | None = None,
    ray: bool = False,
) -> dict[str, Any]:
    """One round of our loop with each of its parts taken out, none cross-validated.

    Scenes have evenly spaced photos: the tankard 6, fern 3, others 10. Arguments are those of
    ``table2``. Raises as ``table2``.
    """
    kinds = [(scene, "even", ABLATION_PHOTOS.get(scene, 10)) for scene in scenes]
    chosen = [Method(name, name, SELECTED if name in OURS else 2, 1, False) for name in methods]
    title = "One round, with parts of the loop taken out"
    options = _Options(weights, features, steps, seeds, backend, jobs, on_run, ray)
    return _study(title, (), data, out, kinds, chosen, options)


def _study(
    title: str,
    paper: Sequence[str],
    data: PathLike,
    out: PathLike,
    kinds: Sequence[tuple[str, str, int]],
    methods: Sequence[Method],
    options: _Options,
) -> dict[str, Any]:
    """Do the runs of a study, and write its report, table, plot and sheets.

    Args:
        title: of the table.
        paper: the paper's own figures, to stand under it.
        data, out: as in ``table2``.
        kinds: (scene, layout, number of photos) of each kind of run.
        methods: that continue from each fit.
        options: as in ``table2``.

    Raises:
        IgsrError: an argument cannot be used, a scene cannot be read or has too few photos, or a
            fit fails.
    """
    _check(methods, options)
    out = Path(out)
    study = StudySpec(
        str(out),
        tuple(methods),
        None if options.weights is None else str(options.weights),
        None if options.features is None else str(options.features),
        options.steps,
        options.max_size,
    )
    specs = [
        RunSpec(scene, layout, photos, seed, options.backend)
        for seed in range(options.seeds)
        for scene, layout, photos in kinds
    ]
    for spec in specs:  # an error in the last scene must not come up hours later
        if not (Path(data) / spec.scene).exists():
            raise IgsrError(f"{Path(data) / spec.scene} does not exist; name --scene.")
        split(load_capture(Path(data) / spec.scene, max_size=study.max_size), spec)
    rows = finished_runs(
        out / "runs",
        [_job(spec, study) for spec in specs],
        partial(run_refinement, study),
        str(data),
        options.jobs,
        options.on_run,
        options.ray,
    )
    report = _report(title, paper, kinds, study, options, rows)
    with atomic_write(out / "study.json") as temporary:
        temporary.write_text(json.dumps(report, indent=2, allow_nan=False), encoding="utf-8")
    write_table(out / "study.md", report, gains_table(report))
    plot_rounds(out / "study.png", report)
    for spec in (spec for spec in specs if spec.seed == 0):
        write_run_sheet(out, spec, methods)
    return report


def _check(methods: Sequence[Method], options: _Options) -> None:
    """Find what cannot be used before the first fit."""
    if options.seeds < 1 or options.jobs < 1:
        raise IgsrError("seeds and jobs must be at least 1.")
    for one in methods:
        if one.method not in METHODS:
            raise IgsrError(f"methods must be of {', '.join(METHODS)}, not {one.method!r}.")
        if one.method in PAPER and options.features is None:
            raise IgsrError(
                f"method {one.method} chooses by a perceptual distance; give --features "
                "squeezenet.npz, or leave it out with --method."
            )
    load_network(options.weights)
    if options.features is not None:
        SqueezeNetDistance(options.features)


def _job(spec: RunSpec, study: StudySpec) -> Run:
    """A run, with all that its result depends on."""
    settings = preset_settings("default", spec.photos, steps=study.steps) | study.file_hashes
    settings["max_size"] = study.max_size
    settings["methods"] = [list(vars(one).values()) for one in study.methods]
    return Run(spec.name, spec, settings, scene=spec.scene)


def _report(
    title: str,
    paper: Sequence[str],
    kinds: Sequence[tuple[str, str, int]],
    study: StudySpec,
    options: _Options,
    rows: Sequence[dict[str, Any]],
) -> dict[str, Any]:
    """What ``study.json`` holds."""
    scenes: dict[str, Any] = {}
    gains: dict[str, Any] = {}
    for kind in kinds:
        same = [row for row in rows if (row["scene"], row["layout"], row["photos"]) == kind]
        scene, layout, photos = kind
        scenes.setdefault(scene, {})[f"{layout} {photos}"] = summarized(same)
        gains.setdefault(scene, {})[f"{layout} {photos}"] = {
            one.name: paired_gains(same, one.name) for one in study.methods
        }
    layouts = dict.fromkeys(layout for _, layout, _ in kinds)
    return {
        "title": title,
        "igsr": _core.__version__,
        "protocol": {
            "seeds": options.seeds,
            "backend": options.backend,
            "near": NEAR,
            "far": FAR,
            "max_size": study.max_size,
            "rounds": [vars(one) for one in study.methods],
            "weights": study.file_hashes["weights"],
        },
        "scenes": scenes,
        "gains": gains,
        "mean_gains": {
            one.name: mean_gains([of[one.name] for by in gains.values() for of in by.values()])
            for one in study.methods
        },
        "runs": list(rows),
        "paper": list(paper),
    } | {layout: summarized([row for row in rows if row["layout"] == layout]) for layout in layouts}
