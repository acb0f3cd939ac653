"""The files that every study leaves: ``study.json`` and ``study.md``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from igsr._internal.atomic_write import atomic_write


def headed(report: dict[str, Any]) -> list[str]:
    """The first lines of ``study.md``: title, version, protocol."""
    about = f"igsr {report['igsr']}; {json.dumps(report['protocol'])}"
    return [f"# {report['title']}", "", about, ""]


def text_of(lines: Sequence[str]) -> str:
    """Lines as a text file has them."""
    return "\n".join(lines) + "\n"


def write_study_files(out: Path, report: dict[str, Any], markdown: str) -> None:
    """Write ``study.json`` and ``study.md`` into ``out``, each under a temporary name first.

    Raises:
        IgsrError: a file cannot be written.
    """
    texts = {
        "study.json": json.dumps(report, indent=2, allow_nan=False),
        "study.md": markdown,
    }
    for name, text in texts.items():
        with atomic_write(out / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
