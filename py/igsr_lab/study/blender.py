"""NeRF Synthetic from eight photos: presets side by side on the same views."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from igsr._internal.choices import FitBackend
from igsr.capture import Capture, load_capture
from igsr.errors import IgsrError
from igsr.fitting.presets import PRESETS, Preset
from igsr_lab.study.scored_fits import Fit, fitted
from igsr_lab.study.splits import with_train_views
from igsr_lab.study.summary import write_study

#: Indices into the train split, as few-view papers have them; codes that derive from 3DGS have 76
#: where the others have 75.
VIEW_IDS = {
    "75": (26, 86, 2, 55, 75, 93, 16, 73),
    "76": (26, 86, 2, 55, 76, 93, 16, 73),
}
SCENES = ("chair", "lego")


def load_views(data: str, one: Fit) -> Capture:
    """A scene with the eight photos of the protocol and its test views."""
    return with_train_views(load_capture(Path(data) / one.scene), VIEW_IDS[one.views])


def blender8(
    data: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    scenes: tuple[str, ...] = SCENES,
    views: tuple[str, ...] = tuple(VIEW_IDS),
    presets: tuple[Preset, ...] = PRESETS,
    seeds: int = 3,
    backend: FitBackend = "cpu",
    jobs: int = 1,
    on_run: Callable[[int, int, dict[str, Any]], None] | None = None,
    ray: bool = False,
) -> dict[str, Any]:
    """Fit every scene from eight photos with every preset and seed, and write what they score.

    Args:
        data: folder that holds the scenes, each with ``transforms_train.json`` and
            ``transforms_test.json``.
        out: folder for ``study.json``, ``study.md``, ``study.png`` and ``runs/``, one file per fit;
            a fit whose file is there is not done again.
        scenes: names of folders in ``data``.
        views: keys of ``VIEW_IDS``.
        presets: names of ``igsr.fitting.presets``.
        seeds: how many seeds, from 0.
        backend: what fits and renders.
        jobs: fits at a time, each in a process of its own with its share of the cores.
        on_run: called with (done, all, the fit's row) after each fit.
        ray: fits run over a Ray cluster instead (``pip install 'igsr[ray]'``).

    Returns:
        What ``study.json`` holds: "mean" by preset over all fits, each score with its spread (the
        standard deviation over seeds of each seed's mean), "scenes" by scene, views and preset,
        "runs", "protocol".

    Raises:
        IgsrError: a scene cannot be read, or a fit fails.
    """
    unknown = [key for key in views if key not in VIEW_IDS]
    if unknown:
        raise IgsrError(f"views must be of {', '.join(VIEW_IDS)}, not {unknown[0]!r}.")
    for scene in scenes:
        if not (Path(data) / scene / "transforms_train.json").is_file():
            raise IgsrError(f"{Path(data) / scene} holds no transforms_train.json; name --scene.")
    photos = {(scene, key): len(VIEW_IDS[key]) for scene in scenes for key in views}
    rows = fitted(data, out, load_views, photos, presets, seeds, backend, jobs, on_run, ray)
    protocol = {
        "name": "blender8",
        "train_views": {key: list(VIEW_IDS[key]) for key in views},
        "seeds": seeds,
        **rows[0]["protocol"],
    }
    return write_study(Path(out), "NeRF Synthetic, 8 views", rows, protocol)
