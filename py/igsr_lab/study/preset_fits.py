"""Presets compared on the same photos: ``blender8`` and ``few_photos``."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from igsr._internal.choices import FitBackend
from igsr._internal.resumable_jobs import Run
from igsr.capture import Capture, load_capture
from igsr.errors import IgsrError
from igsr.evaluation.scores import default_background, evaluate
from igsr.fitting.fit_capture import fit_capture
from igsr.fitting.pose_refinement import refine_cameras
from igsr.fitting.result import FitResult
from igsr_lab.presets import PRESETS, Preset, preset_keywords, preset_settings
from igsr_lab.report_parts import markdown_table, new_figure, save_figure
from igsr_lab.study.scoring import aligned_views
from igsr_lab.study.splits import dtu_views, is_dtu, llff_views, with_train_views
from igsr_lab.study.study import Row, Study, deviation, seed_means, with_spread

#: Indices into the train split of NeRF Synthetic, by few-view papers; codes based on 3DGS have 76
#: instead of 75.
VIEW_IDS = {
    "75": (26, 86, 2, 55, 75, 93, 16, 73),
    "76": (26, 86, 2, 55, 76, 93, 16, 73),
}
#: Numbers of photos of ``few_photos``: those of LLFF's and DTU's protocols, and of a turntable,
#: which needs more to go all round.
FEW_VIEWS = ("3", "6", "9")
TURNTABLE_VIEWS = ("3", "6", "12")
#: Scores of each fit, kept in its row.
SCORES = ("psnr", "ssim", "flip", "cc_psnr", "cc_ssim")
#: Columns of the table with their formats; a study has some of them.
COLUMNS = {
    "psnr": ("PSNR, dB", ".2f"),
    "psnr_refined": ("refined PSNR, dB", ".2f"),
    "ssim": ("SSIM", ".4f"),
    "flip": ("FLIP", ".4f"),
    "cc_psnr": ("cc PSNR, dB", ".2f"),
    "cc_ssim": ("cc SSIM", ".4f"),
    "splats": ("splats", ".0f"),
    "seconds": ("seconds a fit", ".0f"),
}
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


#: Loads the photos of a fit from the folder of scenes. A function of a module, for new processes.
Load = Callable[[str, Fit], Capture]


def blender8(
    study: Study,
    *,
    scenes: tuple[str, ...] = ("chair", "lego"),
    views: tuple[str, ...] = tuple(VIEW_IDS),
    presets: tuple[Preset, ...] = PRESETS,
) -> Row:
    """Fit NeRF Synthetic from eight photos.

    Args:
        study: its data has ``transforms_train.json`` and ``transforms_test.json`` per scene.
        scenes: names of folders in the data.
        views: keys of ``VIEW_IDS``.
        presets: names of ``PRESETS``.

    Returns:
        The content of ``study.json``: "mean" by preset, with the standard deviation of each score
        over seeds; "scenes" by scene, views and preset; "runs"; "protocol".
    """
    unknown = [key for key in views if key not in VIEW_IDS]
    if unknown:
        raise IgsrError(f"views must be of {', '.join(VIEW_IDS)}, not {unknown[0]!r}.")
    study.check_scenes(scenes, "transforms_train.json")
    photos = {(scene, key): len(VIEW_IDS[key]) for scene in scenes for key in views}
    rows = fitted(study, load_blender8, photos, presets)
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
) -> Row:
    """Fit real captures from few photos.

    Scenes whose name starts with "dtu" have DTU's split, all others LLFF's. Masked pixels are not
    fitted or scored. "psnr_refined" is the score after test cameras were fitted to their photos,
    for presets that move cameras.

    Args:
        study: its data has captures.
        scenes: names of folders in the data.
        views: numbers of photos to fit; None is 3, 6 and 9, or 3, 6 and 12 of the tankard.
        presets: names of ``PRESETS``.

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
    rows = fitted(study, load_few_photos, photos, presets, refined=True)
    scored = rows[0]["protocol"]
    protocol = {
        "name": "few-photos",
        "splits": {
            "LLFF": "every 8th photo is scored, evenly spaced ones of the rest are fitted",
            "DTU": "all photos that are not fitted are scored",
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
) -> list[Row]:
    """Execute all fits, seed by seed, so that an interrupted study has fits of all kinds.

    ``photos`` is the number of fitted photos by scene and views.
    """
    more = {"refined": True} if refined else {}
    runs = [
        Run(
            f"{scene}-views{views}-{preset}-seed{seed}-{study.backend}",
            Fit(scene, views, preset, seed, study.backend),
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
    scores = evaluate(result.splats, capture, backend=fit.backend)
    row: Row = {**vars(fit), **{name: scores[name] for name in SCORES}}
    if refined:
        row["psnr_refined"] = refined_psnr(result, capture, fit.backend)
    return row | {
        "splats": len(result.splats),
        "seconds": round(result.seconds, 2),
        "protocol": scores["protocol"],
    }


def refined_psnr(result: FitResult, capture: Capture, backend: FitBackend) -> float:
    """PSNR of test views with cameras aligned to the fitted ones and fitted to their photos."""
    true = [view.camera for view in capture.train_views]
    moved = [view.camera for view in result.capture.train_views]
    background = default_background(capture)
    aligned = aligned_views(capture.test_views, true, moved)
    views = refine_cameras(result.splats, aligned, background, backend=backend)
    refined = Capture(capture.path, views)
    return float(evaluate(result.splats, refined, background=background, backend=backend)["psnr"])


def summarized(rows: list[Row]) -> Row:
    """Mean of each score over the rows, and its standard deviation over seeds."""
    summary: Row = {"fits": len(rows)}
    for score in (score for score in COLUMNS if all(score in row for row in rows)):
        means = seed_means(rows, lambda row, score=score: row[score])  # type: ignore[misc]
        summary[score] = float(np.mean(means))
        summary[f"{score}_spread"] = deviation(means)
    return summary


def write_report(study: Study, title: str, rows: list[Row], protocol: Row) -> Row:
    """Write the study's files; return the content of ``study.json``."""
    presets = dict.fromkeys(row["preset"] for row in rows)
    scenes: dict[str, Row] = {}
    for scene, views in dict.fromkeys((row["scene"], row["views"]) for row in rows):
        same = [row for row in rows if (row["scene"], row["views"]) == (scene, views)]
        scenes.setdefault(scene, {})[views] = _by_preset(same, presets)
    report = {
        "title": title,
        "protocol": protocol,
        "mean": _by_preset(rows, presets),
        "scenes": scenes,
        "runs": rows,
    }
    _plot(study.out / "study.png", report)
    return study.write(report, table_lines)


def _by_preset(rows: list[Row], presets: Iterable[str]) -> Row:
    return {
        preset: summarized([row for row in rows if row["preset"] == preset]) for preset in presets
    }


def _groups(report: Row) -> list[tuple[str, str, Row]]:
    """Scene, views and the summaries by preset."""
    return [
        (scene, views, presets)
        for scene, by_views in report["scenes"].items()
        for views, presets in by_views.items()
    ]


def table_lines(report: Row) -> list[str]:
    """Mean ± spread over seeds of each score."""
    names = [name for name in COLUMNS if name in next(iter(report["mean"].values()))]
    rows = [
        [
            scene,
            views,
            preset,
            *(with_spread(scores[n], scores[f"{n}_spread"], COLUMNS[n][1]) for n in names),
        ]
        for scene, views, presets in [*_groups(report), ("mean", "all", report["mean"])]
        for preset, scores in presets.items()
    ]
    heads = ["scene", "views", "preset", *(COLUMNS[name][0] for name in names)]
    return markdown_table(heads, rows, left=3)


def _plot(path: Path, report: Row) -> None:
    """PSNR of every fit, by scene, views and preset."""
    groups, presets = _groups(report), list(report["mean"])
    figure = new_figure(1.5 + 1.3 * len(groups), 4.0)
    axis = figure.subplots()
    for k, preset in enumerate(presets):
        for g, (scene, views, summaries) in enumerate(groups):
            psnrs = [
                row["psnr"]
                for row in report["runs"]
                if (row["scene"], row["views"], row["preset"]) == (scene, views, preset)
            ]
            at = g + 0.5 * (k + 0.5) / len(presets) - 0.25
            axis.plot([at] * len(psnrs), psnrs, "o", color=f"C{k}", alpha=0.6)
            mean = summaries[preset]["psnr"]
            label = preset if g == 0 else None
            axis.plot(at, mean, "_", markersize=16, markeredgewidth=2, color=f"C{k}", label=label)
    labels = [f"{scene}\nviews {views}" for scene, views, _ in groups]
    axis.set_xticks(range(len(groups)), labels, fontsize=8)
    axis.set_xlim(-0.5, len(groups) - 0.5)
    axis.set_ylabel("PSNR of held-out views, dB")
    axis.set_title(report["title"], fontsize=10)
    axis.grid(alpha=0.3, axis="y")
    axis.legend(fontsize=9)
    save_figure(figure, path)
