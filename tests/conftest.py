"""Fixtures that several test files share."""

import os
import subprocess
from pathlib import Path

import hypothesis
import pytest
import refinements

from igsr import cli
from igsr.cameras.colmap import aliked
from igsr.refinement import refine_photos, rounds
from igsr_lab import __main__ as lab

# Its numbers are megabytes that are not here: it runs only if a folder of them is given.
collect_ignore = [] if os.environ.get("IGSR_DA3_FIXTURES") else ["test_da3_published.py"]

# A failure must be the same failure on the next run, and slowness is not a failure.
hypothesis.settings.register_profile("igsr", derandomize=True, deadline=None)
hypothesis.settings.load_profile("igsr")

#: Matcher "auto" is SIFT in tests, which is faster; ``with_aliked`` changes that.
aliked_is_available = aliked.is_available
aliked.is_available = lambda: False


@pytest.fixture
def with_aliked(monkeypatch):
    """Matcher "auto" uses ALIKED."""
    monkeypatch.setattr(aliked, "is_available", aliked_is_available)


def pytest_report_header() -> list[str]:
    """List the tests that are left out, and how to run them."""
    return [f"{name}: left out, since IGSR_DA3_FIXTURES names no folder" for name in collect_ignore]


@pytest.fixture(scope="session")
def example_path() -> Path:
    """The capture that is committed as an example."""
    return Path(__file__).parent.parent / "examples" / "tea_table"


@pytest.fixture(scope="session")
def ball_photos():
    """Nine photos of a ball to fit, and three to test."""
    return refinements.capture(12)


@pytest.fixture(scope="session")
def few_photos():
    """Three photos of a ball to fit, and two to test."""
    return refinements.capture(5)


@pytest.fixture(scope="session")
def helped(few_photos, tmp_path_factory):
    """A refinement of two rounds, its folder and its events."""
    out = tmp_path_factory.mktemp("helped")
    events = []
    refined = refinements.refine(
        few_photos, 2, refinements.truthful, out=out, progress=events.append
    )
    assert len(refined.rounds) == 2
    return refined, out, events


@pytest.fixture
def rendered(monkeypatch):
    """The reconstructions that refinements render novel views of, in order."""
    seen = []
    propose = rounds.propose_views

    def watched(context, fitted):
        seen.append(fitted)
        return propose(context, fitted)

    for module in (rounds, refine_photos):
        monkeypatch.setattr(module, "propose_views", watched)
    return seen


@pytest.fixture
def igsr_here(capsys):
    """The ``igsr`` command within this process: a new one would import torch each time."""
    return lambda *arguments: _run(cli.app, arguments, capsys)


@pytest.fixture
def lab_here(capsys):
    """``python -m igsr_lab`` within this process."""
    return lambda *arguments: _run(lab.app, arguments, capsys)


def _run(app, arguments, capsys):
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        app([str(argument) for argument in arguments])
    output = capsys.readouterr()
    return subprocess.CompletedProcess(arguments, ended.value.code, output.out, output.err)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """A headless browser of 640 x 480 pixels."""
    from browser import Browser

    with Browser(tmp_path_factory.mktemp("profile"), (640, 480)) as opened:
        yield opened
