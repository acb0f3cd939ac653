"""Import pycolmap without its handler of SIGTERM."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


def load_pycolmap() -> Any:
    """Import pycolmap, and keep the process's handlers of Ctrl-C and SIGTERM.

    The logging library in pycolmap handles SIGTERM by printing a native stack trace.
    """
    if "pycolmap" in sys.modules:
        return sys.modules["pycolmap"]
    with _delayed_signals():
        import pycolmap

    return pycolmap


@contextlib.contextmanager
def _delayed_signals() -> Iterator[None]:
    """Restore the handlers of signals at the end, and send those again that arrived until then.

    pycolmap reports an exception during its import, such as KeyboardInterrupt, as a broken package.
    """
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    # Python sets handlers in the main thread only; None is a handler that Python did not set.
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not in_main_thread or None in handlers.values():
        yield
        return
    arrived: list[int] = []
    for number in SIGNALS:
        signal.signal(number, lambda number, frame: arrived.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for late in arrived:
            signal.raise_signal(late)
