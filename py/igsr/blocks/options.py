"""What a run in blocks is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class BlockOptions:
    """What a run in blocks is asked for.

    Attributes:
        blocks: how many; None: as many as memory asks for.
        ray: address of a Ray cluster; None: one block after another on this machine.
        holdout: every so many photos one is held out; None: as the capture has it.
        max_size: longest side in pixels of photos as loaded; None: as they are.
        backend: "cpu" or "gpu".
        settings: keywords of ``igsr.fit``: preset, quality and those settings that are given.
        background: RGB in [0, 1] behind renders; None: white if photos have alpha, else black.
    """

    blocks: int | None = None
    ray: str | None = None
    holdout: int | None = None
    max_size: int | None = None
    backend: str = "cpu"
    settings: dict[str, Any]
    background: tuple[float, float, float] | None = None
