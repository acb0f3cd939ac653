"""Settings as frozen dataclasses: ``validate`` checks each field by its type and limits.

>>> @dataclass(frozen=True, kw_only=True)
... class FitSettings:
...     steps: int = field(metadata=about(limits=(1, 10_000_000)))
...     density: Literal["mcmc", "fixed"] = field(metadata=about())
...
...     def __post_init__(self) -> None:
...         validate(self)
"""

from __future__ import annotations

import dataclasses
import math
import numbers
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from igsr.errors import IgsrError

_KEY = "igsr.setting"


@dataclass(frozen=True)
class _About:
    help: str
    limits: tuple[float, float] | None
    read: Callable[[str, Any], Any] | None


@dataclass(frozen=True)
class Setting:
    """One setting of a settings class.

    Attributes:
        name: of the field.
        kind: int, float, bool, str or another class.
        choices: allowed values if the type is a ``Literal``, else empty.
        optional: whether None is allowed.
        default: of the field; ``dataclasses.MISSING`` if it has none.
        help: one or two sentences for a command line option; may be empty.
        limits: smallest and largest number, or None.
        read: converts (name, value) to the value that is kept, or raises IgsrError; None if
            ``kind``, ``choices`` and ``limits`` suffice.
    """

    name: str
    kind: type
    choices: tuple[str, ...]
    optional: bool
    default: Any
    help: str
    limits: tuple[float, float] | None
    read: Callable[[str, Any], Any] | None


def about(
    help: str = "",
    *,
    limits: tuple[float, float] | None = None,
    read: Callable[[str, Any], Any] | None = None,
) -> Mapping[str, Any]:
    """Return the metadata of a setting's field; see ``Setting``."""
    return {_KEY: _About(help, limits, read)}


def settings_of(cls: type) -> dict[str, Setting]:
    """Return the settings of a class by name. Fields without ``about`` are left out."""
    hints = typing.get_type_hints(cls)
    return {
        one.name: _setting(one, hints[one.name])
        for one in dataclasses.fields(cls)
        if _KEY in one.metadata
    }


def validate(settings: object) -> None:
    """Check and normalize all settings of an object; call it in ``__post_init__``.

    Numbers of other libraries (numpy) become Python's own.

    Raises:
        IgsrError: a setting has an invalid value; the message names the setting.
    """
    for name, setting in settings_of(type(settings)).items():
        # The object is frozen for all but its own construction.
        object.__setattr__(settings, name, checked(setting, getattr(settings, name)))


def checked_given(cls: type, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of ``given`` that are not None, checked one by one.

    Raises:
        IgsrError: a value is invalid, or a setting is unknown.
    """
    known = settings_of(cls)
    unknown = [name for name in given if name not in known]
    if unknown:
        raise IgsrError(f"unknown setting {unknown[0]}; known settings: {', '.join(known)}.")
    return {name: checked(known[name], value) for name, value in given.items() if value is not None}


def checked(setting: Setting, value: Any) -> Any:
    """Check one value and return it as the setting keeps it.

    Raises:
        IgsrError: the value is invalid.
    """
    name = setting.name
    if value is None and setting.optional:
        return None
    if setting.read is not None:
        return setting.read(name, value)
    if setting.choices:
        # Arrays compare elementwise, so check for text first.
        if not isinstance(value, str) or value not in setting.choices:
            raise IgsrError(f"{name} must be one of {', '.join(setting.choices)}, not {value!r}.")
        return str(value)
    if setting.kind is bool:
        if not isinstance(value, bool):
            raise IgsrError(f"{name} must be True or False, not {value!r}.")
        return value
    if setting.kind is int:
        if isinstance(value, bool) or not isinstance(value, numbers.Integral):
            raise IgsrError(f"{name} must be a whole number, not {value!r}.")
        number = int(value)
        if setting.limits is not None and not setting.limits[0] <= number <= setting.limits[1]:
            low, high = setting.limits
            raise IgsrError(f"{name} must be from {low} to {high}, not {number}.")
        return number
    if setting.kind is float:
        low, high = setting.limits or (-math.inf, math.inf)
        real = isinstance(value, numbers.Real) and not isinstance(value, bool)
        if not real or not low <= float(value) <= high:  # NaN fails both comparisons
            within = "" if setting.limits is None else f" from {low:g} to {high:g}"
            raise IgsrError(f"{name} must be a number{within}, not {value!r}.")
        return float(value)
    if not isinstance(value, setting.kind):
        raise IgsrError(f"{name} must be {setting.kind.__name__}, not {value!r}.")
    return value


def _setting(field: dataclasses.Field[Any], hint: Any) -> Setting:
    metadata: _About = field.metadata[_KEY]
    optional = False
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        kinds = [kind for kind in typing.get_args(hint) if kind is not type(None)]
        optional = len(kinds) < len(typing.get_args(hint))
        hint = kinds[0]
    choices: tuple[str, ...] = ()
    if typing.get_origin(hint) is typing.Literal:
        choices, hint = typing.get_args(hint), str
    return Setting(
        name=field.name,
        kind=typing.get_origin(hint) or hint,
        choices=choices,
        optional=optional,
        default=field.default,
        help=metadata.help,
        limits=metadata.limits,
        read=metadata.read,
    )
