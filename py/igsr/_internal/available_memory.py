"""Memory that a process may still take."""

from __future__ import annotations

from pathlib import Path

_CGROUP_ROOT = Path("/sys/fs/cgroup")
_OWN_CGROUPS = Path("/proc/self/cgroup")


def available_memory() -> int:
    """Return the bytes that this process may still take.

    This is the least of the system's available memory, the rest of each control group's limit
    (versions 1 and 2, as of containers), and the rest of the address space (``ulimit -v``).
    """
    import psutil

    left = [int(psutil.virtual_memory().available), *_left_to_cgroups()]
    address_space = _address_space_limit()
    if address_space is not None:
        left.append(address_space - int(psutil.Process().memory_info().vms))
    return max(0, min(left))


def _address_space_limit() -> int | None:
    try:
        import resource
    except ImportError:  # Windows
        return None
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if soft == resource.RLIM_INFINITY else int(soft)


def _left_to_cgroups() -> list[int]:
    """Bytes left to each control group of this process that has a limit."""
    lines = _text(_OWN_CGROUPS).splitlines()
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
        # Parent groups limit too. In a container only the root may exist.
        group = root / path.lstrip("/")
        for folder in [group, *group.parents]:
            if folder != root and root not in folder.parents:
                break
            most, taken = _number(folder / limit), _number(folder / used)
            if most is not None and taken is not None:
                left.append(most - taken + _reclaimable(folder))
    return left


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return ""


def _number(path: Path) -> int | None:
    text = _text(path).strip()
    return int(text) if text.isdecimal() else None  # "max" means unlimited


def _reclaimable(group: Path) -> int:
    """Bytes of cached files that a control group frees when it needs memory."""
    lines = _text(group / "memory.stat").splitlines()
    fields = dict(line.split(None, 1) for line in lines if " " in line)
    for name in ("total_inactive_file", "inactive_file"):
        if fields.get(name, "").isdecimal():
            return int(fields[name])
    return 0
