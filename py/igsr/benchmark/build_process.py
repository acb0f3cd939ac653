"""A process that times workloads with one build of the renderer, as its parent asks.

The parent (``build_pairs``) runs two of these, each with a build of its own, and asks them in turn.
One JSON value per line on standard input, ``[name, seconds]``: the answer's line holds the
milliseconds of each pass, or, where ``seconds`` is None, its errors against the f64 reference.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import sys
from collections.abc import Callable
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    from igsr.benchmark.timed_work import TimedWork


def use_build(file: str) -> None:
    """Make ``file`` this process's ``igsr._core``; call it before anything of igsr is used.

    Raises:
        ImportError: the file is no build of the renderer for this Python.
    """
    spec = importlib.util.spec_from_file_location("igsr._core", file)
    if spec is None or spec.loader is None:
        raise ImportError(f"{file} is no compiled Python module.")
    module = importlib.util.module_from_spec(spec)
    sys.modules["igsr._core"] = module
    spec.loader.exec_module(module)
    importlib.import_module("igsr").__dict__["_core"] = module


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


def main() -> None:
    """Arguments: the build, and the workloads' settings as JSON."""
    build, settings = sys.argv[1:]
    if build:
        use_build(build)
    all_work: Callable[..., list[TimedWork]]
    all_work = importlib.import_module("igsr.benchmark.timed_work").all_work
    answer({work.name: work for work in all_work(**json.loads(settings))}, sys.stdin, sys.stdout)


if __name__ == "__main__":
    main()
