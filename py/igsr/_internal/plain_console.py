"""A console that prints text as it is."""

from __future__ import annotations

from typing import IO, Any

from rich.console import Console
from rich.text import Text

from igsr.errors import printable


class PlainConsole(Console):
    """A console that ignores markup in names, and escapes terminal codes."""

    def __init__(self, file: IO[str], **options: Any) -> None:
        """Print to ``file``; ``options`` are rich's."""
        super().__init__(file=file, highlight=False, markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Make text of every printed string, in tables, too."""
        return super().render_str(printable(text), **options)
