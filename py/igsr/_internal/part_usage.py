"""Time and peak memory of the parts of a run."""

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
    """Time and memory of a part.

    Attributes:
        seconds: elapsed time.
        cpu_seconds: CPU time of this process and of its children that have ended.
        peak_memory_bytes: peak memory of the process during the part, memory of earlier parts
            included; on systems that cannot reset the peak, since the process began. None if the
            system does not measure it.
    """

    seconds: float
    cpu_seconds: float
    peak_memory_bytes: int | None

    def __add__(self, other: Usage) -> Usage:
        """The usage of both parts in sequence."""
        peaks = [p for p in (self.peak_memory_bytes, other.peak_memory_bytes) if p is not None]
        return Usage(
            self.seconds + other.seconds,
            self.cpu_seconds + other.cpu_seconds,
            max(peaks, default=None),
        )

    def plain(self) -> dict[str, Any]:
        """The usage for JSON."""
        return {
            **asdict(self),
            "seconds": round(self.seconds, 3),
            "cpu_seconds": round(self.cpu_seconds, 3),
        }

    @staticmethod
    def of(found: Mapping[str, Any]) -> Usage:
        """Read the result of ``plain``.

        Raises:
            KeyError, TypeError, ValueError, OverflowError: it is damaged.
        """
        numbers = float(found["seconds"]), float(found["cpu_seconds"])
        peak = None if found["peak_memory_bytes"] is None else int(found["peak_memory_bytes"])
        if not all(0.0 <= number < math.inf for number in (*numbers, peak or 0)):
            raise ValueError("a number is negative or not finite")
        return Usage(*numbers, peak)


class Meter:
    """Measures the usage between two moments."""

    def __init__(self) -> None:
        self._start()

    def lap(self) -> Usage:
        """The usage since the last call or the creation."""
        now, cpu, peak = time.monotonic(), _cpu_seconds(), peak_bytes()
        usage = Usage(now - self._started, cpu - self._cpu, peak)
        self._start()
        return usage

    def _start(self) -> None:
        forget_peak()
        self._started, self._cpu = time.monotonic(), _cpu_seconds()


class Parts:
    """The usage of parts, by name, in the order in which they began."""

    def __init__(self) -> None:
        self.used: dict[str, Usage] = {}

    @contextlib.contextmanager
    def measured(self, name: str) -> Iterator[None]:
        """Measure a part; parts of the same name are added up."""
        meter = Meter()
        try:
            yield
        finally:
            self.add(name, meter.lap())

    def add(self, name: str, usage: Usage) -> None:
        """Add usage to a part."""
        before = self.used.get(name)
        self.used[name] = usage if before is None else before + usage

    def plain(self) -> dict[str, dict[str, Any]]:
        """The usage of each part, for JSON."""
        return {name: usage.plain() for name, usage in self.used.items()}


def total(parts: Mapping[str, Mapping[str, Any]]) -> Usage:
    """The sum of all parts of a report, as ``Parts.plain`` gives them."""
    return sum(map(Usage.of, parts.values()), Usage(0.0, 0.0, None))


def _cpu_seconds() -> float:
    return sum(os.times()[:4])
