"""The Markdown of README, CONTRIBUTING and docs/, taken apart: code blocks, links, headings."""

from __future__ import annotations

import re
import shlex
import unicodedata
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"

#: Pages whose code blocks a newcomer types: they are run.
TYPED = ["README.md", "docs/index.md", "docs/getting-started.md"]
TYPED += sorted(path.relative_to(ROOT).as_posix() for path in DOCS.glob("guides/*.md"))
#: All pages.
PAGES = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"]
PAGES += sorted(path.relative_to(ROOT).as_posix() for path in DOCS.rglob("*.md"))
#: Pages of the site that show a file of the root in their place.
SHOWN = {
    "docs/how-it-works/contributing.md": "CONTRIBUTING.md",
    "docs/reference/changelog.md": "CHANGELOG.md",
}

_FENCE = re.compile(r"^(\s*)(```+|~~~+)\s*(\S*)[^\n]*\n(.*?)^\1\2\s*$", re.MULTILINE | re.DOTALL)
_NOT_RUN = re.compile(r"<!-- not run: (.+?) -->\s*\Z", re.DOTALL)
_LINK = re.compile(r"!?\[(?:[^\[\]]|\[[^\]]*\])*\]\(([^()\s]+(?:\([^()]*\))?[^()\s]*)\)")
_DEFINITION = re.compile(r"^\[[^\]]+\]:\s+(\S+)", re.MULTILINE)


@dataclass(frozen=True)
class Block:
    """A fenced code block."""

    page: str  # path in the repository
    line: int  # of its first line of code
    language: str
    code: str
    not_run: str | None  # why it is not run, from the comment before it

    @property
    def place(self) -> str:
        return f"{self.page}:{self.line}"


def text_of(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def blocks(page: str) -> list[Block]:
    """The fenced code blocks of a page, in order."""
    text = text_of(page)
    found = []
    for match in _FENCE.finditer(text):
        reason = _NOT_RUN.search(text, 0, match.start())
        line = text.count("\n", 0, match.start(4)) + 1
        code = re.sub(rf"^{match[1]}", "", match[4], flags=re.MULTILINE)
        found.append(Block(page, line, match[3], code, reason[1] if reason else None))
    return found


def prose(page: str) -> str:
    """A page without its code blocks."""
    return _FENCE.sub("", text_of(page))


def inline_code(page: str) -> list[str]:
    """Text between single backquotes, line breaks as spaces."""
    return [" ".join(span.split()) for span in re.findall(r"(?<!`)`([^`]+)`(?!`)", prose(page))]


def links(page: str) -> list[str]:
    """Targets of links and images of a page."""
    text = re.sub(r"(?<!`)`[^`\n]+`(?!`)", "", prose(page))
    return _LINK.findall(text) + _DEFINITION.findall(text)


def anchors(page: str) -> set[str]:
    """Names of a page's headings that work both on the site and on a forge."""
    on_site, on_forge = set(), set()
    for heading in re.findall(r"^#{1,6}\s+(.+?)\s*#*$", prose(page), re.MULTILINE):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "")
        ascii_only = unicodedata.normalize("NFKD", plain).encode("ascii", "ignore").decode()
        on_site.add(re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", ascii_only).strip().lower()))
        on_forge.add(re.sub(r"[^\w\- ]", "", plain.strip().lower()).replace(" ", "-"))
    return on_site & on_forge


def commands(code):
    """The commands of a shell block, as words; comments left out, continued lines joined."""
    lines = re.sub(r"\\\n", " ", code).splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]
