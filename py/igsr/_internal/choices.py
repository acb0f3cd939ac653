"""Types of arguments that choose from names."""

from __future__ import annotations

from typing import Literal

#: "auto" is a real GPU if there is one, else the CPU; "reference" computes in float64.
Backend = Literal["auto", "cpu", "gpu", "reference"]
#: Backends with an optimizer.
FitBackend = Literal["auto", "cpu", "gpu"]
ResolvedBackend = Literal["cpu", "gpu", "reference"]
#: Views to fit, or held out for testing.
Split = Literal["train", "test"]
SPLITS: tuple[Split, ...] = ("train", "test")
