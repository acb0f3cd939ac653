"""Make training pairs: renders of fits that were degraded on purpose, and the photos."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.choices import FitBackend
from igsr.capture import Capture, View, load_capture
from igsr.denoiser.inputs import CHANNELS, COLOR
from igsr.errors import IgsrError
from igsr.evaluation.metrics import psnr
from igsr.evaluation.scores import WHITE
from igsr.fitting.fingerprint import fingerprint
from igsr.fitting.fit_capture import fit_capture
from igsr_lab.camera_noise import AFFINE, MATRIX, TURN, Noise, noise_unit, noisy_view
from igsr_lab.denoiser.pair_files import (
    DEFAULT_RECIPES,
    RECIPES,
    Pairs,
    check_one_size,
    rendered_pairs,
    write_pairs,
)
from igsr_lab.presets import PAPER_STEPS, preset_settings
from igsr_lab.resumable_jobs import Run, finished_runs

#: Numbers of photos of "sparse" and "underfit" fits.
FEW = (3, 4, 5, 6, 8, 9, 12, 16)
#: Number of photos by recipe, as in the paper.
PHOTOS = {"paper": 20, "noise": 20, "scattered": 60}
#: Steps of "scattered": few for its number of photos.
SCATTERED_STEPS = 1000
#: Range of standard deviations of camera-to-world's entries.
MATRIX_NOISE = (0.003, 0.02)
#: Range of turns, degrees.
TURN_NOISE = (0.2, 2.0)
#: Fitted photos that are rendered, too: training needs renders without errors.
FITTED_RENDERED = 1


@dataclass(frozen=True)
class PairFit:
    """One fit, with the options of ``make_pairs``; its pairs depend on nothing else."""

    capture: str  # absolute path of the capture
    recipe: str
    number: int  # of the fit within its capture and recipe; of the photo for "leave-one-out"
    views: int
    steps: int | None
    seed: int
    backend: FitBackend
    all_views: bool

    @property
    def scene(self) -> str:
        """Name of its capture."""
        path = Path(self.capture)
        return path.stem if path.suffix == ".json" else path.name

    @property
    def name(self) -> str:
        """Name of its files; ``capture_of_pairs`` reads it."""
        return f"{self.scene}-{self.recipe}-{self.number}-seed{self.seed}-{self.backend}"


@dataclass(frozen=True)
class _Plan:
    """Photos to fit with noise on their cameras, views to render, and a note for the row."""

    train: list[View]
    novel: list[View]
    steps: int | None
    noise: Noise | None = None
    note: tuple[tuple[str, str], ...] = ()


def make_pairs(
    captures: Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    recipes: Sequence[str] = DEFAULT_RECIPES,
    fits: int = 1,
    views: int = 8,
    steps: int | None = None,
    all_views: bool = False,
    seed: int = 0,
    backend: FitBackend = "cpu",
    jobs: int = 1,
    on_run: Callable[[int, int, dict[str, Any]], None] | None = None,
    ray: bool = False,
) -> list[dict[str, Any]]:
    """Fit degraded scenes, and write their renders with the photos.

    Args:
        captures: folders or files of captures with different names.
        out: folder for a ``.npz`` of pairs per fit, and ``runs/`` with a row about each. Finished
            fits are not repeated.
        recipes: names of ``RECIPES``.
        fits: fits per capture and recipe ("leave-one-out" has one per photo instead).
        views: maximum number of novel views rendered per fit; "paper" renders all.
        steps: of each fit; None is the default. Some recipes have their own.
        all_views: also use held-out views, for captures that nothing is scored on.
        seed: random seed.
        backend: "cpu" or "gpu".
        jobs: number of parallel fits, each in its own process.
        on_run: called with (done, total, row) after each fit.
        ray: run the fits on a Ray cluster instead (``pip install 'igsr[ray]'``).

    Returns:
        One row per fit: "pairs" (the file's name), "psnr" of its renders, "photos", "recipe".

    Raises:
        IgsrError: an argument is invalid, or a capture cannot be read or has too few views.
    """
    for name, number in (("fits", fits), ("views", views), ("jobs", jobs)):
        if number < 1:
            raise IgsrError(f"{name} must be at least 1, not {number}.")
    if steps is not None and steps < 1:
        raise IgsrError(f"steps must be at least 1, not {steps}.")
    if seed < 0:
        raise IgsrError(f"seed must not be negative, not {seed}.")
    unknown = [recipe for recipe in recipes if recipe not in RECIPES]
    if unknown:
        raise IgsrError(f"recipe must be one of {', '.join(RECIPES)}, not {unknown[0]!r}.")
    out, runs = Path(out), []
    for path in captures:
        # Load all captures first, so that an error does not come up after hours.
        capture = load_capture(path)
        settings = preset_settings("default", FEW[0]) | {
            "views": views,
            "steps": steps,
            "all_views": all_views,
            "capture": fingerprint(capture.views),
            "channels": CHANNELS,
            "few": list(FEW),
            "noise": [*MATRIX_NOISE, *TURN_NOISE],
        }
        for recipe in recipes:
            count = len(_used(capture, all_views)) if recipe == "leave-one-out" else fits
            for number in range(count):
                fit = PairFit(
                    str(Path(path).resolve()),
                    recipe,
                    number,
                    views,
                    steps,
                    seed,
                    backend,
                    all_views,
                )
                check_one_size(_planned(capture, fit, _random(fit)).novel)
                runs.append(Run(fit.name, fit, settings, out / f"{fit.name}.npz"))
    names = [run.name for run in runs]
    twice = {run.what.scene for run in runs if names.count(run.name) > 1}
    if twice:
        raise IgsrError(f"two captures are called {min(twice)}; pairs have that name, rename one.")
    return finished_runs(out / "runs", runs, partial(_run_fit, out), "", jobs, on_run, ray)


def _run_fit(out: Path, data: str, fit: PairFit) -> dict[str, Any]:
    """Make the pairs of one fit; ``data`` is unused, since paths are absolute."""
    capture = load_capture(fit.capture)
    random = _random(fit)
    plan = _planned(capture, fit, random)
    points = capture.points if plan.noise is None else None  # points reveal the true cameras
    result = fit_capture(
        Capture(capture.path, plan.train, points),
        backend=fit.backend,
        seed=fit.seed + fit.number,
        steps=plan.steps,
        # With exact depths of rendered captures, fits would be better than fits of photos.
        depth_weight=0.0,
        backdrop=False,  # holes must be visible
    )
    background: tuple[float, ...] | None = None
    if plan.train[0].image.shape[2] == 4:
        background = WHITE if random.uniform() < 0.7 else tuple(random.uniform(size=3))
    shuffled = [plan.train[i] for i in random.permutation(len(plan.train))]
    fitted = [view for view in shuffled if _size(view) == _size(plan.novel[0])][:FITTED_RENDERED]
    if fit.recipe == "paper":  # renders all views with their true cameras
        fitted = []
    pairs = rendered_pairs(result.splats, plan.train, plan.novel + fitted, background, fit.backend)
    file = f"{fit.name}.npz"
    write_pairs(out / file, pairs)
    return {
        "pairs": file,
        "recipe": fit.recipe,
        "photos": len(plan.train),
        "steps": plan.steps,
        "renders": len(pairs.truth),
        "psnr": _mean_psnr(pairs, len(plan.novel), capture.path),
        **dict(plan.note),
    }


def _mean_psnr(pairs: Pairs, views: int, capture: Path) -> float:
    """Mean PSNR of the first ``views`` renders."""
    psnrs = [
        psnr(np.moveaxis(inputs[:COLOR], 0, -1), np.moveaxis(truth, 0, -1), mask)
        for inputs, truth, mask in zip(
            pairs.inputs[:views], pairs.truth[:views], pairs.masks[:views], strict=True
        )
        if mask.any()
    ]
    if not psnrs:
        raise IgsrError(f"{capture}: the masks of the views to render leave no pixel.")
    return float(np.mean(psnrs))


def _random(fit: PairFit) -> np.random.Generator:
    return np.random.default_rng(
        [fit.seed, fit.number, 0xDE40, *fit.scene.encode(), *fit.recipe.encode()]
    )


def _size(view: View) -> tuple[int, int]:
    return view.camera.width, view.camera.height


def _used(capture: Capture, all_views: bool) -> list[View]:
    return capture.views if all_views else capture.train_views


def _planned(capture: Capture, fit: PairFit, random: np.random.Generator) -> _Plan:
    """Choose the photos to fit and the views to render."""
    views = _used(capture, fit.all_views)
    if fit.recipe == "leave-one-out":
        train = [replace(v, split="train") for i, v in enumerate(views) if i != fit.number]
        if len(train) < 2:
            raise IgsrError(f"{capture.path} has {len(views)} photos; leave-one-out needs 3.")
        left = views[fit.number]
        return _Plan(train, [left], fit.steps, note=(("left_out", left.name),))
    count = PHOTOS.get(fit.recipe) or int(random.choice(FEW))
    # The paper fits 20 of the views and renders all: they are not where they were fitted.
    held_out = 0 if fit.recipe == "paper" else max(1, min(fit.views, len(views) // 4))
    count = min(count, len(views) - held_out)
    if count < 2:
        raise IgsrError(
            f"{capture.path} has {len(views)} views; {fit.recipe} needs more to render."
        )
    order = random.permutation(len(views))
    train = [replace(views[i], split="train") for i in order[:count]]
    novel = [views[i] for i in order[count : count + fit.views]]
    if fit.recipe == "sparse":
        return _Plan(train, novel, fit.steps)
    if fit.recipe == "scattered":
        return _Plan(train, novel, SCATTERED_STEPS)
    if fit.recipe == "underfit":
        whole = fit.steps or preset_settings("default", count)["steps"]
        return _Plan(train, novel, max(1, int(random.uniform(0.25, 0.75) * whole)))
    is_paper = fit.recipe == "paper"
    noise = Noise(AFFINE, 0.01) if is_paper else _drawn_noise(random)
    unit = noise_unit(train)
    noisy = [noisy_view(view, noise, random, unit) for view in train]
    # No photo was fitted with its true camera, so all views may be rendered.
    novel = [views[i] for i in (*order[count:], *order[:count])]
    steps = PAPER_STEPS if is_paper else fit.steps
    note = (("noise", str(noise)),)
    return _Plan(noisy, novel if is_paper else novel[: fit.views], steps, noise, note)


def _drawn_noise(random: np.random.Generator) -> Noise:
    """Draw the kind of noise, and its size log-uniformly."""
    kind, least, most = (MATRIX, *MATRIX_NOISE) if random.uniform() < 0.5 else (TURN, *TURN_NOISE)
    return Noise(kind, float(least * (most / least) ** random.uniform()))
