"""Settings classes: what they check, and the command line options made from them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import igsr
from igsr._internal.settings import about, checked_given, settings_of, validate
from igsr.cli.settings_options import settings_options


@dataclass(frozen=True, kw_only=True)
class Example:
    steps: int = field(metadata=about("Optimiser steps.", limits=(1, 10_000)))
    seed: int = field(default=7, metadata=about("Of everything random.", limits=(0, 2**63 - 1)))
    start: Literal["auto", "per-camera"] = field(metadata=about("A word.", aliases=("init",)))
    hull: bool = field(metadata=about("Yes or no."))
    dropout: float | None = field(default=None, metadata=about("A part.", limits=(0.0, 0.9)))
    plain: object = None

    def __post_init__(self) -> None:
        validate(self)


GOOD: dict[str, Any] = {"steps": 5, "start": "auto", "hull": True}


def test_a_setting_is_named_once():
    assert list(settings_of(Example)) == ["steps", "seed", "start", "hull", "dropout"]
    start, dropout = settings_of(Example)["start"], settings_of(Example)["dropout"]
    assert (start.kind, start.choices, start.optional) == (str, ("auto", "per-camera"), False)
    assert (dropout.kind, dropout.choices, dropout.optional) == (float, (), True)


def test_numbers_of_other_libraries_become_plain():
    made = Example(**GOOD | {"steps": np.uint8(5), "dropout": np.float32(0.5)})
    assert made == Example(**GOOD, dropout=0.5)
    assert (type(made.steps), type(made.dropout)) == (int, float)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"steps": 0}, r"^steps must be from 1 to 10000, not 0\.$"),
        ({"steps": 2.9}, r"^steps must be a whole number, not 2\.9\.$"),
        ({"steps": True}, r"^steps must be a whole number, not True\.$"),
        ({"steps": None}, r"^steps must be a whole number, not None\.$"),
        ({"seed": 2**63}, "^seed must be from 0 to 9223372036854775807, not"),
        ({"start": "magic"}, r"^start must be one of auto, per-camera, not 'magic'\.$"),
        ({"start": np.zeros(2)}, "^start must be one of auto, per-camera"),
        ({"hull": "yes"}, r"^hull must be True or False, not 'yes'\.$"),
        ({"dropout": 0.95}, r"^dropout must be a number from 0 to 0\.9, not 0\.95\.$"),
        ({"dropout": float("nan")}, "^dropout must be a number from 0 to 0.9, not nan"),
        ({"dropout": "0.5"}, "^dropout must be a number"),
    ],
)
def test_a_setting_that_cannot_be_is_named(bad, message):
    with pytest.raises(igsr.IgsrError, match=message):
        Example(**GOOD | bad)
    if not any(value is None for value in bad.values()):
        with pytest.raises(igsr.IgsrError, match=message):
            checked_given(Example, bad)


def test_given_settings_are_those_that_are_not_none():
    assert checked_given(Example, {"steps": np.int64(3), "hull": None}) == {"steps": 3}
    with pytest.raises(igsr.IgsrError, match=r"^there is no setting stepz; there are steps, seed"):
        checked_given(Example, {"stepz": 3})


def test_options_are_made_from_a_settings_class():
    app, received = typer.Typer(), []

    @app.command()
    @settings_options(Example, leave_out=("dropout",))
    def command(
        path: Annotated[str, typer.Argument()],
        given: dict[str, Any],
        last: Annotated[bool, typer.Option("--last")] = False,
    ) -> None:
        """What the command does."""
        received.append((path, given, last))

    def called(*words):
        return CliRunner().invoke(app, ["there", *words]).exit_code

    assert called() == 0
    assert called("--steps", "4", "--init", "per-camera", "--no-hull", "--last") == 0
    assert received == [
        ("there", {"seed": 7}, False),
        ("there", {"steps": 4, "seed": 7, "start": "per-camera", "hull": False}, True),
    ]
    assert called("--start", "magic") == 2
    assert called("--dropout", "0.5") == 2
    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "200"}).output
    for text in ("What the command does.", "Optimiser steps.", "--init", "--no-hull", "per-camera"):
        assert text in shown
