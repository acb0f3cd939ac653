"""Error messages of the commands: one line on stderr, with a traceback only where asked for."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator
from types import FrameType

import typer

from igsr.errors import IgsrError

#: Exit status after Ctrl-C and SIGTERM: 128 plus the signal, as shells report it.
INTERRUPTED = 130
TERMINATED = 143

#: Environment variable that asks for the traceback behind an error message. ``igsr --debug`` sets
#: it, so that worker processes see it too.
DEBUG_VARIABLE = "IGSR_DEBUG"


class Terminated(KeyboardInterrupt):
    """SIGTERM, which ends a command as Ctrl-C does."""


def debugging() -> bool:
    """Whether ``igsr --debug`` or ``IGSR_DEBUG=1`` asks for tracebacks; ``IGSR_DEBUG=0`` is no."""
    return os.environ.get(DEBUG_VARIABLE, "") not in ("", "0")


@contextlib.contextmanager
def error_messages(interrupted: Callable[[], str] = lambda: "Interrupted.") -> Iterator[None]:
    """Turn errors that a user can fix into one message on stderr and a non-zero exit status.

    Warnings become messages, too.

    Other exceptions are bugs and pass through with their traceback.

    Args:
        interrupted: makes the message after Ctrl-C or SIGTERM.

    Raises:
        typer.Exit: with status 1, ``INTERRUPTED`` or ``TERMINATED``.
    """
    try:
        with _sigterm_raises(), warnings.catch_warnings():
            warnings.showwarning = lambda message, *rest: print_message(str(message))
            yield
    except typer.Exit:  # a RuntimeError
        raise
    except KeyboardInterrupt as error:
        _report(interrupted())
        code = TERMINATED if isinstance(error, Terminated) else INTERRUPTED
        raise typer.Exit(code) from None
    except (IgsrError, RuntimeError) as error:  # the renderer's RuntimeErrors are the GPU's
        _report(str(error))
        raise typer.Exit(1) from None
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _report(f"{where}{error.strerror or error}")
        raise typer.Exit(1) from None
    except MemoryError:
        _report("There is not enough memory for this; use fewer or smaller photos or splats")
        raise typer.Exit(1) from None


@contextlib.contextmanager
def _sigterm_raises() -> Iterator[None]:
    """Raise ``Terminated`` when the process gets SIGTERM."""
    if threading.current_thread() is not threading.main_thread():
        yield  # Python handles signals in the main thread only
        return

    def terminate(number: int, frame: FrameType | None) -> None:
        raise Terminated

    before = signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL if before is None else before)


def print_message(message: str) -> None:
    """Print an error, a warning or a note as one line on stderr, with a full stop at its end."""
    message = " ".join(message.split())
    print(message if message.endswith((".", "!", "?")) else message + ".", file=sys.stderr)


def _report(message: str) -> None:
    """Print the message of the exception that is being handled, and its traceback if asked for."""
    if debugging():
        traceback.print_exc()
    print_message(message)
