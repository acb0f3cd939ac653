"""``igsr weights``: list, download and locate the weights of pose networks."""

from __future__ import annotations

from typing import Annotated

import typer

from igsr.cameras.weights import KNOWN, cache_folder, fetch_weights, known_weights, weights_path
from igsr.cli.error_messages import error_messages, print_message
from igsr.cli.options import JsonOption
from igsr.cli.output import output_console, print_json

app = typer.Typer(
    help="List, download and locate the weights of pose networks.", no_args_is_help=True
)

NameArgument = Annotated[str, typer.Argument(metavar="NAME", help=f"One of {', '.join(KNOWN)}.")]


@app.command("list")
def list_command(as_json: JsonOption = False) -> None:
    """List known weights, their licenses, and which are downloaded."""
    with error_messages():
        rows = [
            {
                "name": one.name,
                "estimator": one.estimator,
                "license": one.license,
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
                f"{one.name:15} {one.size / 1e9:4.2f} GB  {one.license:16} {state:14}  "
                f"--estimator {one.estimator}: {one.purpose}",
                soft_wrap=True,
            )
        console.print(f"cache: {cache_folder()}", style="dim", soft_wrap=True)


@app.command("fetch")
def fetch_command(name: NameArgument) -> None:
    """Download weights NAME to the cache, check them and print their path."""
    with error_messages(lambda: "Interrupted; the unfinished download is deleted."):
        weights = known_weights(name)
        if weights.fetched:
            print_message(f"{name} is published under {weights.license}: {weights.page}")
        path = fetch_weights(name)
    typer.echo(path)


@app.command("path")
def path_command(name: NameArgument) -> None:
    """Print the path of the downloaded weights NAME."""
    with error_messages():
        path = weights_path(name)
    typer.echo(path)
