"""Check that prose stays plain: rates of words that make sentences hard to read may only fall.

    python tests/plain_words.py            list the rates of each part of the repository
    python tests/plain_words.py --check    fail if a rate is above the recorded one
    python tests/plain_words.py --record   record the rates, if none rose
    python tests/plain_words.py --lines GLOB ...    list the lines with such words

Prose is Markdown without code, comments, docstrings and string literals of at least four words.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
RECORDED = Path(__file__).with_suffix(".json")
#: Parts of the repository, by the start of a file's path.
PARTS = ("README.md", "docs", "py/igsr/", "py/igsr_lab", "crates", "tests", "")
#: Words of riddles, personification and archaic connectives; gsplat, vello, Brush and httpx have 12
#: to 16 of them per 10 000 words.
MARKERS = re.compile(
    r"\bwhat\b|\bwhere\b|\b(?:that|those) of\b|\bthose (?:that|who|which|whose|in|with)\b"
    r"|\b(?:tells?|told)\b|\bbeside\b|\b(?:so|as) many\b|\bthe others?\b|\bof which\b|\bof whom\b"
    r"|\banew\b|\b(?:goes|go|went) by\b|\bmend(?:s|ed)?\b|\b(?:is|are) no (?!longer)\w+"
    r"|\b(?:by itself|of its own|of one's own|of your own)\b|\bnobody\b|\bwhoever\b"
    r"|\bmost (?:splats|photos|steps|points|frames|pixels)\b|\bbefore (?:white|black)\b",
    re.IGNORECASE,
)
WORD = re.compile(r"[A-Za-z']+")
MIN_WORDS = 4
#: Rates are per so many words; recorded with one decimal.
PER = 10_000
SLASH_COMMENT = re.compile(r"(?:^|\s)//[/!]?\s*(.*)$")
STRING = re.compile(r'"((?:[^"\\]|\\.)*)"')
TAG = re.compile(r"<(script|style)\b.*?</\1>|<[^>]*>|\{[{%#].*?[}%#]\}", re.DOTALL)


def prose(path: Path) -> Iterator[tuple[int, str]]:
    """Line number and text of each line of prose in a file."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        yield from _python_prose(text)
    elif path.suffix == ".md":
        is_code = False
        for number, line in enumerate(text.splitlines(), 1):
            if line.lstrip().startswith("```"):
                is_code = not is_code
            elif not is_code:
                yield number, re.sub(r"`[^`]*`", " ", line)
    elif path.suffix in (".html", ".jinja"):
        without_tags = TAG.sub(lambda tag: "\n" * tag[0].count("\n") + " ", text)
        yield from enumerate(without_tags.splitlines(), 1)
    else:
        for number, line in enumerate(text.splitlines(), 1):
            comment = SLASH_COMMENT.search(line)
            if comment:
                yield number, comment[1]
            for string in STRING.finditer(line[: comment.start()] if comment else line):
                if len(WORD.findall(string[1])) >= MIN_WORDS:
                    yield number, string[1]


def _python_prose(text: str) -> Iterator[tuple[int, str]]:
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string.lstrip("#: ")
    for node in ast.walk(ast.parse(text)):
        value = node.value if isinstance(node, ast.Constant) else None
        if isinstance(value, str) and len(WORD.findall(value)) >= MIN_WORDS:
            for offset, line in enumerate(value.splitlines()):
                yield node.lineno + offset, line


def tracked(globs: list[str]) -> list[Path]:
    listed = subprocess.run(
        ["git", "ls-files", "-z", *globs], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split("\0")
    suffixes = (".md", ".py", ".rs", ".wgsl", ".js", ".jinja", ".html")
    return [ROOT / name for name in listed if name.endswith(suffixes) and (ROOT / name).is_file()]


def part_of(path: Path) -> str:
    name = path.relative_to(ROOT).as_posix()
    return next(part for part in PARTS if name.startswith(part)) or "other"


def rates() -> dict[str, float]:
    """Markers per ``PER`` words in each part of the repository."""
    words: dict[str, int] = {}
    markers: dict[str, int] = {}
    for path in tracked([]):
        part = part_of(path)
        for _, line in prose(path):
            words[part] = words.get(part, 0) + len(WORD.findall(line))
            markers[part] = markers.get(part, 0) + len(MARKERS.findall(line))
    return {
        part: round(PER * markers.get(part, 0) / max(1, count), 1)
        for part, count in sorted(words.items())
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--lines", nargs="+", metavar="GLOB")
    arguments = parser.parse_args()
    if arguments.lines:
        for path in tracked(arguments.lines):
            for number, line in prose(path):
                if MARKERS.search(line):
                    print(f"{path.relative_to(ROOT)}:{number}: {line.strip()}")
        return 0
    measured = rates()
    recorded = json.loads(RECORDED.read_text()) if RECORDED.is_file() else {}
    rose = {part: rate for part, rate in measured.items() if rate > recorded.get(part, PER)}
    for part, rate in measured.items():
        print(
            f"{rate:7.1f}  {recorded.get(part, '-'):>7}  {part}{'  ROSE' if part in rose else ''}"
        )
    if rose and (arguments.check or arguments.record):
        print(
            f"Prose of {', '.join(rose)} has more hard words than recorded; rewrite the sentences "
            f"that `python tests/plain_words.py --lines {next(iter(rose))}*` lists."
        )
        return 1
    if arguments.record:
        RECORDED.write_text(json.dumps(measured, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
