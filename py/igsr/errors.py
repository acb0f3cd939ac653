"""The one exception that igsr raises for a user's mistake."""

from __future__ import annotations


class IgsrError(ValueError):
    """Something the user gave cannot be used.

    The message is one sentence that names the file, field or argument and says how to mend it; the
    command line prints exactly that sentence and exits with a non-zero status. It is one printable
    line whatever the names quoted in it hold: line breaks, terminal codes and the like are escaped.

    Args:
        message: the sentence.
    """

    def __init__(self, message: str) -> None:
        """Escape what cannot be printed."""
        super().__init__(
            "".join(
                letter if letter.isprintable() else letter.encode("unicode_escape").decode()
                for letter in message
            )
        )
