"""Settings classes check and normalize their values."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import pytest

import igsr
from igsr._internal.settings import about, checked_given, settings_of, validate


@dataclass(frozen=True, kw_only=True)
class Example:
    steps: int = field(metadata=about(limits=(1, 10_000)))
    seed: int = field(default=7, metadata=about(limits=(0, 2**63 - 1)))
    start: Literal["auto", "per-camera"] = field(metadata=about())
    hull: bool = field(metadata=about())
    dropout: float | None = field(default=None, metadata=about(limits=(0.0, 0.9)))
    plain: object = None

    def __post_init__(self) -> None:
        validate(self)


GOOD: dict[str, Any] = {"steps": 5, "start": "auto", "hull": True}


def test_settings_have_the_types_of_their_fields():
    settings = settings_of(Example)
    assert list(settings) == ["steps", "seed", "start", "hull", "dropout"]
    start, dropout = settings["start"], settings["dropout"]
    assert (start.kind, start.choices, start.optional) == (str, ("auto", "per-camera"), False)
    assert (dropout.kind, dropout.choices, dropout.optional) == (float, (), True)


def test_numpy_numbers_become_pythons():
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
def test_invalid_settings_are_named(bad, message):
    with pytest.raises(igsr.IgsrError, match=message):
        Example(**GOOD | bad)
    if not any(value is None for value in bad.values()):
        with pytest.raises(igsr.IgsrError, match=message):
            checked_given(Example, bad)


def test_settings_that_are_none_are_not_given():
    assert checked_given(Example, {"steps": np.int64(3), "hull": None}) == {"steps": 3}
    with pytest.raises(
        igsr.IgsrError, match=r"^unknown setting stepz; known settings: steps, seed"
    ):
        checked_given(Example, {"stepz": 3})
