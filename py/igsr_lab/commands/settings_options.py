"""Command line options made from a settings class, and options read from a file.

Each setting is named once, in its class:

>>> @settings_options(FitSettings, leave_out=("background",))
... def fit_command(out: OutOption, given: dict[str, Any], config: ConfigOption = None) -> None:
...     settings = settings_for("default", photos=12, **given)
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import inspect
import json
import typing
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Annotated, Any

import typer

from igsr._internal.settings import Setting, checked, settings_of
from igsr.cli.error_messages import error_messages
from igsr.errors import IgsrError

#: The parameter that takes what was given on the command line.
GIVEN = "given"
#: Options that a file cannot set.
_NOT_FROM_A_FILE = ("config", "help")
#: What JSON has for the types of options that are not text.
_JSON_TYPES: dict[Any, tuple[tuple[type, ...], str]] = {
    int: ((int,), "a whole number"),
    float: ((int, float), "a number"),
    bool: ((bool,), "true or false"),
}


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
        wrapped.settings = {one.name: one for one in settings}  # type: ignore[attr-defined]
        return wrapped

    return with_options


def given_by_hand(ctx: typer.Context, name: str) -> bool:
    """Whether the command line itself names an option, by its parameter's name."""
    source = ctx.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def options_in(path: Path, command: Any) -> dict[str, Any]:
    """The options that a JSON file sets, by the names of the command's parameters.

    The file holds an object of options by name ("max_splats", "max-splats" or another of the
    option's names); those that are null are left out. In a report, the object is its "settings".

    Args:
        path: of the file.
        command: as typer makes it.

    Raises:
        IgsrError: the file cannot be read, is no such file, or names what is no option; a value is
            of another type than the option's, or out of a setting's range. The message names file
            and option.
    """
    kinds = inspect.signature(command.callback, eval_str=True).parameters
    settings: dict[str, Setting] = getattr(command.callback, "settings", {})
    known = {
        name.lstrip("-").replace("-", "_"): one.name
        for one in command.params
        if one.name not in _NOT_FROM_A_FILE
        for name in (one.name, *one.opts)
    }
    found = {}
    for name, value in _json_object(path).items():
        parameter = known.get(name.replace("-", "_"))
        if parameter is None:
            raise IgsrError(f"{path}: there is no option {name!r} here; leave it out.")
        if value is None:
            continue
        setting = settings.get(parameter)
        if setting is None or setting.read is None:
            types, words = _JSON_TYPES.get(_kind(kinds[parameter].annotation), ((str,), "a text"))
            if not isinstance(value, types) or (isinstance(value, bool) and bool not in types):
                raise IgsrError(f"{path}: {name} must be {words}, not {json.dumps(value)}.")
        if setting is not None:
            try:
                checked(setting, value)
            except IgsrError as error:
                raise IgsrError(f"{path}: {error}") from error
        found[parameter] = value
    return found


def _json_object(path: Path) -> dict[str, Any]:
    """The object of options in a file; see ``options_in``."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise IgsrError(f"Cannot read {path}: {error.strerror or error}.") from error
    except (ValueError, RecursionError) as error:
        raise IgsrError(f"{path} is no JSON file of options ({error}).") from error
    if isinstance(values, dict) and isinstance(values.get("settings"), dict):
        values = values["settings"]
    elif isinstance(values, dict) and "version" in values:
        raise IgsrError(f"{path} has no settings: it is a report of an older version of igsr.")
    if not isinstance(values, dict):
        raise IgsrError(f"{path} is no JSON file of options: it holds no object.")
    return values


def _kind(annotation: Any) -> Any:
    """``int`` of ``Annotated[int | None, ...]``."""
    if typing.get_origin(annotation) is Annotated:
        annotation = typing.get_args(annotation)[0]
    kinds = [one for one in typing.get_args(annotation) if one is not type(None)]
    return kinds[0] if kinds else annotation


def _take_options(ctx: typer.Context, path: Path | None) -> Path | None:
    """Make what the file says the defaults of the other options, which are read after this one."""
    if path is not None:
        with error_messages():
            ctx.default_map = {**(ctx.default_map or {}), **options_in(path, ctx.command)}
    return path


ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config",
        metavar="FILE",
        is_eager=True,
        callback=_take_options,
        help="Take options from a JSON file, such as the report.json of an earlier run, which then "
        "runs again. Options that are given override it.",
    ),
]


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
