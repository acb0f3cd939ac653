"""Import pycolmap without its handler of SIGTERM."""

from __future__ import annotations

import signal
import sys
import threading
from typing import Any


def load_pycolmap() -> Any:
    """Import pycolmap, and keep the process's handler of SIGTERM.

    The logging library in pycolmap replaces it by one that prints a native stack trace.
    """
    is_first = "pycolmap" not in sys.modules
    handler = signal.getsignal(signal.SIGTERM)
    import pycolmap

    # Python sets handlers in the main thread only; None is a handler that Python did not set.
    in_main_thread = threading.current_thread() is threading.main_thread()
    if is_first and in_main_thread and handler is not None:
        signal.signal(signal.SIGTERM, handler)
    return pycolmap
