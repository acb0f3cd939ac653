"""``denoiser_table``: renders of degraded fits before and after denoising, the paper's Table 1."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from igsr.denoiser.cleaning import DOUBT, MIN_CHANGE, NetworkDenoiser
from igsr.denoiser.weights import SHIPPED, load_network
from igsr.errors import IgsrError
from igsr_lab.denoiser.pair_files import read_pairs
from igsr_lab.denoiser.perceptual_distance import SqueezeNetDistance
from igsr_lab.report_parts import write_sheet
from igsr_lab.resumable_jobs import Run, file_hash, finished_runs
from igsr_lab.study.artifact_likeness import Likeness, likeness, plot_likeness
from igsr_lab.study.cleaned_renders import Cleaning, ViewToClean, run_cleaning, to_uint8
from igsr_lab.study.degraded_fits import (
    DEFAULT_KINDS,
    FEW,
    KINDS,
    DegradedFit,
    planned_runs,
    run_fit,
    scenes_in,
)
from igsr_lab.study.denoiser_report import (
    BEFORE,
    OURS,
    ComparedFit,
    comparison_report,
    plot_confidence,
    plot_gains,
    table_lines,
)
from igsr_lab.study.scoring import Picture
from igsr_lab.study.study import Row, Study


@dataclass(frozen=True)
class Comparison:
    """Checked arguments of ``denoiser_table``."""

    out: Path
    fits: list[DegradedFit]
    weights: dict[str, Path]
    features: Path | None
    training_files: list[Path]


def denoiser_table(
    study: Study,
    *,
    scenes: tuple[str, ...] | None = None,
    kinds: tuple[str, ...] = DEFAULT_KINDS,
    denoisers: Mapping[str, Path] | None = None,
    features: Path | None = None,
    pairs: Path | None = None,
) -> Row:
    """Denoise renders of degraded fits with igsr's denoiser and others, and score them.

    Args:
        study: its data has scenes, or folders of scenes. Its folder also gets ``confidence.png``, a
            sheet of pictures per scene, and ``renders/``.
        scenes: names of folders in the data; None is all captures with cameras.
        kinds: of degraded fits: "3", "6", "9" (photos), "noise" (on the cameras) and "paper" (its
            noise and steps).
        denoisers: files of weights by name, in addition to igsr's.
        features: SqueezeNet's arrays (.npz), to score a perceptual distance, too.
        pairs: folder of training pairs, whose errors are compared with those of renders from few
            photographs (see ``artifact_likeness``); also writes ``artifacts.png``.

    Returns:
        The content of ``study.json``: "scenes" by name with "before", "after" (igsr's denoiser) and
        "others" by name, means over kinds and seeds, and "kinds" with the same for each; "mean"
        over scenes of "sparse" and "noise"; "confidence"; "artifacts"; "runs"; "protocol".
    """
    scenes = scenes or scenes_in(study.data)
    settings = _checked(study, scenes, kinds, denoisers or {}, features, pairs)
    out = study.out
    runs, photographs = planned_runs(study.data, out, settings.fits)
    rows = study.rows(runs, partial(run_fit, out))
    columns = {
        name: _cleaned(settings, name, weights, study.jobs)
        for name, weights in {BEFORE: None, **settings.weights}.items()
    }
    compared = [
        ComparedFit(fit, row, {name: column[k] for name, column in columns.items()})
        for k, (fit, row) in enumerate(zip(settings.fits, rows, strict=True))
    ]
    names = _names(scenes)
    report = comparison_report(
        compared,
        names,
        kinds,
        study.seeds,
        perceptual=features is not None,
        artifacts=None if pairs is None else _artifacts(settings, photographs or {*scenes}),
    )
    plot_gains(out / "study.png", report)
    plot_confidence(out / "confidence.png", report["confidence"])
    for scene, name in names.items():
        write_sheet(out / f"{name}.png", _sheet(settings, scene))
    return study.write(report, table_lines)


def _checked(
    study: Study,
    scenes: tuple[str, ...],
    kinds: tuple[str, ...],
    denoisers: Mapping[str, Path],
    features: Path | None,
    pairs: Path | None,
) -> Comparison:
    """Check everything before the first fit."""
    unknown = [kind for kind in kinds if kind not in KINDS]
    if unknown or not kinds:
        raise IgsrError(f"kinds must be of {', '.join(KINDS)}, not {(*unknown, 'none')[0]!r}.")
    if twice := _repeated([*_names(scenes).values()]):
        raise IgsrError(f"two scenes are called {twice[0]}; name the scenes to study.")
    if {OURS, BEFORE} & set(denoisers):
        raise IgsrError(f"denoisers cannot be called {OURS} or {BEFORE}; choose another name.")
    weights = {OURS: SHIPPED, **denoisers}
    for path in weights.values():
        load_network(path)
    if features is not None:
        SqueezeNetDistance(features)
    # Files of killed runs begin with a dot.
    training_files = [] if pairs is None else sorted(pairs.glob("[!.]*-sparse-*.npz"))
    if pairs is not None and not training_files:
        raise IgsrError(f"{pairs} holds no pairs of recipe sparse; make some.")
    fits = [
        DegradedFit(scene, kind, seed, study.backend)
        for scene in scenes
        for seed in range(study.seeds)
        for kind in kinds
    ]
    if twice := _repeated([fit.name for fit in fits]):
        both = [fit.scene for fit in fits if fit.name in twice]
        raise IgsrError(f"files of {both[0]} and {both[-1]} would have one name; rename one.")
    return Comparison(study.out, fits, weights, features, training_files)


def _names(scenes: Sequence[str]) -> dict[str, str]:
    """Name of each scene in the report: the last part of its folder."""
    return {scene: scene.rsplit("/", 1)[-1] for scene in scenes}


def _cleaned(settings: Comparison, name: str, weights: Path | None, jobs: int) -> list[Row]:
    """Rows of one denoiser (None scores the renders themselves) on all fits' renders."""
    out, features = settings.out, settings.features
    depends: dict[str, Any] = {
        "weights": None if weights is None else file_hash(weights),
        "doubt": DOUBT,
        "unseen_change": MIN_CHANGE,  # the name in older runs
        "perceptual": None if features is None else file_hash(features),
    }
    runs = [
        Run(
            f"{fit.name}-{name}",
            Cleaning(
                str(fit.renders(out)),
                None if weights is None else str(weights),
                None if features is None else str(features),
            ),
            depends | {"renders": file_hash(fit.renders(out))},
        )
        for fit in settings.fits
    ]
    return finished_runs(out / "runs", runs, run_cleaning, "", jobs, None)


def _artifacts(settings: Comparison, scenes: Collection[str]) -> Likeness:
    """Compare and plot errors of renders from few photos and of training pairs."""
    real = [
        read_pairs(fit.renders(settings.out))
        for fit in settings.fits
        if fit.kind in FEW and fit.scene in scenes
    ]
    synthetic = [read_pairs(path) for path in settings.training_files]
    found = likeness(real, synthetic)
    plot_likeness(settings.out / "artifacts.png", found, real, synthetic)
    return found


def _sheet(settings: Comparison, scene: str) -> dict[str, dict[str, Picture]]:
    """The middle view by kind of fit: photo, render, and the result of each denoiser."""
    denoisers = {
        name: NetworkDenoiser(load_network(path)) for name, path in settings.weights.items()
    }
    sheet = {}
    for fit in (fit for fit in settings.fits if fit.scene == scene and fit.seed == 0):
        pairs = read_pairs(fit.renders(settings.out))
        view = ViewToClean.of_pairs(pairs, len(pairs.truth) // 2)
        sheet[fit.kind] = {"truth": view.truth, "render": view.render} | {
            name: to_uint8(denoiser.clean(view.inputs)[0]) for name, denoiser in denoisers.items()
        }
    return sheet


def _repeated(names: Sequence[str]) -> list[str]:
    return [name for name in names if names.count(name) > 1]
