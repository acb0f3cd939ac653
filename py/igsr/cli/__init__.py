"""The ``igsr`` command, a file per subcommand."""

from __future__ import annotations

from typing import Annotated

import typer

from igsr._core import __version__
from igsr.cli.bench import bench_command
from igsr.cli.compact import compact_command
from igsr.cli.convert import convert_command
from igsr.cli.denoise import app as denoise_app
from igsr.cli.evaluate import eval_command
from igsr.cli.export import export_command
from igsr.cli.fit import fit_command
from igsr.cli.info import info_command
from igsr.cli.pose import pose_command
from igsr.cli.refine import refine_command
from igsr.cli.render import render_command
from igsr.cli.study import study_command
from igsr.cli.synth import synth_command
from igsr.cli.view import PASSED_ON, view_command

app = typer.Typer(
    help="Fit a Gaussian-splat scene from photos, with known cameras or without.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"igsr {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Say which igsr this is."),
    ] = False,
) -> None:
    pass


app.command("pose")(pose_command)
app.command("refine")(refine_command)
app.command("fit")(fit_command)
app.command("render")(render_command)
app.command("eval")(eval_command)
app.command("info")(info_command)
app.command("view", context_settings=PASSED_ON)(view_command)
app.command("export")(export_command)
app.command("compact")(compact_command)
app.command("convert")(convert_command)
app.add_typer(denoise_app, name="denoise")
app.command("study")(study_command)
app.command("synth")(synth_command)
app.command("bench")(bench_command)


def main() -> None:
    """Run the ``igsr`` command."""
    app()
