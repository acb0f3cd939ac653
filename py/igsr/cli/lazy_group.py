"""A group of commands whose modules are imported only when a command runs."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, MutableMapping
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from igsr._internal.extras import naming_extra
from igsr.cli.error_messages import error_messages
from igsr.errors import IgsrError


class LazyCommand(NamedTuple):
    """Where a command is defined, and its line in the group's help.

    Attributes:
        module: the module that holds it.
        name: the command's function, or a ``typer.Typer`` with commands of its own.
        help: one line.
        context_settings: of the command, as ``typer.Typer.command`` takes them.
    """

    module: str
    name: str
    help: str
    context_settings: dict[str, Any] | None = None


class LazyGroup(TyperGroup):
    """A group that lists its commands from a table and imports the one that runs.

    A subclass sets ``table``. The group's help shows stand-ins made from the table; the command
    itself is imported when it is invoked, asked for its help, or completed by a shell.
    """

    table: ClassVar[Mapping[str, LazyCommand]] = {}

    def __init__(self, **attrs: Any) -> None:
        """Make the stand-ins."""
        super().__init__(**attrs)
        stand_ins: MutableMapping[str, Any] = {
            name: TyperCommand(name, help=entry.help) for name, entry in self.table.items()
        }
        self.commands = stand_ins

    def loaded(self) -> dict[str, Any]:
        """Import all commands; by name, in the order of the table."""
        return {name: load_command(name, entry) for name, entry in self.table.items()}

    def make_context(self, *given: Any, **extra: Any) -> Any:
        """Parse the options, print the help or the version; see ``TyperGroup``."""
        with error_messages():
            return super().make_context(*given, **extra)

    def invoke(self, ctx: Any) -> Any:
        """Run the command that was asked for; see ``TyperGroup`` and ``naming_extra``."""
        with error_messages():
            try:
                return super().invoke(ctx)
            except (ImportError, OSError):
                with naming_extra(f"igsr {ctx.invoked_subcommand}"):
                    raise

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command that ``args`` names and import it; see ``TyperGroup``.

        Raises:
            IgsrError: one of ``args`` is empty. As a path it would mean the current folder.
        """
        for before, word in pairwise(args):
            option, equals, value = word.partition("=")
            if not word or (option.startswith("-") and equals and not value):
                # The option before may have no value.
                after = f" after {before}" if before.startswith("-") else ""
                named = option or f"An argument{after}"
                raise IgsrError(f"{named} is empty; give a value, or leave it out")
        name, command, rest = super().resolve_command(ctx, args)
        if name is not None:
            command = load_command(name, self.table[name])
        return name, command, rest


def load_command(name: str, entry: LazyCommand) -> Any:
    """Import a command's module and make the command under its name in the group."""
    found = getattr(importlib.import_module(entry.module), entry.name)
    app = typer.Typer(add_completion=False)
    if isinstance(found, typer.Typer):
        app.add_typer(found, name=name)
        group: Any = typer.main.get_command(app)
        return group.commands[name]
    app.command(name, context_settings=entry.context_settings)(found)
    return typer.main.get_command(app)
