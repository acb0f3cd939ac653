"""``igsr weights``: list, download and find the weights of pose networks, and train some."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from igsr.cli.error_messages import error_messages, print_message
from igsr.cli.settings_options import ConfigOption, settings_options
from igsr.cli.shared import JsonOption, TimeLeft, error_console, output_console, print_json
from igsr.cli.training_bar import training_bar
from igsr.errors import IgsrError
from igsr.pose.da3.training.training_settings import PoseTraining
from igsr.pose.huggingface_cache import cache_folder
from igsr.pose.weights import KNOWN, fetch_weights, known_weights, weights_path

app = typer.Typer(
    help="List, download, find and train the weights of pose networks.", no_args_is_help=True
)

NameArgument = Annotated[str, typer.Argument(metavar="NAME", help=f"One of {', '.join(KNOWN)}.")]


@app.command("list")
def list_command(as_json: JsonOption = False) -> None:
    """List the weights that igsr can use, their licences, and which are downloaded."""
    with error_messages():
        rows = [
            {
                "name": one.name,
                "estimator": one.estimator,
                "licence": one.licence,
                "bytes": one.size,
                "page": one.page,
                "purpose": one.purpose,
                "path": None if one.path is None else str(one.path),
            }
            for one in KNOWN.values()
        ]
        if as_json:
            print_json({"cache": str(cache_folder()), "weights": rows})
            return
        console = output_console()
        for one in KNOWN.values():
            state = "downloaded" if one.path else "not downloaded"
            console.print(
                f"{one.name:15} {one.size / 1e9:4.2f} GB  {one.licence:16} {state:14}  "
                f"--estimator {one.estimator}: {one.purpose}",
                soft_wrap=True,
            )
        console.print(f"cache: {cache_folder()}", style="dim", soft_wrap=True)


@app.command("fetch")
def fetch_command(name: NameArgument) -> None:
    """Download weights NAME to the cache, check them, and print where they are."""
    with error_messages(lambda: "Interrupted; nothing unfinished is kept."):
        weights = known_weights(name)
        if weights.fetched:
            print_message(f"{name} is published under {weights.licence}: {weights.page}")
        path = fetch_weights(name)
    typer.echo(path)


@app.command("path")
def path_command(name: NameArgument) -> None:
    """Print where the downloaded weights NAME are."""
    with error_messages():
        path = weights_path(name)
    typer.echo(path)


@app.command("train")
@settings_options(PoseTraining)
def train_command(
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for weights, log and checkpoint.")
    ],
    given: dict[str, Any],
    captures_in: Annotated[
        Path | None,
        typer.Option(
            "--captures-in",
            metavar="DIR",
            help="Folder where captures are kept. Default: captures in --out.",
        ),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option("--jobs", help="Captures made at the same time, a core each. Default: all."),
    ] = None,
    device: Annotated[
        str, typer.Option("--device", help="Where to train, as torch names it: cpu, cuda ...")
    ] = "cpu",
    log_every: Annotated[int, typer.Option("--log-every", help="Steps between logged rows.")] = 10,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from the checkpoint in --out.")
    ] = False,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Train a small network like Depth Anything 3 on captures that are made meanwhile.

    For igsr pose --estimator da3 --checkpoint DIR. Needs Mitsuba 3 (pip install 'igsr\\[synth]').
    """
    from igsr.pose.da3.training.train_network import train
    from igsr.training.plot_training import plot_training
    from igsr.training.training_run import CHECKPOINT, LOG

    def interrupted() -> str:
        if (out / CHECKPOINT).is_file():
            return f"Interrupted; go on from the last checkpoint in {out} with --resume."
        return "Interrupted before the first checkpoint; captures that were made are kept."

    with error_messages(interrupted):
        if resume and not (out / CHECKPOINT).is_file():
            raise IgsrError(f"{out} has no checkpoint to go on from; leave out --resume.")
        training = PoseTraining(**given)
        console, time_left = error_console(), TimeLeft()

        def captured(done: int, total: int) -> None:
            left = time_left(done, total)
            console.print(f"{done} of {total} captures to validate on; {left}")

        with training_bar(training.steps) as progress:
            train(
                out,
                training,
                captures=captures_in,
                jobs=(os.cpu_count() or 1) if jobs is None else jobs,
                device=device,
                resume=resume,
                progress=progress,
                captured=captured,
                log_every=log_every,
            )
        rows = plot_training(out / LOG, out / "loss.png")
    last = {name: value for row in rows for name, value in row.items()}
    if as_json:
        print_json(last)
        return
    output_console().print(
        f"validation: turns between photos off by {last['validation_rotation']:.1f} degrees, by "
        f"{last['validation_rotation_constant']:.1f} without looking: {out}",
        markup=False,
    )
