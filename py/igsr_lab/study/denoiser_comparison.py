"""``python -m igsr_lab study denoiser-table``: degraded reconstructions before and after denoising.

The paper's Table 1. Held-out views of degraded fits are rendered, denoised and scored, so that a
denoiser is compared on what it is for.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from igsr._internal.choices import FitBackend
from igsr._internal.resumable_jobs import Run, file_hash, finished_runs
from igsr.denoiser.cleaning import DOUBT, MIN_CHANGE, NetworkDenoiser
from igsr.denoiser.weights import SHIPPED, load_network
from igsr.errors import IgsrError
from igsr_lab.denoiser.pair_files import read_pairs
from igsr_lab.denoiser.perceptual_distance import SqueezeNetDistance
from igsr_lab.study.artifact_likeness import Likeness, likeness, plot_likeness
from igsr_lab.study.cleaned_renders import (
    Cleaned,
    Cleaning,
    Picture,
    ViewToClean,
    eight_bits,
    run_cleaning,
)
from igsr_lab.study.degraded_fits import (
    FEW,
    KINDS,
    USUAL,
    DegradedFit,
    planned_fits,
    run_fit,
    scenes_in,
)
from igsr_lab.study.denoiser_plots import plot_confidence, plot_gains
from igsr_lab.study.denoiser_report import BEFORE, OURS, ComparedFit, comparison_report, markdown
from igsr_lab.study.picture_sheet import write_sheet
from igsr_lab.study.study_files import write_study_files


@dataclass(frozen=True)
class ComparisonSettings:
    """What to compare; see ``denoiser_table``.

    Attributes:
        scenes: names of folders in the data, no two with the same last part.
        kinds: of degraded fits.
        seeds: how many seeds, from 0.
        backend: what fits and renders.
        denoisers: further ones beside igsr's, weights by name.
        features: SqueezeNet's arrays, or None.
        pairs: folder of the training pairs, or None.

    Raises:
        IgsrError: a setting cannot be used, or a file that it names cannot be read.
    """

    scenes: tuple[str, ...]
    kinds: tuple[str, ...]
    seeds: int
    backend: FitBackend
    denoisers: Mapping[str, Path] = field(default_factory=dict)
    features: Path | None = None
    pairs: Path | None = None

    def __post_init__(self) -> None:
        """Check everything before the first fit."""
        if self.seeds < 1:
            raise IgsrError("seeds must be at least 1.")
        unknown = [kind for kind in self.kinds if kind not in KINDS]
        if unknown or not self.kinds:
            raise IgsrError(f"kinds must be of {', '.join(KINDS)}, not {(*unknown, 'none')[0]!r}.")
        if twice := _repeated([*self.scene_names.values()]):
            raise IgsrError(f"two scenes are called {twice[0]}; name the scenes to study.")
        if {OURS, BEFORE} & set(self.denoisers):
            raise IgsrError(f"denoisers cannot be called {OURS} or {BEFORE}; choose another name.")
        for path in self.weights.values():
            load_network(path)
        if self.features is not None:
            SqueezeNetDistance(self.features)
        if self.pairs is not None and not self.training_files:
            raise IgsrError(f"{self.pairs} holds no pairs of recipe sparse; make some.")
        if twice := _repeated([one.name for one in self.fits]):
            scenes = [one.scene for one in self.fits if one.name in twice]
            raise IgsrError(
                f"files of {scenes[0]} and {scenes[-1]} would have one name; rename one."
            )

    @property
    def scene_names(self) -> dict[str, str]:
        """What the report calls each scene: the last part of its folder."""
        return {scene: scene.rsplit("/", 1)[-1] for scene in self.scenes}

    @property
    def weights(self) -> dict[str, Path]:
        """Files of all denoisers by name, igsr's first."""
        return {OURS: SHIPPED, **self.denoisers}

    @property
    def training_files(self) -> list[Path]:
        """Training pairs of recipe "sparse"; the file of a killed run begins with a dot."""
        return [] if self.pairs is None else sorted(self.pairs.glob("[!.]*-sparse-*.npz"))

    @property
    def fits(self) -> list[DegradedFit]:
        """All fits, sorted by scene."""
        return [
            DegradedFit(scene, kind, seed, self.backend)
            for scene in self.scenes
            for seed in range(self.seeds)
            for kind in self.kinds
        ]


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
    backend: FitBackend = "cpu",
    jobs: int = 1,
    on_run: Callable[[int, int, dict[str, Any]], None] | None = None,
    ray: bool = False,
) -> dict[str, Any]:
    """Denoise renders of degraded fits with igsr's denoiser and others, and write their scores.

    Args:
        data: folder that holds the scenes, or folders of scenes.
        out: folder for ``study.json``, ``study.md``, ``study.png``, ``confidence.png``, a sheet of
            truth, render and denoised pictures for each scene, ``renders/`` and ``runs/``; what is
            there is not done again.
        scenes: names of folders in ``data``; None is all that hold photos with cameras.
        kinds: of degraded fits: "3", "6", "9" (photos), "noise" (on the cameras) and "paper" (its
            noise and steps).
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
    data, out = Path(data), Path(out)
    if jobs < 1:
        raise IgsrError("jobs must be at least 1.")
    settings = ComparisonSettings(
        scenes=scenes or scenes_in(data),
        kinds=kinds,
        seeds=seeds,
        backend=backend,
        denoisers={name: Path(path) for name, path in (denoisers or {}).items()},
        features=None if features is None else Path(features),
        pairs=None if pairs is None else Path(pairs),
    )
    planned = planned_fits(data, out, settings.fits)
    rows = finished_runs(
        out / "runs", planned.runs, partial(run_fit, out), str(data), jobs, on_run, ray
    )
    columns = {
        name: _cleaned(out, settings, name, weights, jobs)
        for name, weights in {BEFORE: None, **settings.weights}.items()
    }
    compared = [
        ComparedFit(fit, row, {name: column[k] for name, column in columns.items()})
        for k, (fit, row) in enumerate(zip(settings.fits, rows, strict=True))
    ]
    report = comparison_report(
        compared,
        settings.scene_names,
        kinds,
        seeds,
        perceptual=features is not None,
        artifacts=_artifacts(out, settings, planned.photographs),
    )
    write_study_files(out, report, markdown(report))
    plot_gains(out / "study.png", report)
    plot_confidence(out / "confidence.png", report["confidence"])
    for scene, name in settings.scene_names.items():
        write_sheet(out / f"{name}.png", _sheet(out, settings, scene))
    return report


def _cleaned(
    out: Path, settings: ComparisonSettings, name: str, weights: Path | None, jobs: int
) -> list[Cleaned]:
    """What one denoiser (None: none) makes of all fits' renders."""
    features = settings.features
    depends = {
        "weights": None if weights is None else file_hash(weights),
        "doubt": DOUBT,
        # Older runs have this name.
        "unseen_change": MIN_CHANGE,
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
    rows = finished_runs(out / "runs", runs, run_cleaning, "", jobs, None)
    return [Cleaned.of_row(row) for row in rows]


def _artifacts(
    out: Path, settings: ComparisonSettings, photographs: frozenset[str]
) -> Likeness | None:
    """How alike errors here are to those of the training pairs, also as ``artifacts.png``."""
    if settings.pairs is None:
        return None
    # Without any photographs the scenes with alpha must do.
    scenes = photographs or set(settings.scenes)
    real = [
        read_pairs(fit.renders(out))
        for fit in settings.fits
        if fit.kind in FEW and fit.scene in scenes
    ]
    synthetic = [read_pairs(path) for path in settings.training_files]
    found = likeness(real, synthetic)
    plot_likeness(out / "artifacts.png", found, real, synthetic)
    return found


def _sheet(out: Path, settings: ComparisonSettings, scene: str) -> dict[str, dict[str, Picture]]:
    """For each kind of fit the middle view: truth, render, and what each denoiser makes of it."""
    denoisers = {
        name: NetworkDenoiser(load_network(path)) for name, path in settings.weights.items()
    }
    sheet = {}
    for fit in (one for one in settings.fits if one.scene == scene and one.seed == 0):
        pairs = read_pairs(fit.renders(out))
        view = ViewToClean.of_pairs(pairs, len(pairs.truth) // 2)
        sheet[fit.kind] = {"truth": view.truth, "render": view.render} | {
            name: eight_bits(denoiser.clean(view.inputs)[0]) for name, denoiser in denoisers.items()
        }
    return sheet


def _repeated(names: Sequence[str]) -> list[str]:
    return [name for name in names if names.count(name) > 1]
