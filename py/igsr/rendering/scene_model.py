"""What a scene page embeds of a model: its bytes, and where its splats are."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igsr.rendering.scene_packing import packed_model
from igsr.splats import Splats

#: Log-scales that a .spz holds, and the middle of them.
LOG_SCALES = (-10.0, 5.9375)
MIDDLE_LOG_SCALE = -2.0
#: Splats of a lower opacity logit do not count for the extent, as in splat-view.
FAINT_LOGIT = -2.2
#: How far splats may be, in radii: those within keep a step of at most an 8000th of the radius.
FAR_RADII = 1000
#: Number of splats that the extent is computed from.
SAMPLES = 100_000


@dataclass(frozen=True)
class EmbeddedModel:
    """A model as a page embeds it: relative to ``origin``, and in lengths times ``unit``.

    Attributes:
        packed: its bytes, as ``scene_packing`` describes them.
        count: number of splats in it.
        origin: float64 [3], world position that its splats are relative to, world units: the
            middle of the visible ones.
        unit: what lengths were multiplied by.
        radius: about the origin, times ``unit``: of 90% of the visible splats, at most four times
            that of 50%.
        notes: a message for each thing that the page cannot hold.
    """

    packed: bytes
    count: int
    origin: npt.NDArray[np.float64]
    unit: float
    radius: float
    notes: list[str]


def embedded_model(splats: Splats) -> EmbeddedModel:
    """Pack a model for a page.

    Splats that are not finite are left out, and those that are farther than
    ``FAR_RADII`` from the middle: positions have 24 bits, and such a splat would leave few of them
    to all others.

    Raises:
        IgsrError: the page's format cannot hold the model.
    """
    center, radius = _extent(splats.without_backdrop())
    offsets = splats.means - center.astype(np.float32)
    kept = ~(np.abs(offsets).max(axis=1, initial=0.0) > FAR_RADII * radius)
    unit = _unit(splats)
    shown = replace(
        splats,
        # The page keeps the origin beside the model, so that no position is rounded for it.
        origin=np.zeros(3),
        means=offsets[kept] * np.float32(unit),
        scales=splats.scales[kept] + np.float32(np.log(unit)),
        quats=splats.quats[kept],
        opacities=splats.opacities[kept],
        sh=splats.sh[kept],
    )
    packed, count, notes = packed_model(shown, radius * unit)
    far = len(kept) - int(kept.sum())
    if far > 0:
        notes.append(f"{far} splats farther than {FAR_RADII} radii of the scene are left out.")
    origin = splats.origin + center.astype(np.float32)
    return EmbeddedModel(packed, count, origin, unit, radius * unit, notes)


def _unit(splats: Splats) -> float:
    """A power of two for lengths, 1 where a ``.spz`` holds all log-scales as they are."""
    scales = splats.scales[splats.finite]
    if len(scales) == 0:
        return 1.0
    low, high = np.quantile(scales.max(axis=1), [0.01, 0.99])
    if low >= LOG_SCALES[0] and float(scales.max()) <= LOG_SCALES[1]:
        return 1.0
    return float(2.0 ** np.round((MIDDLE_LOG_SCALE - 0.5 * (low + high)) / np.log(2.0)))


def _extent(splats: Splats) -> tuple[npt.NDArray[np.float64], float]:
    """Centre [3] and radius, relative to the splats' origin, in world units.

    Medians, because captures have a few splats very far out.
    """
    chosen = np.flatnonzero(splats.finite)
    if len(chosen) == 0:
        return np.zeros(3), 1.0
    chosen = chosen[:: -(-len(chosen) // SAMPLES)]
    clear = chosen[splats.opacities[chosen] > FAINT_LOGIT]
    means = splats.means[clear if len(clear) else chosen].astype(np.float64)
    center = np.asarray(np.median(means, axis=0))
    half, most = np.quantile(np.linalg.norm(means - center, axis=1), [0.5, 0.9])
    return center, float(min(most, 4.0 * half)) or 1.0
