"""Remove floaters: by the photos where there are some, else by the splats alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.capture import Capture, PseudoView, View, photos_among
from igsr.errors import IgsrError
from igsr.evaluation.scores import default_background
from igsr.floaters.isolation import alone
from igsr.floaters.photo_evidence import SHOWN, needed_by_others, sightings
from igsr.splats import Splats, subset

Bool = npt.NDArray[np.bool_]

#: Little corrects what has less than this part of its area in pixels that count.
COUNTED = 0.05
#: Most photos that are asked whether they need a splat; with more, these are evenly spaced.
MOST_ASKED = 24


@dataclass(frozen=True, eq=False)
class Cleaned:
    """A scene without its floaters.

    Attributes:
        splats: those that are left, in their order.
        removed: number of splats removed of each kind. With photos: "unseen" (nothing shows it),
            "masked" (photos show nearly all of it in masked pixels) and "floating" (every photo
            that shows it shows it far before the surface, and at most one of them needs it).
            Without photos: "invisible" (not finite, or fainter than anything that is drawn) and
            "alone" (few others are near).
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
    """Remove splats that photos do not support, or, without photos, stray ones.

    Args:
        splats: the scene.
        capture: the photos that the scene was fitted to, and their cameras; only train views are
            asked. What no photo shows is removed: give all of them. Pseudo-views (views with
            weights) keep what they show and photos do not, but cannot tell what is floating or
            what masks hide.
        background: RGB in [0, 1], behind renders and behind photos with alpha. None: white if
            photos have alpha, else black.
        seed: of the random numbers of the estimate which photos need a splat.
        backend: "auto", "cpu", "gpu" or "reference".
        frozen: so many splats, the last ones before a backdrop, stay in any case. A backdrop
            stays, and hides nothing: depths are asked without it.

    Returns:
        The splats that are left, and how many of which kind were removed. Where none would be left,
        all are.

    Raises:
        IgsrError: the capture has no train views.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    if splats.backdrop_splats:
        bare = splats.without_backdrop()
        cleaned = remove_floaters(
            bare, capture, background=background, seed=seed, backend=backend, frozen=frozen
        )
        return replace(cleaned, splats=cleaned.splats.with_backdrop_of(splats))
    if capture is None:
        return _without(splats, stray_splats(splats), frozen)
    if not capture.train_views:
        raise IgsrError(f"{capture.path} has no train views to ask about splats.")
    color = default_background(capture) if background is None else background
    kinds = unsupported_splats(splats, capture.train_views, color, seed, backend)
    return _without(splats, kinds, frozen)


def stray_splats(splats: Splats) -> dict[str, Bool]:
    """Which splats cannot be seen, and which stand alone.

    Where more than half would stand alone, the scene is made of such splats, and none is stray.

    Args:
        splats: the scene.

    Returns:
        bool [N] under "invisible" and "alone".
    """
    faintest = np.log(_core.ALPHA_MIN / (1.0 - _core.ALPHA_MIN))
    invisible = ~splats.finite | ~(splats.opacities >= faintest)
    visible = np.flatnonzero(~invisible)
    stray = np.zeros(len(splats), np.bool_)
    stray[visible] = alone(subset(splats, ~invisible))
    if 2 * stray.sum() > len(visible):
        stray[:] = False
    return {"invisible": invisible, "alone": stray}


def unsupported_splats(
    splats: Splats,
    views: Sequence[View],
    background: Sequence[float],
    seed: int = 0,
    backend: str = "auto",
) -> dict[str, Bool]:
    """Which splats no photo shows, which masks hide, and which are floating.

    Args:
        splats: the scene.
        views: photos, with the scene's colors, and pseudo-views.
        background: RGB in [0, 1], behind renders and behind photos with alpha.
        seed: of the random numbers of the estimate which photos need a splat.
        backend: "auto", "cpu", "gpu" or "reference".

    Returns:
        bool [N] under "unseen", "masked" and "floating"; no splat is of two kinds.

    Raises:
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    photos = photos_among(views)
    masks = [view.mask for view in photos]
    seen = sightings(splats, [view.camera for view in photos], backend, masks)
    others = [view.camera for view in views if isinstance(view, PseudoView)]
    unseen = seen.area + sightings(splats, others, backend).area < SHOWN
    # What photos hardly show, pseudo-views do.
    masked = ~unseen & (seen.area >= SHOWN) & (seen.counted < COUNTED * seen.area)
    floating = (seen.before > 0) & (seen.before == seen.shown)
    if floating.any():
        evenly = np.linspace(0, len(photos) - 1, min(len(photos), MOST_ASKED)).round()
        asked = [photos[int(i)] for i in evenly]
        needed = needed_by_others(splats, asked, background, seed, backend)
        # Where not all are asked, 0 may be for lack of an answer.
        floating &= (needed < 0.0) | (seen.shown == 1)
    return {"unseen": unseen, "masked": masked, "floating": floating & ~unseen & ~masked}


def _without(splats: Splats, kinds: dict[str, Bool], frozen: int = 0) -> Cleaned:
    """The splats that are of no kind, and the last ``frozen``."""
    for kind in kinds.values():
        kind[len(kind) - frozen :] = False
    keep = ~np.logical_or.reduce(list(kinds.values()))
    if not keep[: len(keep) - frozen].any():
        return Cleaned(splats, dict.fromkeys(kinds, 0))
    return Cleaned(subset(splats, keep), {name: int(kind.sum()) for name, kind in kinds.items()})
