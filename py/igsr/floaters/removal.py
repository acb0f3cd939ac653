"""Remove floaters: by the photos if there are any, else by the splats alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.capture import Capture, PseudoView, View, photos_among
from igsr.errors import IgsrError
from igsr.evaluation.scores import default_background
from igsr.floaters.photo_evidence import MIN_AREA_PX, needed_by_others, sightings
from igsr.splats import Splats, subset

Bool = npt.NDArray[np.bool_]

#: A splat with less than this fraction of its area in pixels that count is masked.
MIN_COUNTED_FRACTION = 0.05
#: Maximum number of photos, evenly spaced, to test for their need of a splat.
MAX_NEED_PHOTOS = 24
#: A splat is alone if fewer than this many others are near.
MIN_NEIGHBORS = 6
#: Neighbors are near within this many standard deviations of the splat's longest axis.
NEIGHBOR_SIGMAS = 5.0
#: Grid cells per axis: three such indices make a key of 63 bits.
_CELLS_PER_AXIS = 2**21


@dataclass(frozen=True, eq=False)
class Cleaned:
    """A scene without its floaters.

    Attributes:
        splats: the remaining splats, in their order.
        removed: number of removed splats of each kind. With photos: "unseen" (no photo shows it),
            "masked" (nearly all of it is in masked pixels) and "floating" (every photo shows it
            far in front of the surface, and at most one photo needs it). Without photos:
            "invisible" (not finite, or too faint to be drawn) and "alone" (few splats are near).
    """

    splats: Splats
    removed: dict[str, int]


def remove_floaters(
    splats: Splats,
    capture: Capture | None = None,
    *,
    background: Sequence[float] | None = None,
    seed: int = 0,
    backend: str = "auto",
    frozen: int = 0,
) -> Cleaned:
    """Remove splats that photos do not support, or, without photos, stray splats.

    Args:
        splats: the scene. Its backdrop is kept and does not count as a surface.
        capture: the photos that the scene was fitted to; only train views are used. Give all of
            them: splats that no photo shows are removed. Pseudo-views (views with weights) keep
            splats that no photo shows; they are not evidence against a splat.
        background: RGB in [0, 1] behind renders and photos with alpha. None is white if photos
            have alpha, else black.
        seed: of the random numbers that estimate which photos need a splat.
        backend: "auto", "cpu", "gpu" or "reference".
        frozen: number of splats to keep in any case: the last ones before a backdrop.

    Returns:
        The remaining splats, and the number of removed ones by kind. If none would remain, nothing
        is removed.

    Raises:
        IgsrError: the capture has no train views.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    bare = splats.without_backdrop()
    if capture is None:
        kinds = stray_splats(bare)
    elif not capture.train_views:
        raise IgsrError(f"{capture.path} has no train views; give the photos that were fitted.")
    else:
        color = default_background(capture) if background is None else background
        kinds = unsupported_splats(bare, capture.train_views, color, seed, backend)
    cleaned = _without(bare, kinds, frozen)
    return replace(cleaned, splats=cleaned.splats.with_backdrop_of(splats))


def stray_splats(splats: Splats) -> dict[str, Bool]:
    """Find splats that are "invisible" or "alone", bool [N] each.

    If more than half are alone, the scene consists of such splats, and none is stray.
    """
    min_logit = np.log(_core.ALPHA_MIN / (1.0 - _core.ALPHA_MIN))
    invisible = ~splats.finite | ~(splats.opacities >= min_logit)
    visible = np.flatnonzero(~invisible)
    stray = np.zeros(len(splats), np.bool_)
    stray[visible] = alone(subset(splats, ~invisible))
    if 2 * stray.sum() > len(visible):
        stray[:] = False
    return {"invisible": invisible, "alone": stray}


def alone(splats: Splats) -> Bool:
    """Find splats, all finite, with few neighbors, relative to their own size, bool [N].

    Centers are counted in a cube of 3 x 3 x 3 cells around the splat's. The side of a cell is one
    to two times ``NEIGHBOR_SIGMAS`` standard deviations.
    """
    means = splats.means.astype(np.float64)
    # Clipped to the exponents of float64.
    reach = np.log2(NEIGHBOR_SIGMAS) + splats.scales.max(axis=1) / np.log(2.0)
    levels = np.ceil(np.clip(reach, -1000.0, 1000.0)).astype(int)
    half = _CELLS_PER_AXIS // 2
    result = np.zeros(len(means), np.bool_)
    for level in np.unique(levels):
        mine = np.flatnonzero(levels == level)
        with np.errstate(over="ignore"):
            cells = np.floor(np.clip(means * 2.0**-level, 2 - half, half - 2))
        cells = cells.astype(np.int64) + half
        occupied, count = np.unique(_key(cells), return_counts=True)
        near = np.zeros(len(mine), np.int64)
        for offset in np.ndindex(3, 3, 3):
            keys = _key(cells[mine] + np.array(offset) - 1)
            index = np.minimum(np.searchsorted(occupied, keys), len(occupied) - 1)
            near += np.where(occupied[index] == keys, count[index], 0)
        result[mine] = near - 1 < MIN_NEIGHBORS
    return result


def _key(cells: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    x, y, z = cells.T
    key: npt.NDArray[np.int64] = (x * _CELLS_PER_AXIS + y) * _CELLS_PER_AXIS + z
    return key


def unsupported_splats(
    splats: Splats,
    views: Sequence[View],
    background: Sequence[float],
    seed: int = 0,
    backend: str = "auto",
) -> dict[str, Bool]:
    """Find splats that are "unseen", "masked" or "floating", bool [N] each; none is of two kinds.

    Args:
        splats: the scene.
        views: photos, with the scene's colors, and pseudo-views.
        background: RGB in [0, 1] behind renders and photos with alpha.
        seed: of the random numbers that estimate which photos need a splat.
        backend: "auto", "cpu", "gpu" or "reference".
    """
    photos = photos_among(views)
    masks = [view.mask for view in photos]
    seen = sightings(splats, [view.camera for view in photos], backend, masks)
    pseudo = [view.camera for view in views if isinstance(view, PseudoView)]
    unseen = seen.area + sightings(splats, pseudo, backend).area < MIN_AREA_PX
    # Splats that photos hardly show are left to pseudo-views.
    masked = ~unseen & (seen.area >= MIN_AREA_PX)
    masked &= seen.counted < MIN_COUNTED_FRACTION * seen.area
    floating = (seen.before > 0) & (seen.before == seen.shown)
    if floating.any():
        evenly = np.linspace(0, len(photos) - 1, min(len(photos), MAX_NEED_PHOTOS)).round()
        chosen = [photos[int(i)] for i in evenly]
        needed = needed_by_others(splats, chosen, background, seed, backend)
        # A need of exactly 0 may mean that none of the chosen photos shows the splat.
        floating &= (needed < 0.0) | (seen.shown == 1)
    return {"unseen": unseen, "masked": masked, "floating": floating & ~unseen & ~masked}


def _without(splats: Splats, kinds: dict[str, Bool], frozen: int) -> Cleaned:
    for kind in kinds.values():
        kind[len(kind) - frozen :] = False
    keep = ~np.logical_or.reduce(list(kinds.values()))
    if not keep[: len(keep) - frozen].any():
        return Cleaned(splats, dict.fromkeys(kinds, 0))
    return Cleaned(subset(splats, keep), {name: int(kind.sum()) for name, kind in kinds.items()})
