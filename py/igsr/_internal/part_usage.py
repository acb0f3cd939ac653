"""What each part of a run takes: seconds, processor seconds, peak memory."""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from igsr._internal.peak_memory import forget_peak, peak_bytes


@dataclass(frozen=True)
class Usage:
    """What a part took.

    Attributes:
        seconds: on the clock.
        cpu_seconds: of all cores together, in this process and its children that have ended.
        peak_memory_bytes: most that the process had in memory during the part, with what earlier
            parts left there. Where the system cannot count anew for each part, the most since the
            process began; None where it does not say.
    """

    seconds: float
    cpu_seconds: float
    peak_memory_bytes: int | None

    def __add__(self, other: Usage) -> Usage:
        """Both, one after the other."""
        peaks = [p for p in (self.peak_memory_bytes, other.peak_memory_bytes) if p is not None]
        return Usage(
            self.seconds + other.seconds,
            self.cpu_seconds + other.cpu_seconds,
            max(peaks) if peaks else None,
        )

    def plain(self) -> dict[str, Any]:
        """As reports have it."""
        return {
            **asdict(self),
            "seconds": round(self.seconds, 3),
            "cpu_seconds": round(self.cpu_seconds, 3),
        }

    @staticmethod
    def of(found: Mapping[str, Any]) -> Usage:
        """What ``plain`` gave, read again.

        Raises:
            KeyError, TypeError, ValueError, OverflowError: it is nothing such.
        """
        numbers = float(found["seconds"]), float(found["cpu_seconds"])
        peak = None if found["peak_memory_bytes"] is None else int(found["peak_memory_bytes"])
        if not all(0.0 <= number < math.inf for number in (*numbers, peak or 0)):
            raise ValueError("a number is negative or not finite")
        return Usage(*numbers, peak)


class Meter:
    """What is used from one moment to the next."""

    def __init__(self) -> None:
        """Begin now."""
        self._begin()

    def lap(self) -> Usage:
        """What was used since the last call, or since the beginning."""
        now, cpu, peak = time.monotonic(), cpu_seconds(), peak_bytes()
        usage = Usage(now - self._began, cpu - self._cpu, peak)
        self._begin()
        return usage

    def _begin(self) -> None:
        forget_peak()
        self._began, self._cpu = time.monotonic(), cpu_seconds()


class Parts:
    """The usage of parts, by name, in the order in which they were first begun."""

    def __init__(self) -> None:
        """No part yet."""
        self.used: dict[str, Usage] = {}

    @contextlib.contextmanager
    def measured(self, name: str) -> Iterator[None]:
        """Count what happens inside to a part; one that is named again is added up."""
        meter = Meter()
        try:
            yield
        finally:
            self.add(name, meter.lap())

    def add(self, name: str, usage: Usage) -> None:
        """Count a usage to a part."""
        before = self.used.get(name)
        self.used[name] = usage if before is None else before + usage

    def plain(self) -> dict[str, dict[str, Any]]:
        """As reports have it: the usage of each part by its name."""
        return {name: usage.plain() for name, usage in self.used.items()}


def total(parts: Mapping[str, Mapping[str, Any]]) -> Usage:
    """All parts of a report together.

    Args:
        parts: as ``Parts.plain`` gives them.
    """
    whole = Usage(0.0, 0.0, None)
    for part in parts.values():
        whole += Usage.of(part)
    return whole


def cpu_seconds() -> float:
    """Processor seconds of this process so far, with those of its children that have ended."""
    return sum(os.times()[:4])
