"""Public names of a package that are imported on first use (PEP 562), so that it imports fast."""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from igsr._internal.extras import naming_extra


def lazy_exports(
    package: str,
    homes: Mapping[str, Sequence[str]],
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return the ``__getattr__`` and ``__dir__`` of a package.

    The former raises MissingExtraError for names of ``igsr`` that need an extra.

    Args:
        package: its ``__name__``.
        homes: public names by the module that defines them.
    """
    home_of = {name: module for module, names in homes.items() for name in names}

    def find(name: str) -> Any:
        if name in home_of:
            with naming_extra(f"igsr.{name}") if package == "igsr" else contextlib.nullcontext():
                value = getattr(importlib.import_module(home_of[name]), name)
            setattr(sys.modules[package], name, value)
            return value
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *home_of})

    return find, names
