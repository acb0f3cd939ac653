"""Progress bars: shown where somebody sits before Python, and only the outermost."""

from __future__ import annotations

import sys

import pytest
import scenes

import igsr
from igsr._internal.progress_bar import (
    BarState,
    is_interactive,
    progress_bar,
    progress_or_bar,
)


@pytest.fixture
def interactive(monkeypatch):
    monkeypatch.setattr(sys, "ps1", ">>> ", raising=False)


def state(now):
    return BarState(now, 10, f"at {now}")


def test_scripts_are_not_interactive():
    assert not is_interactive()


def test_prompts_and_notebooks_are_interactive(monkeypatch):
    monkeypatch.setitem(sys.modules, "ipykernel.kernelapp", sys)
    assert is_interactive()
    monkeypatch.delitem(sys.modules, "ipykernel.kernelapp")
    monkeypatch.setattr(sys, "ps1", ">>> ", raising=False)
    assert is_interactive()


def test_a_bar_shows_where_nobody_asked_for_progress(interactive, capsys):
    with progress_or_bar(None, "count", state) as report:
        assert report is not None
        assert report(3) is None
        with progress_or_bar(None, "inner", state) as inner:
            assert inner is None, "one bar at a time"
    shown = capsys.readouterr()
    assert "count 3/10" in shown.err
    assert "at 3" in shown.err
    assert not shown.out


def test_given_progress_is_passed_on_and_is_all_there_is(interactive, capsys):
    with progress_or_bar(state, "count", state) as report:
        assert report is state
        with progress_or_bar(None, "inner", state) as inner:
            assert inner is None
    assert capsys.readouterr().err == ""
    with progress_or_bar(None, "next", state) as report:
        assert report is not None, "the bars that went before do not count"


def test_a_bar_that_never_moved_never_shows(capsys):
    with pytest.raises(igsr.IgsrError, match="bad"), progress_bar("count"):
        raise igsr.IgsrError("bad settings.")
    with progress_bar("count", shown=False) as show:
        show(BarState(1, 2))
    assert capsys.readouterr().err == ""


def test_a_fit_shows_a_bar_in_a_session_and_none_in_a_script(monkeypatch, capsys):
    capture = scenes.capture(views=4, size=24)
    options = {"steps": 5, "backend": "cpu", "max_splats": 50}
    scenes.fit(capture, **options)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys, "ps1", ">>> ", raising=False)
    scenes.fit(capture, **options)
    assert "fit 5/5" in capsys.readouterr().err
    scenes.fit(capture, progress=lambda now: None, **options)
    assert capsys.readouterr().err == ""
