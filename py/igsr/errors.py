"""The one exception that igsr raises for a user's mistake."""

from __future__ import annotations


class IgsrError(ValueError):
    """Something the user gave cannot be used.

    The message is one sentence that names the file, field or argument and says how to mend it; the
    command line prints exactly that sentence and exits with a non-zero status.
    """
