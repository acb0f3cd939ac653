"""Command line options made from a settings class, so that each setting is named once."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from typing import Annotated, Any, Literal

from igsr._internal.settings import Setting, settings_of
from igsr.cli.options import option

#: The parameter of commands that takes the settings.
GIVEN = "given"


def settings_options(cls: type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A decorator that replaces the parameter ``given`` by an option per setting.

    The command receives ``given``, a dictionary of the settings that are not None.

    Args:
        cls: a dataclass whose fields have ``igsr._internal.settings.about`` for metadata.
    """
    settings = settings_of(cls)

    def with_options(command: Callable[..., None]) -> Callable[..., None]:
        parameters: list[inspect.Parameter] = []
        for parameter in inspect.signature(command, eval_str=True).parameters.values():
            if parameter.name == GIVEN:
                parameters += [_parameter(setting) for setting in settings.values()]
            else:
                parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))

        def wrapped(**values: Any) -> None:
            given = {name: values.pop(name) for name in settings}
            command(**values, given={k: v for k, v in given.items() if v is not None})

        wrapped.__doc__ = command.__doc__
        wrapped.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        wrapped.__annotations__ = {one.name: one.annotation for one in parameters}
        return wrapped

    return with_options


def _parameter(setting: Setting) -> inspect.Parameter:
    dashed = setting.name.replace("_", "-")
    name = f"--{dashed}/--no-{dashed}" if setting.kind is bool else f"--{dashed}"
    kind: Any = Literal[setting.choices] if setting.choices else setting.kind
    default = None if setting.default is dataclasses.MISSING else setting.default
    return inspect.Parameter(
        setting.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=default,
        annotation=Annotated[kind | None, option(name, help=setting.help)],
    )
