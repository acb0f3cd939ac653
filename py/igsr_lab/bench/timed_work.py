"""What two builds are compared by: stages (W1) and whole fit steps (W4), timed and checked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from igsr import _core
from igsr_lab.bench.fit_rows import fit_step_ms
from igsr_lab.bench.growth import evenly_chosen, shot_of
from igsr_lab.bench.scenes import Arrays, splats2d, upstream
from igsr_lab.bench.stage_rows import compare, repeated, w1_comparison

#: Splats and side of the pictures of W1.
STAGES = (20_000, 400)
#: Splats and sides of the fit steps.
STEPS = ((20_000, 400), (100_000, 512), (1_000_000, 512), (100_000, 2048))

#: Of each pass: milliseconds of every repeat; or largest and mean error.
Figures = dict[str, list[float]]


@dataclass(frozen=True)
class TimedWork:
    """One workload at one size.

    Attributes:
        name: such as "W4 20000 400".
        workload: "W1" or "W4".
        splats: how many.
        side: of the picture, pixels.
        times: milliseconds of each pass's repeats, of about so many seconds.
        errors: largest and mean error of each pass against the f64 reference.
    """

    name: str
    workload: str
    splats: int
    side: int
    times: Callable[[float], Figures]
    errors: Callable[[], Figures]


def all_work(
    workloads: list[str], backend: str, seed: int, most_splats: int = 1_000_000
) -> list[TimedWork]:
    """The workloads of one backend.

    Args:
        workloads: "W1", "W4" or both.
        backend: a resolved name.
        seed: of all that is drawn.
        most_splats: larger ones are left out.
    """
    sizes = [("W1", *STAGES)] * ("W1" in workloads)
    sizes += [("W4", *size) for size in STEPS if "W4" in workloads]
    make = {"W1": _stages, "W4": _step}
    return [
        make[workload](f"{workload} {count} {side}", backend, seed, count, side)
        for workload, count, side in sizes
        if count <= most_splats
    ]


def _stages(name: str, backend: str, seed: int, count: int, side: int) -> TimedWork:
    own = splats2d(seed, count, side, side)
    dtype = _core.working_dtype(backend)
    v_own: Arrays = {key: v.astype(dtype) for key, v in upstream(seed, side, side).items()}
    background = np.zeros(3, dtype)

    def times(seconds: float) -> Figures:
        found = repeated(
            lambda n: _core.time_rasterize(
                {key: array.astype(dtype) for key, array in own.items()},
                width=side,
                height=side,
                **v_own,
                background=background,
                backend=backend,
                repeats=n,
            ),
            seconds,
        )
        return {key: ms.tolist() for key, ms in found.items()}

    def errors() -> Figures:
        picture, gradients, *_ = w1_comparison(backend, seed, count, side)
        return {
            "rasterize": [picture.max, picture.mean],
            "rasterize_backward": [gradients.max, gradients.mean],
        }

    return TimedWork(name, "W1", count, side, times, errors)


def _step(name: str, backend: str, seed: int, count: int, side: int) -> TimedWork:
    # A million splats are drawn when they are first asked for, once.
    @cache
    def shot() -> Any:
        return shot_of(seed, count, side)

    def times(seconds: float) -> Figures:
        return {"fit step": fit_step_ms(shot(), backend, seconds)}

    def errors() -> Figures:
        comparison, _ = compare(shot().scene, backend, upstream(seed, side, side), evenly_chosen)
        return {"fit step": [comparison.gradients.max, comparison.gradients.mean]}

    return TimedWork(name, "W4", count, side, times, errors)
