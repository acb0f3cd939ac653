"""Make training pairs: renders of fits degraded on purpose, beside the true pictures."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.choices import FitBackend
from igsr._internal.resumable_jobs import Run, finished_runs
from igsr.capture import Capture, View, load_capture
from igsr.denoiser.inputs import CHANNELS, COLOR
from igsr.errors import IgsrError
from igsr.evaluation.metrics import psnr
from igsr.evaluation.scores import WHITE
from igsr.fitting.fit_capture import fingerprint, fit_with_cameras
from igsr.fitting.presets import PAPER_STEPS, preset_settings
from igsr_lab.camera_noise import AFFINE, MATRIX, TURN, Noise, noise_unit, noisy_view
from igsr_lab.denoiser.pair_files import Pairs, write_pairs
from igsr_lab.denoiser.pair_renders import check_one_size, rendered_pairs

#: How fits are degraded. "sparse" has 3 to 16 photos; "underfit" stops early; "noise" has noise on
#: its cameras; "paper" is the paper's recipe, "scattered" its other one; "leave-one-out" leaves one
#: photo of the capture out of each fit, for a capture of one's own.
DEFAULT_RECIPES = ("sparse", "underfit", "noise")
RECIPES = (*DEFAULT_RECIPES, "paper", "scattered", "leave-one-out")
#: Photos of a "sparse" or "underfit" fit.
FEW = (3, 4, 5, 6, 8, 9, 12, 16)
#: Photos of a fit with noise (the paper has 20), and of the paper's "many scattered views".
NOISY_PHOTOS, SCATTERED_PHOTOS = 20, 60
#: Steps of "scattered": few for so many photos.
SCATTERED_STEPS = 1000
#: Standard deviations of camera-to-world's numbers, and degrees of turns.
MATRIX_NOISE, TURN_NOISE = (0.003, 0.02), (0.2, 2.0)
#: Of the photos fitted, so many are rendered too: training needs renders that are good already.
FITTED_RENDERED = 1


@dataclass(frozen=True)
class PairFit:
    """One fit that pairs are made from; everything that they depend on.

    Attributes:
        capture: its whole path.
        recipe: of ``RECIPES``.
        number: of the fit among those of its capture and recipe; for "leave-one-out" of the photo.
        views: novel views to render.
        steps: of the fit, where the recipe does not say; None is the default preset's.
        seed: of everything that is drawn.
        backend: what fits and renders.
        all_views: use the held-out views too.
    """

    capture: str
    recipe: str
    number: int
    views: int
    steps: int | None
    seed: int
    backend: FitBackend
    all_views: bool

    @property
    def scene(self) -> str:
        """What its capture is called."""
        path = Path(self.capture)
        return path.stem if path.suffix == ".json" else path.name

    @property
    def name(self) -> str:
        """Of its files; ``capture_of_pairs`` reads it."""
        return f"{self.scene}-{self.recipe}-{self.number}-seed{self.seed}-{self.backend}"


@dataclass(frozen=True)
class _Plan:
    """What a fit is made from.

    Attributes:
        train: photos to fit, with the cameras that the recipe gives them.
        novel: views to render, with their true cameras.
        steps: of the fit; None is the default preset's.
        noise: on the cameras of ``train``, if any.
        held_out: the photo that "leave-one-out" leaves out.
    """

    train: list[View]
    novel: list[View]
    steps: int | None
    noise: Noise | None = None
    held_out: str | None = None

    @property
    def note(self) -> dict[str, str]:
        """What the row of the fit says of it."""
        if self.held_out is not None:
            return {"left_out": self.held_out}
        return {} if self.noise is None else {"noise": str(self.noise)}


def capture_of_pairs(file: str) -> str:
    """The name of the capture that a file of pairs is of; the file's own where it does not say."""
    found = re.fullmatch(rf"(.+)-(?:{'|'.join(RECIPES)})-\d+-seed\d+.*\.npz", file)
    return file if found is None else found[1]


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
    """Degrade fits in the ways of ``recipes``; write their renders beside the true pictures.

    Args:
        captures: folders or files that ``igsr.load_capture`` reads, with no two names alike.
        out: folder for one ``.npz`` of pairs per fit, and ``runs/`` with a row about each; a fit
            whose row is there is not done again.
        recipes: names of ``RECIPES``.
        fits: fits per capture and recipe ("leave-one-out" has one per photo instead).
        views: novel views rendered per fit, with noise also fitted ones from their true cameras; as
            many as there are, if fewer. "paper" renders all.
        steps: of each fit, where the recipe does not say; None is the default preset's.
        all_views: also use the views that a capture holds out for testing, for captures that
            nothing is ever scored on. Without, they never get into the training.
        seed: of everything that is drawn.
        backend: what fits and renders.
        jobs: fits at a time, each in a process of its own.
        on_run: called with (done, all, the fit's row) after each fit.
        ray: fits run over a Ray cluster instead (``pip install 'igsr[ray]'``).

    Returns:
        One row per fit: "pairs" (the file's name), "psnr" of its renders, "photos", "recipe".

    Raises:
        IgsrError: an argument cannot be used, a capture cannot be read or has too few views.
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
        # Read before the first fit: what is wrong with the last must not come up hours later.
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
            own = len(_used(capture, all_views)) if recipe == "leave-one-out" else fits
            for number in range(own):
                one = PairFit(
                    str(Path(path).resolve()),
                    recipe,
                    number,
                    views,
                    steps,
                    seed,
                    backend,
                    all_views,
                )
                check_one_size(_planned(capture, one, _random(one)).novel)
                runs.append(Run(one.name, one, settings, out / f"{one.name}.npz"))
    names = [run.name for run in runs]
    twice = {run.what.scene for run in runs if names.count(run.name) > 1}
    if twice:
        raise IgsrError(f"two captures are called {min(twice)}; rename one, pairs go by the name.")
    return finished_runs(out / "runs", runs, partial(_work, out), "", jobs, on_run, ray)


def _work(out: Path, data: str, one: PairFit) -> dict[str, Any]:
    """Make the pairs of one fit; for a process of its own. Paths are whole: ``data`` is unused."""
    capture = load_capture(one.capture)
    random = _random(one)
    plan = _planned(capture, one, random)
    points = capture.points if plan.noise is None else None  # they tell where cameras were
    splats, _ = fit_with_cameras(
        Capture(capture.path, plan.train, points),
        backend=one.backend,
        seed=one.seed + one.number,
        steps=plan.steps,
        # Exact depths of rendered captures would make these fits better than those of photos.
        depth_weight=0.0,
        backdrop=False,  # holes are to be seen as such
    )
    has_alpha = plan.train[0].image.shape[2] == 4
    background: tuple[float, ...] | None = None
    if has_alpha:
        background = WHITE if random.uniform() < 0.7 else tuple(random.uniform(size=3))
    shuffled = [plan.train[i] for i in random.permutation(len(plan.train))]
    fitted = [view for view in shuffled if _size(view) == _size(plan.novel[0])][:FITTED_RENDERED]
    if one.recipe == "paper":  # which renders all views from their true cameras
        fitted = []
    pairs = rendered_pairs(splats, plan.train, plan.novel + fitted, background, one.backend)
    file = f"{one.name}.npz"
    write_pairs(out / file, pairs)
    return {
        "pairs": file,
        "recipe": one.recipe,
        "photos": len(plan.train),
        "steps": plan.steps,
        "renders": len(pairs.truth),
        "psnr": _mean_psnr(pairs, len(plan.novel), capture.path),
        **plan.note,
    }


def _mean_psnr(pairs: Pairs, views: int, capture: Path) -> float:
    """Of the first ``views`` renders, over the pixels whose truth is known."""
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


def _random(one: PairFit) -> np.random.Generator:
    """What a fit's choices are drawn from."""
    return np.random.default_rng(
        [one.seed, one.number, 0xDE40, *one.scene.encode(), *one.recipe.encode()]
    )


def _size(view: View) -> tuple[int, int]:
    return view.camera.width, view.camera.height


def _used(capture: Capture, all_views: bool) -> list[View]:
    return capture.views if all_views else capture.train_views


def _planned(capture: Capture, one: PairFit, random: np.random.Generator) -> _Plan:
    """Which photos to fit, how, and which views to render.

    Raises:
        IgsrError: the capture has too few views.
    """
    views = _used(capture, one.all_views)
    if one.recipe == "leave-one-out":
        train = [replace(v, split="train") for i, v in enumerate(views) if i != one.number]
        if len(train) < 2:
            raise IgsrError(f"{capture.path} has {len(views)} photos; leave-one-out needs 3.")
        left = views[one.number]
        return _Plan(train, [left], one.steps, held_out=left.name)
    count = {
        "paper": NOISY_PHOTOS,
        "noise": NOISY_PHOTOS,
        "scattered": SCATTERED_PHOTOS,
    }.get(one.recipe) or int(random.choice(FEW))
    # The paper fits 20 of the views and renders all: they are not where they were fitted.
    held_out = 0 if one.recipe == "paper" else max(1, min(one.views, len(views) // 4))
    count = min(count, len(views) - held_out)
    if count < 2:
        raise IgsrError(
            f"{capture.path} has {len(views)} views; {one.recipe} needs more to render."
        )
    order = random.permutation(len(views))
    train = [replace(views[i], split="train") for i in order[:count]]
    novel = [views[i] for i in order[count : count + one.views]]
    if one.recipe == "sparse":
        return _Plan(train, novel, one.steps)
    if one.recipe == "scattered":
        return _Plan(train, novel, SCATTERED_STEPS)
    if one.recipe == "underfit":
        whole = one.steps or preset_settings("default", count)["steps"]
        return _Plan(train, novel, max(1, int(random.uniform(0.25, 0.75) * whole)))
    noise = Noise(AFFINE, 0.01) if one.recipe == "paper" else _drawn_noise(random)
    unit = noise_unit(train)
    noisy = [noisy_view(view, noise, random, unit) for view in train]
    # No photo was fitted from where it is: as in the paper, all views may be rendered.
    novel = [views[i] for i in (*order[count:], *order[:count])]
    if one.recipe == "paper":
        return _Plan(noisy, novel, PAPER_STEPS, noise)
    return _Plan(noisy, novel[: one.views], one.steps, noise)


def _drawn_noise(random: np.random.Generator) -> Noise:
    """Noise of either kind, its size log-uniform."""
    kind, least, most = (MATRIX, *MATRIX_NOISE) if random.uniform() < 0.5 else (TURN, *TURN_NOISE)
    return Noise(kind, float(least * (most / least) ** random.uniform()))
