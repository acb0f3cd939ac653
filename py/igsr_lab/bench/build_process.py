"""A process that times workloads with one build of the renderer, as its parent asks.

The parent (``build_pairs``) runs two of these, each with a build of its own, and asks them in turn.
One JSON value per line on standard input, ``[name, seconds]``: the answer's line holds the
milliseconds of each pass, or, where ``seconds`` is None, its errors against the f64 reference.
"""

from __future__ import annotations

import json
import sys
from typing import IO, Any

from igsr_lab.bench.timed_work import TimedWork, all_work


def answer(work: dict[str, TimedWork], questions: IO[str], answers: IO[str]) -> None:
    """Answer until the questions end; what fails is answered as {"failed": reason}."""
    for line in questions:
        name, seconds = json.loads(line)
        found: dict[str, Any]
        try:
            found = work[name].errors() if seconds is None else work[name].times(seconds)
        # Another build may lack an argument or a whole function: that is an answer, too.
        except Exception as error:
            found = {"failed": f"{type(error).__name__}: {error}"}
        print(json.dumps(found), file=answers, flush=True)


def main(settings: str) -> None:
    """Answer what standard input asks; ``settings`` are keywords of ``all_work`` as JSON."""
    work = {work.name: work for work in all_work(**json.loads(settings))}
    answer(work, sys.stdin, sys.stdout)
