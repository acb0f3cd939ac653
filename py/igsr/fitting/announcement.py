"""Sentences before slow work: the photos, the steps and the estimated time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from igsr.cameras.colmap.estimator import camera_seconds
from igsr.capture.downscaling import reduced_size
from igsr.capture.load import Overview
from igsr.evaluation.quick_scores import MAX_TRAIN_PHOTOS
from igsr.fitting.photo_statistics import PhotoStatistics, detail_of_files
from igsr.fitting.presets import Quality, settings_for
from igsr.fitting.time_estimate import fit_seconds, other_seconds, slowdown, timed_steps

#: Angle between neighboring photos before cameras are known.
ASSUMED_SPACING_DEG = 10.0
#: Time of a refinement's round, as a fraction of a fit's time.
ROUND_FRACTION = 1.5


def announcement(
    seen: Overview,
    *,
    holdout: int | None,
    max_size: int | None,
    quality: Quality,
    given: Mapping[str, Any],
    backend: str,
    cameras_known: bool,
    rounds: int = 0,
) -> list[str]:
    """Return three sentences: about the photos, the work and its time.

    Args:
        seen: the photos.
        holdout: every Nth photo is held out, or None.
        max_size: longest side of photos as fitted, pixels, or None.
        quality: "draft", "normal" or "high".
        given: fields of ``FitSettings`` that were given.
        backend: "cpu" or "gpu".
        cameras_known: whether the cameras were given, or found by an earlier run.
        rounds: maximum number of rounds of a refinement.
    """
    photos = seen.train_photos(holdout)
    sizes = [reduced_size(width, height, max_size) for width, height in seen.sizes]
    width, height = max(sizes, key=lambda size: size[0] * size[1])
    pixels = sum(w * h for w, h in sizes) / len(sizes)
    detail = detail_of_files(seen.plain, max_size)
    statistics = PhotoStatistics(photos, pixels, float(photos), ASSUMED_SPACING_DEG, detail)
    settings = settings_for(statistics, quality, **given)
    has_alpha = seen.channels == 4
    step = timed_steps(backend, settings.sh_degree, has_alpha)
    fit = (1.0 + ROUND_FRACTION * rounds) * fit_seconds(settings, width, height, step)
    held_out = len(seen.sizes) - photos
    # Photos with alpha start from their hull, photos with depth maps from these.
    swept = settings.start in ("auto", "depths") and not has_alpha and not seen.depths
    scored = held_out + min(photos, MAX_TRAIN_PHOTOS)
    # Scores and depth maps run on the CPU, whose speed is unknown if steps run on a GPU.
    factor = slowdown(step, has_alpha) if backend == "cpu" else 1.0
    fit += other_seconds(photos if swept else 0, scored, pixels, factor)
    cameras = 0.0 if cameras_known else camera_seconds(seen.sizes)
    return [
        f"Found {len(seen.sizes)} photos of {_size_range(seen.sizes)}"
        + (f", {seen.masks} of them with masks" if seen.masks else "")
        + (f", {held_out} of them held out" if held_out else "")
        + ("" if seen.has_cameras else ", without cameras")
        + (f"; skipped: {seen.skipped}." if seen.skipped else "."),
        ("Fits " if cameras_known else "Finds the cameras, then fits ")
        + f"at {width}x{height}: up to {settings.max_splats} splats, {settings.steps} steps.",
        f"Takes {'at most ' if rounds else ''}about {_duration(cameras + fit)} here"
        + (f", {_duration(cameras)} of it for cameras" if cameras else "")
        + "; Ctrl-C stops it, --resume continues.",
    ]


def _size_range(sizes: list[tuple[int, int]]) -> str:
    ordered = sorted(set(sizes), key=lambda size: size[0] * size[1])
    first, last = ordered[0], ordered[-1]
    text = f"{first[0]}x{first[1]}"
    return text if first == last else f"{text} to {last[0]}x{last[1]}"


def _duration(seconds: float) -> str:
    """A time, rounded to the precision of the estimate."""
    if seconds < 90.0:
        return f"{max(5, 5 * round(seconds / 5.0))} s"
    if seconds < 285.0:
        return f"{round(seconds / 30.0) / 2:g} min"
    if seconds < 5400.0:
        return f"{round(seconds / 60.0)} min"
    return f"{seconds / 3600.0:.1f} h"
