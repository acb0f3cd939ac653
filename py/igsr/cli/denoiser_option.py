"""The option that names a denoiser of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from igsr.errors import IgsrError

if TYPE_CHECKING:
    from igsr.denoiser import Denoiser

DenoiserOption = Annotated[
    str | None,
    typer.Option(
        "--denoiser",
        metavar="MODULE:FACTORY",
        help="A denoiser of your own: a function of a Python module or file that makes it.",
    ),
]


def chosen_denoiser(name: str, weights: Path | None) -> Denoiser:
    """The denoiser of that name.

    Raises:
        IgsrError: ``weights`` are given, too, or as ``igsr.denoiser.named_denoiser``.
    """
    if weights is not None:
        raise IgsrError("--weights is for igsr's denoiser; give it or --denoiser, not both")
    from igsr.denoiser import named_denoiser

    return named_denoiser(name)
