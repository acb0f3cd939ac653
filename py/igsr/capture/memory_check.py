"""Whether photos fit into memory, from their sizes alone, before any is decoded.

The numbers of bytes are those of the arrays that a load and a fit on the CPU hold, and were
compared with the memory that processes took.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from igsr.capture.downscaling import reduced_size
from igsr.errors import IgsrError

#: Bytes of a photo's pixel while it is decoded: Pillow's four, copies of it, and what the allocator
#: keeps between photos (17 together, measured on JPEGs of 12 megapixels).
DECODED = 18
#: Bytes of a pixel of the largest photo while it is undistorted: the map, and the padded photo.
UNDISTORTED = 24
#: Bytes of a pixel of the largest photo while it is fitted: render, photo, loss and gradients.
FITTED = 110
#: Bytes of a pixel of the largest photo while it is scored: planes of float64 for SSIM, and the
#: colors and edges that FLIP compares.
SCORED = 740
#: Bytes of a splat at degree 3: parameters, two moments, gradients and statistics, its entries in
#: tiles (1850 together), and the copies that checkpoints and results are.
OF_A_SPLAT = 3500
#: Bytes that a fit takes whatever its size: libraries, and threads' scratch.
LIBRARIES = 650_000_000
#: Photos may take this part of what is available: the rest is for what nobody counted.
USABLE = 0.9
#: Threads beyond these wait for the disk.
MOST_THREADS = 16
#: Sizes that are advised are multiples of this where they are larger, and none is below it.
STEP = 50

_CGROUP_ROOT = Path("/sys/fs/cgroup")
_OWN_CGROUPS = Path("/proc/self/cgroup")


def available_memory() -> int:
    """Bytes that this process may still take without harm to others.

    The least of what the system says is available, what is left to its control groups (versions 1
    and 2; a container's limit), and what is left of its address space (``ulimit -v``).
    """
    import psutil

    left = [int(psutil.virtual_memory().available)]
    left += _left_to_cgroups()
    address_space = _address_space_limit()
    if address_space is not None:
        left.append(address_space - int(psutil.Process().memory_info().vms))
    return max(0, min(left))


def needed_memory(
    sizes: Sequence[tuple[int, int]],
    max_size: int | None = None,
    splats: int | None = None,
    *,
    channels: int = 3,
    masked: bool = False,
    depths: bool = False,
    decoded: Sequence[tuple[int, int]] = (),
) -> int:
    """Bytes that photos take at most, at one time.

    Args:
        sizes: width and height in pixels of each photo as stored.
        max_size: longest side in pixels of photos as loaded; None keeps them as they are.
        splats: most splats of a fit to these photos, or None where they are only loaded.
        channels: of the photos: 3, or 4 with alpha.
        masked: whether pixels are masked, or lens distortion is undone.
        depths: whether photos come with depths.
        decoded: sizes of the files, where photos are parts of them.
    """
    reduced = [reduced_size(width, height, max_size) for width, height in sizes]
    pixels = sum(width * height for width, height in reduced)
    largest = max((width * height for width, height in reduced), default=0)
    held = pixels * (channels + masked + 4 * depths)
    undistorted = UNDISTORTED * largest if masked else 0
    files = decoded or sizes
    loading = held + DECODED * _most_pixels(files) + undistorted
    if splats is None:
        return loading
    # A mask becomes float32 weights; depths are stacked with their confidence, and copied.
    copied = pixels * (channels + 4 * masked + 16 * depths)
    fitting = held + copied + FITTED * largest + OF_A_SPLAT * splats
    scoring = held + SCORED * largest
    return LIBRARIES + max(loading, fitting, scoring)


def largest_size_that_fits(
    sizes: Sequence[tuple[int, int]],
    splats: int | None = None,
    *,
    channels: int = 3,
    masked: bool = False,
    depths: bool = False,
    decoded: Sequence[tuple[int, int]] = (),
    available: int | None = None,
) -> int | None:
    """The longest side in pixels at which photos fit into memory; None where no size does.

    Args:
        sizes, splats, channels, masked, depths, decoded: as ``needed_memory``.
        available: bytes; None is ``available_memory()``.
    """
    usable = USABLE * (available_memory() if available is None else available)

    def fits(size: int) -> bool:
        needed = needed_memory(
            sizes, size, splats, channels=channels, masked=masked, depths=depths, decoded=decoded
        )
        return needed <= usable

    longest = max((max(size) for size in sizes), default=1)
    if fits(longest):
        return longest
    low, high = 0, longest // STEP + 1  # in steps: low fits, or is nothing; high does not
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle * STEP) else (low, middle)
    return low * STEP or None


def check_memory(
    sizes: Sequence[tuple[int, int]],
    max_size: int | None = None,
    splats: int | None = None,
    *,
    channels: int = 3,
    masked: bool = False,
    depths: bool = False,
    decoded: Sequence[tuple[int, int]] = (),
) -> None:
    """Refuse photos that do not fit into memory, and name the size at which they do.

    Args:
        sizes, max_size, splats, channels, masked, depths, decoded: as ``needed_memory``.

    Raises:
        IgsrError: they do not fit.
    """
    available = available_memory()

    def needed_at(size: int | None) -> int:
        return needed_memory(
            sizes, size, splats, channels=channels, masked=masked, depths=depths, decoded=decoded
        )

    if needed_at(max_size) <= USABLE * available:
        return
    width, height = max(sizes, key=lambda size: size[0] * size[1])
    count = f"{len(sizes)} photos" if len(sizes) > 1 else "photo"
    up_to = "" if len(set(sizes)) == 1 else "up to "
    at = "" if max_size is None or max_size >= max(width, height) else f" at --max-size {max_size}"
    says = (
        f"The {count} of {up_to}{width}x{height}{at} would need {_gigabytes(needed_at(max_size))} "
        f"and {_gigabytes(available)} are free"
    )
    size = largest_size_that_fits(
        sizes,
        splats,
        channels=channels,
        masked=masked,
        depths=depths,
        decoded=decoded,
        available=available,
    )
    if size is None:
        raise IgsrError(f"{says}: give fewer photos, or free memory; no --max-size would do.")
    raise IgsrError(f"{says}: give --max-size {size} ({_gigabytes(needed_at(size))}).")


def decoding_threads(
    sizes: Sequence[tuple[int, int]],
    max_size: int | None = None,
    *,
    channels: int = 3,
    decoded: Sequence[tuple[int, int]] = (),
) -> int:
    """How many photos are decoded side by side: as many as memory allows, at least one.

    Args:
        sizes, max_size, channels, decoded: as ``needed_memory``.
    """
    alone = needed_memory(sizes, max_size, channels=channels, masked=True, decoded=decoded)
    left = USABLE * available_memory() - alone
    more = int(max(0.0, left) / (DECODED * max(1, _most_pixels(decoded or sizes))))
    return min(1 + more, os.cpu_count() or 1, MOST_THREADS)


def _most_pixels(sizes: Sequence[tuple[int, int]]) -> int:
    return max((width * height for width, height in sizes), default=0)


def _gigabytes(count: float) -> str:
    return f"{count / 1e9:.1f} GB"


def _address_space_limit() -> int | None:
    try:
        import resource
    except ImportError:  # Windows
        return None
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if soft == resource.RLIM_INFINITY else int(soft)


def _left_to_cgroups() -> list[int]:
    """Bytes left to each control group that this process is in and that has a limit."""
    try:
        lines = _OWN_CGROUPS.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return []
    left = []
    for line in lines:
        _, controllers, path = (line.split(":", 2) + ["", ""])[:3]
        if controllers == "":  # version 2: one tree
            root, limit, used = _CGROUP_ROOT, "memory.max", "memory.current"
        elif "memory" in controllers.split(","):
            root = _CGROUP_ROOT / "memory"
            limit, used = "memory.limit_in_bytes", "memory.usage_in_bytes"
        else:
            continue
        # Each group above limits too. In a container, the path may be that outside of it, of which
        # only the root is seen.
        group = root / path.lstrip("/")
        for folder in [group, *group.parents]:
            if folder != root and root not in folder.parents:
                break
            most, taken = _number(folder / limit), _number(folder / used)
            if most is not None and taken is not None:
                left.append(most - taken + _reclaimable(folder))
    return left


def _number(path: Path) -> int | None:
    try:
        return int(path.read_text(encoding="ascii"))
    except (OSError, ValueError):  # "max" is no limit
        return None


def _reclaimable(group: Path) -> int:
    """Bytes of cached files that a control group gives up when it needs them."""
    try:
        lines = (group / "memory.stat").read_text(encoding="ascii").splitlines()
    except (OSError, ValueError):
        return 0
    fields = dict(line.split(None, 1) for line in lines if " " in line)
    for name in ("total_inactive_file", "inactive_file"):
        if fields.get(name, "").isdigit():
            return int(fields[name])
    return 0
