"""The page of accuracy: every implementation at every setting that trades error for time.

One small scene, so that even the reference's own time can be measured. Two errors are told apart:
that of the arithmetic, an implementation against the f64 reference at the same setting; and that of
the setting itself, the f64 reference at that setting against the f64 reference without it.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr.splats import MAX_SH_DEGREE
from igsr_lab.bench import oracle
from igsr_lab.bench.comparison import BOUND_3D, FLIP
from igsr_lab.bench.machine import describe_machine
from igsr_lab.bench.plots import plot_speed_vs_error
from igsr_lab.bench.scenes import Arrays, Scene, ball
from igsr_lab.bench.stage_rows import pipeline_rows
from igsr_lab.bench.table import machine_line, milliseconds

#: The scene: small enough for the reference to walk all splats at every pixel, and its splats about
#: a pixel in size, where antialiasing matters.
COUNT, WIDTH, HEIGHT, SIZE = 2000, 128, 96, 0.4
#: How long one row is repeated.
SECONDS = 1.0
#: Samples per pixel along each axis of the picture that nothing is left out of.
SAMPLES = 8
#: Longest line of the page's text, characters.
LONGEST_LINE = 100
PLOT_NAME = "speed_vs_error.png"

Table = list[list[str]]


@dataclass(frozen=True)
class Setting:
    """One way to draw the scene.

    Attributes:
        name: what it is called.
        scene: the scene with it.
        against: what its own error is measured against.
        whole: that picture, f64.
    """

    name: str
    scene: Scene
    against: str
    whole: Arrays


def settings(scene: Scene) -> list[Setting]:
    """Every setting: SH degrees against the highest, then both modes against many samples."""
    top = replace(scene, sh_degree=MAX_SH_DEGREE)
    highest, many = _reference_picture(top), many_samples(top)
    degrees = [
        Setting(
            f"SH degree {degree}",
            replace(scene, sh_degree=degree),
            f"SH degree {MAX_SH_DEGREE}",
            highest,
        )
        for degree in range(MAX_SH_DEGREE)
    ]
    samples = f"{SAMPLES}×{SAMPLES} samples per pixel"
    name = f"SH degree {MAX_SH_DEGREE}"
    return [
        *degrees,
        Setting(name, top, samples, many),
        Setting(f"{name}, antialiased", replace(top, antialiased=True), samples, many),
    ]


def many_samples(scene: Scene) -> Arrays:
    """The scene's picture in f64 with ``SAMPLES``^2 samples per pixel in place of the blur.

    A sample keeps the renderer's blur in its own, finer pixels, so that no splat falls between
    samples.
    """
    fine = replace(
        scene,
        intrinsics=scene.intrinsics * SAMPLES,
        width=scene.width * SAMPLES,
        height=scene.height * SAMPLES,
    )
    shape = (scene.height, SAMPLES, scene.width, SAMPLES)
    image = _reference_picture(fine)
    return {
        "color": image["color"].reshape(*shape, 3).mean(axis=(1, 3)),
        "alpha": image["alpha"].reshape(shape).mean(axis=(1, 3)),
    }


def _reference_picture(scene: Scene) -> Arrays:
    projected = _core.project(*scene.arrays(np.float64), **scene.options(), backend="reference")
    crops = oracle.crops(projected, scene.width, scene.height)
    return oracle.picture(projected, crops, (scene.height, scene.width), scene.background)


def setting_columns(setting: Setting) -> dict[str, Any]:
    """A setting's name and its own error, for each of its rows."""
    image = _reference_picture(setting.scene)
    difference = np.maximum(
        np.abs(image["color"] - setting.whole["color"]).max(axis=2),
        np.abs(image["alpha"] - setting.whole["alpha"]),
    )
    return {
        "setting": setting.name,
        "setting_against": setting.against,
        "setting_max_error": float(difference.max()),
        "setting_mean_error": float(difference.mean()),
    }


def measure_accuracy(
    backends: tuple[str, ...],
    seed: int,
    seconds: float = SECONDS,
    on_row: Callable[[str], object] = lambda doing: None,
    scene: Scene | None = None,
) -> dict[str, Any]:
    """``{"machine": ..., "rows": [...]}``; each row names its setting.

    Args:
        backends: names as ``resolved_backends`` returns them.
        seed: of the scene.
        seconds: spent on each time.
        on_row: called with each row when it is measured.
        scene: to measure on; None is the default scene of ``seed``.
    """
    scene = ball(seed, COUNT, WIDTH, HEIGHT, MAX_SH_DEGREE, SIZE) if scene is None else scene
    machine = describe_machine(list(backends), seed)
    on_row("what the settings leave out")
    rows: list[dict[str, Any]] = []
    for setting in settings(scene):
        columns = setting_columns(setting)
        for backend in backends:
            on_row(f"{setting.name} on {backend}")
            measured = pipeline_rows("accuracy", setting.scene, backend, seed, seconds)
            rows.extend({**row, **columns} for row in measured)
    return {"machine": machine, "rows": rows}


def write_accuracy(path: Path, report: dict[str, Any]) -> None:
    """Write the page, and its plot beside it.

    Args:
        path: of the Markdown page.
        report: of ``measure_accuracy``.

    Raises:
        IgsrError: a file cannot be written.
    """
    plot_speed_vs_error(path.with_name(PLOT_NAME), report)
    with atomic_write(path) as temporary:
        temporary.write_text(accuracy_page(report), encoding="utf-8")


def accuracy_page(report: dict[str, Any]) -> str:
    """The page in Markdown."""
    machine, rows = report["machine"], report["rows"]
    first = rows[0]
    compared = min(row["compared_pixels"] for row in rows)
    left_out = max(row["left_out_pixels"] for row in rows)
    figures: Table = []
    for forward, backward in zip(rows[::2], rows[1::2], strict=True):
        figures.append(
            [
                forward["setting"],
                forward["backend"],
                milliseconds(forward["ms"]),
                milliseconds(backward["ms"]),
                _scientific(forward["max_error"]),
                _scientific(forward["mean_error"]),
                f"{_scientific(backward['max_error'])} ({backward['worst']})",
                _scientific(backward["mean_error"]),
                str(forward["band_pixels"]),
                str(forward["left_out_pixels"]),
            ]
        )
    own = {
        row["setting"]: [
            row["setting"],
            row["setting_against"],
            _scientific(row["setting_max_error"]),
            _scientific(row["setting_mean_error"]),
        ]
        for row in rows
    }
    headings = ["setting", "implementation", "forward, ms", "backward, ms", "picture: max", "mean"]
    headings += ["gradients: max", "mean", "band pixels", "left out"]
    return _wrapped(
        [
            "# Accuracy",
            "",
            "Written by `make accuracy`; do not edit.",
            "",
            f"Measured with {machine_line(machine)}. The scene: {first['splats']} splats of about "
            f"a pixel on {first['width']}×{first['height']}; {compared} of its "
            f"{first['width'] * first['height']} pixels are compared, of which a line of the table "
            f"leaves out {left_out} at most. Gradients are of a random loss over colour, alpha and "
            "depth.",
            "",
            "## The arithmetic",
            "",
            "Each implementation against the f64 reference at the same setting, on the same f32 "
            "splats. The reference's own line compares its walk over all splats with the culled "
            "one that the others are compared with: culling leaves out only pairs that contribute "
            "nothing. "
            "Gradients are in parts of the largest of their kind, for the worst kind. A pixel of "
            "the [band](numerics.md#bounds-and-what-is-measured) is left out only where it differs "
            f"by more than the bound, {max(BOUND_3D.values()):g}, or its transmittance by more "
            f"than {FLIP:g} of itself.",
            "",
            *_markdown(headings, figures, left=2),
            "",
            f"![time against largest error of every setting]({PLOT_NAME})",
            "",
            "## The settings",
            "",
            "What a setting itself leaves out, in f64: lower SH degrees against the highest, the "
            "plain and the antialiased mode against a picture that many samples per pixel make "
            "sharp instead of the blur. These splats draw all degrees and are small; a fitted "
            "scene holds less of the higher degrees and is closer to what it was fitted to.",
            "",
            *_markdown(["setting", "against", "max", "mean"], list(own.values()), left=2),
            "",
            "## What is no setting",
            "",
            "* **The exponential.** One polynomial on the cpu (relative error below 1.2e-7 over "
            "all that can be seen, a test) and the device's own on the gpu; there is no coarser "
            "one.",
            "* **Tile culling.** Only the exact one: no pair with alpha ≥ 1/255 is lost, so "
            "it trades nothing.",
            "* **Storage.** f32 everywhere; nothing is kept in half precision.",
            "",
            "## How it is measured",
            "",
            machine["protocol"],
            "",
        ]
    )


def _wrapped(lines: list[str]) -> str:
    """The lines with paragraphs wrapped to fit a screen; tables stay as they are."""
    wrapped = []
    for line in lines:
        indent = "  " if line.startswith("* ") else ""
        wrap = len(line) > LONGEST_LINE and not line.startswith("|")
        wrapped += (
            textwrap.wrap(
                line,
                LONGEST_LINE,
                subsequent_indent=indent,
                break_long_words=False,
                break_on_hyphens=False,
            )
            if wrap
            else [line]
        )
    return "\n".join(wrapped)


def _scientific(value: float) -> str:
    return "0" if value == 0.0 else f"{value:.1e}"


def _markdown(headings: list[str], rows: Table, left: int) -> list[str]:
    """A Markdown table; columns after the first ``left`` are numbers."""
    rule = ["---" if column < left else "---:" for column in range(len(headings))]
    return ["| " + " | ".join(line) + " |" for line in [headings, rule, *rows]]
