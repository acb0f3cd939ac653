"""Let the splats that are left take over what the removed ones showed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..capture import View
from ..errors import IgsrError
from ..fitting import fitter_of
from ..splats import Splats

#: Steps after which a fit from nothing takes up one more SH degree. A refinement begins where all
#: degrees are in use, or it would first unlearn what the model knows of them.
STEPS_PER_DEGREE = 1000
#: Steps between two looks at Ctrl-C and calls of the progress callback.
CHUNK_STEPS = 10
PARAMETERS = ("means", "quats", "scales", "opacities", "sh")


def refined(
    splats: Splats,
    views: list[View],
    steps: int,
    seed: int,
    backend: str,
    on_steps: Callable[[int], None],
) -> Splats:
    """``splats``, as many as they are, after ``steps`` more steps of fitting to ``views``.

    Args:
        splats: where to start; finite, at least one.
        views: what to fit; those with alpha over a new random colour in each step.
        steps: optimiser steps.
        seed: of the order of views and the colours.
        backend: "auto", "cpu" or "gpu".
        on_steps: called with the steps done.

    Raises:
        IgsrError: the views or splats cannot be used; the message names what.
    """
    first = STEPS_PER_DEGREE * splats.sh_degree
    state: dict[str, Any] = {name: getattr(splats, name) for name in PARAMETERS}
    for moment in ("first", "second"):
        state |= {f"{moment}_{name}": np.zeros_like(state[name]) for name in PARAMETERS}
    state["stats_grad_sum"] = np.zeros(len(splats), np.float32)
    state["stats_seen"] = np.zeros(len(splats), np.float32)
    state["step"] = np.array([first], np.uint32)
    settings = {
        "steps": first + steps,
        "seed": seed,
        "sh_degree": splats.sh_degree,
        "max_splats": len(splats),
        "density": "fixed",
    }
    try:
        fitter = fitter_of(views, splats.origin, state, settings, backend)
        while fitter.steps_done < first + steps:
            fitter.step(min(CHUNK_STEPS, first + steps - fitter.steps_done))
            on_steps(fitter.steps_done - first)
    except ValueError as error:
        raise IgsrError(f"{error}.") from error
    return Splats(**fitter.splats(), origin=splats.origin)
