"""The option that chooses a denoiser."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from igsr.cli.options import ADVANCED, option

if TYPE_CHECKING:
    from igsr.denoiser import Denoiser

#: Suffix of weights of igsr's network.
WEIGHTS_SUFFIX = ".safetensors"

DenoiserOption = Annotated[
    str | None,
    option(
        "--denoiser",
        metavar="FILE|MODULE:FACTORY",
        help="Weights (.safetensors), or a function that creates a denoiser.",
        panel=ADVANCED,
    ),
]


def chosen_denoiser(named: str | None, from_weights: Callable[[Path | None], Denoiser]) -> Denoiser:
    """The denoiser of ``--denoiser``; igsr's own if it is None.

    Args:
        named: a file of weights, or "module:factory".
        from_weights: makes igsr's denoiser from a file of weights, or from its own.

    Raises:
        IgsrError: as ``igsr.denoiser.load_network`` and ``igsr.denoiser.named_denoiser``.
    """
    if named is None or named.endswith(WEIGHTS_SUFFIX):
        return from_weights(None if named is None else Path(named))
    from igsr.denoiser import named_denoiser

    return named_denoiser(named)
