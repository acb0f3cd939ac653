"""The ``igsr`` command, a file per subcommand.

The table below is all that ``igsr --help`` reads: a subcommand's module, and with it torch and
whatever else it needs, is imported when that subcommand runs.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

import typer

from igsr.cli.lazy_group import LazyCommand, LazyGroup
from igsr.cli.process_options import MAX_THREADS, log_to_stderr, show_tracebacks, use_threads

#: Options that ``igsr view`` does not know are the viewer's.
_PASSED_ON = {"ignore_unknown_options": True}


class _Commands(LazyGroup):
    """The subcommands of ``igsr``, in the order of the help."""

    table: ClassVar[dict[str, LazyCommand]] = {
        "pose": LazyCommand(
            "igsr.cli.pose", "pose_command", "Find the cameras of photos; write a COLMAP capture."
        ),
        "fit": LazyCommand(
            "igsr.cli.fit", "fit_command", "Fit splats to the photos of a capture and score them."
        ),
        "refine": LazyCommand(
            "igsr.cli.refine",
            "refine_command",
            "Fit few photos, then refit with denoised novel views.",
        ),
        "render": LazyCommand(
            "igsr.cli.render", "render_command", "Render pictures, or a video around the scene."
        ),
        "eval": LazyCommand(
            "igsr.cli.evaluate", "eval_command", "Score a scene against the photos of a capture."
        ),
        "info": LazyCommand(
            "igsr.cli.info",
            "info_command",
            "Describe a scene or a capture, and this machine's backends.",
        ),
        "app": LazyCommand(
            "igsr.cli.web_app", "app_command", "Open a page that makes scenes from dropped photos."
        ),
        "view": LazyCommand(
            "igsr.cli.view",
            "view_command",
            "Show scenes in a window, one alone or two side by side.",
            _PASSED_ON,
        ),
        "compact": LazyCommand(
            "igsr.cli.compact", "compact_command", "Make a scene smaller within a limit on PSNR."
        ),
        "clean": LazyCommand(
            "igsr.cli.clean", "clean_command", "Remove floaters: splats that photos do not support."
        ),
        "convert": LazyCommand(
            "igsr.cli.convert", "convert_command", "Write splats or a capture in another format."
        ),
        "denoise": LazyCommand(
            "igsr.cli.denoise", "denoise_command", "Render the views of a scene and denoise them."
        ),
        "weights": LazyCommand(
            "igsr.cli.weights", "app", "List and download the weights of pose networks."
        ),
    }


app = typer.Typer(
    cls=_Commands,
    help="Fit a Gaussian-splat scene from photos, with known cameras or without.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _version(wanted: bool) -> None:
    if wanted:
        from igsr._core import __version__

        typer.echo(f"igsr {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Print the version."),
    ] = False,
    debug: Annotated[
        bool,
        typer.Option(
            "--debug", help="Print the traceback behind an error message. Also: IGSR_DEBUG=1."
        ),
    ] = False,
    verbose: Annotated[
        int,
        typer.Option(
            "--verbose",
            "-v",
            count=True,
            show_default=False,
            help="Log to stderr what happens; -vv logs details.",
        ),
    ] = 0,
    threads: Annotated[
        int | None,
        typer.Option(
            "--threads",
            metavar="N",
            min=1,
            max=MAX_THREADS,
            help="Use N threads. Default: all cores.",
        ),
    ] = None,
) -> None:
    if debug:
        show_tracebacks()
    if threads is not None:
        use_threads(threads)
    if verbose:
        log_to_stderr(verbose)


def main() -> None:
    """Run the ``igsr`` command."""
    app()
