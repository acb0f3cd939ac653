"""Photos whose depths those of the other photos contradict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from igsr._internal.user_warning import warn_user
from igsr.capture import View
from igsr.fitting.initialization.given_depths import COMPARED
from igsr.fitting.initialization.photo_pixels import known_pixels, pixels_of, reduced, world_points

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

#: Points that a photo is compared at, and the fewest that must fall into another one to compare.
POINTS, FEWEST = 2000, 100
#: Two photos agree where the ratio of their depths has a median logarithm below this.
AGREE = 0.1
#: From behind, each of two photos sees what stands before the other's surface: both ratios are
#: positive, and tell nothing. That is where their mean is above this part of half their difference.
ONE_SIDED = 0.5


def with_agreeing_depths(views: Sequence[View]) -> list[View]:
    """Views without the depths that most photos contradict.

    Photos are compared by twos. Of groups that agree among themselves, the largest is right; depths
    that contradict one of its photos are left out. Where no group is the largest, all stay.

    Args:
        views: with or without depths, in the unit of their cameras.

    Returns:
        The views in their order.

    Raises:
        UserWarning: naming the photos whose depths are left out.
    """
    with_depths = [k for k, view in enumerate(views) if view.known_depth is not None]
    agree, contradict = _compared([reduced(views[k]) for k in with_depths])
    group = _groups(agree)
    sizes = np.bincount(group, minlength=1)
    largest = int(np.argmax(sizes))
    if sizes[largest] < 2 or np.count_nonzero(sizes == sizes[largest]) > 1:
        return list(views)
    right = group == largest
    against = ~right & contradict[:, right].any(axis=1)
    wrong = {with_depths[int(i)] for i in np.nonzero(against)[0]}
    if wrong:
        names = ", ".join(views[k].name for k in sorted(wrong))
        warn_user(f"The depth of {names} contradicts that of the other photos and is left out.")
    return [
        replace(view, depth=None, depth_confidence=None) if k in wrong else view
        for k, view in enumerate(views)
    ]


def _compared(views: list[View]) -> tuple[Bool, Bool]:
    """Which photos agree with which, and which contradict each other, [N, N]."""
    count = len(views)
    agree, contradict = (np.zeros((count, count), dtype=np.bool_) for _ in range(2))
    points = [_some_points(view) for view in views]
    centres = np.array([view.camera.centre for view in views])
    for i in range(count):
        order = np.argsort(np.linalg.norm(centres - centres[i], axis=1), kind="stable")
        for j in (int(k) for k in order[: COMPARED + 1] if k != i):
            here, there = _ratio(points[i], views[j]), _ratio(points[j], views[i])
            if here is None or there is None:
                continue
            apart, common = abs(here - there) / 2.0, abs(here + there) / 2.0
            if common <= max(AGREE, ONE_SIDED * apart):
                kind = agree if apart <= AGREE else contradict
                kind[i, j] = kind[j, i] = True
    return agree, contradict


def _groups(agree: Bool) -> Int64:
    """The number [N] of the group that each photo is in; those that agree are in the same."""
    group = np.arange(len(agree))
    for i, j in np.argwhere(agree):
        group[group == group[j]] = group[i]
    return group


def _some_points(view: View) -> Float64:
    """At most ``POINTS`` world points [P, 3] of a photo's depths, evenly spaced."""
    rows, columns = np.nonzero(known_pixels(view))
    some = np.linspace(0, len(rows) - 1, min(POINTS, len(rows))).astype(np.int64)
    return world_points(view, rows[some], columns[some])


def _ratio(world: Float64, view: View) -> float | None:
    """The median logarithm of points' depths over those of the photo, where it shows enough."""
    row, column, depth, inside = pixels_of(view, world)
    inside &= known_pixels(view)[row, column]
    if np.count_nonzero(inside) < FEWEST:
        return None
    assert view.depth is not None
    return float(np.median(np.log(depth[inside]) - np.log(view.depth[row, column][inside])))
