"""A run of a study of the loop: a first fit, and the rounds of every method from there.

All methods of a run continue from the same fit, so that they differ in nothing but their rounds.
Held-out views are scored after each round and decide nothing in our rounds.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr._internal.choices import FitBackend
from igsr._internal.resumable_jobs import file_hash
from igsr.capture import Camera, Capture, View, load_capture
from igsr.denoiser.weights import SHIPPED
from igsr.errors import IgsrError
from igsr.evaluation.scores import default_background, over_background, score_views
from igsr.fitting.fit_capture import fingerprint
from igsr.refinement.cross_validation import FOLDS
from igsr.refinement.loop import refine, round_denoiser
from igsr.refinement.results import Refined, Round
from igsr.splats import Splats
from igsr_lab.denoiser.perceptual_distance import SqueezeNetDistance, picture_distance
from igsr_lab.study.loop_methods import Method, parts_of
from igsr_lab.study.splits import HOLDOUT, localized, scattered, spread_out

#: How photos are chosen, by the name of the layout.
LAYOUTS: dict[str, Callable[[Sequence[Camera], int], list[int]]] = {
    "localized": localized,
    "scattered": scattered,
    "even": lambda cameras, count: spread_out(len(cameras), count),
}
#: Held-out views of a capture that has test views, and of one that has none; and the views of the
#: latter that the paper's methods may add.
HELD_OUT, HELD_OUT_OF_ALL, GIVEN_VIEWS = 15, 7, 6
#: Held-out views at most this far from the nearest photo's direction, degrees, are near; views
#: farther than the second are far.
NEAR, FAR = 45.0, 60.0
#: Fits that all methods of a run share, by the names of their checkpoints.
SHARED_FITS = ("whole", *(f"fold{number}" for number in range(FOLDS)))


@dataclass(frozen=True)
class RunSpec:
    """Which photos of which scene a run fits.

    Attributes:
        scene: name of the scene's folder in the data.
        layout: of ``LAYOUTS``.
        photos: how many are fitted.
        seed: of everything random.
        backend: what fits and renders.
    """

    scene: str
    layout: str
    photos: int
    seed: int
    backend: FitBackend

    @property
    def name(self) -> str:
        """Of its file and its folder."""
        return f"{self.scene}-{self.layout}{self.photos}-seed{self.seed}-{self.backend}"


@dataclass(frozen=True)
class StudySpec:
    """What all runs of a study share.

    Attributes:
        out: the study's folder.
        methods: that continue from each fit.
        weights: the denoiser's file; None is igsr's own.
        features: SqueezeNet's arrays, for "perceptual" and the paper's methods; None is without.
        steps: of each fit; None is the default preset's.
        max_size: longest side of the photos in pixels; larger ones are reduced. None leaves them.
    """

    out: str
    methods: tuple[Method, ...]
    weights: str | None
    features: str | None
    steps: int | None
    max_size: int | None = None

    @property
    def file_hashes(self) -> dict[str, str | None]:
        """Of the files that results depend on."""
        return {
            "weights": file_hash(SHIPPED if self.weights is None else Path(self.weights)),
            "features": None if self.features is None else file_hash(Path(self.features)),
        }


class RoundRow(TypedDict, total=False):
    """Scores of the held-out views after a round; 0 is the first fit.

    "views" has the scores of each view, "near" and "far" those of some of them and their number, or
    None where there are none. The row of a round that was not accepted has the scores of the round
    before.
    """

    psnr: float
    ssim: float
    flip: float
    perceptual: float
    views: list[dict[str, float | None]]
    near: dict[str, float] | None
    far: dict[str, float] | None
    splats: int
    accepted: bool
    added: int
    cross_validation: dict[str, dict[str, float]]


def split(capture: Capture, spec: RunSpec) -> tuple[Capture, list[View], list[View]]:
    """The photos of a run, the views that it is scored on, and those that the paper may add.

    Of a capture with test views 15 of those are scored, evenly spaced, and the others may be added.
    Of another 7 photos, evenly spaced by name (every 8th for the layout "even", as in LLFF's
    protocol), are scored, and 6 of those that are left may be added.

    Raises:
        IgsrError: the capture has too few photos.
    """
    if capture.test_views:
        train, test = capture.train_views, capture.test_views
        at = spread_out(len(test), HELD_OUT)
        held_out = [test[i] for i in at]
        given = [view for i, view in enumerate(test) if i not in at]
    else:
        by_name = sorted(capture.views, key=lambda view: view.name)
        at = spread_out(len(by_name), HELD_OUT_OF_ALL)
        if spec.layout == "even":
            at = list(range(0, len(by_name), HOLDOUT))
        held_out, given = [by_name[i] for i in at], []
        train = [view for i, view in enumerate(by_name) if i not in at]
    if spec.photos > len(train):
        raise IgsrError(f"{capture.path} has {len(train)} photos to fit, not {spec.photos}.")
    chosen = LAYOUTS[spec.layout]([view.camera for view in train], spec.photos)
    if not capture.test_views:
        rest = [view for i, view in enumerate(train) if i not in chosen]
        given = [rest[i] for i in spread_out(len(rest), GIVEN_VIEWS)] if rest else []
    photos = [train[i] for i in chosen]
    return Capture(capture.path, photos, capture.points), held_out, given


def run_refinement(study: StudySpec, data: str, spec: RunSpec) -> dict[str, Any]:
    """Fit, and continue by every method; what the run's file holds.

    Raises:
        IgsrError: the scene cannot be read or has too few photos, or a fit fails.
    """
    capture = load_capture(Path(data) / spec.scene, max_size=study.max_size)
    photos, held_out, given = split(capture, spec)
    distance = None if study.features is None else SqueezeNetDistance(study.features)
    scorer = _Scorer(held_out, photos, spec.backend, distance)
    folder = Path(study.out) / "rounds" / spec.name
    _clear_if_other(folder, study, photos)
    denoiser = round_denoiser(study.weights)
    first: RoundRow = {}
    methods: dict[str, dict[str, Any]] = {}
    for number, method in enumerate(study.methods):
        out = folder / method.name
        for earlier in study.methods[:number]:
            _share_fits(folder / earlier.name, out)
        parts = parts_of(method, denoiser, photos, given, distance)
        refined = refine(
            photos,
            method.rounds,
            steps=study.steps,
            backend=spec.backend,
            seed=spec.seed,
            out=out,
            resume=True,
            **vars(parts),
        )
        first = first or scorer.scores(refined.first, folder / "first.png")
        methods[method.name] = {
            "rounds": _round_rows(refined, first, scorer, out),
            "stopped": str(refined.stop),
            "seconds": {stage: round(seconds, 2) for stage, seconds in refined.seconds.items()},
        }
    _write_picture(folder / "truth.png", scorer.shown_photo)
    return {**vars(spec), "held_out": len(held_out), "methods": methods}


def _round_rows(refined: Refined, first: RoundRow, scorer: _Scorer, out: Path) -> list[RoundRow]:
    rows: list[RoundRow] = [{**first, "splats": len(refined.first), "accepted": True}]
    for number, done in enumerate(refined.rounds, 1):
        row: RoundRow = {**rows[-1]}
        if done.splats is not None:
            row = {**scorer.scores(done.splats, out / f"round{number}.png")}
            row["splats"] = len(done.splats)
        rows.append({**row, **_round_facts(done)})
    return rows


def _round_facts(done: Round) -> RoundRow:
    return {
        "accepted": done.accepted,
        "added": len(done.selected),
        "cross_validation": {"before": done.validation_before, "after": done.validation_after},
    }


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
        angles = _angles_to_nearest(held_out, photos.views)
        self._near, self._far = angles <= NEAR, angles > FAR

    @property
    def shown_photo(self) -> npt.NDArray[np.uint8]:
        """The true picture of the view whose renders are kept."""
        return over_background(self._held_out[self._shown].image, self._background)

    def scores(self, splats: Splats, picture: Path) -> RoundRow:
        """Mean scores; the render of one view is written to ``picture``."""
        rows = []
        views = score_views(splats, self._held_out, self._background, self._backend)
        for k, view in enumerate(views):
            row = {name: view.scores[name] for name in ("psnr", "ssim", "flip")}
            if self._distance is not None:
                shown = True if view.mask is None else view.mask[..., None]
                row["perceptual"] = picture_distance(
                    self._distance, view.render * shown, view.photo * shown
                )
            rows.append(row)
            if k == self._shown:
                _write_picture(picture, view.render)
        near = [row for row, counts in zip(rows, self._near, strict=True) if counts]
        far = [row for row, counts in zip(rows, self._far, strict=True) if counts]
        return {
            **_means(rows),  # type: ignore[typeddict-item]
            "views": rows,
            "near": {"views": len(near), **_means(near)} if near else None,
            "far": {"views": len(far), **_means(far)} if far else None,
        }


def _means(rows: Sequence[dict[str, float | None]]) -> dict[str, float]:
    """Mean of each score over the views that have it."""
    out: dict[str, float] = {}
    for name in rows[0]:
        known = [value for row in rows if (value := row[name]) is not None]
        if known:
            out[name] = float(np.mean(known))
    return out


def _angles_to_nearest(views: Sequence[View], photos: Sequence[View]) -> npt.NDArray[np.float64]:
    """Degrees between each view's direction and the nearest photo's."""
    directions, known = (
        np.stack([view.camera.viewmat[2, :3] for view in some]) for some in (views, photos)
    )
    return np.degrees(np.arccos(np.clip((directions @ known.T).max(axis=1), -1.0, 1.0)))


def _write_picture(path: Path, picture: npt.NDArray[np.uint8]) -> None:
    with atomic_write(path) as temporary:
        Image.fromarray(picture).save(temporary, format="PNG")


def _clear_if_other(folder: Path, study: StudySpec, photos: Capture) -> None:
    """Remove what a run with other settings or by another version left: it cannot be resumed."""
    made_with = {
        "igsr": _core.__version__,
        "steps": study.steps,
        **study.file_hashes,
        "capture": fingerprint(photos.views),
    }
    note = folder / "made_with.json"
    try:
        same = json.loads(note.read_text(encoding="utf-8")) == made_with
    except (OSError, ValueError):
        same = False
    if not same:
        shutil.rmtree(folder, ignore_errors=True)
        with atomic_write(note) as temporary:
            temporary.write_text(json.dumps(made_with, indent=1), encoding="utf-8")


def _share_fits(source: Path, out: Path) -> None:
    """Copy checkpoints of the fits that all methods begin with, so that each is done once."""
    (out / "checkpoints").mkdir(parents=True, exist_ok=True)
    for name in SHARED_FITS:
        done, own = (folder / "checkpoints" / f"{name}.npz" for folder in (source, out))
        if done.is_file() and not own.is_file():
            with atomic_write(own) as temporary:
                shutil.copyfile(done, temporary)
