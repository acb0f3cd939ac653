"""Studies of the refinement: the paper's Tables 2 and 3, its sweep, photographs, an ablation.

Each takes the ``options`` of ``RefinementSettings``: ``weights``, ``features``, ``steps`` and
``max_size``. Each returns the content of ``study.json``:

* "scenes": by scene and choice of photos, such as "localized 10", and by method: "rounds" with
  mean scores, 0 the fit to the photos alone;
* the same over all scenes by layout;
* "gains" and "mean_gains": paired gains of the last round over round 0;
* "runs", "protocol" and "paper", the paper's own figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from igsr.capture import load_capture
from igsr.denoiser.weights import load_network
from igsr.errors import IgsrError
from igsr.fitting.presets import default_max_size
from igsr.refinement.rounds import MAX_SELECTED
from igsr_lab.denoiser.perceptual_distance import SqueezeNetDistance
from igsr_lab.presets import preset_settings
from igsr_lab.resumable_jobs import Run
from igsr_lab.study.refinement_methods import METHODS, OURS, PAPER, Method
from igsr_lab.study.refinement_report import (
    mean_gains,
    paired_gains,
    plot_rounds,
    summarized,
    table_lines,
    write_run_sheet,
)
from igsr_lab.study.refinement_runs import (
    FAR_DEG,
    NEAR_DEG,
    RefinementRun,
    RefinementSettings,
    run_refinement,
    split,
)
from igsr_lab.study.splits import HOLDOUT
from igsr_lab.study.study import Row, Study

#: The paper's figures (PSNR / SSIM / LPIPS).
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
#: Views added per round in the sweep, and its rounds.
SWEPT_VIEWS = (1, 2, 4)
SWEPT_ROUNDS = 4
#: Stands for all photos that are not held out.
ALL = "all"
#: Longest side of photos that are only counted.
COUNTING_SIZE_PX = 32
#: Number of photos in the ablation, by scene; others have 10.
ABLATION_PHOTOS = {"tankard": 6, "fern": 3}

#: Scene, layout and number of photos of a run.
Kind = tuple[str, str, int]


def table2(
    study: Study,
    *,
    scenes: tuple[str, ...] = ("chair",),
    methods: tuple[str, ...] = ("improvement", "absolute", "ours"),
    **options: Any,
) -> Row:
    """Refine from 10 localized and 10 scattered photos: the paper's Table 2.

    The paper's methods do one round and add 2 views; igsr's do two rounds.
    """
    kinds = [(scene, layout, 10) for scene in scenes for layout in ("localized", "scattered")]
    chosen = [
        Method(name, name, MAX_SELECTED if name in OURS else 2, 2 if name in OURS else 1)
        for name in methods
    ]
    title = "Table 2: 10 photos, one round of the paper's methods and two of igsr's"
    return _refined(study, title, kinds, chosen, options, TABLE2_PAPER)


def table3(
    study: Study,
    *,
    scenes: tuple[str, ...] = ("tankard",),
    methods: tuple[str, ...] = ("absolute", "ours"),
    **options: Any,
) -> Row:
    """Refine a real object from 4 localized photos by two rounds: the paper's Table 3."""
    kinds = [(scene, "localized", 4) for scene in scenes]
    chosen = [Method(name, name, MAX_SELECTED if name in OURS else 1, 2) for name in methods]
    title = "Table 3: two rounds, 4 localized photos"
    return _refined(study, title, kinds, chosen, options, TABLE3_PAPER)


def sweep(
    study: Study,
    *,
    scenes: tuple[str, ...] = ("chair",),
    views: tuple[str, ...] = ("4", "6", "10", "15"),
    **options: Any,
) -> Row:
    """Refine by four rounds of 1, 2 and 4 views, from scattered photos."""
    if not views or not all(_is_number(text) for text in views):
        raise IgsrError(f"views must be numbers of photos, not {', '.join(views) or 'none'}.")
    kinds = [(scene, "scattered", int(text)) for scene in scenes for text in views]
    chosen = [Method(f"ours-{count}", "ours", count, SWEPT_ROUNDS) for count in SWEPT_VIEWS]
    return _refined(study, "Photos, rounds and views added per round", kinds, chosen, options)


def photographs(
    study: Study,
    *,
    scenes: tuple[str, ...] = ("fern",),
    views: tuple[str, ...] = ("3", "6"),
    max_size: int | None = None,
    **options: Any,
) -> Row:
    """Refine real captures by two rounds, as ``igsr.refine``.

    Every 8th photo is held out; the fitted photos are evenly spaced among the rest.

    Args:
        study: the study.
        scenes: names of folders in the data.
        views: numbers of fitted photos, or "all".
        max_size: longest side of photos in pixels; None is the default of fits.
        options: see the module.
    """
    if max_size is None:
        max_size = default_max_size(study.backend)
    kinds = [
        (scene, "even", count) for scene in scenes for count in _counts(views, study.data / scene)
    ]
    title = "Photographs: two rounds"
    chosen = [Method("ours", "ours", MAX_SELECTED, 2)]
    return _refined(study, title, kinds, chosen, {**options, "max_size": max_size})


def refinement_ablation(
    study: Study,
    *,
    scenes: tuple[str, ...] = tuple(ABLATION_PHOTOS),
    methods: tuple[str, ...] = (*OURS, "improvement"),
    **options: Any,
) -> Row:
    """Refine by one round, with one part left out at a time."""
    kinds = [(scene, "even", ABLATION_PHOTOS.get(scene, 10)) for scene in scenes]
    chosen = [Method(name, name, MAX_SELECTED if name in OURS else 2, 1) for name in methods]
    return _refined(study, "One round, without parts of the refinement", kinds, chosen, options)


def _is_number(text: str) -> bool:
    return text.isdecimal() and int(text) > 0


def _counts(views: Sequence[str], scene: Path) -> list[int]:
    """Numbers of photos to fit of a scene."""
    if not views or not all(text == ALL or _is_number(text) for text in views):
        given = ", ".join(views) or "none"
        raise IgsrError(f'views must be numbers of photos or "{ALL}", not {given}.')
    if ALL not in views:
        return [int(text) for text in views]
    capture = load_capture(scene, max_size=COUNTING_SIZE_PX)
    fitted = len(capture.train_views)
    if not capture.test_views:
        fitted -= -(-fitted // HOLDOUT)
    return list(dict.fromkeys(fitted if text == ALL else int(text) for text in views))


def _refined(
    study: Study,
    title: str,
    kinds: Sequence[Kind],
    methods: Sequence[Method],
    options: dict[str, Any],
    paper: Sequence[str] = (),
) -> Row:
    """Execute the runs; write the report, the plot and the sheets."""
    settings = _settings(study, methods, **options)
    runs = [
        RefinementRun(scene, layout, photos, seed, study.backend)
        for seed in range(study.seeds)
        for scene, layout, photos in kinds
    ]
    study.check_scenes([run.scene for run in runs])
    for run in runs:  # so that an error does not come up after hours
        split(load_capture(study.data / run.scene, max_size=settings.max_size), run)
    jobs = [Run(run.name, run, _run_settings(run, settings), scene=run.scene) for run in runs]
    rows = study.rows(jobs, partial(run_refinement, settings))
    report = _report(study, title, kinds, settings, rows) | {"paper": list(paper)}
    plot_rounds(study.out / "study.png", report)
    for run in (run for run in runs if run.seed == 0):
        write_run_sheet(study.out, run, methods)
    return study.write(report, table_lines)


def _settings(
    study: Study,
    methods: Sequence[Method],
    *,
    weights: Path | None = None,
    features: Path | None = None,
    steps: int | None = None,
    max_size: int | None = None,
) -> RefinementSettings:
    """Check the shared settings of the runs."""
    for method in methods:
        if method.method not in METHODS:
            raise IgsrError(f"methods must be of {', '.join(METHODS)}, not {method.method!r}.")
        if method.method in PAPER and features is None:
            raise IgsrError(
                f"method {method.method} selects by a perceptual distance; give --features "
                "squeezenet.npz, or leave it out with --method."
            )
    load_network(weights)
    if features is not None:
        SqueezeNetDistance(features)
    return RefinementSettings(
        str(study.out),
        tuple(methods),
        None if weights is None else str(weights),
        None if features is None else str(features),
        steps,
        max_size,
    )


def _run_settings(run: RefinementRun, settings: RefinementSettings) -> dict[str, Any]:
    """Everything that the result of a run depends on."""
    return {
        **preset_settings("default", run.photos, steps=settings.steps),
        **settings.file_hashes,
        "max_size": settings.max_size,
        "methods": [list(vars(method).values()) for method in settings.methods],
    }


def _report(
    study: Study, title: str, kinds: Sequence[Kind], settings: RefinementSettings, rows: list[Row]
) -> Row:
    scenes: Row = {}
    gains: Row = {}
    names = [method.name for method in settings.methods]
    for scene, layout, photos in kinds:
        kind = (scene, layout, photos)
        same = [row for row in rows if (row["scene"], row["layout"], row["photos"]) == kind]
        key = f"{layout} {photos}"
        scenes.setdefault(scene, {})[key] = summarized(same)
        gains.setdefault(scene, {})[key] = {name: paired_gains(same, name) for name in names}
    by_photos = [methods for by_scene in gains.values() for methods in by_scene.values()]
    layouts = dict.fromkeys(layout for _, layout, _ in kinds)
    return {
        "title": title,
        "protocol": {
            "seeds": study.seeds,
            "backend": study.backend,
            "near": NEAR_DEG,
            "far": FAR_DEG,
            "max_size": settings.max_size,
            "rounds": [vars(method) for method in settings.methods],
            "weights": settings.file_hashes["weights"],
        },
        "scenes": scenes,
        "gains": gains,
        "mean_gains": {
            name: mean_gains([methods[name] for methods in by_photos]) for name in names
        },
        "runs": rows,
        **{layout: summarized([r for r in rows if r["layout"] == layout]) for layout in layouts},
    }
