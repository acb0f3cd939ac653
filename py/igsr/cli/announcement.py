"""What ``igsr fit`` and ``igsr refine`` say at once: what was found, what follows, how long."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from igsr.capture.downscaling import reduced_size
from igsr.capture.load import Overview
from igsr.cli.error_messages import print_message
from igsr.evaluation.quick_scores import MOST_TRAIN
from igsr.fitting.photo_support import PhotoSupport, detail_of_files
from igsr.fitting.presets import Quality, settings_for
from igsr.fitting.time_estimate import fit_seconds, other_seconds, timed_steps, times_usual
from igsr.pose.colmap.time_estimate import camera_seconds

#: Photos as people take them stand this far apart, seen from what they show: degrees.
USUALLY_APART = 10.0
#: A round of a refinement takes this part of a fit's time, by its folds, novel views and refit.
ROUND = 1.5


def announce(
    seen: Overview,
    *,
    holdout: int | None,
    max_size: int | None,
    preset: str,
    quality: Quality,
    given: Mapping[str, Any],
    backend: str,
    cameras_kept: bool,
    photos: int | None = None,
    rounds: int = 0,
) -> None:
    """Print three lines: what was found, what will be done and how long it will take.

    Args:
        seen: the photos.
        holdout: every so many photos one is held out, or None.
        max_size: longest side in pixels of photos as fitted, or None.
        preset, quality: names of ``igsr.fitting.presets``.
        given: fields of ``FitSettings`` that were asked for.
        backend: what fits, "cpu" or "gpu".
        cameras_kept: whether the cameras are known, or were found by an earlier run.
        photos: so many of the photos are fitted; None is all that are not held out.
        rounds: most rounds of a refinement.
    """
    train = seen.train_photos(holdout)
    photos = train if photos is None else min(photos, train)
    sizes = [reduced_size(width, height, max_size) for width, height in seen.sizes]
    width, height = max(sizes, key=lambda size: size[0] * size[1])
    pixels = sum(w * h for w, h in sizes) / len(sizes)
    detail = detail_of_files(seen.plain, max_size)
    support = PhotoSupport(photos, pixels, float(photos), USUALLY_APART, detail)
    settings = settings_for(preset, support, quality, **given)
    cameras = 0.0 if cameras_kept else camera_seconds(seen.sizes)
    alpha = seen.channels == 4
    step = timed_steps(backend, settings.sh_degree, alpha)
    fit = (1.0 + ROUND * rounds) * fit_seconds(settings, width, height, step)
    held_out = len(seen.sizes) - train
    # Photos with alpha are fitted from their hull, and those with depths from these.
    swept = settings.start in ("auto", "depths") and seen.channels < 4 and not seen.depths
    scored = held_out + min(photos, MOST_TRAIN)
    # The rest runs on the CPU in any case; a GPU's steps do not tell how fast that is.
    times = times_usual(step, alpha) if backend == "cpu" else 1.0
    fit += other_seconds(photos if swept else 0, scored, pixels, times)
    print_message(
        f"Found {len(seen.sizes)} photos of {_range_of(seen.sizes)}"
        + (f", {held_out} of them held out" if held_out else "")
        + ("." if seen.has_cameras else ", without cameras.")
    )
    print_message(
        ("" if cameras_kept else "Finds the cameras, then fits ")
        + ("Fits " if cameras_kept else "")
        + f"at {width}x{height}: up to {settings.max_splats} splats, {settings.steps} steps."
    )
    most = "at most about" if rounds else "about"
    print_message(
        f"That takes {most} {_words(cameras + fit)} here"
        + (f", {_words(cameras)} of it for cameras" if cameras else "")
        + "; Ctrl-C stops it, --resume goes on."
    )


def _range_of(sizes: list[tuple[int, int]]) -> str:
    """The sizes of photos, the smallest and the largest if they differ."""
    ordered = sorted(set(sizes), key=lambda size: size[0] * size[1])
    first, last = ordered[0], ordered[-1]
    text = f"{first[0]}x{first[1]}"
    return text if first == last else f"{text} to {last[0]}x{last[1]}"


def _words(seconds: float) -> str:
    """A time in words that are as exact as the estimate."""
    if seconds < 90.0:
        return f"{max(5, 5 * round(seconds / 5.0))} s"
    if seconds < 285.0:
        return f"{round(seconds / 30.0) / 2:g} min"
    if seconds < 5400.0:
        return f"{round(seconds / 60.0)} min"
    return f"{seconds / 3600.0:.1f} h"
