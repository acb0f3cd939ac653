"""Command line options made from a settings class."""

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import pytest
import typer
from typer.testing import CliRunner

from igsr._internal.settings import about
from igsr_lab.commands.denoiser import settings_options


@dataclass(frozen=True, kw_only=True)
class Example:
    steps: int = field(metadata=about("Optimizer steps.", limits=(1, 10_000)))
    seed: int = field(default=7, metadata=about("Random seed."))
    start: Literal["auto", "per-camera"] = field(metadata=about("A word."))
    hull: bool = field(metadata=about("Yes or no."))
    plain: object = None


@pytest.fixture
def command():
    """A function that runs a command with these options, and the calls that it received."""
    app, calls = typer.Typer(), []

    @app.command()
    @settings_options(Example)
    def example(
        path: Annotated[str, typer.Argument()],
        given: dict[str, Any],
        last: Annotated[bool, typer.Option("--last")] = False,
    ) -> None:
        """Do something."""
        calls.append((path, given, last))

    return lambda *words: CliRunner().invoke(app, words, env={"COLUMNS": "200"}), calls


def test_a_command_receives_the_given_settings_and_no_unknown_choices(command):
    run, calls = command
    assert run("there").exit_code == 0
    words = ("--steps", "4", "--start", "per-camera", "--no-hull", "--last")
    assert run("there", *words).exit_code == 0
    assert run("there", "--start", "magic").exit_code == 2
    assert calls == [
        ("there", {"seed": 7}, False),
        ("there", {"steps": 4, "seed": 7, "start": "per-camera", "hull": False}, True),
    ]


def test_help_shows_all_settings(command):
    shown = command[0]("--help").output
    for text in ("Do something.", "Optimizer steps.", "--start", "--no-hull", "per-camera"):
        assert text in shown
    assert "--plain" not in shown
