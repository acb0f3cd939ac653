"""Another build of the renderer in place of the package's own, for this process."""

from __future__ import annotations

import importlib
import importlib.util
import sys


def use_build(file: str) -> None:
    """Make ``file`` this process's ``igsr._core``.

    Raises:
        ImportError: the file is not a build of the renderer for this Python.
        RuntimeError: a build is in use already; modules that hold it would go on with it.
    """
    if "igsr._core" in sys.modules:
        raise RuntimeError("A build of the renderer is in use already.")
    spec = importlib.util.spec_from_file_location("igsr._core", file)
    if spec is None or spec.loader is None:
        raise ImportError(f"{file} is not a compiled Python module.")
    module = importlib.util.module_from_spec(spec)
    sys.modules["igsr._core"] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules["igsr._core"]
        raise
    importlib.import_module("igsr").__dict__["_core"] = module
