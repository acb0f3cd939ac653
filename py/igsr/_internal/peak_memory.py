"""The peak memory of this process, and its reset."""

from __future__ import annotations

import sys
from pathlib import Path

#: Linux forgets a process's peak memory when 5 is written here.
CLEAR_REFS = Path("/proc/self/clear_refs")
STATUS = Path("/proc/self/status")


def peak_bytes() -> int | None:
    """Largest resident size of this process since ``forget_peak``; None if unknown."""
    try:
        status = STATUS.read_text(encoding="ascii").splitlines()
        return 1024 * next(int(line.split()[1]) for line in status if line.startswith("VmHWM:"))
    except (OSError, ValueError, StopIteration):
        pass
    try:
        import resource
    except ImportError:  # Windows
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most


def forget_peak() -> bool:
    """Reset the peak to the current resident size; return False if the system cannot."""
    try:
        CLEAR_REFS.write_text("5")
    except OSError:
        return False
    return True
