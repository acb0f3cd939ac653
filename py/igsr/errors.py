"""The exceptions that igsr raises for input that it cannot use."""

from __future__ import annotations

import unicodedata


def printable(text: str) -> str:
    """Escape line breaks, terminal codes and the like; spaces of any width stay."""
    return "".join(
        letter
        if letter.isprintable() or unicodedata.category(letter) == "Zs"
        else letter.encode("unicode_escape").decode()
        for letter in text
    )


class IgsrError(ValueError):
    """An argument, option or file that cannot be used.

    The message names the argument, field or file and says how to mend it. The command line prints
    it and exits with a non-zero status. It is one printable line: line breaks, terminal codes and
    the like in quoted names are escaped.

    Args:
        message: the error message.
    """

    def __init__(self, message: str) -> None:
        """Escape the message."""
        super().__init__(printable(message))


class MissingExtraError(IgsrError, ImportError):
    """A package is not installed that comes with one of igsr's extras.

    Attributes:
        extra: the name of the extra, as in ``pip install 'igsr[refine]'``.

    Args:
        user: what needs the package, such as "igsr refine".
        package: its import name.
        extra: the extra that brings it.
    """

    def __init__(self, user: str, package: str, extra: str) -> None:
        """Say what is missing, and how to install it."""
        super().__init__(f"{user} needs {package}: pip install 'igsr[{extra}]'.")
        self.extra = extra
