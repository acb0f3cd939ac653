"""Rows of single stages (W1) and of the whole pipeline (W2, accuracy)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr_lab.bench import oracle
from igsr_lab.bench.comparison import (
    BOUND_2D,
    BOUND_3D,
    Band,
    Error,
    errors_row,
    gradient_error,
    picture_error,
    size_row,
)
from igsr_lab.bench.scenes import Arrays, Scene, splats2d, upstream

#: On a shared machine, one of this many repeats is undisturbed.
MIN_REPEATS = 5
#: Measurements that take longer are repeated twice only.
LONG_SECONDS = 10.0
#: Default time that a row is repeated.
SECONDS = 2.0

#: Floating-point operations per blended (splat, pixel) pair, a multiply-add as two: offset 6,
#: exponential 16, alpha and transmittance 3, four channels 8; backward without the channels, plus
#: the channels' gradients 15, alpha's 6 and the six moments 11. Pixels that a splat does not reach
#: are not counted.
FORWARD_OPERATIONS = 33
BACKWARD_OPERATIONS = 57

#: Largest array whose memory Linux's C library keeps after it is freed.
KEPT_BYTES = 32 * 2**20

Times = dict[str, npt.NDArray[np.float64]]


@dataclass(frozen=True)
class Comparison:
    """Errors of one backend's picture and gradients."""

    picture: Error
    gradients: Error
    band: Band


def repeated(measure: Callable[[int], Times], seconds: float) -> Times:
    """Repeat ``measure(1)`` for some seconds, at least ``MIN_REPEATS`` times (2 if it is slow)."""
    # A process that never freed a large array returns pages after each call, and takes 1.5 times as
    # long for W1. Programs that load photos have freed one.
    np.empty(KEPT_BYTES - 2**16, np.uint8)
    started = time.perf_counter()
    parts = [measure(1)]  # also the warm-up: pipelines compile, pages are touched
    least = MIN_REPEATS if time.perf_counter() - started < LONG_SECONDS else 2
    while len(parts) < least or time.perf_counter() - started < seconds:
        parts.append(measure(1))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def runs_on_cores(backend: str) -> bool:
    """Whether a backend runs on the cores that the peak is measured on."""
    return backend != "gpu" or "llvmpipe" in _core.backend_info(backend)["device"].lower()


def timing_row(
    ms: npt.NDArray[np.float64], backend: str, operations: float | None
) -> dict[str, Any]:
    """The time columns of a row; the peak is measured right after it."""
    peak = max(_core.peak_multiply_add(0.01) for _ in range(3))
    row: dict[str, Any] = {
        "ms": float(ms.min()),
        "ms_median": float(np.median(ms)),
        "repeats": len(ms),
        "peak_gflops": peak,
    }
    if operations is not None and runs_on_cores(backend):
        row["gflops"] = operations / (row["ms"] * 1e6)
        row["fraction_of_peak"] = row["gflops"] / peak
    return row


def _masked(v_image: Arrays, left_out: npt.NDArray[np.bool_], known: npt.NDArray[Any]) -> Arrays:
    """Upstream gradients without the pixels that are left out or not compared."""
    keep = ~left_out & np.isfinite(known)
    return {
        name: np.where(keep[..., None] if v.ndim == 3 else keep, v, np.float32(0.0))
        for name, v in v_image.items()
    }


def w1_comparison(
    backend: str, seed: int, count: int, side: int
) -> tuple[Error, Error, Band, Arrays]:
    """Errors of W1's picture and gradients, the band, and the upstream gradients that count."""
    projected = splats2d(seed, count, side, side)
    shape = (side, side)
    background = np.zeros(3)
    dtype = _core.working_dtype(backend)
    exact = {name: array.astype(np.float64) for name, array in projected.items()}
    own = {name: array.astype(dtype) for name, array in projected.items()}
    crops = oracle.crops(exact, side, side)
    expected = oracle.picture(exact, crops, shape, background)
    in_band = oracle.band(exact, crops, shape, oracle.ALPHA_BAND_2D)
    options: dict[str, Any] = {"background": background.astype(dtype), "backend": backend}
    got = _core.rasterize(own, width=side, height=side, **options)
    picture, band = picture_error(got, expected, in_band, BOUND_2D[backend])
    v_image = _masked(upstream(seed, side, side), band.left_out, expected["alpha"])
    v_own = {name: v.astype(dtype) for name, v in v_image.items()}
    v_expected = oracle.gradients2d(exact, crops, expected, v_image, background)
    v_got = _core.rasterize_backward(own, got, **v_own, **options, absolute=False)
    return picture, gradient_error(v_got, v_expected), band, v_own


def rasterize_rows(
    backend: str, seed: int, seconds: float = SECONDS, count: int = 20_000, side: int = 400
) -> list[dict[str, Any]]:
    """W1: rasterize and its backward on 2D splats; both include binning."""
    picture, gradients, band, v_own = w1_comparison(backend, seed, count, side)
    projected = splats2d(seed, count, side, side)
    dtype = _core.working_dtype(backend)
    own = {name: array.astype(dtype) for name, array in projected.items()}
    size: dict[str, Any] = {"width": side, "height": side}
    options: dict[str, Any] = {"background": np.zeros(3, dtype), "backend": backend}
    times = repeated(
        lambda n: _core.time_rasterize(own, **size, **v_own, **options, repeats=n), seconds
    )
    exact = {name: array.astype(np.float64) for name, array in projected.items()}
    pairs = oracle.pair_counts(exact, side, side)
    common = {
        **size_row("W1", backend, count, side, side),
        "tile_pairs": pairs.tiles,
        "pixel_pairs": pairs.pixels,
        "blended_pairs": pairs.blended,
    }
    passes = (
        ("rasterize", FORWARD_OPERATIONS, "picture", picture),
        ("rasterize_backward", BACKWARD_OPERATIONS, "gradients", gradients),
    )
    return [
        {
            **common,
            "pass": name,
            **timing_row(times[name], backend, operations * pairs.blended),
            **errors_row(of, error, band),
        }
        for name, operations, of, error in passes
    ]


def compare(
    scene: Scene, backend: str, v_image: Arrays, chosen: Callable[[list[Any]], list[Any]] = list
) -> tuple[Comparison, Arrays]:
    """Compare a backend's picture and gradients of a scene with the reference.

    Returns the comparison, and the upstream gradients that count; ``chosen`` chooses crops.
    """
    dtype = _core.working_dtype(backend)
    parameters = scene.arrays(dtype)
    projected = _core.project(*parameters, **scene.options(), backend=backend)
    options: dict[str, Any] = {"background": scene.background.astype(dtype), "backend": backend}
    got = _core.rasterize(projected, width=scene.width, height=scene.height, **options)

    def gradients(counted: Arrays) -> Arrays:
        v_own = {name: v.astype(dtype) for name, v in counted.items()}
        v2d = _core.rasterize_backward(projected, got, **v_own, **options, absolute=False)
        return _core.project_backward(
            *parameters, projected, v2d, **scene.options(), backend=backend
        ) | {"v_background": v2d["v_background"]}

    return compare_picture(scene, projected, got, gradients, BOUND_3D[backend], v_image, chosen)


def compare_picture(
    scene: Scene,
    projected: Arrays,
    got: Arrays,
    gradients: Callable[[Arrays], Arrays],
    bound: float,
    v_image: Arrays,
    chosen: Callable[[list[Any]], list[Any]] = list,
) -> tuple[Comparison, Arrays]:
    """Compare a picture ``got`` and its gradients with the reference; see ``compare``.

    ``projected`` are the splats, projected in f32 by one of igsr's backends.
    """
    exact = oracle.project(scene, projected)
    crops = chosen(oracle.crops(exact, scene.width, scene.height))
    expected = oracle.picture(exact, crops, (scene.height, scene.width), scene.background)
    in_band = oracle.band(exact, crops, (scene.height, scene.width), oracle.ALPHA_BAND_3D)
    picture, band = picture_error(got, expected, in_band, bound)
    counted = _masked(v_image, band.left_out, expected["alpha"])
    v2d_expected = oracle.gradients2d(exact, crops, expected, counted, scene.background)
    v_expected = oracle.gradients3d(scene, exact, v2d_expected) | {
        "v_background": v2d_expected["v_background"]
    }
    return Comparison(picture, gradient_error(gradients(counted), v_expected), band), counted


def pipeline_rows(
    workload: str, scene: Scene, backend: str, seed: int, seconds: float = SECONDS
) -> list[dict[str, Any]]:
    """Forward and backward of the whole pipeline, from splats to their gradients."""
    v_image = upstream(seed, scene.width, scene.height)
    comparison, v_image = compare(scene, backend, v_image)
    dtype = _core.working_dtype(backend)
    parameters = scene.arrays(dtype)
    keywords = scene.options() | {name: v.astype(dtype) for name, v in v_image.items()}
    keywords |= {"background": scene.background.astype(dtype), "backend": backend}
    times = repeated(lambda n: _core.time_pipeline(*parameters, **keywords, repeats=n), seconds)
    count = len(scene.splats["means"])
    common = size_row(workload, backend, count, scene.width, scene.height)
    passes = (
        ("forward", ("project", "rasterize"), "picture", comparison.picture),
        ("backward", ("rasterize_backward", "project_backward"), "gradients", comparison.gradients),
    )
    return [
        {
            **common,
            "pass": name,
            **timing_row(times[stages[0]] + times[stages[1]], backend, None),
            "stages_ms": {stage: float(times[stage].min()) for stage in stages},
            **errors_row(of, error, comparison.band),
        }
        for name, stages, of, error in passes
    ]
