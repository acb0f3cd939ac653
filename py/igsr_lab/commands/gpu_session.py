"""``python -m igsr_lab gpu-session``: all measurements of a GPU within eight minutes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from igsr._internal.atomic_write import check_writable
from igsr.cli.error_messages import error_messages
from igsr.cli.options import option
from igsr_lab import bench


def gpu_session_command(
    out: Annotated[Path, option("--out", help="Folder for the report.")] = Path("out/gpu-session"),
) -> None:
    """Measure kernels, the viewer, errors and gsplat; write report.html and report.json.

    A part that fails or takes too long has a message in the report, and the next part runs. The
    exit status is 1 if one fails. Software drivers get smaller scenes.
    """
    with error_messages():
        path = out / "report.html"
        check_writable(path)
        report = bench.run_session(path, lambda part: print(f"{part} ...", flush=True))
    failed = [part for part in report["parts"] if part["error"]]
    for part in failed:
        print(f"{part['name']}: {part['error']}")
    print(f"\nThe report is {path}; its figures are in {bench.json_beside(path)}.")
    if failed:
        raise typer.Exit(1)
