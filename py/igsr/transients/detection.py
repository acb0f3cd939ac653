"""Pixels that show what one photo has and the others do not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from igsr._internal.choices import Backend
from igsr.capture import PseudoView, View
from igsr.splats import Splats
from igsr.transients.regions import box_sums, dilated, eroded, labels
from igsr.transients.witnesses import (
    SLACK,
    SmallPhoto,
    Testimony,
    colors_at,
    shown_at_any_depth,
    small_photos,
    testimony,
)

Bool = npt.NDArray[np.bool_]
Float32 = npt.NDArray[np.float32]

#: A region begins where a photo's color is further from all that the others show than this, and
#: than so many deviations of the scene's; it goes on where it differs from theirs by the second.
SEED, SEED_DEVIATIONS = 0.10, 3.0
GROW, GROW_DEVIATIONS = 0.03, 1.0
#: Least part of the photo that a region, and what it begins with, has.
LEAST_REGION, LEAST_SEED = 0.004, 0.001
#: A scene has transient things, beyond doubt, if one photo has a region with so much, as a part of
#: the photo, that no other explains. Static scenes that were measured have 0.0005 at most, those
#: with figures in some photos 0.015 and more.
PLAIN = 0.003
#: What is no wider than twice the first, or so near to the picture's edge, is no such proof: edges
#: of things, and of photos whose undistortion left dark borders.
THIN, FRAME = 2, 4
#: Pixels on each side among which most decide; and how far a region goes on from where it begins.
VOTE, REACH = 4, 24
#: Where others agree on no color, the mean of those within so many pixels stands for it.
NEAR = 4
#: The scene's deviation is told by so many photos at most, evenly spaced: what others say of a
#: photo takes more memory than the photo.
MEASURED = 64
#: Masks are grown by so many small pixels: edges are mixed colors.
MARGIN = 2


def find_transients(
    splats: Splats,
    views: Sequence[View],
    before: Sequence[Bool | None],
    *,
    least: float = 0.0,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    backend: Backend = "auto",
) -> list[Bool | None]:
    """Find what one photo shows and the others do not.

    Args:
        splats: the scene as fitted so far.
        views: V views with the scene's colors; pseudo-views are left alone, and not asked.
        before: for each, bool [H, W], what was found before: no witness for others.
        least: nothing is found unless some photo has a region with so much, as a part of the photo,
            that no other explains; see ``PLAIN``.
        background: RGB in [0, 1] behind photos with alpha.
        backend: "auto", "cpu", "gpu" or "reference".

    Returns:
        For each view, bool [H, W], True where it shows something transient; None where it shows
        nothing of the kind.
    """
    which = [k for k, view in enumerate(views) if not isinstance(view, PseudoView)]
    photos = small_photos(
        splats, [views[k] for k in which], [before[k] for k in which], background, backend
    )
    measured = np.linspace(0, len(photos) - 1, min(len(photos), MEASURED)).round().astype(int)
    said = {int(k): testimony(int(k), photos) for k in measured}
    deviation = _deviation([photos[k] for k in said], list(said.values()))
    found: list[Bool | None] = [None] * len(views)
    most = 0.0
    for k, photo in enumerate(photos):
        what = said.pop(k) if k in said else testimony(k, photos)
        if what is None:
            continue
        small, plain = regions(photo, what, deviation)
        most = max(most, plain)
        if small.any():
            found[which[k]] = _enlarged(small, views[which[k]])
    return found if most >= least else [None] * len(views)


def _difference(photo: SmallPhoto, what: Testimony) -> Float32:
    """How far colors are off what the others show, in the channel where most, [N]."""
    own = colors_at(photo.color, what.pixels)
    return np.asarray(np.abs(own - what.color).max(axis=-1))


def _deviation(photos: Sequence[SmallPhoto], said: Sequence[Testimony | None]) -> float:
    """Standard deviation of colors from what others show, by the median."""
    differences = [
        _difference(photo, what)[what.agreed]
        for photo, what in zip(photos, said, strict=True)
        if what is not None
    ]
    together = np.concatenate([np.zeros(1), *differences])
    return 1.4826 * float(np.median(together))


def _unlike(photo: SmallPhoto, what: Testimony) -> Float32:
    """How far colors are off all that others show within ``SLACK`` pixels, [H, W].

    Where the others agree on nothing, the mean of what they show near stands for it; 0 where they
    show nothing near.
    """
    height, width = photo.usable.shape
    sums = np.zeros((height * width, 4))
    sums[what.pixels[what.agreed]] = np.concatenate(
        [what.color[what.agreed], np.ones((int(what.agreed.sum()), 1))], axis=1
    )
    whole = sums.reshape(height, width, 4)
    there = np.where(whole[..., 3:] > 0.0, whole, box_sums(whole, NEAR))
    known = there[..., 3] > 0.0
    color = there[..., :3] / np.maximum(there[..., 3:], 1.0)
    low, high = np.full(color.shape, np.inf), np.full(color.shape, -np.inf)
    around = [(SLACK, SLACK)] * 2 + [(0, 0)]
    least = np.pad(np.where(known[..., None], color, np.inf), around, constant_values=np.inf)
    most = np.pad(np.where(known[..., None], color, -np.inf), around, constant_values=-np.inf)
    for dy, dx in np.ndindex(2 * SLACK + 1, 2 * SLACK + 1):
        shift = slice(dy, dy + height), slice(dx, dx + width)
        np.minimum(low, least[shift], out=low)
        np.maximum(high, most[shift], out=high)
    own = photo.color / np.float32(255.0)
    off = np.maximum(low - own, own - high).max(axis=-1)
    return np.where(photo.usable & known, off, 0.0).astype(np.float32)


def regions(photo: SmallPhoto, what: Testimony, deviation: float) -> tuple[Bool, float]:
    """The transient regions of a small photo, bool [H, W], and how plain to see they are.

    The latter is the part of the photo that the largest region has of pixels that nothing explains;
    thin lines and the picture's edge do not count.

    Args:
        photo: the photo.
        what: the others say of it.
        deviation: standard deviation of the scene's colors from what others show.
    """
    height, width = photo.usable.shape

    def picture(which: Bool) -> Bool:
        out = np.zeros(height * width, np.bool_)
        out[what.pixels[which]] = True
        return out.reshape(height, width)

    odd = what.agreed & ~what.explained
    seed = picture(odd & (what.outside > max(SEED, SEED_DEVIATIONS * deviation)))
    seed = dilated(eroded(seed, 1), 1)
    unseen = seed.copy()
    start = np.flatnonzero(seed)
    unseen.reshape(-1)[start] = ~shown_at_any_depth(photo, start, what)
    unseen &= 2 * box_sums(unseen, VOTE) >= box_sums(seed, VOTE)
    if not unseen.any():
        return unseen, 0.0
    unlike = _unlike(photo, what) > max(GROW, GROW_DEVIATIONS * deviation)
    likely = seed | (unlike & ~picture(what.explained))
    grown = unseen.copy()
    for _ in range(REACH):
        grown |= dilated(grown, 1) & likely
    grown = eroded(dilated(grown, 2), 2)
    number = labels(grown)
    size = np.bincount(number.reshape(-1)) / seed.size
    seeds = np.bincount(number[unseen], minlength=len(size)) / seed.size
    keep = (size >= LEAST_REGION) & (seeds >= LEAST_SEED)
    keep[0] = False
    core = unseen.copy()
    core[:FRAME] = core[-FRAME:] = core[:, :FRAME] = core[:, -FRAME:] = False
    core = dilated(eroded(core, THIN), THIN)
    cores = np.bincount(number[core], minlength=len(size)) / seed.size
    plain = float(cores[keep].max(initial=0.0))
    return dilated(keep[number], MARGIN), plain


def _enlarged(small: Bool, view: View) -> Bool:
    """A small mask at the size of the view."""
    height, width = small.shape
    rows = ((np.arange(view.camera.height) + 0.5) * height / view.camera.height).astype(np.int64)
    columns = ((np.arange(view.camera.width) + 0.5) * width / view.camera.width).astype(np.int64)
    return small[rows[:, None], columns]
