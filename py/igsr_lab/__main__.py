"""``python -m igsr_lab``: the commands of the lab."""

from __future__ import annotations

from typing import ClassVar

import typer

from igsr.cli.lazy_group import LazyCommand, LazyGroup

#: Module, function and help of each command.
COMMANDS = {
    "study": ("study", "app", "Run the experiments of the literature and of docs/."),
    "bench": ("bench", "bench_command", "Measure speed and error of the backends."),
    "bench-check": (
        *("bench_check", "bench_check_command"),
        "Compare this build's speed with another commit's.",
    ),
    "gpu-check": (
        *("gpu_check", "gpu_check_command"),
        "Test and measure this computer's GPU, and write a report.",
    ),
    "gpu-session": (
        *("gpu_session", "gpu_session_command"),
        "Measure all of a GPU within eight minutes, and write a report.",
    ),
    "synth": ("synth", "synth_command", "Make synthetic captures with exact cameras."),
    "pairs": ("denoiser", "pairs_command", "Make training pairs for the denoiser."),
    "train": ("denoiser", "train_command", "Train a denoiser on training pairs."),
}


class _Commands(LazyGroup):
    table: ClassVar[dict[str, LazyCommand]] = {
        name: LazyCommand(f"igsr_lab.commands.{module}", function, help)
        for name, (module, function, help) in COMMANDS.items()
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
