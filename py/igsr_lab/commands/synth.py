"""``python -m igsr_lab synth``: make synthetic captures."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

from igsr.cli.error_messages import error_messages
from igsr.cli.options import JsonOption, option
from igsr.cli.output import error_console, output_console, print_json
from igsr_lab.commands.options import RayOption


def synth_command(
    scenes: Annotated[int, option("--scenes", metavar="N", help="Number of scenes.")],
    out: Annotated[Path, option("--out", metavar="DIR", help="Folder of the captures.")],
    seed: Annotated[int, option("--seed", help="Random seed.")] = 0,
    first: Annotated[int, option("--first", help="Number of the first scene.")] = 0,
    size: Annotated[int, option("--size", help="Longer side of the photos, pixels.")] = 256,
    views: Annotated[int, option("--views", help="Train photos per scene.")] = 24,
    test_views: Annotated[int, option("--test-views", help="Test photos per scene.")] = 8,
    spp: Annotated[int, option("--spp", help="Light paths per pixel, a square number.")] = 16,
    angle: Annotated[
        float | None,
        option(
            "--angle",
            metavar="DEGREES",
            help="Angle between neighboring train photos. Default: photos from all sides.",
        ),
    ] = None,
    jobs: Annotated[
        int | None, option("--jobs", help="Scenes made in parallel. Default: one per core.")
    ] = None,
    ray: RayOption = False,
    as_json: JsonOption = False,
) -> None:
    """Make synthetic captures: random scenes rendered with exact cameras, depth and masks.

    Needs Mitsuba 3 (pip install 'igsr\\[synth]'). Finished scenes are kept in --out; the same
    command continues from there.
    """
    from igsr_lab import synth

    with error_messages(
        lambda: "Interrupted; finished scenes are kept, the same command continues from there."
    ):
        console = error_console()

        def on_scene(done: int, total: int, row: dict[str, Any]) -> None:
            kind = "" if row["kind"] == "none" else f", {row['kind']}"
            console.print(
                f"{done} of {total}: {row['name']} ({', '.join(row['contents'])}{kind}) "
                f"in {row['seconds']:.0f} s"
            )

        report = synth.synthesize(
            out,
            scenes,
            seed=seed,
            first=first,
            settings=synth.CaptureSettings(size, views, test_views, spp, angle),
            jobs=(os.cpu_count() or 1) if jobs is None else jobs,
            on_scene=on_scene,
            ray=ray,
        )
    if as_json:
        print_json(report)
        return
    made = sum(row["seconds"] is not None for row in report["scenes"])
    output_console().print(f"{made} made, {scenes - made} already finished: {out}")
