"""The paper's experiments with its loop (Tables 2 and 3, Figure 7's sweep), and our ablation."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from igsr.errors import IgsrError
from igsr.refinement.loop import CHOSEN
from igsr.study.loop_runs import OURS, Rounds, studied

Path = str | os.PathLike[str]
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
#: Photos of the captures that the ablation is made on; others have 10.
ABLATION_PHOTOS = {"tankard": 6, "fern": 3}
ABLATION_METHODS = (*OURS, "improvement")


def table2(
    data: Path,
    out: Path,
    *,
    scenes: tuple[str, ...] = ("chair",),
    methods: tuple[str, ...] = TABLE2_METHODS,
    weights: Path | None = None,
    features: Path | None = None,
    steps: int | None = None,
    seeds: int = 3,
    backend: str = "cpu",
    jobs: int = 1,
    on_run: OnRun | None = None,
    ray: bool = False,
) -> dict[str, Any]:
    """A round of the paper's from 10 photos, localized and scattered, and two of ours.

    Args:
        data: folder that holds the scenes.
        out: folder for ``study.json``, ``study.md``, ``study.png``, a sheet of a held-out view by
            round for each choice of photos, ``runs/`` and ``rounds/``, what each loop leaves; what
            is there is not done again.
        scenes: names of folders in ``data``.
        methods: of ``igsr.study.loop_runs.METHODS``; the paper's add their best 2.
        weights: the denoiser's file; None is igsr's own.
        features: SqueezeNet's arrays (.npz), for the perceptual distance.
        steps: of each fit; None is the default preset's.
        seeds: how many seeds, from 0.
        backend: what fits and renders.
        jobs: runs at a time, each in a process of its own with its share of the cores.
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
    rounds = [
        Rounds(name, name, CHOSEN, 2, True) if name in OURS else Rounds(name, name, 2, 1, True)
        for name in methods
    ]
    title = "Table 2: 10 photos, one round of the paper's and two of ours"
    return studied(
        title, TABLE2_PAPER, data, out, kinds, rounds, weights, features, steps, seeds, backend,
        jobs, on_run, ray,
    )  # fmt: skip


def table3(
    data: Path,
    out: Path,
    *,
    scenes: tuple[str, ...] = ("tankard",),
    methods: tuple[str, ...] = TABLE3_METHODS,
    weights: Path | None = None,
    features: Path | None = None,
    steps: int | None = None,
    seeds: int = 3,
    backend: str = "cpu",
    jobs: int = 1,
    on_run: OnRun | None = None,
    ray: bool = False,
) -> dict[str, Any]:
    """Two rounds from 4 localized photos of a real object; arguments are those of ``table2``.

    The paper's methods add their best one. Raises as ``table2``.
    """
    kinds = [(scene, "localized", 4) for scene in scenes]
    rounds = [Rounds(name, name, CHOSEN if name in OURS else 1, 2, True) for name in methods]
    title = "Table 3: two rounds, 4 localized photos"
    return studied(
        title, TABLE3_PAPER, data, out, kinds, rounds, weights, features, steps, seeds, backend,
        jobs, on_run, ray,
    )  # fmt: skip


def sweep(
    data: Path,
    out: Path,
    *,
    scenes: tuple[str, ...] = ("chair",),
    views: tuple[str, ...] = SWEPT_PHOTOS,
    weights: Path | None = None,
    features: Path | None = None,
    steps: int | None = None,
    seeds: int = 1,
    backend: str = "cpu",
    jobs: int = 1,
    on_run: OnRun | None = None,
    ray: bool = False,
) -> dict[str, Any]:
    """4, 6, 10 and 15 scattered photos, up to four rounds of 1, 2 and 4 views, none rolled back.

    Arguments are those of ``table2``; ``views`` are the numbers of photos. Raises as ``table2``.
    """
    if not views or not all(text.isdecimal() and int(text) > 0 for text in views):
        raise IgsrError(f"views must be numbers of photos, not {', '.join(views) or 'none'}.")
    kinds = [(scene, "scattered", int(text)) for scene in scenes for text in views]
    rounds = [Rounds(f"ours-{count}", "ours", count, SWEPT_ROUNDS, False) for count in SWEPT_VIEWS]
    title = "Photos, rounds and views added per round"
    return studied(
        title, (), data, out, kinds, rounds, weights, features, steps, seeds, backend,
        jobs, on_run, ray,
    )  # fmt: skip


def refinement_ablation(
    data: Path,
    out: Path,
    *,
    scenes: tuple[str, ...] = tuple(ABLATION_PHOTOS),
    methods: tuple[str, ...] = ABLATION_METHODS,
    weights: Path | None = None,
    features: Path | None = None,
    steps: int | None = None,
    seeds: int = 1,
    backend: str = "cpu",
    jobs: int = 1,
    on_run: OnRun | None = None,
    ray: bool = False,
) -> dict[str, Any]:
    """One round of our loop with each of its parts taken out, none rolled back.

    Scenes have evenly spaced photos: the tankard 6, fern 3, others 10. Arguments are those of
    ``table2``. Raises as ``table2``.
    """
    kinds = [(scene, "even", ABLATION_PHOTOS.get(scene, 10)) for scene in scenes]
    rounds = [Rounds(name, name, CHOSEN if name in OURS else 2, 1, False) for name in methods]
    title = "One round, with parts of the loop taken out"
    return studied(
        title, (), data, out, kinds, rounds, weights, features, steps, seeds, backend,
        jobs, on_run, ray,
    )  # fmt: skip
