"""Viewpoints from which objects are visible, and a suitable exposure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from igsr_lab.synth.cameras import Rig, Viewpoint, at_angle, spread
from igsr_lab.synth.description import Description
from igsr_lab.synth.mitsuba_scene import LoadedScene, first_hits, take_photo

#: Longer side of the small renders that viewpoints and exposures are chosen by.
PROBE_SIZE_PX = 40
#: Maximum number of viewpoints tried for one photo.
ATTEMPTS = 12


def choose_viewpoints(
    loaded: LoadedScene,
    description: Description,
    rig: Rig,
    rng: np.random.Generator,
    count: int,
    margin: float,
) -> list[Viewpoint]:
    """Spread cameras over the rig, each with free sight of the objects.

    ``margin`` is the fraction of the rig that is left out on every side.
    """
    chosen = []
    for position in spread(rng, count, margin):
        best, least = None, np.inf
        for attempt in range(ATTEMPTS):
            shift = rng.normal(0.0, 0.04 * attempt, 2)
            moved = np.clip(position + shift, margin, 1.0 - margin)
            viewpoint = rig.viewpoint(rng, moved)
            fault = _fault(loaded, description, rig, viewpoint)
            if fault < least:
                best, least = viewpoint, fault
            if fault == 0.0:
                break
        assert best is not None
        chosen.append(best)
    return chosen


def viewpoints_at_angle(
    loaded: LoadedScene,
    description: Description,
    rig: Rig,
    rng: np.random.Generator,
    count: int,
    angle: float,
) -> list[Viewpoint]:
    """Cameras ``angle`` radians apart, from the side with the freest sight of the objects."""
    best, least = [], np.inf
    for _ in range(ATTEMPTS):
        plain, positions = at_angle(rig, rng.uniform(*rig.azimuth), angle, count)
        viewpoints = [plain.viewpoint(rng, position) for position in positions]
        fault = sum(_fault(loaded, description, plain, viewpoint) for viewpoint in viewpoints)
        if fault < least:
            best, least = viewpoints, fault
        if fault == 0.0:
            break
    return best


def _probe(viewpoint: Viewpoint) -> Viewpoint:
    scale = min(1.0, PROBE_SIZE_PX / max(viewpoint.width, viewpoint.height))
    width, height = (max(1, round(scale * n)) for n in (viewpoint.width, viewpoint.height))
    return replace(viewpoint, width=width, height=height)


def _fault(loaded: LoadedScene, description: Description, rig: Rig, viewpoint: Viewpoint) -> float:
    """How bad a view is: 0 if nothing is near the lens and the objects are large enough."""
    depth, is_object = first_hits(loaded, _probe(viewpoint))
    nearest = float(np.nanmin(depth)) if np.isfinite(depth).any() else np.inf
    share = float(is_object.mean())
    too_near = max(0.0, 1.0 - nearest / (0.3 * rig.distance))
    too_little = max(0.0, 1.0 - share / (0.08 if description.family == "object" else 0.06))
    return too_near + too_little


def exposure(loaded: LoadedScene, viewpoints: list[Viewpoint], rng: np.random.Generator) -> float:
    """Factor on linear colors that avoids overexposure and black."""
    bright = []
    for viewpoint in viewpoints:
        linear = take_photo(loaded, _probe(viewpoint), 16, 0)
        seen = linear[linear[..., 3] > 0.5]
        bright.append(seen[:, :3] @ [0.2126, 0.7152, 0.0722])
    values = np.concatenate(bright)
    values = values[np.isfinite(values)]
    if not len(values) or values.max() <= 0.0:
        return 1.0
    middle, high = np.percentile(values, [50.0, 95.0])
    # Middle gray, as cameras meter, unless highlights would be overexposed.
    gray = 0.18 * float(np.exp(rng.normal(0.0, 0.25)))
    return float(min(gray / max(middle, 1e-4), 1.1 / max(high, 1e-4)))
