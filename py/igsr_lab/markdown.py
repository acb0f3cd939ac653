"""Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def markdown_table(heads: Sequence[str], rows: Iterable[Sequence[object]], left: int) -> list[str]:
    """Return the lines of a table; the first ``left`` columns are left-aligned."""
    rule = [*["---"] * left, *["---:"] * (len(heads) - left)]
    return [f"| {' | '.join(map(str, cells))} |" for cells in (heads, rule, *rows)]


def cell(value: float | None, form: str) -> str:
    """Format a number; None is "-"."""
    return "-" if value is None else format(value, form)
