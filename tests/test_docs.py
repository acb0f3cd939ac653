"""README, CONTRIBUTING and docs/ are right: links lead somewhere, code blocks and options work.

Code blocks of README, getting started and the guides are run, page by page in a folder of their
own, on tiny photos. Steps and frames are few, and COLMAP looks for the same photos' cameras once. A
block that cannot run says why in a comment before it, ``<!-- not run: reason -->``; its commands
are parsed at least.
"""

from __future__ import annotations

import copy
import functools
import io
import itertools
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import documentation
import numpy as np
import pytest
import rooms
from documentation import DOCS, PAGES, ROOT, TYPED
from PIL import Image
from typer.main import get_command

import igsr
from igsr.cameras.colmap import Colmap
from igsr.cli import app
from igsr_lab import __main__ as lab

#: How many blocks of a page are not run. A further one is a decision, not an accident.
NOT_RUN = {
    "docs/guides/app.md": 3,
    "docs/guides/blocks.md": 1,
    "README.md": 2,
    "docs/getting-started.md": 2,
    "docs/guides/cameras.md": 2,
    "docs/guides/denoising.md": 2,
    "docs/guides/installation.md": 2,
    "docs/guides/levels.md": 1,
    "docs/guides/smaller-scenes.md": 1,
    "docs/guides/viewing.md": 4,
}
#: Values in place of those on the page, so that runs are short.
SHORT = {"--steps": "4", "--rounds": "0", "--orbit": "2", "--max-splats": "600"}
#: Options added to commands that have them, if the page does not name them.
ADDED = ("--steps", "--rounds", "--max-splats")
#: The page on which `igsr refine` makes a round; this takes longer than all else.
WITH_A_ROUND = "README.md"
#: Options of ``igsr`` itself, before the command, and how many values follow each.
PROCESS_OPTIONS = {"--threads": 1, "-v": 0, "-vv": 0, "--debug": 0, "--version": 0}
#: Options in the text that are other programs'.
OF_OTHERS = {"--locked", "--path", "--release", "--nocapture", "--grid", "--window"}
#: Pages that name options of splat-view, and former options.
OTHER_OPTIONS = ("docs/guides/viewing.md", "CHANGELOG.md")
#: Folders whose files name pages of docs/ in comments and messages.
NAMING = ("py", "crates", "tests", "examples")


# ---- links -------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES)
def test_links_and_pictures_lead_somewhere(page):
    folder, shown = (ROOT / page).parent, documentation.SHOWN
    wrong = []
    for target in documentation.links(page):
        if re.match(r"https?://|mailto:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (folder / path).resolve() if path else ROOT / page
        if not file.is_relative_to(ROOT) or not file.exists():
            wrong.append(target)
            continue
        named = file.relative_to(ROOT).as_posix()
        # The site has docs/ only.
        on_the_site = page in {*shown.values(), *PAGES} - {"README.md", *shown}
        if on_the_site and path and not named.startswith("docs/"):
            wrong.append(target)
        if anchor and anchor not in documentation.anchors(shown.get(named, named)):
            wrong.append(target)
    assert not wrong


def test_sources_name_pages_that_exist():
    wrong = []
    for folder in NAMING:
        for path in (ROOT / folder).rglob("*"):
            if path.suffix not in {".py", ".rs", ".wgsl", ".toml"} or path == Path(__file__):
                continue
            for named in re.findall(r"\bdocs/[\w/-]+\.(?:md|png)", path.read_text("utf-8")):
                # instant-ngp has a page of this name.
                if not (ROOT / named).is_file() and named != "docs/nerf_dataset_tips.md":
                    wrong.append(f"{path.relative_to(ROOT)}: {named}")
    assert not wrong


def test_the_site_builds_without_a_warning_and_has_every_command(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", tmp_path / "site"]
    env = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    page = (tmp_path / "site" / "reference" / "command-line.html").read_text(encoding="utf-8")
    for name in (name for name in _commands_by_name() if name.startswith("igsr")):
        assert f'id="{name.replace(" ", "-")}"' in page, name
    assert (tmp_path / "site" / "reference" / "changelog.html").read_text().count("<li>") > 5


# ---- commands ----------------------------------------------------------------------------------


@functools.cache
def _commands_by_name():
    walk = runpy.run_path(DOCS / "_site" / "command_line_page.py")["walk"]
    return {**dict(walk()), **dict(walk("lab", lab.app))}


def _commands(block):
    """The commands of a block, with "lab" for "python -m igsr_lab"."""
    return [
        ["lab", *words[3:]] if words[:3] == ["python", "-m", "igsr_lab"] else words
        for words in documentation.commands(block.code)
    ]


def _without_process_options(words):
    """The words without options between "igsr" and the command: "--threads 1", "-v" ..."""
    rest = words[1:]
    while rest and rest[0] in PROCESS_OPTIONS:
        rest = rest[1 + PROCESS_OPTIONS[rest[0]] :]
    return [words[0], *rest]


def _named_command(words):
    """The command that words such as "python -m igsr_lab study table2 DATA" name, and its name."""
    known = _commands_by_name()
    words = _without_process_options(words)
    name = " ".join(words[:2])
    while len(words) > len(name.split()) and f"{name} {words[len(name.split())]}" in known:
        name += " " + words[len(name.split())]
    assert name in known, f"there is no command {name}"
    return name, known[name]


def _options(command):
    inner = getattr(command, "commands", {}).values()
    own = {opt for p in command.params for opt in (*p.opts, *p.secondary_opts)}
    return own.union({"--help"}, *(_options(one) for one in inner))


def _unknown_options(words):
    name, command = _named_command(words)
    if name == "igsr view":
        return []  # the rest is splat-view's
    words = _without_process_options(words)
    given = [word.partition("=")[0] for word in words if re.match(r"--?[a-z]", word)]
    return [option for option in given if option not in _options(command)]


def _parse(words):
    """Fail if the command line rejects the words."""

    def below(command, name, rest, parent):
        context = command.make_context(name, rest, parent=parent)
        if getattr(command, "commands", None):
            rest = [*getattr(context, "_protected_args", []), *context.args]
            member, inner, rest = command.resolve_command(context, rest)
            below(inner, member, rest, context)

    below(get_command(app if words[0] == "igsr" else lab.app), words[0], words[1:], None)


@pytest.mark.parametrize("page", [page for page in PAGES if page != "CHANGELOG.md"])
def test_commands_and_options_exist(page):
    """In blocks and in the text, also with placeholders."""
    wrong = []
    code = [span.replace("python -m igsr_lab", "lab") for span in documentation.inline_code(page)]
    spans = [span for span in code if span.startswith(("igsr ", "lab "))]
    lines = [(page, span.replace("[", " ").replace("]", " ").split()) for span in spans]
    for block in documentation.blocks(page):
        if block.language == "sh":
            lines += [(block.place, words) for words in _shell(block)]
        elif block.language == "python":
            compile(block.code, block.place, "exec")
    targets = set(re.findall(r"^([a-z][\w-]*):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for place, words in lines:
        # "python -m igsr_lab pairs|train|apply" and "igsr COMMAND" stand for several.
        if words[0] in ("igsr", "lab") and len(words) > 1 and re.fullmatch(r"[a-z-]+", words[1]):
            wrong += [f"{place}: {option}" for option in _unknown_options(words)]
        elif words[0] == "make":
            wrong += [f"{place}: {w}" for w in words[1:] if "=" not in w and w not in targets]
        else:
            files = [w for w in words if re.fullmatch(r"(tests|examples)/\S+\.py", w)]
            wrong += [f"{place}: {file}" for file in files if not (ROOT / file).is_file()]
    assert not wrong


@pytest.mark.parametrize("page", [page for page in PAGES if page not in OTHER_OPTIONS])
def test_options_in_the_text_exist(page):
    commands = [get_command(app), *_commands_by_name().values()]
    known = OF_OTHERS.union(*map(_options, commands))
    spans = [span for span in documentation.inline_code(page) if span.startswith("--")]
    named = [word for span in spans for word in re.findall(r"(?<!\S)--[a-z][\w-]*", span)]
    assert [option for option in named if option not in known] == []


def _shell(block):
    try:
        return _commands(block)
    except ValueError:
        assert block.not_run, f"{block.place} is no plain list of commands"
        return []


# ---- code blocks -------------------------------------------------------------------------------


def test_blocks_that_are_not_run_are_few_and_say_why():
    told = [block for page in TYPED for block in documentation.blocks(page) if block.not_run]
    for block in told:
        print(f"{block.place} is not run: {block.not_run}")
        for words in _shell(block):
            if words[0] in ("igsr", "lab") and words[1] != "view":
                _parse(words)
    counts = {page: sum(block.page == page for block in told) for page in TYPED}
    assert {page: count for page, count in counts.items() if count} == NOT_RUN


@pytest.mark.parametrize("page", TYPED)
def test_code_blocks_run(page, world, capsys):
    names = {"__name__": "__main__"}
    ran = 0
    for block in documentation.blocks(page):
        if block.not_run or block.language == "text":
            continue
        assert block.language in {"sh", "python", "json"}, f"{block.place}: name its language"
        if block.language == "json":
            json.loads(block.code)
        elif block.language == "python":
            exec(compile(block.code, block.place, "exec"), names)
        else:
            for words in _commands(block):
                _run(words, block.place)
        ran += 1
    capsys.readouterr()
    assert ran or page in {"docs/index.md", *NOT_RUN}, "a guide without a block to run"


def _run(words, place):
    if words[0] in ("igsr", "lab"):
        said = io.StringIO()
        run = app if words[0] == "igsr" else lab.app
        with redirect_stdout(said), redirect_stderr(said), pytest.raises(SystemExit) as ended:
            run(_shortened(words, place))
        assert not ended.value.code, f"{place}: {' '.join(words)}\n{said.getvalue()}"
    elif words[0] == "python":
        before, sys.argv = sys.argv, _shortened(words, place)
        try:
            runpy.run_path(words[1], run_name="__main__")
        finally:
            sys.argv = before
    else:
        raise AssertionError(f"{place}: {words[0]} is not run here; mark the block")


def _shortened(words, place):
    """The arguments of a command, with few steps and frames."""
    short = {**SHORT, "--rounds": "1"} if place.startswith(WITH_A_ROUND) else SHORT
    given = [short.get(before, word) for before, word in itertools.pairwise(words)]
    if words[0] not in ("igsr", "lab"):
        return given
    options = _options(_named_command(words)[1])
    missing = [name for name in ADDED if name in options and name not in given]
    return given + [word for name in missing for word in (name, short[name])]


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """Files of the pages: ``photos`` without cameras, and ``examples`` with a tiny capture."""
    folder = tmp_path_factory.mktemp("docs")
    (folder / "photos").mkdir()
    for k, angle in enumerate(np.linspace(-0.4, 0.4, 5)):
        Image.fromarray(rooms.picture(rooms.camera(angle))).save(folder / "photos" / f"{k}.png")
    table = folder / "examples" / "tea_table"
    table.mkdir(parents=True)
    shutil.copy(ROOT / "examples" / "own_loss.py", table.parent)
    for split, count in (("train", 8), ("test", 2)):
        whole = ROOT / "examples" / "tea_table"
        document = json.loads((whole / f"transforms_{split}.json").read_text())
        document["frames"] = document["frames"][:: len(document["frames"]) // count][:count]
        (table / f"transforms_{split}.json").write_text(json.dumps(document))
        (table / split).mkdir()
        for frame in document["frames"]:
            name = frame["file_path"] + ".png"
            with Image.open(whole / name) as photo:
                photo.resize((48, 48), Image.Resampling.BOX).save(table / name)
    return folder


@pytest.fixture
def world(made, tmp_path, monkeypatch):
    """A folder to run a page in, with short fits."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    short = {"steps": int(SHORT["--steps"])}
    _shorten(monkeypatch, "compact", short)
    _shorten(monkeypatch, "fit", {**short, "max_splats": int(SHORT["--max-splats"])})
    _shorten(monkeypatch, "refine", {**short, "rounds": int(SHORT["--rounds"])})
    monkeypatch.setattr(Colmap, "__call__", _looked_for_once(Colmap.__call__))
    return tmp_path


def _shorten(monkeypatch, name, short):
    function = getattr(igsr, name)
    monkeypatch.setattr(igsr, name, lambda *args, **given: function(*args, **{**given, **short}))


_FOUND = {}


def _looked_for_once(function):
    def remembered(self, photos, **options):
        key = (options.get("seed"), *((photo.name, photo.image.tobytes()) for photo in photos))
        if key not in _FOUND:
            _FOUND[key] = function(self, photos, **options)
        return copy.deepcopy(_FOUND[key])

    return remembered
