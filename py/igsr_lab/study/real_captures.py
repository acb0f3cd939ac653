"""Real captures from 3 to 12 photos: presets side by side on the same views."""

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
from igsr_lab.study.splits import dtu_views, llff_views
from igsr_lab.study.summary import write_study

SCENES = ("fern", "dtu_scan24", "tankard")
#: Numbers of photos. LLFF's and DTU's protocols have three; a turntable needs more to go round.
VIEWS = ("3", "6", "9")
TURNTABLE_VIEWS = ("3", "6", "12")


def default_views(scene: str) -> tuple[str, ...]:
    """The numbers of photos that a scene is fitted from."""
    return TURNTABLE_VIEWS if scene == "tankard" else VIEWS


def is_dtu(scene: str) -> bool:
    """Whether a scene, by its name, has DTU's split; all others have LLFF's."""
    return scene.startswith("dtu")


def load_views(data: str, one: Fit) -> Capture:
    """A scene with the photos of the protocol to fit and to score."""
    return _chosen(load_capture(Path(data) / one.scene), one.scene, one.views)


def _chosen(capture: Capture, scene: str, views: str) -> Capture:
    return (dtu_views if is_dtu(scene) else llff_views)(capture, int(views))


def few_photos(
    data: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    scenes: tuple[str, ...] = SCENES,
    views: tuple[str, ...] | None = None,
    presets: tuple[Preset, ...] = PRESETS,
    seeds: int = 3,
    backend: FitBackend = "cpu",
    jobs: int = 1,
    on_run: Callable[[int, int, dict[str, Any]], None] | None = None,
    ray: bool = False,
) -> dict[str, Any]:
    """Fit every scene from few photos with every preset and seed, and write what they score.

    Scenes whose name starts with "dtu" have DTU's split (see ``dtu_views``), others LLFF's (see
    ``llff_views``). Where a capture has masks, only pixels inside are fitted and scored.
    "psnr_refined" is scored with test cameras fitted to their photos, which presets that move
    cameras need.

    Args:
        data: folder that holds the scenes, each a capture that ``igsr.load_capture`` reads.
        out: folder for ``study.json``, ``study.md``, ``study.png`` and ``runs/``, one file per fit;
            a fit whose file is there is not done again.
        scenes: names of folders in ``data``.
        views: numbers of photos to fit, the same for all scenes; None is each scene's own.
        presets: names of ``igsr.fitting.presets``.
        seeds: how many seeds, from 0.
        backend: what fits and renders.
        jobs: fits at a time, each in a process of its own with its share of the cores.
        on_run: called with (done, all, the fit's row) after each fit.
        ray: fits run over a Ray cluster instead (``pip install 'igsr[ray]'``).

    Returns:
        What ``study.json`` holds: "mean" by preset over all fits, each score with its spread (the
        standard deviation over seeds of each seed's mean), "scenes" by scene, views and preset,
        "runs", "protocol" with the names of the photos fitted and how many are scored.

    Raises:
        IgsrError: a scene cannot be read or has too few photos, or a fit fails.
    """
    wrong = [count for count in views or () if not (count.isascii() and count.isdigit())]
    if wrong:
        raise IgsrError(f"views must be numbers of photos, such as 3, not {wrong[0]!r}.")
    photos: dict[tuple[str, str], int] = {}
    splits: dict[str, Any] = {}
    for scene in scenes:
        # Read before the first fit: what is wrong with the last scene must not come up hours later.
        capture = load_capture(Path(data) / scene)
        train: dict[str, list[str]] = {}
        for count in views or default_views(scene):
            chosen = _chosen(capture, scene, count)
            train[count] = [view.name for view in chosen.train_views]
            photos[scene, count] = len(train[count])
        masked = any(view.mask is not None for view in capture.views)
        splits[scene] = {"split": "DTU" if is_dtu(scene) else "LLFF", "masks": masked}
        splits[scene]["train_views"] = train
    rows = fitted(
        data, out, load_views, photos, presets, seeds, backend, jobs, on_run, ray, refined=True
    )
    scored = rows[0]["protocol"]
    protocol = {
        "name": "few-photos",
        "splits": {
            "LLFF": "every 8th photo scored, evenly spaced ones of the rest fitted",
            "DTU": "all photos scored that are not fitted",
        },
        "scenes": splits,
        "seeds": seeds,
        "refined": "test cameras aligned to the fitted ones where those moved, then each fitted to "
        "its photo, splats frozen",
        "ssim": scored["ssim"],
        "flip": scored["flip"],
    }
    return write_study(Path(out), "Real captures, few photos", rows, protocol)
