"""Seconds, processor seconds and peak memory of parts."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

from igsr._internal import peak_memory
from igsr._internal.part_usage import Meter, Parts, Usage, total

MIB = 2**20


@pytest.mark.skipif(
    not os.access(peak_memory.CLEAR_REFS, os.W_OK), reason="only Linux forgets a peak"
)
def test_each_part_has_a_peak_of_its_own():
    # A process of its own: what other tests left in memory may be freed in between.
    code = """
import numpy as np
from igsr._internal.part_usage import Parts, total
parts = Parts()
with parts.measured("large"):
    block = np.ones(64 * 2**20, np.uint8)
    del block
with parts.measured("small"):
    pass
print(*(parts.used[name].peak_memory_bytes for name in ("large", "small")))
print(total(parts.plain()).peak_memory_bytes)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    large, small, whole = (int(number) for number in done.stdout.split())
    assert large - small > 50 * MIB
    assert whole == large


def test_sleep_takes_seconds_and_work_takes_processor_seconds():
    meter = Meter()
    time.sleep(0.2)
    slept = meter.lap()
    began = time.process_time()
    while time.process_time() - began < 0.2:
        pass
    worked = meter.lap()
    assert slept.seconds >= 0.2
    assert slept.cpu_seconds < 0.1
    assert worked.cpu_seconds >= 0.15


def test_a_part_that_is_named_again_is_added_up():
    parts = Parts()
    parts.add("fit", Usage(1.0, 2.0, 100))
    parts.add("score", Usage(0.5, 0.5, 300))
    parts.add("fit", Usage(3.0, 1.0, 50))
    assert parts.used["fit"] == Usage(4.0, 3.0, 100)
    assert total(parts.plain()) == Usage(4.5, 3.5, 300)
    assert list(parts.plain()) == ["fit", "score"]


def test_it_is_counted_where_a_part_fails():
    parts = Parts()
    with pytest.raises(ValueError, match="no"), parts.measured("fit"):
        raise ValueError("no")
    assert parts.used["fit"].seconds >= 0.0


def test_a_system_that_does_not_say_has_none(monkeypatch, tmp_path):
    monkeypatch.setattr(peak_memory, "STATUS", tmp_path / "none")
    monkeypatch.setattr(peak_memory, "CLEAR_REFS", tmp_path / "none" / "none")
    assert not peak_memory.forget_peak()
    assert peak_memory.peak_bytes() > MIB  # by getrusage
    assert Usage(1.0, 1.0, None) + Usage(1.0, 1.0, None) == Usage(2.0, 2.0, None)


@pytest.mark.parametrize(
    "found",
    [
        {},
        [],
        {"seconds": 1, "cpu_seconds": -1, "peak_memory_bytes": 1},
        {"seconds": float("nan"), "cpu_seconds": 1, "peak_memory_bytes": 1},
        {"seconds": 1, "cpu_seconds": 1, "peak_memory_bytes": float("inf")},
        {"seconds": 1, "cpu_seconds": "a", "peak_memory_bytes": 1},
    ],
)
def test_what_is_no_usage_is_refused(found):
    with pytest.raises((KeyError, TypeError, ValueError, OverflowError)):
        Usage.of(found)


def test_a_usage_is_read_as_it_was_written():
    usage = Usage(1.25, 2.5, 7)
    assert Usage.of(usage.plain()) == usage
