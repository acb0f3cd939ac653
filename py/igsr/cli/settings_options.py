"""Command line options made from a settings class, so that each setting is named once.

>>> @settings_options(FitSettings, leave_out=("background",))
... def fit_command(out: OutOption, given: dict[str, Any], as_json: JsonOption = False) -> None:
...     settings = settings_for("default", photos=12, **given)
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import inspect
from collections.abc import Callable, Collection
from typing import Annotated, Any

import typer

from igsr._internal.settings import Setting, settings_of

#: The parameter that takes what was given on the command line.
GIVEN = "given"


def settings_options(
    cls: type, leave_out: Collection[str] = ()
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A decorator that puts an option for each setting of ``cls`` where ``given`` stands.

    The command then receives ``given``: the settings that the command line names, by name, as plain
    values. A setting that was not given is in it only where its field has a default.

    Args:
        cls: a dataclass whose fields have ``igsr._internal.settings.about`` for metadata.
        leave_out: settings that get no option.
    """
    settings = [one for one in settings_of(cls).values() if one.name not in leave_out]

    def with_options(command: Callable[..., None]) -> Callable[..., None]:
        signature = inspect.signature(command, eval_str=True)
        parameters: list[inspect.Parameter] = []
        for parameter in signature.parameters.values():
            if parameter.name == GIVEN:
                parameters += [_option(setting) for setting in settings]
            else:
                parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))

        @functools.wraps(command)
        def wrapped(**values: Any) -> None:
            given = {one.name: _plain(values.pop(one.name)) for one in settings}
            values[GIVEN] = {name: value for name, value in given.items() if value is not None}
            command(**values)

        wrapped.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
        wrapped.__annotations__ = {one.name: one.annotation for one in parameters}
        return wrapped

    return with_options


def _option(setting: Setting) -> inspect.Parameter:
    """The option of a setting: ``--sh-degree`` for sh_degree, ``--hull/--no-hull`` for a bool."""
    dashed = setting.name.replace("_", "-")
    names = [f"--{name}" for name in (dashed, *setting.aliases)]
    kind: Any = setting.kind
    if kind is bool:
        names[0] += f"/--no-{dashed}"
    if setting.choices:
        make_enum: Any = enum.Enum
        kind = make_enum(setting.name, {one: one for one in setting.choices}, type=str)
    default = None if setting.default is dataclasses.MISSING else setting.default
    if setting.choices and default is not None:
        default = kind(default)
    return inspect.Parameter(
        setting.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=default,
        annotation=Annotated[kind | None, typer.Option(*names, help=setting.help)],
    )


def _plain(value: Any) -> Any:
    return value.value if isinstance(value, enum.Enum) else value
