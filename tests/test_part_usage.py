"""Seconds and memory of the parts of a run."""

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
    not os.access(peak_memory.CLEAR_REFS, os.W_OK), reason="only Linux resets the peak"
)
def test_each_part_has_a_peak_of_its_own():
    # In a new process, since other tests may free memory in between.
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


def test_work_takes_processor_seconds_and_sleep_does_not():
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


def test_parts_of_one_name_are_added_up():
    parts = Parts()
    parts.add("fit", Usage(1.0, 2.0, 100))
    parts.add("score", Usage(0.5, 0.5, 300))
    parts.add("fit", Usage(3.0, 1.0, 50))
    assert parts.used["fit"] == Usage(4.0, 3.0, 100)
    assert total(parts.plain()) == Usage(4.5, 3.5, 300)
    assert list(parts.plain()) == ["fit", "score"]


def test_a_part_that_fails_is_measured():
    parts = Parts()
    with pytest.raises(ValueError, match="no"), parts.measured("fit"):
        raise ValueError("no")
    assert parts.used["fit"].seconds >= 0.0


def test_systems_without_a_peak_per_part(monkeypatch, tmp_path):
    monkeypatch.setattr(peak_memory, "STATUS", tmp_path / "none")
    monkeypatch.setattr(peak_memory, "CLEAR_REFS", tmp_path / "none" / "none")
    assert not peak_memory.forget_peak()
    assert peak_memory.peak_bytes() > MIB  # by getrusage
    assert Usage(1.0, 1.0, None) + Usage(1.0, 1.0, None) == Usage(2.0, 2.0, None)


def test_usages_are_read_as_they_were_written():
    usage = Usage(1.25, 2.5, 7)
    assert Usage.of(usage.plain()) == usage


@pytest.mark.parametrize(
    "damaged",
    [
        {},
        [],
        {"seconds": 1, "cpu_seconds": -1, "peak_memory_bytes": 1},
        {"seconds": float("nan"), "cpu_seconds": 1, "peak_memory_bytes": 1},
        {"seconds": 1, "cpu_seconds": 1, "peak_memory_bytes": float("inf")},
        {"seconds": 1, "cpu_seconds": "a", "peak_memory_bytes": 1},
    ],
)
def test_damaged_usages_are_refused(damaged):
    with pytest.raises((KeyError, TypeError, ValueError, OverflowError)):
        Usage.of(damaged)
