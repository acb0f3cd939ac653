"""Fine-tuning of pruned models."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.capture import View
from igsr.errors import IgsrError
from igsr.fitting.fitter import fitter_of
from igsr.splats import PARAMETERS, Splats

#: Parameters of splats with the optimizer's moments, as ``_core.Fitter`` takes and returns them.
State = dict[str, npt.NDArray[Any]]

#: Steps after which a fit adds an SH degree. Fine-tuning starts at a step that has all degrees.
STEPS_PER_DEGREE = 1000
#: Steps between progress callbacks and checks for Ctrl-C.
CHUNK_STEPS = 10
MOMENTS = ("first_", "second_")


def fresh_state(splats: Splats) -> State:
    """Make an optimizer state with zero moments."""
    state: State = {name: np.ascontiguousarray(getattr(splats, name)) for name in PARAMETERS}
    for moment in MOMENTS:
        state |= {moment + name: np.zeros_like(state[name]) for name in PARAMETERS}
    for name in ("stats_grad_sum", "stats_seen"):
        state[name] = np.zeros(len(splats), np.float32)
    return state


def subset(state: State, indices: npt.NDArray[np.intp]) -> State:
    """Select the splats at ``indices`` [M] and their moments."""
    return {name: array[indices] for name, array in state.items() if name != "step"}


def with_sh_degree(state: State, degree: int) -> State:
    """Remove SH bands above ``degree``, or add zero bands up to it."""
    bands = (degree + 1) ** 2
    changed = {f"{prefix}sh" for prefix in ("", *MOMENTS)}

    def fitted(sh: npt.NDArray[Any]) -> npt.NDArray[Any]:
        missing = max(0, bands - sh.shape[1])
        return np.ascontiguousarray(np.pad(sh[:, :bands], ((0, 0), (0, missing), (0, 0))))

    return {name: fitted(array) if name in changed else array for name, array in state.items()}


def splats_of(state: State, origin: npt.NDArray[np.float64]) -> Splats:
    """Return the splats of a state."""
    return Splats(**{name: state[name] for name in PARAMETERS}, origin=origin, antialiased=False)


def refined(
    state: State,
    origin: npt.NDArray[np.float64],
    views: list[View],
    steps: int,
    settle: bool,
    seed: int,
    backend: str,
    on_steps: Callable[[int], None],
) -> State:
    """Fine-tune ``state`` to ``views`` without changing the number of splats.

    Args:
        state: the start; finite, at least one splat.
        origin: float64 [3], of the means, world units.
        views: photos; photos with alpha are over a new random color in each step.
        steps: optimizer steps.
        settle: whether the learning rate of the means decays to its final value; False hardly
            decays it, since another pruning round follows.
        seed: of the order of views and the colors.
        backend: "auto", "cpu" or "gpu".
        on_steps: called with the number of steps done.
    """
    degree = round(state["sh"].shape[1] ** 0.5) - 1
    # The learning rates of the last third of a fit suit a nearly correct model.
    first = max(STEPS_PER_DEGREE * degree, -(-steps // 2))
    settings = {
        "steps": first + steps if settle else 3 * (first + steps),
        "seed": seed,
        "sh_degree": degree,
        "max_splats": len(state["means"]),
        "density": "fixed",
    }
    start = {**state, "step": np.array([first], np.uint32)}
    try:
        fitter = fitter_of(views, origin, start, settings, backend)
        while (done := fitter.steps_done - first) < steps:
            fitter.step(min(CHUNK_STEPS, steps - done))
            on_steps(fitter.steps_done - first)
    except ValueError as error:
        raise IgsrError(f"{error}.") from error
    return fitter.state()
