"""Where huggingface_hub keeps what was downloaded; read without that library."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder() -> Path:
    """The cache: HF_HUB_CACHE, else ``hub`` in HF_HOME, else in the user's cache folder."""
    home = os.environ.get("HF_HOME") or (
        Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "huggingface"
    )
    return Path(os.environ.get("HF_HUB_CACHE") or Path(home) / "hub").expanduser()


def cached_snapshots(model: str) -> list[Path]:
    """The cached revisions of a model, the current one first, then by name.

    Args:
        model: such as "owner/name".
    """
    folder = cache_folder() / f"models--{model.replace('/', '--')}"
    try:
        current = (folder / "refs" / "main").read_text(errors="replace").strip()
    except OSError:
        current = ""
    snapshots = sorted(folder.glob("snapshots/*/"), key=lambda one: one.name)
    return sorted(snapshots, key=lambda one: one.name != current)
