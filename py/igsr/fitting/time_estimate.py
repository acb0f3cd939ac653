"""Estimated time of a fit on this machine, from a few timed steps."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from igsr import _core
from igsr.fitting.initialization.depth_maps import MAX_DEPTH_MAPS, MAX_SIDE_PX
from igsr.fitting.settings import FitSettings

#: Sides of the two photos that steps are timed on, pixels, and the two numbers of splats.
SIDES_PX = (128, 384)
SPLATS = (2_000, 20_000)
#: Steps timed of each, after one that is not; the fastest counts.
TIMED_STEPS = 3
#: Mean number of splats that cover a pixel in fitted scenes; photos with alpha are mostly empty.
COVER = 40.0
COVER_ALPHA = 18.0
#: Number of splats: this fraction of the maximum at first, growing until this fraction of the steps
#: to this fraction of the maximum.
START_FRACTION = 0.5
GROWN_AT = 0.5
GROWN_FRACTION = 0.95
#: Maximum splats per pixel that density control adds without a limit.
MAX_SPLATS_PER_PIXEL = 0.5
#: Number of parts that steps are summed over.
PARTS = 50
#: Seconds for each pixel of a depth map and of a scored photo, at ``TYPICAL`` speed.
DEPTH_SECONDS_PER_PIXEL = 1.5e-5
SCORE_SECONDS_PER_PIXEL = 2e-6
#: Pixels of the depth map of a larger photo.
MAX_DEPTH_MAP_PIXELS = 0.7 * MAX_SIDE_PX**2


@dataclass(frozen=True)
class StepTime:
    """Time of an optimizer step, seconds.

    Attributes:
        fixed: of any step.
        per_pixel: of each pixel of the photo.
        per_splat: of each splat.
    """

    fixed: float
    per_pixel: float
    per_splat: float

    def seconds(self, pixels: float, splats: float) -> float:
        """Return the time of a step."""
        return self.fixed + self.per_pixel * pixels + self.per_splat * splats


#: Two cores, and the factor for photos with alpha.
TYPICAL = StepTime(1e-3, 7e-8, 4e-7)
TYPICAL_ALPHA_FACTOR = 0.6


def timed_steps(backend: str, sh_degree: int = 1, alpha: bool = False) -> StepTime:
    """Time a few steps on random photos and splats, for about a second.

    Args:
        backend: "cpu" or "gpu".
        sh_degree: of the fit.
        alpha: whether the photos have alpha.

    Raises:
        RuntimeError: no adapter answers for backend "gpu".
    """
    small, large = SIDES_PX[0] ** 2, SIDES_PX[1] ** 2
    few, many = SPLATS
    cover = COVER_ALPHA if alpha else COVER
    base = _timed_step(backend, SIDES_PX[0], few, sh_degree, cover)
    more_pixels = _timed_step(backend, SIDES_PX[1], few, sh_degree, cover)
    more_splats = _timed_step(backend, SIDES_PX[1], many, sh_degree, cover)
    per_pixel = max(0.0, more_pixels - base) / (large - small)
    per_splat = max(0.0, more_splats - more_pixels) / (many - few)
    return StepTime(max(0.0, base - per_pixel * small - per_splat * few), per_pixel, per_splat)


def fit_seconds(
    settings: FitSettings, width: float, height: float, step: StepTime, until: int | None = None
) -> float:
    """Estimate the time of a fit's steps.

    Args:
        settings: of the fit.
        width, height: of its photos, pixels.
        step: time of a step on this machine.
        until: only the steps before this one; None for all.
    """
    seconds, longest = 0.0, round(max(width, height))
    is_fixed = settings.density == "fixed"
    limit = min(settings.max_splats, MAX_SPLATS_PER_PIXEL * width * height)
    if is_fixed:
        limit = settings.max_splats
    first = settings.first_step
    for part in range(PARTS):
        progress = (part + 0.5) / PARTS
        at = first + int(progress * (settings.steps - first))
        reduction = _core.reduction(settings.steps, settings.coarse_to_fine, at, longest)
        grown = 1.0 if is_fixed else min(1.0, progress / GROWN_AT)
        splats = limit * (START_FRACTION + (GROWN_FRACTION - START_FRACTION) * grown)
        steps = (settings.steps - first) / PARTS
        if until is not None:
            begins = first + part * (settings.steps - first) / PARTS
            steps = min(steps, max(0.0, until - begins))
        seconds += steps * step.seconds(width * height / reduction**2, splats)
    return seconds


def work_done(settings: FitSettings, width: float, height: float, step: int) -> float:
    """Estimate the fraction of a fit's time, in [0, 1], that its first steps take.

    Args:
        settings: of the fit.
        width, height: of its photos, pixels.
        step: number of steps done.
    """
    whole = fit_seconds(settings, width, height, TYPICAL)
    if step >= settings.steps or whole <= 0.0:
        return 1.0
    until = max(settings.first_step, step)
    return fit_seconds(settings, width, height, TYPICAL, until=until) / whole


def slowdown(step: StepTime, alpha: bool) -> float:
    """Return the time of a step on this machine, as a multiple of the typical one.

    Args:
        step: of ``timed_steps``.
        alpha: whether it was timed for photos with alpha.
    """
    work = (float(SIDES_PX[1] ** 2), float(SPLATS[1]))
    return step.seconds(*work) / TYPICAL.seconds(*work) / (TYPICAL_ALPHA_FACTOR if alpha else 1.0)


def other_seconds(photos: int, scored: int, pixels: float, slowdown: float = 1.0) -> float:
    """Estimate the time of depth maps before a fit and of scores after it.

    Args:
        photos: number of photos to find depth maps for.
        scored: number of photos to score.
        pixels: of a photo.
        slowdown: of this machine.
    """
    in_maps = min(photos, MAX_DEPTH_MAPS) * min(pixels, MAX_DEPTH_MAP_PIXELS)
    return slowdown * (
        DEPTH_SECONDS_PER_PIXEL * in_maps + SCORE_SECONDS_PER_PIXEL * scored * pixels
    )


def _timed_step(backend: str, side: int, splats: int, sh_degree: int, cover: float) -> float:
    """Time of the fastest of some steps, seconds."""
    random = np.random.default_rng(0)
    # In view of a camera at the origin that sees from -1 to 1 at depth 1.
    depth = random.uniform(2.0, 4.0, size=splats)
    means = np.stack([random.uniform(-1.0, 1.0, splats) * depth for _ in range(2)] + [depth], 1)
    # Splats are rasterized to about three standard deviations.
    radius = np.sqrt(cover * 4.0 / (np.pi * splats)) / 3.0 * depth
    scales = radius[:, None] * random.uniform(0.3, 1.7, (splats, 3))
    state = {
        "means": means.astype(np.float32),
        "quats": random.normal(size=(splats, 4)).astype(np.float32),
        "scales": np.log(scales).astype(np.float32),
        "opacities": random.normal(size=splats).astype(np.float32),
        "sh": random.normal(0.0, 0.3, (splats, (sh_degree + 1) ** 2, 3)).astype(np.float32),
    }
    config = {"steps": 10 * TIMED_STEPS, "sh_degree": sh_degree, "density": "fixed"}
    image = random.integers(0, 256, (side, side, 3), dtype=np.uint8)
    intrinsics = np.array([[side / 2.0] * 4])
    fitter = _core.Fitter(
        [image], [None], [None], [(1, None)], np.eye(4)[None], intrinsics, state, config, backend
    )
    fitter.step(1)
    seconds = []
    for _ in range(TIMED_STEPS):
        began = time.perf_counter()
        fitter.step(1)
        seconds.append(time.perf_counter() - began)
    return min(seconds)
