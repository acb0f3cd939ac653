"""Write JSON files atomically."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from igsr._internal.atomic_write import atomic_write


def write_json(path: Path, report: dict[str, Any]) -> None:
    """Write ``report`` as JSON.

    Raises:
        IgsrError: the file cannot be written.
    """
    text = json.dumps(report, indent=2, allow_nan=False) + "\n"
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
