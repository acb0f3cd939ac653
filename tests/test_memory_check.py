"""Photos that do not fit into memory."""

from __future__ import annotations

import re
import resource
from dataclasses import replace
from pathlib import Path

import pytest
from capture_files import assert_refused, photo, save, write_transforms

from igsr._internal import available_memory as available
from igsr._internal.available_memory import available_memory
from igsr.capture import load_capture, memory_check
from igsr.capture.memory_check import USABLE_PART, PhotoSizes
from igsr.capture.photo_folder import read_photos
from igsr.errors import IgsrError

TWELVE_MP = PhotoSizes(sizes=[(4000, 3000)] * 100)


def test_the_message_names_a_size_that_fits(monkeypatch):
    monkeypatch.setattr(memory_check, "available_memory", lambda: 2_000_000_000)
    with pytest.raises(IgsrError) as error:
        TWELVE_MP.check_memory(splats=30_000)
    match = re.fullmatch(
        r"The 100 photos of 4000x3000 would need (\d+\.\d) GB and 2\.0 GB are free: "
        r"give --max-size (\d+) \((\d\.\d) GB\)\.",
        str(error.value),
    )
    assert match is not None, str(error.value)
    size = int(match[2])
    assert 500 < size < 2000
    TWELVE_MP.check_memory(size, 30_000)
    too_much = TWELVE_MP.needed_memory(size + memory_check.SIZE_STEP_PX, 30_000)
    assert too_much > USABLE_PART * 2e9
    one_small = replace(TWELVE_MP, sizes=[*TWELVE_MP.sizes, (10, 10)])
    for photos, given, words in (
        (TWELVE_MP, (3000, 30_000), "of 4000x3000 at --max-size 3000 would need"),
        (one_small, (None, 30_000), "of up to 4000x3000 would"),
        (TWELVE_MP, (None, 10_000_000), "give fewer photos, or free memory; no --max-size would"),
    ):
        assert_refused(words, photos.check_memory, *given)


def test_more_pixels_channels_masks_and_splats_need_more():
    base = TWELVE_MP.needed_memory(1000, 30_000)
    assert TWELVE_MP.needed_memory(1000) < base < TWELVE_MP.needed_memory(1100, 30_000)
    assert base < replace(TWELVE_MP, channels=4).needed_memory(1000, 30_000)
    assert base < replace(TWELVE_MP, masked=True).needed_memory(1000, 30_000)
    assert TWELVE_MP.needed_memory(1000, 300_000) < TWELVE_MP.needed_memory(1000, 400_000)
    for size in (4000, 9999):
        assert TWELVE_MP.needed_memory(size) == TWELVE_MP.needed_memory()
    assert TWELVE_MP.largest_size_that_fits(available=10**12) == 4000
    assert TWELVE_MP.largest_size_that_fits(available=10**6) is None


def test_depths_need_more():
    sizes = [(1000, 750)] * 100
    without, with_depths = PhotoSizes(sizes=sizes), PhotoSizes(sizes=sizes, depths=True)
    # Four bytes per pixel as loaded; in a fit also depth and confidence twice.
    for splats, bytes_per_pixel in ((None, 4), (1_000_000, 20)):
        extra = with_depths.needed_memory(None, splats) - without.needed_memory(None, splats)
        assert extra == bytes_per_pixel * 100 * 1000 * 750


def test_photos_are_refused_before_any_is_decoded(tmp_path, monkeypatch):
    write_transforms(tmp_path / "capture")
    for index in range(3):
        save(tmp_path / "photos" / f"{index}.png", photo(index, 400, 300))
    monkeypatch.setattr(memory_check, "available_memory", lambda: 9000)
    decoder = "igsr.capture.image_files.load_pixels"
    monkeypatch.setattr(decoder, lambda *_: pytest.fail("a photo is decoded"))
    assert_refused("3 photos of 48x32 would need", load_capture, tmp_path / "capture")
    assert_refused("3 photos of 400x300 would need", read_photos, tmp_path / "photos")


def test_available_memory():
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
def test_limits_of_control_groups(tmp_path, monkeypatch, version):
    root = tmp_path / "cgroup"
    memory = root / "memory" if version == 1 else root
    old, new = ("limit_in_bytes", "usage_in_bytes"), ("max", "current")
    limit, used = (f"memory.{name}" for name in (old if version == 1 else new))
    group = memory / "jobs" / "mine"
    group.mkdir(parents=True)
    own = tmp_path / "own"
    own.write_text("4:memory:/jobs/mine\n" if version == 1 else "0::/jobs/mine\n")
    monkeypatch.setattr(available, "_CGROUP_ROOT", root)
    monkeypatch.setattr(available, "_OWN_CGROUPS", own)
    without = available_memory()
    (group / limit).write_text("max\n")
    (group / used).write_text("100\n")
    assert available_memory() > 0.5 * without
    (group.parent / limit).write_text("3000000\n")
    (group.parent / used).write_text("1000000\n")
    assert available_memory() == 2_000_000, "a parent group limits too"
    (group / limit).write_text("1500000\n")
    (group / used).write_text("900000\n")
    assert available_memory() == 600_000
    (group / "memory.stat").write_text("anon 5\ninactive_file 300000\nbroken\n")
    assert available_memory() == 900_000, "cached files are freed"
    (group / used).write_text("9000000\n")
    assert available_memory() == 0
    own.write_text("nothing of the kind")
    assert available_memory() > 0.5 * without


def test_large_photos_are_decoded_by_fewer_threads(monkeypatch):
    monkeypatch.setattr(memory_check.os, "cpu_count", lambda: 64)
    for free in (2_000_000_000, 3_000_000_000):
        monkeypatch.setattr(memory_check, "available_memory", lambda free=free: free)
        threads = TWELVE_MP.decoding_threads(1000)
        needed = replace(TWELVE_MP, masked=True).needed_memory(1000)
        photo = memory_check.DECODED_BYTES * 12_000_000
        assert 1 < threads < 16
        assert needed + (threads - 1) * photo <= USABLE_PART * free < needed + threads * photo
    assert TWELVE_MP.decoding_threads() == 1
    assert PhotoSizes(sizes=[(48, 32)]).decoding_threads() == memory_check.MAX_THREADS
