"""``==`` for dataclasses that hold arrays."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np


class ArrayEquality:
    """Gives a dataclass an ``==`` that compares arrays entry by entry and returns one bool.

    The dataclass is declared with ``eq=False``, whose generated ``==`` raises for arrays. Two
    objects are equal if they have the same class and equal fields. Arrays are equal if dtype, shape
    and entries are; NaN equals NaN, so that a copy equals its original.
    """

    def __eq__(self, other: object) -> bool:
        """Whether ``other`` has the same class and equal fields."""
        if self is other:
            return True
        if type(other) is not type(self):
            return NotImplemented
        return all(
            _equal(getattr(self, field.name), getattr(other, field.name))
            for field in fields(self)  # type: ignore[arg-type]  # of dataclasses only
        )


def _equal(one: Any, other: Any) -> bool:
    if one is other:
        return True
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return (
            isinstance(one, np.ndarray)
            and isinstance(other, np.ndarray)
            and one.dtype == other.dtype
            and np.array_equal(one, other, equal_nan=one.dtype.kind in "fc")
        )
    if isinstance(one, (list, tuple)):
        return (
            type(one) is type(other)
            and len(one) == len(other)
            and all(_equal(a, b) for a, b in zip(one, other, strict=True))
        )
    return bool(one == other)
