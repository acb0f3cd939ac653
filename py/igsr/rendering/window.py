"""The viewer ``splat-view`` as a program: a scene in a window, or pictures without one."""

from __future__ import annotations

import signal
import sys

from igsr import _core


def main() -> None:
    """Run the viewer with the command line's arguments; see ``splat-view --help``."""
    # Python's own handler would run only after the window is closed.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.stdout.flush()
    sys.exit(_core.run_viewer(sys.argv[1:]))


if __name__ == "__main__":
    main()
