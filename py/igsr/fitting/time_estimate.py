"""How long a fit takes on this machine: a few steps are timed, the rest is counted."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from igsr import _core
from igsr.fitting.initialization.plane_sweep import MOST_SWEPT
from igsr.fitting.settings import FitSettings

#: Sides in pixels of the two photos that steps are timed on, and numbers of splats before them.
#: Three timings tell what a step, a pixel and a splat cost.
SIDES = (128, 384)
SPLATS = (2_000, 20_000)
#: Steps timed of each, after one that is not.
TIMED = 3
#: Splats cover their photo so often: as those of fitted scenes do. Photos with alpha show nothing
#: in much of their area.
COVER, COVER_OF_ALPHA = 40.0, 18.0
#: Part of the most splats that fits start with, from which step on they have as many as they come
#: to, and how many of the most that mostly is.
START_PART, GROWN, REACHED = 0.5, 0.5, 0.95
#: Splats per pixel that fits without a limit of their own come to, at most.
UNLIMITED_PER_PIXEL = 0.5
#: Seconds of a photo's depth map, and of a scored photo's pixel, on a machine whose steps take as
#: long as ``USUAL``; others are as many times as fast as their steps.
SWEPT, SCORED = 0.4, 2e-6
#: Parts that steps are counted in.
PARTS = 50


@dataclass(frozen=True)
class StepTime:
    """What an optimizer step takes, in seconds.

    Attributes:
        fixed: any step.
        per_pixel: each pixel of its photo.
        per_splat: each splat.
    """

    fixed: float
    per_pixel: float
    per_splat: float

    def of(self, pixels: float, splats: float) -> float:
        """A step on a photo of so many pixels, with so many splats."""
        return self.fixed + self.per_pixel * pixels + self.per_splat * splats


#: What steps take on two cores.
USUAL = StepTime(1e-3, 7e-8, 4e-7)
#: What part of that they take on photos with alpha.
USUAL_OF_ALPHA = 0.6


def timed_steps(backend: str, sh_degree: int = 1, alpha: bool = False) -> StepTime:
    """Time a few steps on made-up photos and splats; takes about a second.

    Args:
        backend: "cpu" or "gpu".
        sh_degree: of the fit.
        alpha: whether the photos have alpha.

    Raises:
        RuntimeError: no adapter answers for backend "gpu".
    """
    small, large = SIDES[0] ** 2, SIDES[1] ** 2
    few, many = SPLATS
    cover = COVER_OF_ALPHA if alpha else COVER
    base = _timed(backend, SIDES[0], few, sh_degree, cover)
    more_pixels = _timed(backend, SIDES[1], few, sh_degree, cover)
    more_splats = _timed(backend, SIDES[1], many, sh_degree, cover)
    per_pixel = max(0.0, more_pixels - base) / (large - small)
    per_splat = max(0.0, more_splats - more_pixels) / (many - few)
    return StepTime(max(0.0, base - per_pixel * small - per_splat * few), per_pixel, per_splat)


def fit_seconds(
    settings: FitSettings, width: float, height: float, step: StepTime, until: int | None = None
) -> float:
    """Seconds that the steps of a fit take.

    Args:
        settings: of the fit.
        width, height: of its photos, pixels.
        step: what steps take on this machine.
        until: count the steps before this one; None counts all.
    """
    seconds, longest = 0.0, round(max(width, height))
    most = min(settings.max_splats, UNLIMITED_PER_PIXEL * width * height)
    if settings.density == "fixed":
        most = settings.max_splats
    first = settings.first_step
    for part in range(PARTS):
        progress = (part + 0.5) / PARTS
        at = first + int(progress * (settings.steps - first))
        by = _core.reduction(settings.steps, settings.coarse_to_fine, at, longest)
        grown = 1.0 if settings.density == "fixed" else min(1.0, progress / GROWN)
        splats = most * (START_PART + (REACHED - START_PART) * grown)
        begins = first + part * (settings.steps - first) / PARTS
        steps = (settings.steps - first) / PARTS
        if until is not None:
            steps = min(steps, max(0.0, until - begins))
        seconds += steps * step.of(width * height / by**2, splats)
    return seconds


def work_done(settings: FitSettings, width: float, height: float, step: int) -> float:
    """Part of a fit's time, in [0, 1], that its first steps take: late ones have more splats.

    Args:
        settings: of the fit.
        width, height: of its photos, pixels.
        step: number of steps done.
    """
    whole = fit_seconds(settings, width, height, USUAL)
    first = settings.first_step
    if step >= settings.steps or whole <= 0.0:
        return 1.0
    return fit_seconds(settings, width, height, USUAL, until=max(first, step)) / whole


def times_usual(step: StepTime, alpha: bool) -> float:
    """How many times as long as usual a step takes on this machine.

    Args:
        step: of ``timed_steps``.
        alpha: whether it was timed for photos with alpha.
    """
    work = (float(SIDES[1] ** 2), float(SPLATS[1]))
    return step.of(*work) / USUAL.of(*work) / (USUAL_OF_ALPHA if alpha else 1.0)


def other_seconds(photos: int, scored: int, pixels: float, times: float = 1.0) -> float:
    """Seconds that a run takes beside the steps: depth maps before them, and scores after.

    Args:
        photos: number of photos that depth maps are found for.
        scored: number of photos scored.
        pixels: of a photo.
        times: how many times as long as usual this machine takes.
    """
    return times * (SWEPT * min(photos, MOST_SWEPT) + SCORED * scored * pixels)


def _timed(backend: str, side: int, splats: int, sh_degree: int, cover: float) -> float:
    """Seconds of a step: the least of some."""
    random = np.random.default_rng(0)
    # Before a camera at the origin that sees from -1 to 1 at depth 1.
    depth = random.uniform(2.0, 4.0, size=splats)
    means = np.stack([random.uniform(-1.0, 1.0, splats) * depth for _ in range(2)] + [depth], 1)
    # Three standard deviations to all sides, about, are rasterized.
    radius = np.sqrt(cover * 4.0 / (np.pi * splats)) / 3.0 * depth
    state = {
        "means": means.astype(np.float32),
        "quats": random.normal(size=(splats, 4)).astype(np.float32),
        "scales": np.log(radius[:, None] * random.uniform(0.3, 1.7, (splats, 3))).astype(
            np.float32
        ),
        "opacities": random.normal(size=splats).astype(np.float32),
        "sh": random.normal(0.0, 0.3, (splats, (sh_degree + 1) ** 2, 3)).astype(np.float32),
    }
    config = {"steps": 10 * TIMED, "sh_degree": sh_degree, "density": "fixed"}
    image = random.integers(0, 256, (side, side, 3), dtype=np.uint8)
    intrinsics = np.array([[side / 2.0] * 4])
    fitter = _core.Fitter(
        [image], [None], [None], [(1, None)], np.eye(4)[None], intrinsics, state, config, backend
    )
    fitter.step(1)
    least = np.inf
    for _ in range(TIMED):
        began = time.perf_counter()
        fitter.step(1)
        least = min(least, time.perf_counter() - began)
    return float(least)
