"""The viewer ``splat-view`` as a program: a scene in a window, or pictures without one."""

from __future__ import annotations

import signal
import sys

from igsr import _core


def main() -> None:
    """Do what the command line asks for; ``splat-view --help`` lists what it takes."""
    # Python's own handler would wait for the window to be closed.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.stdout.flush()
    sys.exit(_core.run_viewer(sys.argv[1:]))


if __name__ == "__main__":
    main()
