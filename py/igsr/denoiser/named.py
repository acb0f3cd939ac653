"""Denoisers of others, by name: ``module:factory``, or ``file.py:factory``."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from typing import Any

from igsr.denoiser.cleaning import Denoiser
from igsr.errors import IgsrError


def named_denoiser(name: str) -> Denoiser:
    """The denoiser that a factory makes.

    The module is imported, so it runs: name only what you trust.

    Args:
        name: ``MODULE:FACTORY`` of a module that Python finds, or of a ``.py`` file. The factory is
            called without arguments and returns the denoiser (``Denoiser``).

    Raises:
        IgsrError: there is no such module or factory, or it fails, or makes nothing callable.
    """
    module_name, separator, factory_name = name.rpartition(":")
    if not separator or not module_name or not factory_name:
        raise IgsrError(f"denoiser must be MODULE:FACTORY, such as my_denoiser:make, not {name!r}")
    try:
        module = _module(module_name)
    except IgsrError:
        raise
    except Exception as error:
        raise IgsrError(f"denoiser: {module_name} cannot be imported: {_said(error)}") from error
    factory = getattr(module, factory_name, None)
    if not callable(factory):
        raise IgsrError(f"denoiser: {module_name} has no function {factory_name}")
    try:
        made = factory()
    except Exception as error:
        raise IgsrError(f"denoiser: {name} failed: {_said(error)}") from error
    if not callable(made):
        raise IgsrError(
            f"denoiser: {name} must return a function of a render and photos, "
            f"not {type(made).__name__}"
        )
    denoiser: Denoiser = made
    return denoiser


def _module(name: str) -> Any:
    if not name.endswith(".py"):
        return importlib.import_module(name)
    path = Path(name)
    if not path.is_file():
        raise IgsrError(f"denoiser: there is no file {path}")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise IgsrError(f"denoiser: {path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    # Classes of the module are looked up there, by dataclasses for one.
    sys.modules.setdefault(path.stem, module)
    spec.loader.exec_module(module)
    return module


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
