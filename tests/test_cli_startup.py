"""Start of the command: imported modules, help texts, and the options before the command."""

import json
import logging
import os
import re
import subprocess
import sys

import pytest
import scenes

from igsr import cli
from igsr.cli.lazy_group import load_command

#: Modules that take longer to import than a quick command may take.
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


def python(code, *arguments, **variables):
    command = [sys.executable, "-c", code, *arguments]
    environment = {**os.environ, **variables}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)


def imported(code, *arguments):
    """Top-level modules, and modules of igsr, that some code imports."""
    done = python(TRACED.format(code=code), *map(str, arguments))
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
    inner = {f"igsr._internal{name}" for name in ("", ".extras", ".lazy_exports")}
    assert rooms == {*inner, "igsr.errors"}


@pytest.mark.parametrize(
    ("arguments", "others"),
    [
        (["--help"], ("numpy", "PIL")),
        (["--version"], ("PIL", "rich")),
        (["info", "{scene}"], ("PIL",)),
        (["info", "{capture}"], ()),
        (["convert", "{scene}", "{target}"], ("PIL",)),
        (["info", "--help"], ("PIL",)),
        (["fit", "--help"], ()),
        (["refine", "--help"], ()),
    ],
)
def test_quick_commands_import_nothing_slow(arguments, others, places):
    arguments = [argument.format(**places) for argument in arguments]
    modules, _ = imported("from igsr.cli import main; main()", *arguments)
    assert not modules & {*SLOW, *others}


def commands():
    """Every command by the words that name it."""
    for name, entry in cli._Commands.table.items():
        command = load_command(name, entry)
        for sub, subcommand in getattr(command, "commands", {}).items():
            yield pytest.param([name, sub], subcommand, id=f"{name}-{sub}")
        yield pytest.param([name], command, id=name)


@pytest.mark.parametrize(("words", "command"), list(commands()))
def test_help_fits_80_columns(words, command, igsr_here, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = igsr_here(*words, "--help").stdout
    assert max(map(len, text.splitlines())) <= 80
    assert command.name == words[-1]
    for name in (name for parameter in command.params for name in parameter.opts):
        if name.startswith("--"):
            assert re.search(rf"(?<![\w-]){name}(?![\w-])", text), f"{name} is cut off"
    first_panel = text.partition("─ Options ─")[2].partition("╰")[0]
    assert 1 <= len(re.findall(r"^│[ *]+--", first_panel, re.MULTILINE)) <= 12


def test_help_lists_the_commands_and_a_typo_gets_a_suggestion(igsr_here):
    text = igsr_here("--help").stdout
    places = [text.index(f" {name} ") for name in cli._Commands.table]
    assert places == sorted(places)
    assert all(len(entry.help) <= 80 for entry in cli._Commands.table.values())
    assert "--install-completion" in text
    typo = igsr_here("rendr")
    assert typo.returncode == 2
    assert "render" in typo.stderr


@pytest.fixture
def clean_environment(monkeypatch):
    """Restore the variables and the logger that options of the process change."""
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
    detailed = igsr_here("info", "nowhere.ply")
    assert detailed.returncode == quiet.returncode == 1
    assert detailed.stderr.startswith("Traceback")
    assert "splats.py" in detailed.stderr
    assert detailed.stderr.endswith(quiet.stderr)
    monkeypatch.delenv("IGSR_DEBUG")
    assert igsr_here("--debug", "info", "nowhere.ply").stderr.startswith("Traceback")
    assert os.environ["IGSR_DEBUG"] == "1"  # for worker processes


def test_verbose_logs_to_stderr(igsr_here, clean_environment, places):
    quiet = igsr_here("info", places["capture"], "--json")
    verbose = igsr_here("-v", "info", places["capture"], "--json")
    assert json.loads(verbose.stdout) == json.loads(quiet.stdout)
    assert "igsr.capture" not in quiet.stderr
    assert "igsr.capture" in verbose.stderr
    assert "3 views" in verbose.stderr


def test_threads_are_set_for_all_libraries(clean_environment, igsr_here, places):
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
    ("words", "expected"),
    [
        ("igsr ", set(cli._Commands.table)),
        ("igsr convert --t", {"--to"}),
        ("igsr weights f", {"fetch"}),
    ],
)
def test_shells_complete_commands_and_options(words, expected):
    variables = {"_IGSR_COMPLETE": "complete_bash", "COMP_WORDS": words}
    variables["COMP_CWORD"] = str(len(words.split(" ")) - 1)
    done = python("from igsr.cli import app; app(prog_name='igsr')", **variables)
    assert expected <= set(done.stdout.split()), done.stderr
