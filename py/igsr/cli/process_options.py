"""Options of the process, before any command: ``--debug``, ``--verbose`` and ``--threads``.

They are set before the command's module is imported, because thread pools read their size once.
"""

from __future__ import annotations

import os
import sys

from igsr.cli.error_messages import DEBUG_VARIABLE

#: Environment variables that set how many threads the renderer, torch and numpy start.
THREAD_VARIABLES = (
    "RAYON_NUM_THREADS",
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
)
#: More threads than any machine has cores are a slip of the finger.
MOST_THREADS = 1024


def show_tracebacks() -> None:
    """Show the traceback behind each error message, here and in worker processes."""
    os.environ[DEBUG_VARIABLE] = "1"


def use_threads(count: int) -> None:
    """Let everything that starts threads start ``count`` of them, here and in worker processes."""
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(count)))
    if "torch" in sys.modules:  # it has read its variable already
        import torch

        torch.set_num_threads(count)


def log_to_stderr(verbosity: int) -> None:
    """Print igsr's log on stderr: 1 for what happens, 2 for details too."""
    import logging

    logger = logging.getLogger("igsr")
    logger.setLevel(logging.INFO if verbosity == 1 else logging.DEBUG)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s", "%H:%M:%S"))
    logger.handlers[:] = [handler]
