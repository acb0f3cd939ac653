"""NeRF Synthetic from eight photos: presets side by side on the same views."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..capture import Capture, load_capture
from ..errors import IgsrError
from ..evaluation import WHITE, evaluate
from ..fitting import fit
from ..presets import preset_settings
from .runs import Run, finished_runs
from .summary import write_study

#: Indices into the train split, as few-view papers have them; codes that derive from 3DGS have 76
#: where the others have 75.
VIEW_IDS = {
    "75": (26, 86, 2, 55, 75, 93, 16, 73),
    "76": (26, 86, 2, 55, 76, 93, 16, 73),
}
SCORES = ("psnr", "ssim", "flip")


@dataclass(frozen=True)
class Fit:
    """One fit of the study; everything that its scores depend on."""

    scene: str
    views: str
    preset: str
    seed: int
    backend: str


def with_train_views(capture: Capture, ids: tuple[int, ...]) -> Capture:
    """The capture with these of its train views, by index, and all of its test views.

    Raises:
        IgsrError: it has no train view of such an index, or no test views.
    """
    train = capture.train_views
    if max(ids) >= len(train):
        raise IgsrError(
            f"{capture.path} has {len(train)} train views; the protocol needs number {max(ids)}."
        )
    if not capture.test_views:
        raise IgsrError(f"{capture.path} has no test views to score.")
    return Capture(capture.path, [train[i] for i in ids] + capture.test_views, capture.points)


def run_fit(data: str, one: Fit) -> dict[str, Any]:
    """Fit and score; for a process of its own."""
    capture = with_train_views(load_capture(Path(data) / one.scene), VIEW_IDS[one.views])
    seconds = 0.0

    def progress(now: Any) -> None:
        nonlocal seconds
        seconds = now.seconds

    splats = fit(capture, backend=one.backend, seed=one.seed, preset=one.preset, progress=progress)
    scores = evaluate(splats, capture, background=WHITE, backend=one.backend)
    return {
        **vars(one),
        **{name: scores[name] for name in SCORES},
        "splats": len(splats),
        "seconds": round(seconds, 2),
        "protocol": scores["protocol"],
    }


def blender8(
    data: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    scenes: tuple[str, ...] = ("chair", "lego"),
    views: tuple[str, ...] = ("75", "76"),
    presets: tuple[str, ...] = ("default", "3dgs"),
    seeds: int = 3,
    backend: str = "cpu",
    jobs: int = 1,
    on_run: Callable[[int, int, dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Fit every scene from eight photos with every preset and seed, and write what they score.

    Args:
        data: folder that holds the scenes, each with ``transforms_train.json`` and
            ``transforms_test.json``.
        out: folder for ``study.json``, ``study.md``, ``study.png`` and ``runs/``, one file per fit;
            a fit whose file is there is not done again.
        scenes: names of folders in ``data``.
        views: keys of ``VIEW_IDS``.
        presets: names of ``igsr.presets``.
        seeds: how many seeds, from 0.
        backend: what fits and renders.
        jobs: fits at a time, each in a process of its own with its share of the cores.
        on_run: called with (done, all, the fit's row) after each fit.

    Returns:
        What ``study.json`` holds: "mean" by preset over all fits, each score with its spread (the
        standard deviation over seeds of each seed's mean), "scenes" by scene and preset, "runs",
        "protocol".

    Raises:
        IgsrError: a scene cannot be read, or a fit fails.
    """
    if seeds < 1 or jobs < 1:
        raise IgsrError("seeds and jobs must be at least 1.")
    unknown = [key for key in views if key not in VIEW_IDS]
    if unknown:
        raise IgsrError(f"views must be of {', '.join(VIEW_IDS)}, not {unknown[0]!r}.")
    for scene in scenes:
        if not (Path(data) / scene / "transforms_train.json").is_file():
            raise IgsrError(f"{Path(data) / scene} holds no transforms_train.json; name --scenes.")
    fits = [
        Fit(scene, ids, preset, seed, backend)
        for seed in range(seeds)
        for scene in scenes
        for ids in views
        for preset in presets
    ]
    tasks = [
        Run(
            f"{one.scene}-views{one.views}-{one.preset}-seed{one.seed}-{one.backend}",
            one,
            preset_settings(one.preset, len(VIEW_IDS[one.views])),
        )
        for one in fits
    ]
    rows = finished_runs(Path(out) / "runs", tasks, run_fit, str(data), jobs, on_run)
    protocol = {
        "name": "blender8",
        "train_views": {key: list(VIEW_IDS[key]) for key in views},
        "seeds": seeds,
        **rows[0]["protocol"],
    }
    return write_study(Path(out), "NeRF Synthetic, 8 views", rows, presets, scenes, protocol)
