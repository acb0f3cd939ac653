"""Which pairs of photos the network is shown.

The graphs are those of the published code by Wang et al. (CVPR 2024), named alike.
"""

from __future__ import annotations

import re

from igsr.errors import IgsrError

#: Photos up to which all pairs are shown.
MOST_COMPLETE = 20
#: Photos after each that it is paired with where there are more.
WINDOW = 8
#: Photos that swin and logwin pair each with where no number is given.
USUAL_WINDOW = 3

_KIND = re.compile(r"(complete)|(swin|logwin)(?:-(\d{1,9}))?(-noncyclic)?|(oneref)(?:-(\d{1,9}))?")


def usual_graph(photos: int) -> str:
    """The kind of graph for a number of photos.

    All pairs grow with the square of the photos in time and memory: 20 photos are 380 predictions.
    Up to there any photo may see what any other does, whatever their order. Beyond, each photo is
    paired with the 8 after it, which is 16 predictions a photo and so no fewer than before, but
    relies on names in the order of taking, as cameras and videos give them. The window goes round
    from the last photo to the first: of a path that does not close, these few pairs have low
    confidence and are passed over.
    """
    return "complete" if photos <= MOST_COMPLETE else f"swin-{WINDOW}"


def pair_graph(kind: str, photos: int) -> list[tuple[int, int]]:
    """Ordered pairs of photos, both orders of each, one after the other; sorted.

    Args:
        kind: "complete": all; "swin-K": each with the K photos after it, from the last on to the
            first; "logwin-K": each with those 1, 2, 4, ... 2^(K-1) after it; "oneref-K": all with
            photo K, counted from 0. K is 3 where swin and logwin leave it away, 0 for oneref;
            "-noncyclic" behind swin and logwin ends the window at the last photo.
        photos: how many there are, at least 2.

    Raises:
        IgsrError: the kind is unknown, its number is 0 or names no photo, or there are too few
            photos.
    """
    match = _KIND.fullmatch(kind)
    if match is None:
        raise IgsrError(
            f"the pair graph {kind!r} is unknown; give complete, swin-K, logwin-K or oneref-K, "
            "with -noncyclic behind the middle two where the path does not close"
        )
    if photos < 2:
        raise IgsrError(f"poses need at least two photos, and there is {photos}; add some")
    _, window, number, noncyclic, oneref, reference = match.groups()
    if oneref:
        centre = int(reference or 0)
        if centre >= photos:
            raise IgsrError(f"{kind} names photo {centre} of {photos}; count from 0")
        joined = {(min(i, centre), max(i, centre)) for i in range(photos) if i != centre}
    elif window:
        steps = int(number or USUAL_WINDOW)
        if steps < 1:
            raise IgsrError(f"{kind} pairs no photos; give a number of at least 1")
        # Photos have no more others than this, and 2 to a larger power would only be large.
        steps = min(steps, photos)
        offsets = [2**k for k in range(steps)] if window == "logwin" else range(1, steps + 1)
        reached = [(i, i + step) for i in range(photos) for step in offsets]
        if noncyclic:
            reached = [(i, j) for i, j in reached if j < photos]
        wrapped = [(i, j % photos) for i, j in reached]
        joined = {(min(pair), max(pair)) for pair in wrapped if pair[0] != pair[1]}
    else:
        joined = {(i, j) for j in range(photos) for i in range(j)}
    return [pair for i, j in sorted(joined) for pair in ((i, j), (j, i))]
