"""Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def markdown_table(heads: Sequence[str], rows: Iterable[Sequence[object]], left: int) -> list[str]:
    """The lines of a table; its first ``left`` columns are aligned left, the others right."""
    rule = [*["---"] * left, *["---:"] * (len(heads) - left)]
    return [f"| {' | '.join(map(str, cells))} |" for cells in (heads, rule, *rows)]


def cell(value: float | None, form: str) -> str:
    """A number in a format; "-" where there is none."""
    return "-" if value is None else format(value, form)
