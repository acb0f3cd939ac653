"""Error messages of the commands: one line on stderr, with a traceback only where asked for."""

from __future__ import annotations

import contextlib
import math
import os
import re
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import typer

from igsr.errors import IgsrError, printable

#: Exit status after Ctrl-C and SIGTERM: 128 plus the signal, as shells report it.
INTERRUPTED = 130
TERMINATED = 143

#: Seconds after a signal in which further ones are ignored. ``timeout`` and ``uv run`` send two.
REPEATS_S = 2.0
_raised_at = -math.inf

#: Environment variable that asks for the traceback behind an error message. ``igsr --debug`` sets
#: it, so that worker processes see it too.
DEBUG_VARIABLE = "IGSR_DEBUG"


class Terminated(KeyboardInterrupt):
    """SIGTERM, which ends a command as Ctrl-C does."""


def nothing_written(target: Path) -> Callable[[], str]:
    """The message after an interruption: that ``target`` is not written, or that it is."""

    def state() -> tuple[int, int] | None:
        with contextlib.suppress(OSError):
            found = target.stat()
            return found.st_ino, found.st_mtime_ns
        return None

    before = state()
    return lambda: f"Interrupted; {'nothing' if state() == before else target} is written."


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
        with _signals_raise(), warnings.catch_warnings():
            # Pillow warns of damaged EXIF and the like even if the pixels can be read.
            warnings.filterwarnings("ignore", module="PIL")
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
def _signals_raise() -> Iterator[None]:
    """Raise ``KeyboardInterrupt`` or ``Terminated`` when the process gets a signal to end."""
    if threading.current_thread() is not threading.main_thread():
        yield  # Python handles signals in the main thread only
        return
    defaults = (signal.SIG_DFL, signal.default_int_handler)
    signals = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.getsignal(number) for number in signals}
    replaced = {number: handler for number, handler in before.items() if handler in defaults}
    for number in replaced:
        signal.signal(number, _raise)
    started_at = time.monotonic()
    try:
        yield
    finally:
        if _raised_at < started_at:  # else the process is about to end
            for number, handler in replaced.items():
                signal.signal(number, handler)


def _raise(number: int, frame: FrameType | None) -> None:
    global _raised_at
    now = time.monotonic()
    if now - _raised_at > REPEATS_S:
        _raised_at = now
        raise Terminated if number == signal.SIGTERM else KeyboardInterrupt


def print_message(message: str) -> None:
    """Print an error, a warning or a note as one line on stderr, with a full stop at its end."""
    message = printable(" ".join(re.split(r"[ \t\r\n]+", message.strip())))
    print(message if message.endswith((".", "!", "?")) else message + ".", file=sys.stderr)


def _report(message: str) -> None:
    """Print the message of the exception that is being handled, and its traceback if asked for."""
    if debugging():
        traceback.print_exc()
    print_message(message)
