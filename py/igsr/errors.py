"""The exception that igsr raises for input that it cannot use."""

from __future__ import annotations


class IgsrError(ValueError):
    """An argument, option or file that cannot be used.

    The message names the argument, field or file and says how to mend it. The command line prints
    it and exits with a non-zero status. It is one printable line: line breaks, terminal codes and
    the like in quoted names are escaped.

    Args:
        message: the error message.
    """

    def __init__(self, message: str) -> None:
        """Escape what cannot be printed."""
        super().__init__(
            "".join(
                letter if letter.isprintable() else letter.encode("unicode_escape").decode()
                for letter in message
            )
        )
