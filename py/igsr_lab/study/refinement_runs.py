"""One run of a refinement study: a first fit, and the rounds of each method from there.

All methods of a run continue from the same fit. Held-out views are scored after each round and do
not influence igsr's rounds.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr._internal.choices import FitBackend
from igsr._internal.json_file import write_json
from igsr.capture import Camera, Capture, View, load_capture
from igsr.denoiser.weights import SHIPPED
from igsr.errors import IgsrError
from igsr.evaluation.scores import default_background, over_background, score_views
from igsr.fitting.fingerprint import fingerprint
from igsr.refinement.refine_photos import refine, round_denoiser
from igsr.refinement.results import Refined
from igsr.splats import Splats
from igsr_lab.denoiser.perceptual_distance import SqueezeNetDistance
from igsr_lab.resumable_jobs import file_hash
from igsr_lab.study.refinement_methods import Method, refine_keywords
from igsr_lab.study.scoring import known_means, masked_distance
from igsr_lab.study.splits import HOLDOUT, localized, scattered, spread_out
from igsr_lab.study.study import Row

#: Choices of photos by name.
LAYOUTS: dict[str, Callable[[Sequence[Camera], int], list[int]]] = {
    "localized": localized,
    "scattered": scattered,
    "even": lambda cameras, count: spread_out(len(cameras), count),
}
#: Number of held-out views of a capture with test views.
HELD_OUT = 15
#: Number of held-out views of another capture, and of views that the paper's methods may add.
HELD_OUT_OF_ALL = 7
GIVEN_VIEWS = 6
#: Held-out views up to this angle from the nearest photo's viewing direction are near.
NEAR_DEG = 45.0
#: Held-out views beyond this angle are far.
FAR_DEG = 60.0
#: Scores of a round.
SCORES = ("psnr", "ssim", "flip")
#: Checkpoint of the fit that all methods of a run share.
SHARED_FIT = "whole.npz"


@dataclass(frozen=True)
class RefinementRun:
    """The photos of a run; ``layout`` is a key of ``LAYOUTS``, ``photos`` their number."""

    scene: str
    layout: str
    photos: int
    seed: int
    backend: FitBackend

    @property
    def name(self) -> str:
        """Name of its file and folder."""
        return f"{self.scene}-{self.layout}{self.photos}-seed{self.seed}-{self.backend}"


@dataclass(frozen=True)
class RefinementSettings:
    """Shared by all runs of a study."""

    out: str  # folder of the study
    methods: tuple[Method, ...]  # continue from each fit
    weights: str | None  # the denoiser's file; None is igsr's own
    features: str | None  # SqueezeNet's arrays (.npz), for the perceptual distance, or None
    steps: int | None  # of each fit; None is the default
    max_size: int | None = None  # longest side of the photos in pixels; None keeps their size

    @property
    def file_hashes(self) -> dict[str, str | None]:
        """Hashes of the files that results depend on."""
        return {
            "weights": file_hash(SHIPPED if self.weights is None else Path(self.weights)),
            "features": None if self.features is None else file_hash(Path(self.features)),
        }


def split(capture: Capture, run: RefinementRun) -> tuple[Capture, list[View], list[View]]:
    """Choose the photos to fit, the held-out views, and the views that the paper may add.

    If the capture has test views, 15 evenly spaced ones are held out and the rest may be added.
    Otherwise 7 evenly spaced photos (every 8th with layout "even", as LLFF) are held out and 6
    photos that are not fitted may be added.
    """
    if capture.test_views:
        train, test = capture.train_views, capture.test_views
        at = spread_out(len(test), HELD_OUT)
        held_out = [test[i] for i in at]
        given = [view for i, view in enumerate(test) if i not in at]
    else:
        by_name = sorted(capture.views, key=lambda view: view.name)
        at = spread_out(len(by_name), HELD_OUT_OF_ALL)
        if run.layout == "even":
            at = list(range(0, len(by_name), HOLDOUT))
        held_out, given = [by_name[i] for i in at], []
        train = [view for i, view in enumerate(by_name) if i not in at]
    if run.photos > len(train):
        raise IgsrError(f"{capture.path} has {len(train)} photos to fit, not {run.photos}.")
    chosen = LAYOUTS[run.layout]([view.camera for view in train], run.photos)
    if not capture.test_views:
        rest = [view for i, view in enumerate(train) if i not in chosen]
        given = [rest[i] for i in spread_out(len(rest), GIVEN_VIEWS)] if rest else []
    photos = [train[i] for i in chosen]
    return Capture(capture.path, photos, capture.points), held_out, given


def run_refinement(settings: RefinementSettings, data: str, run: RefinementRun) -> Row:
    """Fit, and continue by every method; return the row."""
    capture = load_capture(Path(data) / run.scene, max_size=settings.max_size)
    photos, held_out, given = split(capture, run)
    distance = None if settings.features is None else SqueezeNetDistance(settings.features)
    scorer = _Scorer(held_out, photos, run.backend, distance)
    folder = Path(settings.out) / "rounds" / run.name
    _remove_outdated(folder, settings, photos)
    denoiser = round_denoiser(settings.weights)
    first: Row = {}
    methods: dict[str, Row] = {}
    for number, method in enumerate(settings.methods):
        out = folder / method.name
        for earlier in settings.methods[:number]:
            _share_fit(folder / earlier.name, out)
        refined = refine(
            photos,
            method.rounds,
            steps=settings.steps,
            backend=run.backend,
            seed=run.seed,
            out=out,
            resume=True,
            **refine_keywords(method, denoiser, photos, given, distance),
        )
        first = first or scorer.scores(refined.first, folder / "first.png")
        methods[method.name] = {
            "rounds": _round_rows(refined, first, scorer, out),
            "stopped": str(refined.stop),
            "seconds": {stage: round(seconds, 2) for stage, seconds in refined.seconds.items()},
        }
    _write_picture(folder / "truth.png", scorer.shown_photo)
    return {**vars(run), "held_out": len(held_out), "methods": methods}


def _round_rows(refined: Refined, first: Row, scorer: _Scorer, out: Path) -> list[Row]:
    """Scores after each round."""
    rows: list[Row] = [{**first, "splats": len(refined.first)}]
    for number, done in enumerate(refined.rounds, 1):
        scores = scorer.scores(done.splats, out / f"round{number}.png")
        rows.append({**scores, "splats": len(done.splats), "added": len(done.selected)})
    return rows


class _Scorer:
    """Scores splats on the held-out views of a run."""

    def __init__(
        self,
        held_out: list[View],
        photos: Capture,
        backend: FitBackend,
        distance: SqueezeNetDistance | None,
    ) -> None:
        self._held_out, self._backend, self._distance = held_out, backend, distance
        self._background = default_background(photos)
        self._shown = len(held_out) // 2
        self._angles = _angles_to_nearest(held_out, photos.views)

    @property
    def shown_photo(self) -> npt.NDArray[np.uint8]:
        """The photo of the view whose renders are kept."""
        return over_background(self._held_out[self._shown].image, self._background)

    def scores(self, splats: Splats, picture: Path) -> Row:
        """Mean scores; write the render of one view to ``picture``."""
        rows: list[Row] = []
        views = score_views(splats, self._held_out, self._background, self._backend)
        for k, view in enumerate(views):
            row: Row = {name: view.scores[name] for name in SCORES}
            if self._distance is not None:
                distance = masked_distance(self._distance, view.render, view.photo, view.mask)
                row["perceptual"] = distance
            rows.append(row)
            if k == self._shown:
                _write_picture(picture, view.render)
        groups = {"near": self._angles <= NEAR_DEG, "far": self._angles > FAR_DEG}
        means: Row = {**_means(rows), "views": rows}
        for name, in_group in groups.items():
            some = [row for row, inside in zip(rows, in_group, strict=True) if inside]
            means[name] = {"views": len(some), **_means(some)} if some else None
        return means


def _means(rows: Sequence[Row]) -> Row:
    means = known_means(rows, list(rows[0]))
    return {name: value for name, value in means.items() if value is not None}


def _angles_to_nearest(views: Sequence[View], photos: Sequence[View]) -> npt.NDArray[np.float64]:
    """Angles in degrees between each view's direction and the nearest photo's."""
    directions, known = (
        np.stack([view.camera.viewmat[2, :3] for view in some]) for some in (views, photos)
    )
    return np.degrees(np.arccos(np.clip((directions @ known.T).max(axis=1), -1.0, 1.0)))


def _write_picture(path: Path, picture: npt.NDArray[np.uint8]) -> None:
    with atomic_write(path) as temporary:
        Image.fromarray(picture).save(temporary, format="PNG")


def _remove_outdated(folder: Path, settings: RefinementSettings, photos: Capture) -> None:
    """Remove the files of a run with other settings or another version: it cannot be resumed."""
    made_with: dict[str, Any] = {
        "igsr": _core.__version__,
        "steps": settings.steps,
        **settings.file_hashes,
        "capture": fingerprint(photos.views),
    }
    note = folder / "made_with.json"
    try:
        same = json.loads(note.read_text(encoding="utf-8")) == made_with
    except (OSError, ValueError):
        same = False
    if not same:
        shutil.rmtree(folder, ignore_errors=True)
        write_json(note, made_with)


def _share_fit(source: Path, out: Path) -> None:
    """Copy the checkpoint of the fit that all methods begin with, so that it is done once."""
    done, own = (folder / "checkpoints" / SHARED_FIT for folder in (source, out))
    own.parent.mkdir(parents=True, exist_ok=True)
    if done.is_file() and not own.is_file():
        with atomic_write(own) as temporary:
            shutil.copyfile(done, temporary)
