"""Which extra of igsr brings a package that is not installed."""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Iterator

from igsr.errors import MissingExtraError

#: The extra of ``pip install 'igsr[EXTRA]'`` that brings a package, by the package's import name.
EXTRA_OF = {"torch": "refine", "torchmetrics": "refine", "torchvision": "lpips"}


def is_installed(package: str) -> bool:
    """Whether a top-level package can be imported; it is not."""
    try:
        return importlib.util.find_spec(package) is not None
    except ModuleNotFoundError:  # whatever finds modules here says so itself
        return False


@contextlib.contextmanager
def naming_extra(user: str) -> Iterator[None]:
    """Name the extra where an import within fails since that extra is not installed.

    Args:
        user: what needs the package, such as "Splats.to_torch".

    Raises:
        MissingExtraError: a package of an extra is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRA_OF:
            raise
        raise MissingExtraError(user, package, EXTRA_OF[package]) from error
