"""What the commands share: options, loading, progress bars, output, scores."""

from __future__ import annotations

import contextlib
import enum
import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, overload

import typer

from igsr._internal.choices import Backend, ResolvedBackend, Split
from igsr.errors import IgsrError

# ``igsr info`` and ``igsr convert`` import this module: what takes long to import and only some
# commands need is imported by the function that needs it.
if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as ProgressBar

    from igsr.capture import Capture
    from igsr.evaluation import ScoredView, Scores
    from igsr.splats import Splats

logger = logging.getLogger(__name__)

#: Folder of the example capture, in that of the run that asked for it.
EXAMPLE = "example"
NAMED_COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "grey": (0.5, 0.5, 0.5)}


class BackendChoice(str, enum.Enum):
    """Backends that render."""

    auto = "auto"
    cpu = "cpu"
    gpu = "gpu"
    reference = "reference"


class FitBackendChoice(str, enum.Enum):
    """Backends that fit: the reference renders, but has no optimizer."""

    auto = "auto"
    cpu = "cpu"
    gpu = "gpu"


class PresetChoice(str, enum.Enum):
    """Sets of fit settings."""

    default = "default"
    baseline_3dgs = "3dgs"
    instantsplat = "instantsplat"


class QualityChoice(str, enum.Enum):
    """How much time a fit is worth."""

    draft = "draft"
    normal = "normal"
    high = "high"


class SplitChoice(str, enum.Enum):
    """Train or test views of a capture."""

    train = "train"
    test = "test"


BackendOption = Annotated[
    BackendChoice,
    typer.Option(
        "--backend",
        help="auto: the GPU if there is a real one, else the CPU. reference: 64-bit floats, slow.",
    ),
]
FitBackendOption = Annotated[
    FitBackendChoice,
    typer.Option("--backend", help="auto: the GPU if there is a real one, else the CPU."),
]
BackgroundOption = Annotated[
    str | None,
    typer.Option(
        "--background",
        metavar="COLOR",
        help="Color behind renders and behind photos with alpha: white, black, grey, or R,G,B "
        "from 0 to 1. Default: white if photos have alpha, else black.",
    ),
]
HoldoutOption = Annotated[
    int | None,
    typer.Option(
        "--holdout",
        "--test-every",
        metavar="N",
        help="Hold out every Nth photo for testing, such as 8.",
    ),
]
MaxSizeOption = Annotated[
    int | None,
    typer.Option(
        "--max-size",
        metavar="N",
        help="Load photos whose longest side has more than N pixels reduced to that. Default: as "
        "they are.",
    ),
]
FitSizeOption = Annotated[
    int | None,
    typer.Option(
        "--max-size",
        metavar="N",
        help="Fit photos whose longest side has more than N pixels reduced to that. Default: 1000 "
        "on the CPU, 1600 on a GPU, times 0.6 for --quality draft and 1.6 for high.",
    ),
]
QualityOption = Annotated[
    QualityChoice,
    typer.Option(
        "--quality", help="Size of photos, steps and splats, where these options do not say."
    ),
]
SeedOption = Annotated[
    int, typer.Option("--seed", help="Random seed. Results are deterministic for a given seed.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]
ExampleOption = Annotated[
    bool,
    typer.Option(
        "--example",
        help=f"Take igsr's example capture: eight photos of a tea table, and eight held-out ones. "
        f"They are written to --out/{EXAMPLE}.",
    ),
]
CaptureArgument = Annotated[
    Path, typer.Argument(metavar="CAPTURE", help="Folder or file with photos and cameras.")
]
SceneArgument = Annotated[
    Path,
    typer.Argument(metavar="SCENE", help="Splat file: .ply, .splat, .ksplat, .spz, .sog or .glb."),
]


@overload
def resolved(backend: FitBackendChoice) -> Literal["cpu", "gpu"]: ...
@overload
def resolved(backend: BackendChoice) -> ResolvedBackend: ...
def resolved(backend: BackendChoice | FitBackendChoice) -> ResolvedBackend:
    """The name of the backend that runs: "cpu", "gpu" or "reference".

    Raises:
        RuntimeError: backend gpu was asked for and no adapter answers.
    """
    from igsr import _core

    name = _core.resolve_backend(backend.value)
    logger.info("backend %s: %s", name, _core.backend_info(name)["device"])
    return name


def background_color(text: str | None) -> tuple[float, float, float] | None:
    """RGB in [0, 1] of ``--background``; None for the default.

    Raises:
        IgsrError: the text is neither a name nor three numbers.
    """
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


def load(path: Path, holdout: int | None, max_size: int | None = None) -> Capture:
    """Load a capture; hold out every ``holdout``-th view if that is given.

    Photos are reduced to ``max_size`` pixels of their longest side, if that is given.

    Raises:
        IgsrError: as ``load_capture`` and ``Capture.with_holdout``.
    """
    from igsr.capture import load_capture

    capture = load_capture(path, max_size)
    return capture if holdout is None else capture.with_holdout(holdout)


def error_console() -> Console:
    """The console for progress: stderr."""
    from rich.console import Console

    return Console(file=sys.stderr, highlight=False)


def output_console() -> Console:
    """The console for results: stdout."""
    from rich.console import Console

    # Without soft wrapping, long paths would be broken into lines.
    return Console(file=sys.stdout, highlight=False, soft_wrap=True)


def print_json(value: dict[str, Any]) -> None:
    """Print one JSON object on stdout."""
    import json

    print(json.dumps(value, indent=2, allow_nan=False))


def score_line(scores: dict[str, Any]) -> str:
    """Mean scores in one line."""
    parts = [
        f"PSNR {scores['psnr']:.2f} dB",
        f"SSIM {scores['ssim']:.4f}",
        "MS-SSIM " + (f"{scores['ms_ssim']:.4f}" if scores["ms_ssim"] is not None else "-"),
        f"FLIP {scores['flip']:.4f}",
        f"color-corrected PSNR {scores['cc_psnr']:.2f} dB SSIM {scores['cc_ssim']:.4f}",
    ]
    return "   ".join(parts)


def fitted_line(train: dict[str, Any]) -> str:
    """Scores of fitted photos in one line; ``train`` as reports have it."""
    of = "" if train["views"] == train["of"] else f", {train['views']} of {train['of']}"
    return f"fitted photos{of}: PSNR {train['psnr']:.2f} dB   SSIM {train['ssim']:.4f}"


def parts_line(parts: dict[str, dict[str, Any]]) -> str:
    """Seconds and peak memory of each part in one line; ``parts`` as reports have them."""

    def written(name: str, part: dict[str, Any]) -> str:
        peak = part["peak_memory_bytes"]
        memory = "" if peak is None else f" {peak / 2**30:.1f} GiB"
        return f"{name} {part['seconds']:.1f} s{memory}"

    return ", ".join(written(name, part) for name, part in parts.items())


#: What the kinds of floaters are, as ``igsr.floaters.Cleaned`` names them.
_FLOATERS = {
    "unseen": "that no photo shows",
    "masked": "that masks hide",
    "floating": "floating before the surface",
    "invisible": "too faint to be drawn",
    "alone": "with few others near",
}


def removed_line(removed: dict[str, int]) -> str:
    """How many floaters of which kind are removed, as one line.

    Args:
        removed: as ``igsr.floaters.Cleaned`` has it.
    """
    kinds = (f"{count} {_FLOATERS[kind]}" for kind, count in removed.items())
    return f"removed {sum(removed.values())} splats: {', '.join(kinds)}"


def masked_line(masked: dict[str, float], photos: int) -> str:
    """In how many photos transient things are masked, as one line.

    Args:
        masked: part of each photo that is masked, by name.
        photos: number of photos.
    """
    most = max(masked, key=lambda name: masked[name])
    return (
        f"transient things masked in {len(masked)} of {photos} photos, most in {most} "
        f"({100.0 * masked[most]:.1f} %)"
    )


def protocol_line(protocol: dict[str, Any]) -> str:
    """How views were scored, in one line; ``protocol`` as ``Scores.protocol``."""
    background = tuple(protocol["background"])
    names = {color: name for name, color in NAMED_COLORS.items()}
    behind = names.get(background) or ",".join(f"{channel:g}" for channel in background)
    some = f" of {protocol['of']}" if "of" in protocol else ""
    return (
        f"scored on {protocol['views']}{some} {protocol['split']} view"
        f"{'' if protocol['views'] == 1 else 's'} over {behind}, {protocol['pixels']}"
    )


@contextlib.contextmanager
def stopped(bar: ProgressBar) -> Iterator[None]:
    """Stop a progress bar at the end, if it was started.

    The caller starts it with the first progress, so that an error before that is a single line.
    """
    try:
        yield
    finally:
        if bar.live.is_started:
            bar.stop()


def scored(
    splats: Splats,
    capture: Capture,
    split: Split,
    background: tuple[float, float, float],
    backend: Backend,
    shown: bool,
) -> tuple[Scores, list[ScoredView]]:
    """Scores of a split, and the views for a contact sheet; with a progress bar if ``shown``.

    Raises:
        IgsrError: as ``evaluate``.
    """
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as ProgressBar

    from igsr.evaluation.contact_sheet import sheet_names
    from igsr.evaluation.scores import evaluate

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
    """A view's name with another suffix, as a relative path without ``..``.

    Joined to a folder it stays inside.
    """
    from igsr.capture.write_files import relative_name

    return Path(relative_name(view_name)).with_suffix(suffix)


def photos_or_example(named: Path | None, is_example: bool, out: Path, argument: str) -> Path:
    """The photos that a command line names, or the example capture, which is written into ``out``.

    Args:
        named: path of photos, or None.
        is_example: whether --example was given.
        out: the folder of the run.
        argument: what the help calls the path.

    Raises:
        IgsrError: neither or both were given, or the example cannot be written.
    """
    if named is None and not is_example:
        raise IgsrError(f"{argument} is missing; name a folder of photos, or give --example")
    if named is None:
        from igsr.capture.example import write_example

        return write_example(out / EXAMPLE)
    if is_example:
        raise IgsrError(f"--example takes the place of {argument}; leave {named} or --example out")
    return named
