"""Old names of attributes, keywords and module contents, which work on for one release.

Each use of an old name gives a ``DeprecationWarning`` that names the new one. Old names of whole
modules are in ``igsr._internal.moved_modules``.
"""

from __future__ import annotations

import functools
import sys
import warnings
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

_Function = TypeVar("_Function", bound=Callable[..., Any])
_Class = TypeVar("_Class", bound=type)


def renamed_keywords(**names: str) -> Callable[[_Function], _Function]:
    """A decorator of functions: ``old="new"`` keywords may still be given by their old names.

    The function raises ``TypeError`` where a keyword is given by both names.
    """

    def decorate(function: _Function) -> _Function:
        @functools.wraps(function)
        def with_old_keywords(*args: Any, **kwargs: Any) -> Any:
            for old, new in names.items():
                if old in kwargs:
                    if new in kwargs:
                        raise TypeError(
                            f"{function.__name__} was given {new} and {old}, its old name"
                        )
                    _warn(f"the keyword {old} of {function.__name__}", new)
                    kwargs[new] = kwargs.pop(old)
            return function(*args, **kwargs)

        return with_old_keywords  # type: ignore[return-value]

    return decorate


def renamed_attributes(
    **names: str | tuple[str, Callable[[Any], Any]],
) -> Callable[[_Class], _Class]:
    """A decorator of classes: ``old="new"`` attributes can still be read by their old names.

    ``old=("new", convert)`` also turns the new value into what the old attribute held.
    """

    def decorate(cls: _Class) -> _Class:
        for old, now in names.items():
            new, convert = now if isinstance(now, tuple) else (now, _unchanged)
            setattr(cls, old, _old_attribute(cls.__name__, old, new, convert))
        return cls

    return decorate


def renamed_names(module: str, **names: str) -> Callable[[str], Any]:
    """A module's ``__getattr__`` that finds ``old="new"`` names of the module."""

    def find(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        _warn(f"{module}.{name}", f"{module}.{names[name]}")
        return getattr(sys.modules[module], names[name])

    return find


class RenamedKeys(dict[str, Any]):
    """A dictionary that also finds values by the old names of its keys."""

    def __init__(self, values: Mapping[str, Any], names: Mapping[str, str]) -> None:
        """Keep ``values``; ``names`` has the new key of each old one."""
        super().__init__(values)
        self._names = names

    def __missing__(self, key: str) -> Any:
        new = self._names.get(key)
        if new is None or new not in self:
            raise KeyError(key)
        _warn(f"the key {key!r}", repr(new))
        return self[new]


def _unchanged(value: Any) -> Any:
    return value


def _old_attribute(cls: str, old: str, new: str, convert: Callable[[Any], Any]) -> property:
    def read(self: Any) -> Any:
        _warn(f"{cls}.{old}", f"{cls}.{new}")
        return convert(getattr(self, new))

    return property(read, doc=f"The old name of ``{new}``.")


def _warn(old: str, new: str) -> None:
    """Warn at the line that uses the old name: the caller of our caller."""
    warnings.warn(
        f"{old} is now {new}; the old name goes with the next release.",
        DeprecationWarning,
        stacklevel=3,
    )
