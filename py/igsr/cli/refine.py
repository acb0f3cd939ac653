"""``igsr refine``: from photos to a scene, with views added that nobody photographed."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar

from igsr.capture.photo_folder import FRAMES
from igsr.cli.pose import (
    CameraFinder,
    CheckpointOption,
    EstimatorOption,
    FramesOption,
    GraphOption,
    capture_to_fit,
)
from igsr.cli.shared import (
    BackendChoice,
    BackendOption,
    HoldoutOption,
    JsonOption,
    error_console,
    one_sentence,
    output_console,
    print_json,
    resolved,
    stopped,
    warnings_as_sentences,
)
from igsr.errors import IgsrError
from igsr.pose import AUTO

if TYPE_CHECKING:
    from igsr.capture import Capture
    from igsr.refinement.results import RefineProgress

#: What each part of a round does, for the bar.
_DOING = {
    "fit": "fit",
    "look": "look from where no photo was taken",
    "judge": "judge by photos left out",
    "refit": "fit with the views added",
    "test": "score",
}


def refine_command(
    photos: Annotated[
        Path, typer.Argument(metavar="PHOTOS", help="A folder of photos, or a capture.")
    ],
    out: Annotated[
        Path,
        typer.Option("--out", help="Folder for scene.ply, report.html, report.json, rounds/."),
    ],
    rounds: Annotated[
        str,
        typer.Option("--rounds", help="At most so many, or auto: until one does not help, or 4."),
    ] = AUTO,
    holdout: HoldoutOption = None,
    photo_count: Annotated[
        int | None,
        typer.Option("--photos", help="Use so many of the train photos, evenly spaced."),
    ] = None,
    steps: Annotated[int | None, typer.Option("--steps", help="Of each fit.")] = None,
    backend: BackendOption = BackendChoice.auto,
    seed: Annotated[int, typer.Option("--seed", help="Same seed, same bits.")] = 0,
    weights: Annotated[
        Path | None,
        typer.Option("--weights", metavar="FILE", help="A denoiser. Default: igsr's own."),
    ] = None,
    estimator: EstimatorOption = AUTO,
    network: CheckpointOption = None,
    graph: GraphOption = None,
    frames: FramesOption = FRAMES,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from the checkpoints in --out.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Fit photos, render views that nobody took, clean them, keep what helps, and fit again."""
    from igsr.refinement.loop import check_arguments, refine, round_denoiser

    with one_sentence(
        lambda: f"Interrupted; what is done is in {out}, the same command with --resume goes on."
    ):
        name = resolved(backend)
        most = _rounds(rounds)
        check_arguments(most, steps, name, seed, out, resume)
        denoiser = round_denoiser(weights)
        with warnings_as_sentences():
            capture, _ = capture_to_fit(
                photos,
                out,
                holdout,
                CameraFinder(estimator, network, graph, frames, seed),
                resume=resume,
                shown=not as_json,
            )
        with _bar(shown=not as_json) as show, warnings_as_sentences():
            refined = refine(
                capture if photo_count is None else _some_photos(capture, photo_count),
                most,
                show,
                steps=steps,
                backend=name,
                seed=seed,
                denoiser=denoiser,
                out=out,
                resume=resume,
            )
    accepted = sum(one.accepted for one in refined.rounds)
    tests = [refined.first_test, *(one.test for one in refined.rounds if one.accepted)]
    summary: dict[str, Any] = {
        "accepted": accepted,
        "tried": len(refined.rounds),
        "stopped": refined.stopped,
        "test": tests if refined.first_test else None,
        "splats": len(refined.splats),
        "seconds": {part: round(seconds, 2) for part, seconds in refined.seconds.items()},
        "out": str(out),
    }
    if as_json:
        print_json(summary)
        return
    console = output_console()
    console.print(
        f"{accepted} of {len(refined.rounds)} rounds accepted; stopped: {refined.stopped}",
        markup=False,
    )
    if refined.first_test:
        steps_of = " -> ".join(f"{scores['psnr']:.2f}" for scores in tests if scores)
        console.print(f"PSNR of the test views by round: {steps_of} dB")
    names = ("scene.ply", "report.html", "report.json")
    console.print("  ".join(str(out / file) for file in names), style="dim")


def _some_photos(capture: Capture, count: int) -> Capture:
    """The capture with ``count`` of its train views, evenly spaced, and its test views."""
    from igsr.capture import Capture

    train = capture.train_views
    if not 1 <= count <= len(train):
        raise IgsrError(
            f"--photos must be from 1 to {len(train)}, the train photos of {capture.path}, "
            f"not {count}."
        )
    ids = [(2 * k + 1) * len(train) // (2 * count) for k in range(count)]
    return Capture(capture.path, [train[i] for i in ids] + capture.test_views, capture.points)


def _rounds(text: str) -> int | str:
    if text == AUTO:
        return text
    try:
        return int(text)
    except ValueError:
        raise IgsrError(f"--rounds must be a whole number or auto, not {text!r}.") from None


@contextlib.contextmanager
def _bar(shown: bool) -> Iterator[Callable[[RefineProgress], None]]:
    bar = ProgressBar(
        TextColumn("round {task.fields[round]}"),
        BarColumn(bar_width=30),
        TextColumn("{task.fields[doing]}"),
        TimeRemainingColumn(compact=True),
        console=error_console(),
        disable=not shown,
    )
    task = bar.add_task("refine", total=1.0, round=0, doing="")
    with stopped(bar):

        def show(now: RefineProgress) -> None:
            bar.start()
            bar.update(task, completed=now.done, round=now.round, doing=_DOING[now.doing])

        yield show
