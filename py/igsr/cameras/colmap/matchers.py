"""Which matchers a run uses: SIFT, ALIKED, both, or the user's own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from igsr.cameras.colmap import aliked
from igsr.cameras.colmap.matcher import Matcher
from igsr.errors import IgsrError

#: Both if the extra ``matching`` is installed, else SIFT.
AUTO = "auto"
MATCHERS = (AUTO, "sift", "aliked")

ADVICE = (
    "pip install 'igsr[matching]' adds a trained matcher, which places photos from further apart."
)
#: A name of ``MATCHERS``, or the user's own.
Choice: TypeAlias = "str | Matcher"


@dataclass(frozen=True)
class Matchers:
    """Matchers whose matches are verified together.

    Attributes:
        name: for reports, and to recognize cameras found with them.
        sift: whether SIFT is one of them.
        learned: makes the learned matcher, or None.
        advice: how to place more photos, or "".
    """

    name: str
    sift: bool
    learned: Callable[[], Matcher] | None
    advice: str = ""

    @property
    def aliked(self) -> bool:
        """Whether ALIKED is one of them."""
        return self.learned is aliked.Aliked


def chosen_matchers(choice: Choice) -> Matchers:
    """Return the matchers of a choice; nothing is loaded.

    Raises:
        IgsrError: the name is unknown, or a custom matcher has no name.
    """
    if choice == AUTO and aliked.is_available():
        return Matchers("sift+aliked", True, aliked.Aliked)
    if choice == AUTO:
        return Matchers("sift", True, None, ADVICE)
    if choice == "sift":
        return Matchers("sift", True, None)
    if choice == "aliked":
        return Matchers("aliked", False, aliked.Aliked)
    name = getattr(choice, "name", None)
    if isinstance(choice, str) or not isinstance(name, str):
        raise IgsrError(
            f"matcher must be {', '.join(MATCHERS)} or an object with features, matches and a "
            f"name, by which found cameras are kept, not {choice!r}"
        )
    own = choice
    return Matchers(name, False, lambda: own)
