"""Hooks of ``mkdocs build`` for three pages: the command line, CHANGELOG.md and CONTRIBUTING.md.

The page of the command line is generated from the commands, so it is always current. The two files
are in the repository's root, as forges expect.
"""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]

#: Pages of docs/ that show a file of the root.
OF_THE_ROOT = {
    "how-it-works/contributing.md": "CONTRIBUTING.md",
    "reference/changelog.md": "CHANGELOG.md",
}


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """The Markdown that a page is built from."""
    path = page.file.src_uri
    if path == "reference/command-line.md":
        return markdown + "\n" + _command_line_page().commands_markdown()
    if path in OF_THE_ROOT:
        text = (ROOT / OF_THE_ROOT[path]).read_text(encoding="utf-8")
        # All such pages are one folder below docs/.
        return re.sub(r"\]\(docs/", "](../", text)
    return markdown


def _command_line_page() -> Any:
    spec = importlib.util.spec_from_file_location(
        "command_line_page", Path(__file__).with_name("command_line_page.py")
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
