"""Settings as frozen dataclasses whose fields say what they mean and what they may be.

A settings class names each setting once. Its fields carry a help text, limits and other names in
their metadata (``about``); ``validate`` checks them and ``igsr.cli.settings_options`` makes command
line options from them:

>>> @dataclass(frozen=True, kw_only=True)
... class FitSettings:
...     steps: int = field(metadata=about("Optimiser steps.", limits=(1, 10_000_000)))
...     density: Literal["mcmc", "fixed"] = field(metadata=about("How splats are added."))
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
    aliases: tuple[str, ...]
    read: Callable[[str, Any], Any] | None


@dataclass(frozen=True)
class Setting:
    """One setting of a settings class.

    Attributes:
        name: of the field.
        kind: int, float, bool, str or another class.
        choices: what it may be, where its type is a ``Literal``; else empty.
        optional: whether it may be None.
        default: of the field; ``dataclasses.MISSING`` where it has none.
        help: what it means, one or two sentences.
        limits: least and most of a number, or None.
        aliases: other names of its command line option, without dashes.
        read: takes name and value and returns the value as it is kept, or raises IgsrError; None
            where ``kind``, ``choices`` and ``limits`` say all.
    """

    name: str
    kind: type
    choices: tuple[str, ...]
    optional: bool
    default: Any
    help: str
    limits: tuple[float, float] | None
    aliases: tuple[str, ...]
    read: Callable[[str, Any], Any] | None


def about(
    help: str,
    *,
    limits: tuple[float, float] | None = None,
    aliases: tuple[str, ...] = (),
    read: Callable[[str, Any], Any] | None = None,
) -> Mapping[str, Any]:
    """The metadata of a setting's field; see ``Setting``."""
    return {_KEY: _About(help, limits, aliases, read)}


def settings_of(cls: type) -> dict[str, Setting]:
    """The settings of a class by name, in its order. Fields without ``about`` are none."""
    hints = typing.get_type_hints(cls)
    return {
        one.name: _setting(one, hints[one.name])
        for one in dataclasses.fields(cls)
        if _KEY in one.metadata
    }


def validate(settings: object) -> None:
    """Check a settings object; for its ``__post_init__``.

    Numbers of other libraries (numpy) become Python's own, so that equal settings look alike
    wherever they are written.

    Raises:
        IgsrError: a setting cannot be used; the message names it.
    """
    for name, setting in settings_of(type(settings)).items():
        # The object is frozen for all but its own construction.
        object.__setattr__(settings, name, checked(setting, getattr(settings, name)))


def checked_given(cls: type, given: Mapping[str, Any]) -> dict[str, Any]:
    """Those settings of ``given`` that are not None, checked one by one.

    Raises:
        IgsrError: one cannot be used, or there is none of that name.
    """
    known = settings_of(cls)
    unknown = [name for name in given if name not in known]
    if unknown:
        raise IgsrError(f"there is no setting {unknown[0]}; there are {', '.join(known)}.")
    return {name: checked(known[name], value) for name, value in given.items() if value is not None}


def checked(setting: Setting, value: Any) -> Any:
    """``value`` as the setting keeps it.

    Raises:
        IgsrError: the setting cannot have this value.
    """
    name = setting.name
    if value is None and setting.optional:
        return None
    if setting.read is not None:
        return setting.read(name, value)
    if setting.choices:
        # Compared as text: what is no text may have a comparison of its own, as arrays do.
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
        if not real or not low <= float(value) <= high:  # nan is in no range
            within = "" if setting.limits is None else f" from {low:g} to {high:g}"
            raise IgsrError(f"{name} must be a number{within}, not {value!r}.")
        return float(value)
    if not isinstance(value, setting.kind):
        raise IgsrError(f"{name} must be {setting.kind.__name__}, not {value!r}.")
    return value


def _setting(field: dataclasses.Field[Any], hint: Any) -> Setting:
    said: _About = field.metadata[_KEY]
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
        help=said.help,
        limits=said.limits,
        aliases=said.aliases,
        read=said.read,
    )
