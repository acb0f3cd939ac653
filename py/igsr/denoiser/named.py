"""Denoisers by name: ``module:factory`` or ``file.py:factory``."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from typing import Any

from igsr.denoiser.cleaning import Denoiser
from igsr.errors import IgsrError


def named_denoiser(name: str) -> Denoiser:
    """Import a module and call its factory of a denoiser.

    The module's code runs; name only modules that you trust.

    Args:
        name: ``MODULE:FACTORY`` of an installed module or a ``.py`` file. The factory takes no
            arguments and returns a ``Denoiser``.

    Raises:
        IgsrError: the module or factory is missing or fails, or returns something else.
    """
    module_name, separator, factory_name = name.rpartition(":")
    if not separator or not module_name or not factory_name:
        raise IgsrError(f"denoiser must be MODULE:FACTORY, such as my_denoiser:make, not {name!r}")
    try:
        module = _module(module_name)
    except IgsrError:
        raise
    except Exception as error:
        raise IgsrError(f"denoiser: {module_name} cannot be imported: {_shown(error)}") from error
    factory = getattr(module, factory_name, None)
    if not callable(factory):
        raise IgsrError(f"denoiser: {module_name} has no function {factory_name}")
    try:
        denoiser = factory()
    except Exception as error:
        raise IgsrError(f"denoiser: {name} failed: {_shown(error)}") from error
    if not callable(denoiser):
        raise IgsrError(
            f"denoiser: {name} must return a function of a render and photos, "
            f"not {type(denoiser).__name__}"
        )
    return denoiser


def _module(name: str) -> Any:
    if not name.endswith(".py"):
        return importlib.import_module(name)
    path = Path(name)
    if not path.is_file():
        raise IgsrError(f"denoiser: there is no file {path}")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look up their module there.
    sys.modules.setdefault(path.stem, module)
    spec.loader.exec_module(module)
    return module


def _shown(error: Exception) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
