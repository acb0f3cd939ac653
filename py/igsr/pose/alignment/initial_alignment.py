"""Where the alignment starts: pointmaps put together along the strongest spanning tree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera
from igsr.geometry.similarity import Similarity, apply, similarity_between, similarity_of_points
from igsr.pose.alignment.absolute_pose import absolute_pose
from igsr.pose.alignment.depths_on_rays import depths_on_rays
from igsr.pose.alignment.intrinsics import Placed, intrinsics_of
from igsr.pose.alignment.observations import Observations
from igsr.pose.alignment.placement import Placement, joined, mapped_viewmat
from igsr.pose.alignment.predictions import PhotoToAlign
from igsr.pose.alignment.spanning_tree import spanning_tree

Float64 = npt.NDArray[np.float64]


def start(
    observations: Observations, photos: Sequence[PhotoToAlign], seed: int
) -> tuple[Placement, dict[int, Float64]] | list[int]:
    """Cameras and edges, and the depths [P] of every photo's pixels, in one world frame.

    Where edges contradict the others, or say nothing that a camera could be found by, these are
    returned instead; without them there may be a start.

    Args:
        observations: of photos that are all connected.
        photos: all of them; where poses are fixed, the world frame is theirs.
        seed: what draws samples.
    """
    placed, poses, lost = _along_the_tree(observations)
    if lost:
        return lost
    intrinsics = intrinsics_of(observations, photos, placed, seed)
    for photo in observations.photos:
        if photo in intrinsics and photo not in poses:
            K, size = intrinsics[photo], (photos[photo].height, photos[photo].width)
            pose = _pose(observations, photo, placed[photo], K, size, seed)
            if pose is not None:
                poses[photo] = pose
    for photo in observations.photos:
        if photo not in intrinsics or photo not in poses:
            lost += np.flatnonzero((observations.edges == photo).any(axis=1)).tolist()
    if lost:
        return lost
    world = _to_fixed(poses, photos)
    placed = {photo: (apply(world, xyz), sure) for photo, (xyz, sure) in placed.items()}
    for photo, viewmat in poses.items():
        fixed = photos[photo].viewmat
        poses[photo] = mapped_viewmat(world, viewmat) if fixed is None else fixed
    edges = _edges(observations, placed)
    lost = [e for e, similarity in enumerate(edges) if similarity is None]
    if lost:
        return lost
    placement = Placement(poses, intrinsics, [edge for edge in edges if edge])
    return placement, {photo: _depths(observations, placement, photo) for photo in placed}


def _along_the_tree(
    observations: Observations,
) -> tuple[dict[int, Placed], dict[int, Float64], list[int]]:
    """The photos' points, world-to-camera [4, 4] of those that are first on an edge of the tree,
    and the edge that could not be joined to the others, if one could not."""
    points: dict[int, Placed] = {}
    poses: dict[int, Float64] = {}
    for e, from_first in spanning_tree(observations.edges, observations.scores):
        photos = [int(photo) for photo in observations.edges[e]]
        old, new = (0, 1) if from_first else (1, 0)
        sides = [observations.side(e, side) for side in (0, 1)]
        points.setdefault(photos[old], sides[old])  # The first edge's are where they are.
        similarity = _onto([(sides[old], points[photos[old]])])
        if similarity is None:
            return points, poses, [e]
        xyz, confidence = sides[new]
        points[photos[new]] = apply(similarity, xyz), confidence
        poses.setdefault(photos[0], _camera_of_edge(observations, e, similarity))
    return points, poses, []


def _onto(parts: Sequence[tuple[Placed, Placed]]) -> Similarity | None:
    """The similarity from points to where they are placed, by what both are sure of."""
    return similarity_of_points(
        np.concatenate([xyz for (xyz, _), _ in parts], axis=1),
        np.concatenate([xyz for _, (xyz, _) in parts], axis=1),
        np.concatenate([np.log(np.minimum(one, other)) for (_, one), (_, other) in parts]),
    )


def _camera_of_edge(observations: Observations, edge: int, similarity: Similarity) -> Float64:
    """World-to-camera [4, 4] of an edge's first photo."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = similarity.rotation.T
    centre = apply(similarity, observations.camera(edge)[:, None])[:, 0]
    viewmat[:3, 3] = -similarity.rotation.T @ centre
    return viewmat


def _pose(
    observations: Observations,
    photo: int,
    placed: Placed,
    K: Float64,
    size: tuple[int, int],
    seed: int,
) -> Float64 | None:
    """World-to-camera [4, 4] of a photo whose points are placed.

    Of the poses that the pixels and that the photo's own frame tell, the one whose rays pass nearer
    to the points: where these are right only nearly, and seen from far beside where they were first
    seen, RANSAC finds some that agree on a wrong pose.
    """
    pixels = observations.photos[photo].pixels
    points, confidence = placed
    found = absolute_pose(points, pixels, confidence, K, size, seed)
    poses = [] if found is None else [found[0]]
    own = _own_pose(observations, photo, placed)
    if own is not None:
        poses.append(own)
    if not poses:
        return None
    rays = np.ones((3, len(pixels)))
    rays[:2] = ((pixels - K[[0, 1], 2]) / K[[0, 1], [0, 1]]).T
    weights = np.log(confidence)

    def off_rays(viewmat: Float64) -> float:
        local = viewmat[:3, :3] @ points + viewmat[:3, 3:]
        return float(np.linalg.norm(local - rays * np.maximum(local[2], 0.0), axis=0) @ weights)

    return min(poses, key=off_rays)


def _own_pose(observations: Observations, photo: int, placed: Placed) -> Float64 | None:
    """World-to-camera [4, 4] from what the photo's own frame says of its points, or None."""
    own = np.flatnonzero(observations.edges[:, 0] == photo)
    for e in own[np.argsort(-observations.scores[own], kind="stable")]:
        similarity = _onto([(observations.side(int(e), 0), placed)])
        if similarity is not None:
            return _camera_of_edge(observations, int(e), similarity)
    return None


def _to_fixed(found: dict[int, Float64], photos: Sequence[PhotoToAlign]) -> Similarity:
    """The similarity that brings found cameras to the fixed ones; of one, its scale is kept."""
    pairs = []
    for photo, viewmat in found.items():
        fixed = photos[photo].viewmat
        if fixed is not None:
            pairs.append((Camera(viewmat, np.eye(3), 1, 1), Camera(fixed, np.eye(3), 1, 1)))
    if not pairs:
        return Similarity(1.0, np.eye(3), np.zeros(3))
    cameras, others = zip(*pairs, strict=True)
    return similarity_between(cameras, others)


def _edges(observations: Observations, placed: dict[int, Placed]) -> list[Similarity | None]:
    """Per edge the similarity from its frame to the points of both its photos."""
    return [
        _onto([(observations.side(e, side), placed[int(photos[side])]) for side in (0, 1)])
        for e, photos in enumerate(observations.edges)
    ]


def _depths(observations: Observations, placement: Placement, photo: int) -> Float64:
    """Depths [P] of a photo's pixels; those that nobody sees before the camera get the median."""
    seen = observations.photos[photo]
    K, viewmat = placement.intrinsics[photo], placement.viewmats[photo]
    camera = Similarity(1.0, viewmat[:3, :3], viewmat[:3, 3])
    to_camera = [joined(camera, placement.edges[e]) for e in seen.edges]
    slopes = (seen.pixels - K[[0, 1], 2]) / K[[0, 1], [0, 1]]
    depth = depths_on_rays(
        np.stack([apply(edge, xyz) for edge, xyz in zip(to_camera, seen.points, strict=True)]),
        np.log(seen.confidence),
        slopes.T,
    )
    with np.errstate(invalid="ignore"):
        ahead = depth > 0.0
    typical = float(np.median(depth[ahead])) if ahead.any() else 1.0
    return np.maximum(np.where(ahead, depth, typical), 1e-3 * typical)
