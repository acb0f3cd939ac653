"""Names and texts of files are printed as they are: no markup, no codes for the terminal."""

import ast
import json
import os
import warnings
import zipfile
from pathlib import Path

import pytest
import scenes

import igsr
from igsr._internal.event import NOTE, Event
from igsr._internal.progress_bar import progress_bar
from igsr.cli.error_messages import error_messages, print_message
from igsr.cli.output import error_console, output_console
from igsr.cli.process_options import log_to_stderr
from igsr.errors import printable

#: Codes for the title, a color and a cleared terminal, reversed text, and a byte that is no text.
CODES = "\x1b]0;title\x07\x1b[31m\x9b2J\u202e\udcff"
#: As a path, it closes a tag of markup that is not open.
NAME = f"{CODES}[/b]:smile:[old]\n"

windows = pytest.mark.skipif(os.name == "nt", reason="Windows has no such names")


def assert_printable(text):
    assert [letter for letter in text if letter != "\n" and not letter.isprintable()] == []


def calls(path):
    """The functions and methods of text that a module calls, and the calls' keywords."""
    text = path.read_text(encoding="utf-8")
    if not any(word in text for word in ("Console(", "from_markup(", "TextColumn(", "print(")):
        return
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            yield name, {keyword.arg for keyword in node.keywords}


def test_all_text_is_printed_with_the_functions_tested_here():
    # These print JSON and the page's address.
    may_print = {"error_messages.py", "output.py", "web_app.py", "web_view.py"}
    for path in sorted(Path(igsr.__file__).parent.rglob("*.py")):
        for name, keywords in calls(path):
            last = name.rpartition(".")[2]
            assert last not in ("Console", "from_markup"), f"{path}: use igsr.cli.output"
            assert last != "TextColumn" or "markup" in keywords, path
            assert name != "print" or path.name in may_print, f"{path}: use igsr.cli.output"


def print_table(text):
    from rich.table import Table

    table = Table(text)
    table.add_row(text)
    console = output_console()
    console.width = 1000
    console.print(table)


def print_note(text):
    with progress_bar() as show:
        show(Event(NOTE, message=text))


def print_progress(text):
    with progress_bar() as show:
        show(Event("fit", 1, 2, text))


def print_warning(text):
    with error_messages():
        warnings.warn(text, stacklevel=1)


def print_log(text):
    import logging

    logger = logging.getLogger("igsr")
    before = (logger.handlers[:], logger.level)
    log_to_stderr(1)
    logger.info("%s", text)
    # The handler writes to this test's stderr, which is closed for later tests.
    logger.handlers[:] = before[0]
    logger.setLevel(before[1])


PRINTERS = {
    "output": lambda text: output_console().print(text, style="dim"),
    "error": lambda text: error_console().print(text, soft_wrap=True),
    "table": print_table,
    "note": print_note,
    "progress": print_progress,
    "message": print_message,
    "warning": print_warning,
    "log": print_log,
}


@pytest.mark.parametrize("printer", PRINTERS)
def test_text_is_printed_as_it_is(printer, monkeypatch, capsys):
    if printer == "progress":
        monkeypatch.setenv("FORCE_COLOR", "1")
        monkeypatch.setenv("TERM", "xterm")
        monkeypatch.setenv("COLUMNS", "1000")
    PRINTERS[printer](NAME.strip())
    printed = capsys.readouterr()
    text = printed.out + printed.err
    assert printable(CODES) in text
    assert "[/b]:smile:[old]" in text
    assert "Traceback" not in text
    if printer != "progress":  # the bar itself moves the cursor
        assert_printable(text)
    for code in ("\x07", "\x1b]", "\x9b", "\u202e"):
        assert code not in text


def test_spaces_of_any_width_stay(capsys):
    name = "Screenshot\xa01.00\u202fPM\u3000.png"
    print_message(f"{name} is\nmissing")
    assert capsys.readouterr().err == f"{name} is missing.\n"


@pytest.fixture(scope="module")
def named(tmp_path_factory):
    """A folder in which a scene and a capture have the name."""
    folder = tmp_path_factory.mktemp("named")
    path = Path(f"{folder}/{NAME}")
    path.parent.mkdir()
    scenes.splats(60).save(path.with_name(path.name + ".ply"))
    scenes.write_capture(path, scenes.capture(views=3, size=16, alpha=True))
    return folder


SCENE, CAPTURE, OUT = f"{NAME}.ply", NAME, f"{NAME}out"
CPU = ("--backend", "cpu")
COMMANDS = {
    "info": ("info", SCENE),
    "info of a capture": ("info", CAPTURE),
    "convert": ("convert", SCENE, f"{OUT}.spz"),
    "convert to a page": ("convert", SCENE, f"{OUT}.html"),
    "convert to levels": ("convert", SCENE, f"{OUT}lod", "--lod", "2"),
    "convert a capture": ("convert", CAPTURE, f"{OUT}colmap"),
    "clean": ("clean", SCENE, "--out", f"{OUT}clean.ply", *CPU),
    "render": ("render", SCENE, "--cameras", CAPTURE, "--out", f"{OUT}r", *CPU),
    "fit": ("fit", CAPTURE, "--out", f"{OUT}fit", "--steps", "2", "--max-splats", "60", *CPU),
    "no scene": ("info", f"{OUT}no.ply"),
    "no capture": ("view", SCENE, "--web", "--cameras", f"{OUT}no"),
}


@windows
@pytest.mark.parametrize("command", COMMANDS)
def test_commands_print_names_as_they_are(command, named, igsr_here, monkeypatch):
    monkeypatch.chdir(named)
    result = igsr_here(*COMMANDS[command])
    assert result.returncode == (1 if command.startswith("no ") else 0), result.stderr
    text = result.stdout + result.stderr
    assert_printable(text)
    assert printable(CODES) in text
    assert "[/b]:smile:[old]" in text


def ply(*lines):
    head = ["ply", "format binary_little_endian 1.0", *lines, "end_header\n"]
    return "\n".join(head).encode("utf-8", "replace")


def gltf(**parts):
    return json.dumps({"asset": {"version": "2.0"}, **parts}).encode()


#: Damaged files with codes in all texts that messages quote.
TEXT = CODES.replace("\udcff", "")
HEADERS = {
    "format.ply": b"ply\nformat " + TEXT.encode() + b" 1.0\nend_header\n",
    "element.ply": ply(f"element {TEXT} 1"),
    "keyword.ply": ply(f"{TEXT} vertex 1"),
    "count.ply": ply(f"element vertex {TEXT}"),
    "type.ply": ply("element vertex 1", f"property {TEXT} x"),
    "twice.ply": ply("element vertex 1", *2 * [f"property float {TEXT}"]),
    "comment.ply": ply(f"comment {TEXT}", "element vertex 1", "property float x"),
    "required.gltf": gltf(extensionsRequired=[TEXT], extensionsUsed=[TEXT]),
    "version.gltf": gltf(asset={"version": TEXT}),
    "buffer.gltf": gltf(
        buffers=[{"uri": TEXT, "byteLength": 4}],
        bufferViews=[{"buffer": 0, "byteLength": 4}],
        accessors=[{"bufferView": 0, "type": TEXT, "componentType": 5126, "count": 1}],
        meshes=[
            {"name": TEXT, "primitives": [{"mode": 0, "attributes": {"POSITION": 0, TEXT: 0}}]}
        ],
    ),
    "files.sog": {"version": 2, "count": 1, "means": {"files": [TEXT, TEXT]}},
    "text/transforms.json": gltf(frames=[{"file_path": TEXT}]),
    "model/transforms.json": gltf(
        camera_model=TEXT, w=8, h=8, fl_x=9, frames=[{"file_path": "a.png"}]
    ),
}


@pytest.mark.parametrize("name", HEADERS)
def test_texts_of_damaged_files_are_escaped(name, tmp_path, igsr_here):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    content = HEADERS[name]
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("meta.json", json.dumps(content))
    result = igsr_here("info", path if path.parent == tmp_path else path.parent)
    assert result.returncode == 1
    assert result.stderr.count("\n") == 1
    assert_printable(result.stdout + result.stderr)
