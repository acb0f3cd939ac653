"""W4: growth of a fit step's time and memory with splats and pixels.

Each point runs in its own process, for its own peak memory. The scene is a ball of splats whose
density does not depend on their number, the photo is noise.
"""

from __future__ import annotations

import gc
from collections.abc import Sequence
from typing import Any

import numpy as np

from igsr._internal.peak_memory import forget_peak, peak_bytes
from igsr._internal.worker_processes import in_a_process
from igsr.errors import IgsrError
from igsr_lab.bench.comparison import errors_row, size_row
from igsr_lab.bench.fit_rows import Shot, fit_step_ms, step_rows
from igsr_lab.bench.scenes import ball, upstream
from igsr_lab.bench.stage_rows import compare, runs_on_cores, timing_row

#: Numbers of splats, at GROWN_SIDE pixels a side.
COUNTS = (10_000, 30_000, 100_000, 300_000, 1_000_000)
GROWN_SIDE = 512
#: Sides in pixels, at GROWN_COUNT splats.
SIDES = (256, 512, 1024, 2048)
GROWN_COUNT = 100_000
#: Splats and sides for software drivers: minutes, not hours.
SMALL_POINTS = ((10_000, 256), (30_000, 256), (10_000, 512))
#: Splats and side for the comparison with the custom loop.
PAIR = (20_000, 400)
SH_DEGREE = 2
#: So few splats that the picture's buffers take almost all memory.
EMPTY = 16
#: Larger points do not run if a step takes longer.
STEP_SECONDS = 20.0
#: Number of crops that are compared with the reference.
CROPS = 64
#: Time that a point is repeated.
POINT_SECONDS = 1.0


def points() -> list[tuple[int, int]]:
    """Splats and side of every point, the smaller first."""
    return [(count, GROWN_SIDE) for count in COUNTS] + [
        (GROWN_COUNT, side) for side in SIDES if side != GROWN_SIDE
    ]


def shot_of(seed: int, count: int, side: int) -> Shot:
    """A ball of splats and a photo of noise."""
    random = np.random.default_rng([seed, side])
    photo = random.integers(0, 256, (side, side, 3), dtype=np.uint8)
    return Shot(ball(seed, count, side, side, SH_DEGREE), photo)


def parameter_bytes(count: int) -> int:
    """Size of the parameters: 11 numbers for shape and place, and the SH coefficients."""
    return 4 * count * (11 + 3 * (SH_DEGREE + 1) ** 2)


def measure(seed: int, count: int, side: int, backend: str, seconds: float) -> dict[str, Any]:
    """Time, memory if it is known, and error of one point; for its own process."""
    shot = shot_of(seed, count, side)
    # Threads and devices, which are opened once, are not the fit's.
    fit_step_ms(shot_of(seed, EMPTY, 16), backend, 0.0)
    # The process's size does not include a device's memory or memory below an earlier peak.
    memory: dict[str, int] = {}
    gc.collect()
    if runs_on_cores(backend) and forget_peak() and (before := peak_bytes()) is not None:
        times = fit_step_ms(shot, backend, seconds)
        memory["peak_bytes"] = (peak_bytes() or before) - before
    else:
        times = fit_step_ms(shot, backend, seconds)
    v_image = upstream(seed, side, side)
    comparison, _ = compare(shot.scene, backend, v_image, evenly_chosen)
    return {
        **size_row("W4", backend, count, side, side),
        "pass": "fit step",
        **timing_row(np.array(times), backend, None),
        **memory,
        **errors_row("gradients", comparison.gradients, comparison.band, comparison.picture),
    }


def evenly_chosen(crops: list[Any]) -> list[Any]:
    """Choose ``CROPS`` of the crops."""
    if len(crops) <= CROPS:
        return crops
    return [crops[i] for i in np.linspace(0, len(crops) - 1, CROPS).round().astype(int)]


def growth_rows(
    backend: str,
    seed: int,
    grid: Sequence[tuple[int, int]] | None = None,
    seconds: float = POINT_SECONDS,
    name: str = "W4",
) -> list[dict[str, Any]]:
    """W4: the rows of all points; ``name`` is the workload's."""
    rows: list[dict[str, Any]] = []
    buffers: dict[int, int] = {}
    too_slow: tuple[int, int] | None = None
    for count, side in points() if grid is None else grid:
        common = size_row(name, backend, count, side, side) | {"pass": "fit step"}
        if too_slow is not None and count >= too_slow[0] and side >= too_slow[1]:
            reason = (
                f"{too_slow[0]} splats at {too_slow[1]} x {too_slow[1]} took more than "
                f"{STEP_SECONDS:g} s a step already"
            )
            rows.append({**common, "not_run": reason})
            continue
        try:
            row = in_a_process(measure, seed, count, side, backend, seconds) | {"workload": name}
            if "peak_bytes" in row:
                if side not in buffers:
                    empty = in_a_process(measure, seed, EMPTY, side, backend, 0.0)
                    buffers[side] = empty["peak_bytes"]
                row |= {
                    "image_bytes": buffers[side],
                    "bytes_per_splat": max(0, row["peak_bytes"] - buffers[side]) / count,
                    # 2 x parameters + gradients + optimizer state.
                    "contract_bytes_per_splat": 5 * parameter_bytes(1),
                }
        except (IgsrError, RuntimeError) as error:  # the GPU raises RuntimeError
            rows.append({**common, "not_run": f"the fit failed: {error}"})
            continue
        rows.append(row)
        if row["ms"] > 1e3 * STEP_SECONDS:
            too_slow = (count, side)
    return rows


def pair_rows(backend: str, seed: int, seconds: float, pair: tuple[int, int] = PAIR) -> Any:
    """A step of the built-in fit and one of the custom loop, on W4's scene."""
    return step_rows("W4", [shot_of(seed, *pair)], backend, seconds)
