"""``igsr eval``: score a scene on photos."""

from __future__ import annotations

import itertools
from typing import Annotated

from rich.table import Table

from igsr import _core
from igsr._internal.event import Event
from igsr._internal.progress_bar import progress_bar
from igsr.cli.error_messages import error_messages
from igsr.cli.options import (
    BackendOption,
    BackgroundOption,
    CaptureArgument,
    HoldoutOption,
    JsonOption,
    MaxSizeOption,
    SceneArgument,
    SplitName,
    background_color,
    load,
    option,
    resolved,
)
from igsr.cli.output import output_console, print_json, protocol_line, score_line
from igsr.evaluation.scores import (
    default_background,
    default_split,
    evaluate,
    views_of_split,
)
from igsr.splats import Splats


def eval_command(
    scene: SceneArgument,
    capture_path: CaptureArgument,
    holdout: HoldoutOption = None,
    max_size: MaxSizeOption = None,
    split: Annotated[
        SplitName | None,
        option("--split", help="Views to score. Default: test if there are any, else train."),
    ] = None,
    background: BackgroundOption = None,
    backend: BackendOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Score SCENE on the photos of CAPTURE."""
    with error_messages():
        name = resolved(backend)
        splats = Splats.load(scene)
        capture = load(capture_path, holdout, max_size)
        color = background_color(background) or default_background(capture)
        chosen = split or default_split(capture)
        views = views_of_split(capture, chosen)
        with progress_bar(shown=not as_json) as show:
            done = itertools.count(1)
            scores = evaluate(
                splats,
                capture,
                chosen,
                color,
                name,
                lambda scored: show(Event("score", next(done), len(views))),
            )
        scores["protocol"]["holdout"] = holdout
    report = {**scores, "splats": len(splats), **_core.backend_info(name)}
    if as_json:
        print_json(report)
        return
    table = Table(box=None, pad_edge=False)
    for heading in ("view", "PSNR", "SSIM", "MS-SSIM", "FLIP", "cc PSNR", "cc SSIM"):
        table.add_column(heading, justify="left" if heading == "view" else "right")
    for row in scores["views"]:
        table.add_row(
            row["name"],
            f"{row['psnr']:.2f}",
            f"{row['ssim']:.4f}",
            "-" if row["ms_ssim"] is None else f"{row['ms_ssim']:.4f}",
            f"{row['flip']:.4f}",
            f"{row['cc_psnr']:.2f}",
            f"{row['cc_ssim']:.4f}",
        )
    console = output_console()
    console.print(table)
    console.print(score_line(scores))
    console.print(protocol_line(scores["protocol"]), style="dim")
