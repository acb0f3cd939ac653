"""``denoiser_table``: renders of degraded fits before and after denoising, the paper's Table 1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from igsr_lab.figures import write_sheet
from igsr_lab.study.artifact_likeness import Likeness, likeness, plot_likeness
from igsr_lab.study.cleaned_renders import Cleaned, Cleaning, ViewToClean, run_cleaning, to_uint8
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
class ComparisonSettings:
    """Checked arguments of ``denoiser_table``."""

    scenes: tuple[str, ...]
    kinds: tuple[str, ...]
    seeds: int
    backend: FitBackend
    denoisers: Mapping[str, Path] = field(default_factory=dict)
    features: Path | None = None
    pairs: Path | None = None

    def __post_init__(self) -> None:
        """Check everything before the first fit."""
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
        if twice := _repeated([fit.name for fit in self.fits]):
            scenes = [fit.scene for fit in self.fits if fit.name in twice]
            raise IgsrError(
                f"files of {scenes[0]} and {scenes[-1]} would have one name; rename one."
            )

    @property
    def scene_names(self) -> dict[str, str]:
        """Name of each scene in the report: the last part of its folder."""
        return {scene: scene.rsplit("/", 1)[-1] for scene in self.scenes}

    @property
    def weights(self) -> dict[str, Path]:
        """Files of all denoisers by name, igsr's first."""
        return {OURS: SHIPPED, **self.denoisers}

    @property
    def training_files(self) -> list[Path]:
        """Training pairs of recipe "sparse"; files of killed runs begin with a dot."""
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

    Raises:
        IgsrError: an argument, a scene or a denoiser cannot be used, or a fit fails.
    """
    out = study.out
    settings = ComparisonSettings(
        scenes=scenes or scenes_in(study.data),
        kinds=kinds,
        seeds=study.seeds,
        backend=study.backend,
        denoisers=denoisers or {},
        features=features,
        pairs=pairs,
    )
    runs, photographs = planned_runs(study.data, out, settings.fits)
    rows = study.rows(runs, partial(run_fit, out))
    columns = {
        name: _cleaned(out, settings, name, weights, study.jobs)
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
        study.seeds,
        perceptual=features is not None,
        artifacts=_artifacts(out, settings, photographs),
    )
    plot_gains(out / "study.png", report)
    plot_confidence(out / "confidence.png", report["confidence"])
    for scene, name in settings.scene_names.items():
        write_sheet(out / f"{name}.png", _sheet(out, settings, scene))
    return study.write(report, table_lines)


def _cleaned(
    out: Path, settings: ComparisonSettings, name: str, weights: Path | None, jobs: int
) -> list[Cleaned]:
    """Scores of one denoiser (None: none) on all fits' renders."""
    features = settings.features
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
    rows = finished_runs(out / "runs", runs, run_cleaning, "", jobs, None)
    return [Cleaned.of_row(row) for row in rows]


def _artifacts(
    out: Path, settings: ComparisonSettings, photographs: frozenset[str]
) -> Likeness | None:
    """Compare errors of renders from few photographs with those of training pairs; plot them."""
    if settings.pairs is None:
        return None
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
    """The middle view by kind of fit: photo, render, and the result of each denoiser."""
    denoisers = {
        name: NetworkDenoiser(load_network(path)) for name, path in settings.weights.items()
    }
    sheet = {}
    for fit in (fit for fit in settings.fits if fit.scene == scene and fit.seed == 0):
        pairs = read_pairs(fit.renders(out))
        view = ViewToClean.of_pairs(pairs, len(pairs.truth) // 2)
        sheet[fit.kind] = {"truth": view.truth, "render": view.render} | {
            name: to_uint8(denoiser.clean(view.inputs)[0]) for name, denoiser in denoisers.items()
        }
    return sheet


def _repeated(names: Sequence[str]) -> list[str]:
    return [name for name in names if names.count(name) > 1]
