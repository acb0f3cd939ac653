"""Where all blocks of a run stand, in one view: from the files that their workers write."""

from __future__ import annotations

import contextlib
import json
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from igsr.blocks.tasks import PROGRESS

#: Seconds between two looks.
LOOK_EVERY = 1.0


@dataclass(frozen=True)
class Standing:
    """Where one task stands.

    Attributes:
        name: of the task.
        work: part of it that is done, in [0, 1].
        text: more in words; empty where it has not begun.
    """

    name: str
    work: float
    text: str


def standing_of(name: str, folder: Path, is_done: bool) -> Standing:
    """Where a task stands, by its folder."""
    if is_done:
        return Standing(name, 1.0, "done")
    try:
        news = json.loads((folder / PROGRESS).read_text(encoding="utf-8"))
        work = min(1.0, max(0.0, float(news["work"])))
        text = f"step {int(news['step'])} of {int(news['steps'])}, {int(news['splats'])} splats"
        return Standing(name, work, f"{text}, {news['host']}")
    except (OSError, ValueError, KeyError, TypeError):
        return Standing(name, 0.0, "")


@contextlib.contextmanager
def watched(
    folders: Sequence[tuple[str, Path]],
    done: Callable[[], set[str]],
    told: Callable[[list[Standing]], None],
) -> Iterator[None]:
    """Look at tasks now and then, while what is inside goes on.

    Args:
        folders: name and folder of each task.
        done: names of the tasks that are done.
        told: called with where all of them stand.
    """
    ended = threading.Event()

    def tell() -> None:
        over = done()
        told([standing_of(name, folder, name in over) for name, folder in folders])

    def look() -> None:
        tell()
        while not ended.wait(LOOK_EVERY):
            tell()

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        tell()


@contextlib.contextmanager
def bars(shown: bool) -> Iterator[Callable[[list[Standing]], None]]:
    """A bar on stderr for each task; what it yields moves them."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    view = Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=30),
        TextColumn("{task.fields[text]}"),
        console=Console(file=sys.stderr, highlight=False),
        disable=not shown,
    )
    numbers = {}

    def show(all_of_them: list[Standing]) -> None:
        view.start()
        for one in all_of_them:
            if one.name not in numbers:
                numbers[one.name] = view.add_task(one.name, total=1.0, text="")
            view.update(numbers[one.name], completed=one.work, text=one.text)

    try:
        yield show
    finally:
        if view.live.is_started:
            view.stop()
