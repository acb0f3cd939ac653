"""``igsr export``: write a capture in another format."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

from igsr._internal.atomic_write import check_folder
from igsr.capture import load_capture
from igsr.capture.write_colmap import write_colmap
from igsr.capture.write_transforms import write_transforms
from igsr.cli.error_messages import error_messages
from igsr.cli.shared import CaptureArgument, JsonOption, output_console, print_json


class FormatChoice(str, enum.Enum):
    """Formats of captures that can be written."""

    colmap = "colmap"
    colmap_text = "colmap-text"
    transforms = "transforms"


def export_command(
    capture_path: CaptureArgument,
    out: Annotated[Path, typer.Option("--out", help="New or empty folder.")],
    form: Annotated[
        FormatChoice,
        typer.Option("--format", help="colmap (binary), colmap-text, or transforms (nerfstudio)."),
    ] = FormatChoice.colmap,
    as_json: JsonOption = False,
) -> None:
    """Write CAPTURE in another format: undistorted photos at full resolution, masks, cameras."""
    with error_messages(lambda: "Interrupted; nothing is written."):
        check_folder(out)
        capture = load_capture(capture_path)
        if form is FormatChoice.transforms:
            write_transforms(capture, out)
        else:
            write_colmap(capture, out, text=form is FormatChoice.colmap_text)
    if as_json:
        print_json({"out": str(out), "format": form.value, "views": len(capture.views)})
    else:
        output_console().print(f"{len(capture.views)} views in {out}")
