"""Photos that do not fit into memory."""

from __future__ import annotations

import re
import resource
from pathlib import Path

import pytest
from capture_files import photo, save, write_transforms

from igsr.capture import load_capture, memory_check
from igsr.capture.memory_check import (
    USABLE,
    available_memory,
    check_memory,
    decoding_threads,
    largest_size_that_fits,
    needed_memory,
)
from igsr.capture.photo_folder import load_photos
from igsr.errors import IgsrError

TWELVE = [(4000, 3000)] * 100


@pytest.fixture
def two_gigabytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_check, "available_memory", lambda: 2_000_000_000)


@pytest.mark.usefixtures("two_gigabytes")
def test_the_message_names_a_size_that_fits() -> None:
    with pytest.raises(IgsrError) as error:
        check_memory(TWELVE, splats=30_000)
    found = re.fullmatch(
        r"The 100 photos of 4000x3000 would need (\d+\.\d) GB and 2\.0 GB are free: "
        r"give --max-size (\d+) \((\d\.\d) GB\)\.",
        str(error.value),
    )
    assert found is not None, str(error.value)
    size = int(found[2])
    assert 500 < size < 2000
    check_memory(TWELVE, size, 30_000)
    assert needed_memory(TWELVE, size + 50, 30_000) > USABLE * 2e9, "the largest of its steps"
    with pytest.raises(IgsrError, match=r"of 4000x3000 at --max-size 3000 would need"):
        check_memory(TWELVE, 3000, 30_000)
    with pytest.raises(IgsrError, match="of up to 4000x3000 would"):
        check_memory([*TWELVE, (10, 10)], splats=30_000)
    with pytest.raises(IgsrError, match="give fewer photos, or free memory; no --max-size would"):
        check_memory(TWELVE, splats=10_000_000)


def test_more_needs_more() -> None:
    base = needed_memory(TWELVE, 1000, 30_000)
    assert needed_memory(TWELVE, 1000) < base < needed_memory(TWELVE, 1100, 30_000)
    assert base < needed_memory(TWELVE, 1000, 30_000, channels=4)
    assert base < needed_memory(TWELVE, 1000, 30_000, masked=True)
    assert needed_memory(TWELVE, 1000, 300_000) < needed_memory(TWELVE, 1000, 400_000)
    assert needed_memory(TWELVE, 4000) == needed_memory(TWELVE) == needed_memory(TWELVE, 9999)
    assert largest_size_that_fits(TWELVE, available=10**12) == 4000
    assert largest_size_that_fits(TWELVE, available=10**6) is None


def test_photos_are_refused_before_any_is_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def decode(*arguments: object) -> None:
        raise AssertionError("a photo is decoded")

    write_transforms(tmp_path / "capture")
    for index in range(3):
        save(tmp_path / "photos" / f"{index}.png", photo(index, 400, 300))
    monkeypatch.setattr(memory_check, "available_memory", lambda: 9000)
    monkeypatch.setattr("igsr.capture.photos.load_pixels", decode)
    with pytest.raises(IgsrError, match="3 photos of 48x32 would need"):
        load_capture(tmp_path / "capture")
    with pytest.raises(IgsrError, match="3 photos of 400x300 would need"):
        load_photos(tmp_path / "photos")


def test_what_is_available() -> None:
    here = available_memory()
    assert 0 < here < 1 << 50
    before = resource.getrlimit(resource.RLIMIT_AS)
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limit = taken + 200_000_000
    try:
        resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
        assert available_memory() <= 200_000_000
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.parametrize("version", [1, 2])
def test_limits_of_control_groups(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: int
) -> None:
    root = tmp_path / "cgroup"
    memory = root / "memory" if version == 1 else root
    limit, used = {
        1: ("memory.limit_in_bytes", "memory.usage_in_bytes"),
        2: ("memory.max", "memory.current"),
    }[version]
    group = memory / "jobs" / "mine"
    group.mkdir(parents=True)
    own = tmp_path / "own"
    own.write_text("4:memory:/jobs/mine\n" if version == 1 else "0::/jobs/mine\n")
    monkeypatch.setattr(memory_check, "_CGROUP_ROOT", root)
    monkeypatch.setattr(memory_check, "_OWN_CGROUPS", own)
    without = available_memory()
    (group / limit).write_text("max\n")
    (group / used).write_text("100\n")
    assert available_memory() > 0.5 * without, "no limit"
    (group.parent / limit).write_text("3000000\n")
    (group.parent / used).write_text("1000000\n")
    assert available_memory() == 2_000_000, "a group above limits too"
    (group / limit).write_text("1500000\n")
    (group / used).write_text("900000\n")
    assert available_memory() == 600_000
    (group / "memory.stat").write_text("anon 5\ninactive_file 300000\nbroken\n")
    assert available_memory() == 900_000, "cached files are given up"
    (group / used).write_text("9000000\n")
    assert available_memory() == 0
    own.write_text("nothing of the kind")
    assert available_memory() > 0.5 * without


def test_few_large_photos_are_decoded_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_check.os, "cpu_count", lambda: 64)
    for free in (2_000_000_000, 3_000_000_000):
        monkeypatch.setattr(memory_check, "available_memory", lambda free=free: free)
        threads = decoding_threads(TWELVE, 1000)
        needed = needed_memory(TWELVE, 1000, masked=True)
        one = memory_check.DECODED * 12_000_000
        assert 1 < threads < 16
        assert needed + (threads - 1) * one <= USABLE * free < needed + threads * one
    assert decoding_threads(TWELVE) == 1, "one at a time, where there is hardly room"
    assert decoding_threads([(48, 32)]) == 16
