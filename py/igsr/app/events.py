"""Handlers for the events of the page of ``igsr app``."""

from __future__ import annotations

import contextlib
import html
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gradio as gr

from igsr.app.intake import check_files
from igsr.app.results import EXPORTS, MAX_COMPARED, WRITTEN, comparisons, in_words
from igsr.app.runs import DONE, FAILED, QUEUED, RUNNING, STOPPED, Run, Runs
from igsr.errors import IgsrError

_STATES = {
    QUEUED: "Waiting",
    RUNNING: "Working",
    STOPPED: "Stopped",
    FAILED: "Failed",
    DONE: "Done",
}
_LABELS = {
    "scene.html": "page to send (.html)",
    "report.html": "report",
    "scene.mp4": "video (.mp4)",
}


class Events:
    """Handlers of the page's events; the page shows their errors."""

    def __init__(self, runs: Runs) -> None:
        self._runs = runs

    def check(self, files: list[str] | None) -> tuple[str, Any]:
        """Return notes about dropped files, and their thumbnails."""
        if not files:
            return "", gr.update(value=[], visible=False)
        with _shown_errors():
            intake = check_files([Path(file) for file in files])
        count = len(intake.thumbnails)
        counts = {"photo": count, "video": intake.videos}
        parts = [f"{n} {kind}{'s' if n > 1 else ''}" for kind, n in counts.items() if n]
        lines = [f"{' and '.join(parts)} can be used."] if parts else []
        pictures = gr.update(value=intake.thumbnails, visible=bool(count))
        return _paragraphs([*lines, *intake.left_out, *intake.advice]), pictures

    def make_scene(
        self, files: list[str] | None, quality: str, holdout: int, leave_out: bool, seed: int
    ) -> str:
        """Queue a run with dropped photos and return its name."""
        with _shown_errors():
            intake = check_files([Path(file) for file in files or ()])
            if not intake.can_run:
                raise IgsrError(" ".join([*intake.left_out, *intake.advice]))
            return self._create(intake.taken, quality, holdout, leave_out, seed)

    def make_example(self, quality: str, holdout: int, leave_out: bool, seed: int) -> str:
        """Queue a run with the example photos and return its name."""
        with _shown_errors():
            return self._create({}, quality, holdout, leave_out, seed)

    def _create(
        self, files: dict[str, Path], quality: str, holdout: int, leave_out: bool, seed: int
    ) -> str:
        run = Run(
            "",
            quality=quality,
            holdout=int(holdout or 0) or None,
            allow_missing=bool(leave_out),
            seed=int(seed or 0),
        )
        return self._runs.create(files, run).name

    def run_state(self, name: str) -> dict[str, Any]:
        """Return the state of a run.

        It has "state", "message", "stage", "done" in [0, 1], "seconds_left" and "files": their
        addresses below the address of the app, by name.
        """
        with _shown_errors():
            run = self._runs.get(name)
        is_running, is_done = run.state == RUNNING, run.state == DONE
        stage, done, left = self._runs.progress(name) if is_running else ("", 0.0, None)
        return {
            "state": run.state,
            "message": run.message,
            "stage": stage,
            "done": 1.0 if is_done else done,
            "seconds_left": left,
            "files": {file: _address(name, file) for file in (*WRITTEN, *EXPORTS) if is_done},
        }

    def stop_run(self, name: str) -> None:
        """Stop a run, which keeps its checkpoint."""
        with _shown_errors():
            self._runs.stop(name)

    def resume_run(self, name: str) -> None:
        """Queue a run again, to continue from its checkpoint."""
        with _shown_errors():
            self._runs.start(name)

    def delete_run(self, name: str, confirmed: str) -> None:
        """Delete a run with its photos, if that is confirmed."""
        with _shown_errors():
            if confirmed:
                self._runs.delete(name)

    def open_page(self, request: gr.Request) -> list[Any]:
        """Show the run that the address names, or the form for a new scene."""
        name = dict(request.query_params).get("run", "")
        try:
            self._runs.folder(name)
        except IgsrError:
            name = ""
        view = f'<iframe title="scene" src="runs/{name}/view/"></iframe>' if name else ""
        columns = gr.update(visible=not name), gr.update(visible=bool(name))
        return [name, *columns, view, "" if name else self._cards(), gr.update(active=bool(name))]

    def update(self, name: str, drawn: str) -> list[Any]:
        """Show a run; the results only if its state is not ``drawn``."""
        try:
            run = self._runs.get(name)
        except IgsrError as error:  # deleted in another tab
            run = Run(name, state=FAILED, message=str(error))
        is_active = run.state in (RUNNING, QUEUED)
        skipped = [gr.skip()] * (1 + MAX_COMPARED)
        if run.state == drawn and not is_active:
            return [drawn, *[gr.skip()] * 5, *skipped]
        shown = [
            run.state,
            self._status(run),
            gr.update(visible=is_active),
            gr.update(visible=run.state in (STOPPED, FAILED)),
            gr.update(visible=not is_active),
            "\n".join(log := self._runs.log(name)),
        ]
        return [*shown, *(self._results(name, log) if run.state == DONE else skipped)]

    def _results(self, name: str, log: list[str]) -> list[Any]:
        folder = self._runs.folder(name)
        pairs: list[Any] = [gr.update(value=pair, visible=True) for pair in comparisons(folder)]
        pairs += [gr.update(visible=False)] * (MAX_COMPARED - len(pairs))
        links = [
            f'<a href="{_address(name, file)}">{_LABELS.get(file, file)}</a>'
            for file in (*WRITTEN, *EXPORTS)
        ]
        return [_paragraphs(in_words(folder, log)) + f"<p>Download: {' '.join(links)}</p>", *pairs]

    def _status(self, run: Run) -> str:
        text = f"<b>{_STATES[run.state]}.</b> {html.escape(run.message)}"
        if run.state == QUEUED:
            return f"{text} Another scene is being made."
        if run.state != RUNNING:
            return text
        stage, done, left = self._runs.progress(run.name)
        bar = f'<progress value="{done:.3f}"></progress>'
        if left is None:
            # The command's estimate, without its advice on options.
            estimate = "".join(self._runs.log(run.name)[-1:]).partition(";")[0]
        else:
            estimate = f"{_duration(left)} left"
        return f"{text} {html.escape(stage)}<br>{bar}<br>{html.escape(estimate)}"

    def _cards(self) -> str:
        cards = []
        for name in self._runs.names():
            when = f"{name[:4]}-{name[4:6]}-{name[6:8]} {name[9:11]}:{name[11:13]}"
            try:
                state = _STATES[self._runs.get(name).state]
            except IgsrError:  # deleted meanwhile
                continue
            picture = f'<img alt="" loading="lazy" src="runs/{name}/view/photo?number=0">'
            cards.append(f'<a href="?run={name}">{picture}{when}<br>{state}</a>')
        return f'<h2>Scenes</h2><div class="runs">{"".join(cards)}</div>' if cards else ""


@contextlib.contextmanager
def _shown_errors() -> Iterator[None]:
    try:
        yield
    except (IgsrError, OSError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        message = html.escape(f"{reason.rstrip('.')}.")
        raise gr.Error(message, duration=None, print_exception=False) from error


def _address(name: str, file: str) -> str:
    return f"runs/{name}/files/{file}"


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60.0:.0f} min"


def _paragraphs(lines: Sequence[str]) -> str:
    return "".join(f"<p>{html.escape(line)}</p>" for line in lines)
