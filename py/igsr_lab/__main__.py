"""``python -m igsr_lab``: the commands of the lab."""

from __future__ import annotations

from typing import ClassVar

import typer

from igsr.cli.lazy_group import LazyCommand, LazyGroup


class _Commands(LazyGroup):
    """The commands, in the order of the help."""

    table: ClassVar[dict[str, LazyCommand]] = {
        "study": LazyCommand(
            "igsr_lab.commands.study", "app", "Run the experiments of the literature and of docs/."
        ),
        "bench": LazyCommand(
            "igsr_lab.commands.bench", "bench_command", "Measure speed and error of the backends."
        ),
        "bench-check": LazyCommand(
            "igsr_lab.commands.bench_check",
            "bench_check_command",
            "Compare this build's speed with that of a commit.",
        ),
        "gpu-check": LazyCommand(
            "igsr_lab.commands.gpu_check",
            "gpu_check_command",
            "Test and measure this computer's GPU, and write a report.",
        ),
        "synth": LazyCommand(
            "igsr_lab.commands.synth",
            "synth_command",
            "Make synthetic captures with exact cameras.",
        ),
        "pairs": LazyCommand(
            "igsr_lab.commands.denoiser", "pairs_command", "Make training pairs for the denoiser."
        ),
        "train": LazyCommand(
            "igsr_lab.commands.denoiser", "train_command", "Train a denoiser on training pairs."
        ),
    }


app = typer.Typer(
    cls=_Commands,
    help="Experiments around igsr.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


@app.callback()
def _options() -> None:
    pass


if __name__ == "__main__":
    app(prog_name="python -m igsr_lab")
