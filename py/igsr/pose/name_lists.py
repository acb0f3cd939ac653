"""Names of photos in messages."""

from __future__ import annotations

from collections.abc import Sequence

#: Names shown of a long list.
NAMED = 5


def listed(names: Sequence[str]) -> str:
    """The names with commas, of a long list the first ones and how many more there are."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more
