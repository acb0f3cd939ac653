"""``igsr convert``: a splat file in another format."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from igsr._internal.atomic_write import check_writable
from igsr.cli.error_messages import error_messages, print_message, warning_messages
from igsr.cli.shared import (
    JsonOption,
    SceneArgument,
    output_console,
    print_json,
)
from igsr.splats import Splats


def convert_command(
    scene: SceneArgument,
    target: Annotated[
        Path,
        typer.Argument(
            metavar="TARGET",
            help="File to write. Its ending sets the format: .ply, .compressed.ply, .splat, .spz, "
            ".sog, .glb or .gltf.",
        ),
    ],
    as_json: JsonOption = False,
) -> None:
    """Write SCENE in the format of TARGET; name what that format cannot hold."""
    with error_messages(lambda: "Interrupted; nothing is written."), warning_messages():
        check_writable(target)
        splats = Splats.load(scene)
        notes = splats.save(target)
    size = target.stat().st_size
    if as_json:
        print_json(
            {
                "scene": str(scene),
                "target": str(target),
                "splats": len(splats),
                "sh_degree": splats.sh_degree,
                "antialiased": splats.antialiased,
                "bytes_before": scene.stat().st_size,
                "bytes": size,
                "notes": notes,
            }
        )
        return
    for note in notes:
        print_message(note)
    before = scene.stat().st_size
    output_console().print(
        f"{len(splats)} splats in {target}, {size} bytes ({size / max(before, 1):.2f} of {scene})"
    )
