"""Presets compared on the same photos: ``blender8`` and ``few_photos``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from igsr._internal.choices import FitBackend
from igsr.capture import Capture, load_capture
from igsr.errors import IgsrError
from igsr.evaluation import metrics
from igsr.evaluation.scores import ScoredView, default_background, evaluate
from igsr.fitting.fit_capture import fit_capture
from igsr.fitting.pose_refinement import refine_cameras
from igsr.fitting.result import FitResult
from igsr_lab.denoiser.perceptual_distance import (
    Backbone,
    Distance,
    lpips_distance,
    picture_distance,
)
from igsr_lab.presets import PRESETS, Preset, preset_keywords, preset_settings
from igsr_lab.report_parts import (
    draw_psnr,
    label_groups,
    markdown_table,
    new_figure,
    save_figure,
)
from igsr_lab.resumable_jobs import Run
from igsr_lab.study.published import published
from igsr_lab.study.scoring import aligned_views
from igsr_lab.study.splits import DTU_TEST, dtu_views, is_dtu, llff_views, with_train_views
from igsr_lab.study.study import SCORE_COLUMNS, Row, Study, by_preset, grouped, with_spread

#: Indices into the train split of NeRF Synthetic, by few-view papers; codes based on 3DGS have 76
#: instead of 75.
VIEW_IDS = {
    "75": (26, 86, 2, 55, 75, 93, 16, 73),
    "76": (26, 86, 2, 55, 76, 93, 16, 73),
}
#: Numbers of photos of ``few_photos``: LLFF's and DTU's protocols; a turntable needs more photos.
FEW_VIEWS = ("3", "6", "9")
TURNTABLE_VIEWS = ("3", "6", "12")
#: Scores of each fit, kept in its row.
SCORES = ("psnr", "ssim", "flip", "cc_psnr", "cc_ssim")
#: Description of refined cameras for protocols.
REFINED = (
    "test cameras aligned to the fitted ones if those moved, then each fitted to its photo with "
    "frozen splats"
)


@dataclass(frozen=True)
class Fit:
    """One fit; its scores depend on nothing else. ``views`` names the choice of photos."""

    scene: str
    views: str
    preset: Preset
    seed: int
    backend: FitBackend
    lpips_backbone: Backbone | None = None


#: Loads the photos of a fit from the folder of scenes. A function of a module, for new processes.
Load = Callable[[str, Fit], Capture]


def blender8(
    study: Study,
    *,
    scenes: tuple[str, ...] = ("chair", "lego"),
    views: tuple[str, ...] = tuple(VIEW_IDS),
    presets: tuple[Preset, ...] = PRESETS,
    lpips: Backbone | None = None,
) -> Row:
    """Fit NeRF Synthetic from eight photos.

    Args:
        study: its data has ``transforms_train.json`` and ``transforms_test.json`` per scene.
        scenes: names of folders in the data.
        views: keys of ``VIEW_IDS``.
        presets: names of ``PRESETS``.
        lpips: also score LPIPS with this backbone, which torchvision downloads.

    Returns:
        The content of ``study.json``: "mean" by preset, with the standard deviation of each score
        over seeds; "scenes" by scene, views and preset; "runs"; "protocol".
    """
    unknown = [key for key in views if key not in VIEW_IDS]
    if unknown:
        raise IgsrError(f"views must be of {', '.join(VIEW_IDS)}, not {unknown[0]!r}.")
    study.check_scenes(scenes, "transforms_train.json")
    photos = {(scene, key): len(VIEW_IDS[key]) for scene in scenes for key in views}
    rows = fitted(study, load_blender8, photos, presets, lpips=lpips)
    protocol = {
        "name": "blender8",
        "train_views": {key: list(VIEW_IDS[key]) for key in views},
        "seeds": study.seeds,
        **rows[0]["protocol"],
    }
    return write_report(study, "NeRF Synthetic, 8 views", rows, protocol)


def few_photos(
    study: Study,
    *,
    scenes: tuple[str, ...] = ("fern", "dtu_scan24", "tankard"),
    views: tuple[str, ...] | None = None,
    presets: tuple[Preset, ...] = PRESETS,
    lpips: Backbone | None = None,
) -> Row:
    """Fit real captures from few photos.

    Scenes whose name starts with "dtu" have DTU's split, all others LLFF's. Photos of DTU are
    fitted whole and scored as in papers: PSNR in their masks, SSIM of pictures that are white
    outside. Elsewhere masked pixels are not fitted or scored. "psnr_refined" is the score after
    test cameras were fitted to their photos, for presets that move cameras.

    Args:
        study: its data has captures.
        scenes: names of folders in the data.
        views: numbers of photos to fit; None is 3, 6 and 9, or 3, 6 and 12 of the tankard.
        presets: names of ``PRESETS``.
        lpips: as ``blender8``.

    Returns:
        The content of ``study.json``, as ``blender8``; "protocol" names the fitted photos.
    """
    wrong = [count for count in views or () if not (count.isascii() and count.isdigit())]
    if wrong:
        raise IgsrError(f"views must be numbers of photos, such as 3, not {wrong[0]!r}.")
    photos: dict[tuple[str, str], int] = {}
    splits: Row = {}
    for scene in scenes:
        # Load all scenes first, so that an error does not come up after hours.
        capture = load_capture(study.data / scene)
        default = TURNTABLE_VIEWS if scene == "tankard" else FEW_VIEWS
        chosen = {count: few_views(capture, scene, count) for count in views or default}
        photos |= {(scene, count): len(few.train_views) for count, few in chosen.items()}
        splits[scene] = {
            "split": "DTU" if is_dtu(scene) else "LLFF",
            "masks": any(view.mask is not None for view in capture.views),
            "train_views": {
                count: [view.name for view in few.train_views] for count, few in chosen.items()
            },
        }
    rows = fitted(study, load_few_photos, photos, presets, refined=True, lpips=lpips)
    scored = rows[0]["protocol"]
    protocol = {
        "name": "few-photos",
        "splits": {
            "LLFF": "every 8th photo is scored, evenly spaced ones of the rest are fitted",
            "DTU": f"photos {', '.join(map(str, DTU_TEST))} are scored, PSNR in their masks, SSIM "
            "of pictures that are white outside",
        },
        "scenes": splits,
        "seeds": study.seeds,
        "refined": REFINED,
        "ssim": scored["ssim"],
        "flip": scored["flip"],
    }
    return write_report(study, "Real captures, few photos", rows, protocol)


def load_blender8(data: str, fit: Fit) -> Capture:
    """Load the eight photos and the test views of a scene."""
    return with_train_views(load_capture(Path(data) / fit.scene), VIEW_IDS[fit.views])


def load_few_photos(data: str, fit: Fit) -> Capture:
    """Load a scene with the split of ``few_photos``."""
    return few_views(load_capture(Path(data) / fit.scene), fit.scene, fit.views)


def few_views(capture: Capture, scene: str, views: str) -> Capture:
    """Split a capture by DTU's or LLFF's protocol."""
    return (dtu_views if is_dtu(scene) else llff_views)(capture, int(views))


def fitted(
    study: Study,
    load: Load,
    photos: dict[tuple[str, str], int],
    presets: tuple[Preset, ...],
    refined: bool = False,
    lpips: Backbone | None = None,
) -> list[Row]:
    """Execute all fits, seed by seed, so that an interrupted study has fits of all kinds.

    ``photos`` is the number of fitted photos by scene and views.
    """
    more: Row = {"refined": True} if refined else {}
    if lpips is not None:
        lpips_distance(lpips)  # before the first fit, so that an error does not come up after it
        more["lpips"] = lpips
    runs = [
        Run(
            f"{scene}-views{views}-{preset}-seed{seed}-{study.backend}",
            Fit(scene, views, preset, seed, study.backend, lpips),
            preset_settings(preset, photos[scene, views]) | more,
            scene=scene,
        )
        for seed in range(study.seeds)
        for scene, views in photos
        for preset in presets
    ]
    work = partial(run_fit, load, refined=True) if refined else partial(run_fit, load)
    return study.rows(runs, work)


def run_fit(load: Load, data: str, fit: Fit, refined: bool = False) -> Row:
    """Fit and score photos as ``igsr fit`` does; return the row."""
    capture = load(data, fit)
    keywords = preset_keywords(fit.preset, capture)
    result = fit_capture(capture, backend=fit.backend, seed=fit.seed, **keywords)
    more = MoreScores(white_outside=is_dtu(fit.scene), lpips=fit.lpips_backbone)
    scores = evaluate(result.splats, capture, backend=fit.backend, on_view=more.add)
    row: Row = {**vars(fit), **{name: scores[name] for name in SCORES}, **more.means()}
    if refined:
        row["psnr_refined"] = refined_psnr(result, capture, fit.backend)
    return row | {
        "splats": len(result.splats),
        "seconds": round(result.seconds, 2),
        "protocol": scores["protocol"],
    }


class MoreScores:
    """Scores of papers that ``evaluate`` does not have: "lpips", and "ssim" of white masks.

    Args:
        white_outside: make pictures white outside their masks.
        lpips: LPIPS' backbone, or None.
    """

    def __init__(self, white_outside: bool, lpips: Backbone | None) -> None:
        self._white_outside = white_outside
        self._lpips: Distance | None = None
        if lpips is not None:
            self._lpips = lpips_distance(lpips)
        self._rows: list[dict[str, float]] = []

    def add(self, view: ScoredView) -> None:
        """Score a view."""
        render, photo = view.render, view.photo
        if self._white_outside and view.mask is not None:
            inside, white = view.mask[..., None], np.uint8(255)
            render, photo = np.where(inside, render, white), np.where(inside, photo, white)
        row = {}
        if self._white_outside:
            row["ssim"] = metrics.ssim(render, photo)
        if self._lpips is not None:
            row["lpips"] = picture_distance(self._lpips, render, photo)
        self._rows.append(row)

    def means(self) -> dict[str, float]:
        """The means over the views."""
        return {name: float(np.mean([row[name] for row in self._rows])) for name in self._rows[0]}


def refined_psnr(result: FitResult, capture: Capture, backend: FitBackend) -> float:
    """PSNR of test views with cameras aligned to the fitted ones and fitted to their photos."""
    true = [view.camera for view in capture.train_views]
    moved = [view.camera for view in result.capture.train_views]
    background = default_background(capture)
    aligned = aligned_views(capture.test_views, true, moved)
    views = refine_cameras(result.splats, aligned, background, backend=backend)
    refined = Capture(capture.path, views)
    return float(evaluate(result.splats, refined, background=background, backend=backend)["psnr"])


def write_report(study: Study, title: str, rows: list[Row], protocol: Row) -> Row:
    """Write the study's files; return the content of ``study.json``."""
    scores = [name for name in SCORE_COLUMNS if name in rows[0]]
    photos = {views: "8" if views in VIEW_IDS else views for views in {r["views"] for r in rows}}
    groups = {
        (scene, views): same
        for scene, of_scene in grouped(rows, "scene").items()
        for views, same in grouped(of_scene, "views").items()
    }
    scenes: Row = {}
    for (scene, views), same in groups.items():
        scenes.setdefault(scene, {})[views] = by_preset(same, scores)
    report = {
        "title": title,
        "protocol": protocol,
        "mean": by_preset(rows, scores),
        "scenes": scenes,
        "published": published_rows([(scene, photos[views]) for scene, views in groups]),
        "runs": rows,
    }
    figure = new_figure(1.5 + 1.3 * len(groups), 4.0)
    axis = figure.subplots()
    dots = {", ".join(key): grouped(same, "preset") for key, same in groups.items()}
    draw_psnr(axis, dots)
    label_groups(axis, dots)
    axis.set_title(title, fontsize=10)
    save_figure(figure, study.out / "study.png")
    return study.write(report, table_lines)


def published_rows(groups: Sequence[tuple[str, str]]) -> list[Row]:
    """Published results on the photos of scenes and numbers of photos."""
    return [
        {"scene": scene, "photos": photos, **one._asdict()}
        for scene, photos in dict.fromkeys(groups)
        for one in published(scene, photos)
    ]


def table_lines(report: Row) -> list[str]:
    """Mean ± spread over seeds of each score."""
    names = [name for name in SCORE_COLUMNS if name in next(iter(report["mean"].values()))]
    groups = [
        (scene, views, presets)
        for scene, by_views in report["scenes"].items()
        for views, presets in by_views.items()
    ]
    rows = [
        [
            scene,
            views,
            preset,
            *(with_spread(scores[n], scores[f"{n}_spread"], SCORE_COLUMNS[n][1]) for n in names),
        ]
        for scene, views, presets in [*groups, ("mean", "all", report["mean"])]
        for preset, scores in presets.items()
    ]
    heads = ["scene", "views", "preset", *(SCORE_COLUMNS[name][0] for name in names)]
    lines = markdown_table(heads, rows, left=3)
    if report["published"]:
        cells = [
            [*(one[name] for name in ("scene", "photos", "method", "source"))]
            + [f"{one['psnr']:.2f}", "–" if one["ssim"] is None else f"{one['ssim']:.3f}"]
            for one in report["published"]
        ]
        heads = ["scene", "photos", "published", "scenes, source", "PSNR, dB", "SSIM"]
        lines += ["", *markdown_table(heads, cells, left=4)]
    return lines
