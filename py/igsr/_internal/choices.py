"""Names that public arguments choose from, as types for editors and type checkers."""

from __future__ import annotations

from typing import Literal

#: What renders. "auto" is a real GPU if one answers, else the CPU; "reference" computes in float64.
Backend = Literal["auto", "cpu", "gpu", "reference"]
#: What fits: the reference has no optimizer.
FitBackend = Literal["auto", "cpu", "gpu"]
#: A backend that "auto" is resolved to.
ResolvedBackend = Literal["cpu", "gpu", "reference"]
#: Views to fit, or views that are held out for testing.
Split = Literal["train", "test"]
SPLITS: tuple[Split, ...] = ("train", "test")
