"""Training pairs: renders of fits that have too little to go on, beside the true pictures."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.resumable_jobs import Run, finished_runs
from igsr.capture import Capture, View, load_capture
from igsr.denoiser.inputs import CHANNELS, COLOR
from igsr.denoiser.training.pair_files import write_pairs
from igsr.denoiser.training.pair_renders import check_one_size, rendered_pairs
from igsr.errors import IgsrError
from igsr.evaluation.metrics import psnr
from igsr.evaluation.scores import WHITE
from igsr.fitting.presets import PAPER_STEPS, preset_settings
from igsr.fitting.run import fingerprint, fit_with_cameras
from igsr.geometry.camera_noise import AFFINE, MATRIX, TURN, Noise, noise_unit, noisy_view

#: Kinds of fits. "sparse" has 3 to 16 photos; "underfit" stops early; "noise" has wrong cameras;
#: "paper" is the paper's recipe, "scattered" its other one; "leave-one-out" leaves one photo of the
#: capture out of each fit, for a capture of one's own.
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
#: Of the photos fitted, so many are rendered too: what is good already must be seen in training.
FITTED_RENDERED = 1


@dataclass(frozen=True)
class PairFit:
    """One fit that pairs are made from; everything that they depend on."""

    capture: str
    recipe: str
    number: int
    views: int
    steps: int | None
    seed: int
    backend: str
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
    backend: str = "cpu",
    jobs: int = 1,
    on_run: Callable[[int, int, dict[str, Any]], None] | None = None,
    ray: bool = False,
) -> list[dict[str, Any]]:
    """Fit captures poorly in the ways of ``recipes`` and write what renders look like, and should.

    Args:
        captures: folders or files that ``igsr.load_capture`` reads, with no two names alike.
        out: folder for one ``.npz`` of pairs per fit, and ``runs/`` with a row about each; a fit
            whose row is there is not done again.
        recipes: names of ``RECIPES``.
        fits: fits per capture and recipe ("leave-one-out" has one per photo instead).
        views: unseen views rendered per fit, after noise also fitted ones from their true cameras;
            as many as there are, if fewer. "paper" renders all.
        steps: of each fit, where the recipe does not say; None is the default preset's.
        all_views: use the views too that a capture holds out to be scored, as of captures that
            nothing is ever scored on; without, what is trained never sees them.
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
                check_one_size(_chosen(capture, one, _random(one))[1])
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
    train, unseen, steps, about = _chosen(capture, one, random)
    given = Capture(capture.path, train, None if about.get("noise") else capture.points)
    splats, _ = fit_with_cameras(
        given, backend=one.backend, seed=one.seed + one.number, steps=steps, hull=_hull(one)
    )
    has_alpha = train[0].image.shape[2] == 4
    background: tuple[float, ...] | None = None
    if has_alpha:
        background = WHITE if random.uniform() < 0.7 else tuple(random.uniform(size=3))
    shown = [train[i] for i in random.permutation(len(train))]
    fitted = [view for view in shown if _size(view) == _size(unseen[0])][:FITTED_RENDERED]
    if one.recipe == "paper":  # which renders all views from their true cameras
        fitted = []
    pairs = rendered_pairs(splats, train, unseen + fitted, background, one.backend)
    file = f"{one.name}.npz"
    write_pairs(out / file, pairs)
    seen, true, masks = pairs.inputs[:, :COLOR], pairs.truth, pairs.masks
    before = [
        psnr(np.moveaxis(seen[k], 0, -1), np.moveaxis(true[k], 0, -1), masks[k])
        for k in range(len(unseen))
        if masks[k].any()
    ]
    if not before:
        raise IgsrError(f"{capture.path}: the masks of the views to render leave no pixel.")
    return {
        "pairs": file,
        "recipe": one.recipe,
        "photos": len(train),
        "steps": steps,
        "renders": len(pairs.truth),
        "psnr": float(np.mean(before)),
        **about,
    }


def _random(one: PairFit) -> np.random.Generator:
    """What a fit's choices are drawn from."""
    return np.random.default_rng(
        [one.seed, one.number, 0xDE40, *one.scene.encode(), *one.recipe.encode()]
    )


def _size(view: View) -> tuple[int, int]:
    return view.camera.width, view.camera.height


def _used(capture: Capture, all_views: bool) -> list[View]:
    return capture.views if all_views else capture.train_views


def _hull(one: PairFit) -> bool | None:
    """Silhouettes of wrong cameras, or as the paper had them, take nothing away."""
    return False if one.recipe in ("noise", "paper", "scattered") else None


def _chosen(
    capture: Capture, one: PairFit, random: np.random.Generator
) -> tuple[list[View], list[View], int | None, dict[str, Any]]:
    """Photos to fit (their cameras as the recipe has them), views to render, steps, and a note."""
    views = _used(capture, one.all_views)
    if one.recipe == "leave-one-out":
        train = [replace(v, split="train") for i, v in enumerate(views) if i != one.number]
        if len(train) < 2:
            raise IgsrError(f"{capture.path} has {len(views)} photos; leave-one-out needs 3.")
        return train, [views[one.number]], one.steps, {"left_out": views[one.number].name}
    count = {
        "paper": NOISY_PHOTOS,
        "noise": NOISY_PHOTOS,
        "scattered": SCATTERED_PHOTOS,
    }.get(one.recipe) or int(random.choice(FEW))
    # The paper fits 20 of the views and renders all: they are not where they were fitted.
    held = 0 if one.recipe == "paper" else max(1, min(one.views, len(views) // 4))
    count = min(count, len(views) - held)
    if count < 2:
        raise IgsrError(
            f"{capture.path} has {len(views)} views; {one.recipe} needs more to render."
        )
    order = random.permutation(len(views))
    train = [replace(views[i], split="train") for i in order[:count]]
    unseen = [views[i] for i in order[count : count + one.views]]
    if one.recipe == "sparse":
        return train, unseen, one.steps, {}
    if one.recipe == "scattered":
        return train, unseen, SCATTERED_STEPS, {}
    if one.recipe == "underfit":
        whole = one.steps or preset_settings("default", count)["steps"]
        return train, unseen, max(1, int(random.uniform(0.25, 0.75) * whole)), {}
    steps = one.steps
    if one.recipe == "paper":
        noise, steps = Noise(AFFINE, 0.01), PAPER_STEPS
    else:
        kind, least, most = (
            (MATRIX, *MATRIX_NOISE) if random.uniform() < 0.5 else (TURN, *TURN_NOISE)
        )
        size = least * (most / least) ** random.uniform()
        noise, steps = Noise(kind, float(size)), one.steps
    unit = noise_unit(train)
    # No photo was fitted from where it is: as in the paper, all views may be rendered.
    unseen = [views[i] for i in (*order[count:], *order[:count])]
    if one.recipe != "paper":
        unseen = unseen[: one.views]
    noisy = [noisy_view(view, noise, random, unit) for view in train]
    return noisy, unseen, steps, {"noise": str(noise)}
