"""What the commands have in common: options, sentences, scores."""

from __future__ import annotations

import contextlib
import enum
import json
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as ProgressBar

from igsr import _core
from igsr.capture import Capture, load_capture
from igsr.capture.write_files import relative_name
from igsr.errors import IgsrError
from igsr.evaluation.contact_sheet import sheet_names
from igsr.evaluation.scores import ScoredView, evaluate
from igsr.splats import Splats

#: Exit status after Ctrl-C: 128 + SIGINT, as shells report it.
INTERRUPTED = 130


NAMED_COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "grey": (0.5, 0.5, 0.5)}


class BackendChoice(str, enum.Enum):
    """What computes."""

    auto = "auto"
    cpu = "cpu"
    gpu = "gpu"
    reference = "reference"


class PresetChoice(str, enum.Enum):
    """Sets of fit settings."""

    default = "default"
    baseline_3dgs = "3dgs"
    instantsplat = "instantsplat"


class SplitChoice(str, enum.Enum):
    """Which views of a capture."""

    train = "train"
    test = "test"


BackendOption = Annotated[
    BackendChoice,
    typer.Option("--backend", help="auto: a real GPU if one answers, else the CPU."),
]


BackgroundOption = Annotated[
    str | None,
    typer.Option(
        "--background",
        metavar="COLOR",
        help="white, black, grey or R,G,B in 0..1, behind renders and photos with alpha. "
        "Default: white where photos have alpha, else black.",
    ),
]


HoldoutOption = Annotated[
    int | None,
    typer.Option("--holdout", help="Every how many views one is held out and scored, such as 8."),
]


JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object, for machines.")]


JobsOption = Annotated[int, typer.Option("--jobs", help="Fits at a time; they share the cores.")]
RayOption = Annotated[
    bool, typer.Option("--ray", help="Fits go over a Ray cluster (pip install 'igsr[ray]').")
]
CaptureArgument = Annotated[
    Path, typer.Argument(metavar="CAPTURE", help="Folder or file that holds photos and cameras.")
]


SceneArgument = Annotated[
    Path,
    typer.Argument(metavar="SCENE", help="A splat file: .ply, .splat, .ksplat, .spz, .sog, .glb."),
]


@contextlib.contextmanager
def one_sentence(interrupted: Callable[[], str] = lambda: "Interrupted.") -> Iterator[None]:
    """Turn what a user can mend into one sentence on stderr and a non-zero exit."""
    try:
        yield
    except KeyboardInterrupt:
        complain(interrupted())
        raise typer.Exit(INTERRUPTED) from None
    except (IgsrError, RuntimeError) as error:  # the renderer's RuntimeErrors are the GPU's
        complain(str(error))
        raise typer.Exit(1) from None
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        complain(f"{where}{error.strerror or error}")
        raise typer.Exit(1) from None
    except MemoryError:
        complain("There is not enough memory for this; use fewer or smaller photos or splats")
        raise typer.Exit(1) from None


@contextlib.contextmanager
def warnings_as_sentences() -> Iterator[None]:
    """Print the warnings of igsr itself as the command prints its errors, as they come."""
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *rest: complain(str(message))
        yield


def complain(sentence: str) -> None:
    """Print one sentence on stderr."""
    sentence = " ".join(sentence.split())
    print(sentence if sentence.endswith((".", "!", "?")) else sentence + ".", file=sys.stderr)


def resolved(backend: BackendChoice) -> str:
    """The backend that runs; a missing adapter is found before any work."""
    return _core.resolve_backend(backend.value)


def background_color(text: str | None) -> tuple[float, float, float] | None:
    """RGB in [0, 1] of what --background says; None for the default."""
    if text is None:
        return None
    if text in NAMED_COLORS:
        return NAMED_COLORS[text]
    try:
        red, green, blue = (float(part) for part in text.split(","))
        if all(0.0 <= channel <= 1.0 for channel in (red, green, blue)):
            return red, green, blue
    except ValueError:
        pass
    raise IgsrError(
        f"--background must be {', '.join(NAMED_COLORS)} or three numbers in 0..1 such as "
        f"0.2,0.2,0.2, not {text!r}."
    )


def load(path: Path, holdout: int | None) -> Capture:
    """A capture, with every ``holdout``-th view held out if that is given."""
    capture = load_capture(path)
    return capture if holdout is None else capture.with_holdout(holdout)


class TimeLeft:
    """Time left of runs of which some were there already, guessed from those done since."""

    def __init__(self) -> None:
        self._started = time.monotonic()
        self._before: int | None = None

    def __call__(self, done: int, total: int) -> str:
        """In words, when ``done`` of ``total`` are there."""
        if self._before is None:
            self._before = done - 1
        each = (time.monotonic() - self._started) / (done - self._before)
        return f"about {each * (total - done) / 60.0:.0f} min left"


def error_console() -> Console:
    """Where progress goes."""
    return Console(file=sys.stderr, highlight=False)


def output_console() -> Console:
    """Where results go."""
    # Paths stay whole: a terminal breaks long lines by itself.
    return Console(file=sys.stdout, highlight=False, soft_wrap=True)


def print_json(value: dict[str, Any]) -> None:
    """Print one JSON object on stdout."""
    print(json.dumps(value, indent=2, allow_nan=False))


def score_line(scores: dict[str, Any]) -> str:
    """The scores of some views in one line."""
    parts = [
        f"PSNR {scores['psnr']:.2f} dB",
        f"SSIM {scores['ssim']:.4f}",
        "MS-SSIM " + (f"{scores['ms_ssim']:.4f}" if scores["ms_ssim"] is not None else "-"),
        f"FLIP {scores['flip']:.4f}",
    ]
    return "   ".join(parts)


def protocol_line(protocol: dict[str, Any]) -> str:
    """How views were scored, in one line."""
    background = tuple(protocol["background"])
    names = {color: name for name, color in NAMED_COLORS.items()}
    behind = names.get(background) or ",".join(f"{channel:g}" for channel in background)
    return (
        f"scored on {protocol['views']} {protocol['split']} view"
        f"{'' if protocol['views'] == 1 else 's'} over {behind}, {protocol['pixels']}"
    )


@contextlib.contextmanager
def stopped(bar: ProgressBar) -> Iterator[None]:
    """Stop a bar at the end. It starts with the first progress: a mistake before is one line."""
    try:
        yield
    finally:
        if bar.live.is_started:
            bar.stop()


def scored(
    splats: Splats,
    capture: Capture,
    split: str,
    background: tuple[float, float, float],
    backend: str,
    shown: bool,
) -> tuple[dict[str, Any], list[ScoredView]]:
    """The scores, and the views that go on a contact sheet."""
    views = capture.test_views if split == "test" else capture.train_views
    wanted = sheet_names([view.name for view in views])
    sheet: list[ScoredView] = []
    bar = ProgressBar(
        TextColumn("score {task.completed}/{task.total}"),
        BarColumn(bar_width=30),
        console=error_console(),
        disable=not shown,
        transient=True,
    )
    task = bar.add_task("score", total=len(views))
    with stopped(bar):

        def on_view(scored: ScoredView) -> None:
            bar.start()
            bar.advance(task)
            if scored.name in wanted:
                sheet.append(scored)

        scores = evaluate(splats, capture, split, background, backend, on_view)
    return scores, sheet


def picture_name(view_name: str, suffix: str) -> Path:
    """A view's name as a relative path that cannot leave the folder it is joined to."""
    return Path(relative_name(view_name)).with_suffix(suffix)
