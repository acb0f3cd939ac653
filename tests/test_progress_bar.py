"""Progress bars: only in interactive sessions, and only for the outermost run."""

from __future__ import annotations

import sys

import pytest
import scenes

import igsr
from igsr._internal.event import CAMERAS_FOUND, NOTE, Event
from igsr._internal.progress_bar import is_interactive, progress_bar
from igsr.run import open_run


@pytest.fixture
def interactive(monkeypatch):
    monkeypatch.setattr(sys, "ps1", ">>> ", raising=False)


def test_scripts_are_not_interactive():
    assert not is_interactive()


@pytest.mark.usefixtures("interactive")
def test_prompts_are_interactive():
    assert is_interactive()


def test_notebooks_are_interactive(monkeypatch):
    monkeypatch.setitem(sys.modules, "ipykernel.kernelapp", sys)
    assert is_interactive()


@pytest.fixture
def terminal(monkeypatch):
    """Let rich take the captured stderr for a terminal."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")


@pytest.mark.parametrize(
    ("event", "text"),
    [
        (Event("load photos", 3, 10, "at 3"), "load photos 3/10"),
        (Event("load photos", 3, 10, "at 3"), "at 3"),
        (Event("fit", 5, 20, part=0.25), "fit 5/20"),
        (Event(NOTE, message="Found [2] photos."), "Found [2] photos."),
    ],
)
@pytest.mark.usefixtures("terminal")
def test_the_bar_shows_stages_counts_and_notes(event, text, capsys):
    with progress_bar() as show:
        show(event)
    shown = capsys.readouterr()
    assert text in shown.err
    assert not shown.out


@pytest.mark.usefixtures("terminal")
def test_the_bar_ignores_files(tmp_path, capsys):
    with progress_bar() as show:
        show(Event(CAMERAS_FOUND, path=tmp_path))
    assert capsys.readouterr().err == ""


def test_notes_only_are_printed_without_a_terminal(capsys):
    with progress_bar() as show:
        show(Event(NOTE, message="a note"))
        show(Event("fit", 5, 20, part=0.25))
    assert capsys.readouterr().err == "a note\n"


@pytest.mark.usefixtures("terminal")
def test_a_bar_without_events_prints_nothing(capsys):
    with pytest.raises(igsr.IgsrError, match="bad"), progress_bar():
        raise igsr.IgsrError("bad settings.")
    with progress_bar(shown=False) as show:
        show(Event("fit", 1, 2))
        show(Event(NOTE, message="a note"))
    assert capsys.readouterr().err == ""


@pytest.mark.usefixtures("interactive", "terminal")
def test_runs_show_a_bar_unless_they_have_a_listener_or_are_nested(capsys):
    event, events = Event("count", 3, 10), []
    with open_run(None, None) as run:
        run.report(event)
        with open_run(None, None) as inner:
            assert not inner.is_followed
    assert "count 3/10" in capsys.readouterr().err
    with open_run(None, events.append) as run:
        run.report(event)
    assert events == [event]
    assert capsys.readouterr().err == ""


@pytest.mark.usefixtures("terminal")
def test_fits_show_a_bar_in_interactive_sessions_only(monkeypatch, capsys):
    capture = scenes.capture(views=4, size=24)
    options = {"steps": 5, "backend": "cpu", "max_splats": 50}
    igsr.fit(capture, **options)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys, "ps1", ">>> ", raising=False)
    igsr.fit(capture, **options)
    assert "fit 5/5" in capsys.readouterr().err
    igsr.fit(capture, progress=lambda event: None, **options)
    assert capsys.readouterr().err == ""
