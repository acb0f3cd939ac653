"""Intrinsics that the alignment starts with."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from igsr.pose.alignment.absolute_pose import searched_focal
from igsr.pose.alignment.focal import weiszfeld_focal
from igsr.pose.alignment.observations import Observations
from igsr.pose.alignment.predictions import PhotoToAlign

Float64 = npt.NDArray[np.float64]
#: Points [3, P] and their raw confidence [P].
Placed = tuple[Float64, Float64]


def intrinsics_of(
    observations: Observations,
    photos: Sequence[PhotoToAlign],
    placed: Mapping[int, Placed],
    seed: int,
) -> dict[int, Float64]:
    """Intrinsics [3, 3] of all photos but those of which nothing tells the focal length.

    A group's focal length is what the pointmaps of its photos tell, each in the photo's own frame
    and on its own best edge. Where a group has none, focal lengths are tried, and that is taken
    with which a pose fits most of the points of any of its photos.

    Args:
        observations: of the photos.
        photos: all of them.
        placed: of each photo its points in the world.
        seed: what draws samples.
    """
    groups: dict[Hashable, list[int]] = {}
    result = {}
    for photo in observations.photos:
        given = photos[photo].intrinsics
        if given is None:
            groups.setdefault(photos[photo].group, []).append(photo)
        else:
            result[photo] = given
    for members in groups.values():
        focal = _told_focal(observations, photos, members)
        if focal is None:
            focal = _searched_focal(observations, photos, members, placed, seed)
        if focal is not None:
            result |= {photo: photos[photo].centred(focal) for photo in members}
    return result


def _told_focal(
    observations: Observations, photos: Sequence[PhotoToAlign], members: Sequence[int]
) -> float | None:
    parts = []
    for photo in members:
        own = np.flatnonzero(observations.edges[:, 0] == photo)
        if len(own):
            e = int(own[np.argmax(observations.scores[own])])
            xyz, confidence = observations.side(e, 0)
            middle = [photos[photo].width / 2, photos[photo].height / 2]
            offsets = observations.photos[photo].pixels - middle
            parts.append((xyz - observations.camera(e)[:, None], offsets, np.log(confidence)))
    if not parts:
        return None
    points, from_middle, weights = (list(column) for column in zip(*parts, strict=True))
    return weiszfeld_focal(
        np.concatenate(points, axis=1), np.concatenate(from_middle), np.concatenate(weights)
    )


def _searched_focal(
    observations: Observations,
    photos: Sequence[PhotoToAlign],
    members: Sequence[int],
    placed: Mapping[int, Placed],
    seed: int,
) -> float | None:
    best: tuple[float, int] | None = None
    for photo in members:
        points, confidence = placed[photo]
        pixels, size = (
            observations.photos[photo].pixels,
            (photos[photo].height, photos[photo].width),
        )
        found = searched_focal(points, pixels, confidence, size, seed)
        if found is not None and (best is None or found[1] > best[1]):
            best = found
    return None if best is None else best[0]
