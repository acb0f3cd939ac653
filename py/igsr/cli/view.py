"""``igsr view``: a scene in a window."""

from __future__ import annotations

import shutil
import subprocess
from typing import Annotated

import typer

from igsr.cli.shared import INTERRUPTED, one_sentence
from igsr.errors import IgsrError

#: The viewer, a program of its own: windows are not this package's business.
PROGRAM = "splat-view"

#: Options that this command does not know are the viewer's.
PASSED_ON = {"ignore_unknown_options": True}


def view_command(
    scenes: Annotated[
        list[str],
        typer.Argument(
            metavar="SCENE...",
            help="Splat files, or the folder of a fit or a refinement; then options of splat-view.",
        ),
    ],
) -> None:
    """Show splats in a window, two scenes side by side, by splat-view, which is installed apart."""
    with one_sentence():
        program = shutil.which(PROGRAM)
        if program is None:
            raise IgsrError(
                f"{PROGRAM} is not installed; in igsr's source, run: "
                "cargo install --locked --path crates/splat_view"
            )
        try:
            code = subprocess.run([program, *scenes], check=False).returncode
        except KeyboardInterrupt:
            code = INTERRUPTED
    raise typer.Exit(code if code >= 0 else 128 - code)
