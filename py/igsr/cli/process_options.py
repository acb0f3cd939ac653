"""Global options: ``--debug``, ``--verbose`` and ``--threads``.

They are applied before the command's module is imported, because thread pools read their size once.
"""

from __future__ import annotations

import os
import sys

from igsr.cli.error_messages import DEBUG_VARIABLE
from igsr.errors import printable

#: Environment variables for the number of threads of the renderer, torch and numpy.
THREAD_VARIABLES = (
    "RAYON_NUM_THREADS",
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
)
MAX_THREADS = 1024


def show_tracebacks() -> None:
    """Show tracebacks with error messages, also in worker processes."""
    os.environ[DEBUG_VARIABLE] = "1"


def use_threads(count: int) -> None:
    """Set the number of threads, also in worker processes."""
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(count)))
    if "torch" in sys.modules:  # it reads the variable once
        import torch

        torch.set_num_threads(count)


def log_to_stderr(verbosity: int) -> None:
    """Print igsr's log to stderr: level INFO for 1, DEBUG for 2."""
    import logging

    def escape(record: logging.LogRecord) -> bool:
        record.msg, record.args = printable(record.getMessage()), None
        return True

    logger = logging.getLogger("igsr")
    logger.setLevel(logging.INFO if verbosity == 1 else logging.DEBUG)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s", "%H:%M:%S"))
    handler.addFilter(escape)
    logger.handlers[:] = [handler]
