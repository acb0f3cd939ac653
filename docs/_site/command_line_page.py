"""The reference of the command line, as Markdown, from the commands themselves."""

from __future__ import annotations

import enum
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

from typer.main import get_command

from igsr.cli import app
from igsr.cli.lazy_group import LazyGroup


def commands_markdown() -> str:
    """Return a section for each command, with its help, usage, arguments and options."""
    return "\n".join(line for name, command in walk() for line in _section(name, command))


def walk(root: str = "igsr", app: Any = app) -> Iterator[tuple[str, Any]]:
    """Every command by its full name, such as "igsr weights list"; groups before their members."""

    def below(name: str, command: Any) -> Iterator[tuple[str, Any]]:
        if name != root:
            yield name, command
        members = command.loaded() if isinstance(command, LazyGroup) else None
        for member, inner in (members or getattr(command, "commands", {})).items():
            if not inner.hidden:
                yield from below(f"{name} {member}", inner)

    return below(root, get_command(app))


def _section(name: str, command: Any) -> list[str]:
    lines = ["#" * len(name.split()) + f" {name}", ""]
    lines += [_text(command.help or ""), ""]
    if getattr(command, "commands", None):
        return lines
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    options = [p for p in command.params if p.param_type_name == "option" and not p.hidden]
    places = " ".join(_place(argument) for argument in arguments)
    lines += ["```text", " ".join(part for part in (name, places, "[OPTIONS]") if part), "```", ""]
    if arguments or options:
        lines += ["| | | default |", "| --- | --- | --- |"]
    for argument in arguments:
        lines.append(_row(f"`{_name(argument)}`", argument.help, "required"))
    for option in options:
        names = ", ".join(f"`{spelled}`" for spelled in option.opts + option.secondary_opts)
        value = _value(option)
        default = "required" if option.required else _default(option)
        lines.append(_row(f"{names} {value}".strip(), option.help, default))
    return [*lines, ""]


def _name(argument: Any) -> str:
    return str(argument.metavar or argument.name.upper()).strip("{}[]")


def _place(argument: Any) -> str:
    name = _name(argument).removesuffix("...")
    return name + ("..." if argument.nargs == -1 else "")


def _value(option: Any) -> str:
    """Return the name of an option's value, or the possible values."""
    kind = _type(option)
    if option.is_flag or kind is bool:
        return ""
    if option.metavar:
        return f"`{option.metavar}`"
    if isinstance(kind, type) and issubclass(kind, enum.Enum):
        return ", ".join(f"`{choice.value}`" for choice in kind)
    return f"`{_NAMES.get(kind, 'TEXT')}`"


#: Values by their type.
_NAMES = {int: "INTEGER", float: "NUMBER", Path: "PATH"}


def _type(option: Any) -> Any:
    """The Python type of one value; typer before 0.27 has click's types instead."""
    described = getattr(option, "type_descriptor", None)
    if described is not None:
        return (get_args(described.annotation) or (described.annotation,))[0]
    choices = getattr(option.type, "choices", None)
    if choices:
        return enum.Enum("Choices", {str(choice): str(choice) for choice in choices})
    types = {"integer": int, "float": float, "path": Path, "boolean": bool}
    return types.get(option.type.name, str)


def _default(option: Any) -> str:
    default = getattr(option.default, "value", option.default)
    # Flags have False or True; other types mark "none given".
    return f"`{default}`" if type(default) in (int, float, str) else ""


def _row(*cells: str | None) -> str:
    return "| " + " | ".join(_text(cell or "").replace("|", "\\|") for cell in cells) + " |"


def _text(text: str) -> str:
    """Help as Markdown: typer's line breaks kept between paragraphs only, options as code."""
    paragraphs = [" ".join(part.split()) for part in re.split(r"\n\s*\n", text.strip())]
    return "\n\n".join(
        re.sub(r"(?<![\w`-])(--[a-z][\w-]*)", r"`\1`", part).replace("<", "&lt;")
        for part in paragraphs
    )
