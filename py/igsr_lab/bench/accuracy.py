"""The page about accuracy: every implementation at every setting that trades error for time.

The scene is small, so that the reference can be timed, too. There are two errors: of the
arithmetic, an implementation against the f64 reference at the same setting; and of the
setting, the f64 reference with it against the f64 reference without.
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
from igsr_lab.bench.comparison import BOUND_3D, MIN_FLIP
from igsr_lab.bench.plots import plot_speed_vs_error
from igsr_lab.bench.scenes import Arrays, Scene, ball
from igsr_lab.bench.stage_rows import pipeline_rows
from igsr_lab.bench.table import describe_machine, machine_line, milliseconds
from igsr_lab.report_parts import markdown_table

#: The scene: few splats of about a pixel, whose antialiasing matters.
COUNT = 2000
WIDTH, HEIGHT = 128, 96
SIZE = 0.4
#: Time that a row is repeated.
SECONDS = 1.0
#: Samples per pixel along each axis of the exact picture.
SAMPLES = 8
#: Maximum length of the page's lines.
MAX_LINE = 100
PLOT_NAME = "speed_vs_error.png"


@dataclass(frozen=True)
class Setting:
    """One way to render the scene, and the f64 picture ``against`` which its error is measured."""

    name: str
    scene: Scene
    against: str
    whole: Arrays


def settings(scene: Scene) -> list[Setting]:
    """SH degrees against the highest, then both modes against many samples."""
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
    """The picture in f64 with ``SAMPLES``^2 samples per pixel instead of the blur.

    Samples have the renderer's blur at their finer size, so that none misses a splat.
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
    """Name and error of a setting, for its rows."""
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
    """Measure every setting; return ``{"machine": ..., "rows": [...]}``."""
    scene = ball(seed, COUNT, WIDTH, HEIGHT, MAX_SH_DEGREE, SIZE) if scene is None else scene
    machine = describe_machine(list(backends), seed)
    on_row("errors of the settings")
    rows: list[dict[str, Any]] = []
    for setting in settings(scene):
        columns = setting_columns(setting)
        for backend in backends:
            on_row(f"{setting.name} on {backend}")
            measured = pipeline_rows("accuracy", setting.scene, backend, seed, seconds)
            rows.extend({**row, **columns} for row in measured)
    return {"machine": machine, "rows": rows}


def write_accuracy(path: Path, report: dict[str, Any]) -> None:
    """Write the Markdown page and its plot."""
    plot_speed_vs_error(path.with_name(PLOT_NAME), report)
    with atomic_write(path) as temporary:
        temporary.write_text(accuracy_page(report), encoding="utf-8")


def accuracy_page(report: dict[str, Any]) -> str:
    """The page in Markdown."""
    rows = report["rows"]
    first = rows[0]
    compared = min(row["compared_pixels"] for row in rows)
    left_out = max(row["left_out_pixels"] for row in rows)
    figures = [
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
        for forward, backward in zip(rows[::2], rows[1::2], strict=True)
    ]
    of_settings = {
        row["setting"]: [
            row["setting"],
            row["setting_against"],
            _scientific(row["setting_max_error"]),
            _scientific(row["setting_mean_error"]),
        ]
        for row in rows
    }
    heads = ["setting", "implementation", "forward, ms", "backward, ms", "picture: max", "mean"]
    heads += ["gradients: max", "mean", "band pixels", "left out"]
    lines = [
        "# Accuracy",
        "",
        "Written by `make accuracy`; do not edit.",
        "",
        f"Measured with {machine_line(report['machine'])}. The scene: {first['splats']} splats of "
        f"about a pixel on {first['width']}×{first['height']}; {compared} of its "
        f"{first['width'] * first['height']} pixels are compared; no row leaves out more than "
        f"{left_out}. Gradients are of a random loss over color, alpha and depth.",
        "",
        "## Arithmetic",
        "",
        "Each implementation is compared with the f64 reference at the same setting, on the same "
        "f32 splats. The rows `reference` compare the reference without and with culling, which "
        "leaves out only pairs that contribute nothing. Gradient errors are divided by the largest "
        "gradient of the same parameter; the table has the worst parameter. A pixel of the "
        "[band](numerics.md#bounds-and-what-is-measured) is left out only if it differs by more "
        f"than {max(BOUND_3D.values()):g}, or its transmittance by more than {MIN_FLIP:.1%}.",
        "",
        *markdown_table(heads, figures, left=2),
        "",
        f"![time against largest error of every setting]({PLOT_NAME})",
        "",
        "## Settings",
        "",
        "The table has the error of each setting in f64. Lower SH degrees are compared with the "
        "highest; the plain and the antialiased mode with a picture of many samples per pixel, "
        "without blur. These splats use all degrees and are small; fitted scenes have weaker "
        "higher degrees and smaller errors.",
        "",
        *markdown_table(["setting", "against", "max", "mean"], of_settings.values(), left=2),
        "",
        "## Fixed choices",
        "",
        "* **The exponential.** One polynomial on the cpu (relative error below 1.2e-7 over the "
        "visible range, which a test checks) and the device's on the gpu.",
        "* **Tile culling.** Exact: no pair with alpha ≥ 1/255 is lost.",
        "* **Storage.** f32 everywhere; nothing is kept in half precision.",
        "",
        "## Protocol",
        "",
        report["machine"]["protocol"],
        "",
    ]
    return "\n".join(wrapped for line in lines for wrapped in _wrapped(line))


def _wrapped(line: str) -> list[str]:
    """Wrap a paragraph; tables stay as they are."""
    if len(line) <= MAX_LINE or line.startswith("|"):
        return [line]
    indent = "  " if line.startswith("* ") else ""
    return textwrap.wrap(
        line, MAX_LINE, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )


def _scientific(value: float) -> str:
    return "0" if value == 0.0 else f"{value:.1e}"
