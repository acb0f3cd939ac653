"""What ``import igsr`` and quick commands import, and the options before the command."""

from __future__ import annotations

import importlib
import json
import logging
import os
import subprocess
import sys

import pytest
import scenes
import typer

import igsr
from igsr import cli
from igsr.cli.lazy_group import load_command

#: Each takes longer to import than a quick command may take to run.
SLOW = ("torch", "torchmetrics", "matplotlib", "pycolmap", "av", "mitsuba", "scipy")

#: Runs a command as ``igsr`` does, then prints the modules that were imported.
TRACED = """
import sys
before = set(sys.modules)
try:
    {code}
except SystemExit as ended:
    assert not ended.code, ended.code
print("imported", *sorted({{name.partition(".")[0] for name in sys.modules}}))
print("rooms", *sorted(name for name in sys.modules if name.startswith("igsr.")))
"""


def imported(code, *arguments):
    """Top-level modules, and modules of igsr, that are imported after some code ran."""
    done = subprocess.run(
        [sys.executable, "-c", TRACED.format(code=code), *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    *_, modules, rooms = done.stdout.splitlines()
    return set(modules.split()[1:]), set(rooms.split()[1:])


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    folder = tmp_path_factory.mktemp("startup")
    scenes.splats().save(folder / "scene.ply")
    capture = scenes.write_capture(folder / "capture", scenes.capture(views=3, size=16))
    return {"scene": folder / "scene.ply", "capture": capture, "target": folder / "scene.spz"}


def test_importing_igsr_imports_neither_numpy_nor_torch():
    modules, rooms = imported("import igsr")
    assert not modules & {*SLOW, "numpy", "rich", "typer", "PIL"}
    assert rooms == {
        "igsr._internal",
        "igsr._internal.extras",
        "igsr._internal.lazy_exports",
        "igsr.errors",
    }


@pytest.mark.parametrize(
    ("arguments", "further"),
    [
        (["--help"], ("numpy", "PIL")),
        (["--version"], ("PIL", "rich")),
        (["info", "{scene}"], ("PIL",)),
        (["info", "{capture}"], ()),
        (["convert", "{scene}", "{target}"], ("PIL",)),
        (["info", "--help"], ("PIL",)),
    ],
)
def test_quick_commands_import_nothing_slow(arguments, further, places):
    arguments = [argument.format(**places) for argument in arguments]
    modules, _ = imported("from igsr.cli import main; main()", *arguments)
    assert not modules & {*SLOW, *further}


def commands():
    return cli._Commands.table


@pytest.mark.parametrize("name", commands())
def test_every_command_of_the_table_is_there(name):
    command = load_command(name, commands()[name])
    assert command.name == name
    assert command.help
    assert len(commands()[name].help) <= 80


def test_the_table_has_every_module_of_commands():
    folder = os.path.dirname(cli.__file__)
    files = {name[:-3] for name in os.listdir(folder) if name.endswith(".py")}
    of_commands = {
        name
        for name in files - {"__init__", "__main__"}
        if hasattr(importlib.import_module(f"igsr.cli.{name}"), "app")
        or hasattr(importlib.import_module(f"igsr.cli.{name}"), f"{name}_command")
        or name == "evaluate"
    }
    assert {entry.module for entry in commands().values()} == {
        f"igsr.cli.{name}" for name in of_commands
    }


def test_help_lists_every_command_and_a_slip_is_told(igsr_here):
    help_text = igsr_here("--help").stdout
    for name in commands():
        assert f" {name} " in help_text
    slip = igsr_here("rendr")
    assert slip.returncode == 2
    assert "render" in slip.stderr


@pytest.fixture
def clean_environment(monkeypatch):
    """Options of the process set variables: gone after the test."""
    for name in ("IGSR_DEBUG", *cli.process_options.THREAD_VARIABLES):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    logger = logging.getLogger("igsr")
    monkeypatch.setattr(logger, "handlers", [])
    monkeypatch.setattr(logger, "level", logging.WARNING)


def test_debug_shows_the_traceback_behind_a_message(igsr_here, clean_environment, monkeypatch):
    quiet = igsr_here("info", "nowhere.ply")
    assert "Traceback" not in quiet.stderr
    monkeypatch.setenv("IGSR_DEBUG", "0")
    assert igsr_here("info", "nowhere.ply").stderr == quiet.stderr
    monkeypatch.setenv("IGSR_DEBUG", "1")
    told = igsr_here("info", "nowhere.ply")
    assert told.returncode == quiet.returncode == 1
    assert told.stderr.startswith("Traceback")
    assert "splats.py" in told.stderr
    assert told.stderr.endswith(quiet.stderr)
    monkeypatch.delenv("IGSR_DEBUG")
    assert igsr_here("--debug", "info", "nowhere.ply").stderr.startswith("Traceback")
    assert os.environ["IGSR_DEBUG"] == "1"  # for worker processes


def test_verbose_logs_to_stderr(igsr_here, clean_environment, places):
    quiet = igsr_here("info", places["capture"], "--json")
    told = igsr_here("-v", "info", places["capture"], "--json")
    assert json.loads(told.stdout) == json.loads(quiet.stdout)
    assert "igsr.capture" not in quiet.stderr
    assert "igsr.capture" in told.stderr
    assert "3 views" in told.stderr


def test_threads_are_set_for_all_that_starts_them(clean_environment, igsr_here, places):
    import torch

    before = torch.get_num_threads()
    try:
        assert igsr_here("--threads", 3, "info", places["scene"]).returncode == 0
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    assert os.environ["RAYON_NUM_THREADS"] == os.environ["OMP_NUM_THREADS"] == "3"


@pytest.mark.parametrize("count", ["0", "-1", "1025", "many"])
def test_threads_are_checked(count, igsr_here, places):
    result = igsr_here("--threads", count, "info", places["scene"])
    assert result.returncode == 2
    assert "--threads" in result.stderr


@pytest.mark.parametrize(
    ("words", "wanted"),
    [("igsr ", set(commands())), ("igsr export --f", {"--format"}), ("igsr weights f", {"fetch"})],
)
def test_shells_complete_commands_and_options(words, wanted):
    done = subprocess.run(
        [sys.executable, "-c", "from igsr.cli import app; app(prog_name='igsr')"],
        env={
            **os.environ,
            "_IGSR_COMPLETE": "complete_bash",
            "COMP_WORDS": words,
            "COMP_CWORD": str(len(words.split(" ")) - 1),
        },
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert wanted <= set(done.stdout.split()), done.stderr


def test_completion_is_offered(igsr_here):
    assert "--install-completion" in igsr_here("--help").stdout


def test_test_every_is_holdout(igsr_here, places):
    scene, capture = places["scene"], places["capture"]
    old, new = (
        igsr_here("eval", scene, capture, option, 2, "--backend", "cpu", "--json").stdout
        for option in ("--holdout", "--test-every")
    )
    assert json.loads(old) == json.loads(new)
    assert json.loads(new)["protocol"]["split"] == "test"


def test_typer_keeps_what_the_lazy_group_overrides():
    assert typer.main.get_command(cli.app).list_commands(None) == list(commands())
    assert igsr.__version__
