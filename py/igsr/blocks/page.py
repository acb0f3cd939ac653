"""``report.html`` of a fit in blocks: one page, with everything inside.

The page itself is ``templates/blocks.html.jinja``; this module says what is put into it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from igsr._internal.choices import Backend
from igsr.blocks.manifest import Manifest
from igsr.blocks.options import BlockOptions
from igsr.blocks.seams import AT_A_TIME, loaded_in_parts
from igsr.capture.exposure import Exposure
from igsr.evaluation.report_page import (
    ADDED,
    PHOTO,
    beside,
    drawn_cameras,
    number,
    part_rows,
    scene_frame,
    write_template,
)
from igsr.evaluation.scores import ScoredView, score_views
from igsr.rendering.scene_page import PageCamera, PageModel
from igsr.splats import Splats

#: Most photos that are shown beside renders, and most cameras that are drawn.
MOST_SHOWN, MOST_DRAWN = 6, 500


def write_block_page(
    path: Path,
    report: Mapping[str, Any],
    manifest: Manifest,
    splats: Splats,
    exposures: Mapping[str, Exposure],
    options: BlockOptions,
) -> None:
    """Write the page, whole or not at all; it needs nothing but a browser.

    Args:
        path: where to.
        report: of ``report.json``.
        manifest: the capture's photos.
        splats: the joined scene.
        exposures: of photos, by name.
        options: of the run.

    Raises:
        IgsrError: a photo cannot be decoded, or the file not be written.
    """
    train = [_camera(manifest, index) for index in _some(manifest.of_split("train"), MOST_DRAWN)]
    test = [_camera(manifest, index) for index in _some(manifest.of_split("test"), MOST_DRAWN)]
    held_out = report["protocol"]["split"] == "test"
    background = report["protocol"]["background"]
    resolved = Path(report["capture"]).resolve()
    name = (resolved.parent.name if resolved.name == "images" else resolved.name) or "photos"
    text = "Held-out photos" if held_out else "Fitted photos; none is held out"
    crossing = report["across_seams"]["photos"] > 0
    variables = {
        "name": name,
        "limit": None,
        "scene": scene_frame([PageModel(name, splats)], train, background, name),
        "photos": report["photos"],
        "splats": report["splats"],
        "blocks": report["blocks"],
        "seams": report["seams"],
        "score_rows": _score_rows(report, "held out" if held_out else "fitted"),
        "held_out": bool(test),
        "beside_text": f"{text}: those across seams." if crossing else f"{text}.",
        "beside_views": beside(_shown(report, manifest, splats, exposures, options)),
        "cameras": drawn_cameras(
            [(PHOTO, [one.camera for one in train]), (ADDED, [one.camera for one in test])],
            [one.camera for one in train],
        ),
        "not_registered": [],
        "parts": part_rows(report["parts"], {}),
        "peak_memory": report["peak_memory_bytes"],
        "version": report["version"],
        "backend": f"{report['backend']} ({report['instruction_set']})",
        "seed": report["settings"].get("seed", 0),
        "settings": report["settings"],
    }
    write_template(path, Path(__file__).with_name("templates"), "blocks.html.jinja", variables)


def _some(numbers: list[int], most: int) -> list[int]:
    """At most so many of the numbers, evenly spaced."""
    evenly = np.linspace(0, len(numbers) - 1, min(most, len(numbers))).round()
    return [numbers[int(index)] for index in evenly]


def _camera(manifest: Manifest, index: int) -> PageCamera:
    return PageCamera(manifest.shots[index].name, manifest.shots[index].camera)


def _shown(
    report: Mapping[str, Any],
    manifest: Manifest,
    splats: Splats,
    exposures: Mapping[str, Exposure],
    options: BlockOptions,
) -> list[ScoredView]:
    """Some of the photos that were scored; those across seams, where there are some."""
    crossing = [row["name"] for row in report["views"] if row["across"]]
    names = set(crossing or [row["name"] for row in report["views"]])
    numbers = [index for index, shot in enumerate(manifest.shots) if shot.name in names]
    some = _some(numbers, min(MOST_SHOWN, AT_A_TIME))
    parts = loaded_in_parts(manifest, some, options.max_size, exposures, as_taken=True)
    backend = cast(Backend, options.backend)
    background = report["protocol"]["background"]
    return [one for part in parts for one in score_views(splats, part, background, backend)]


def _score_rows(report: Mapping[str, Any], kind: str) -> list[dict[str, str]]:
    rows = [{"label": f"{report['protocol']['views']} {kind}", **_numbers(report)}]
    across = report["across_seams"]
    if across["photos"]:
        label = f"{across['photos']} of them across seams"
        rows.append({"label": label, **_numbers(across)})
    return rows


def _numbers(scores: Mapping[str, Any]) -> dict[str, str]:
    digits = {"psnr": 2, "ssim": 4, "ms_ssim": 4, "flip": 4}
    return {name: number(scores.get(name), places) for name, places in digits.items()}
