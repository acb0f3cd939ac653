"""Initialize the alignment: join pointmaps along the strongest spanning tree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr.cameras.alignment.camera_solvers import (
    Placed,
    absolute_pose,
    depths_on_rays,
    intrinsics_of,
)
from igsr.cameras.alignment.predictions import Observations, PhotoToAlign
from igsr.cameras.grid import ray_slopes
from igsr.capture import Camera
from igsr.geometry.similarity import Similarity, similarity_between, similarity_of_points

Float64 = npt.NDArray[np.float64]


@dataclass(eq=False)
class Placement:
    """Cameras and edges in one world frame."""

    viewmats: dict[int, Float64]  # [4, 4] per photo, world to camera
    intrinsics: dict[int, Float64]  # [3, 3] per photo, pixels of the photo
    edges: list[Similarity]  # per edge, from its stored frame (``Observations``) to the world

    def mapped(self, world: Similarity) -> Placement:
        """Map to another world frame."""
        return Placement(
            {photo: mapped_viewmat(world, viewmat) for photo, viewmat in self.viewmats.items()},
            self.intrinsics,
            [world @ edge for edge in self.edges],
        )


def mapped_viewmat(world: Similarity, viewmat: Float64) -> Float64:
    """Map a world-to-camera [4, 4] to another world."""
    return world.camera(Camera(viewmat, np.eye(3), 1, 1)).viewmat


def components(photos: int, edges: Sequence[tuple[int, int]]) -> list[list[int]]:
    """Connected components of a number of photos, the largest first."""
    label = np.arange(photos)
    for first, second in edges:
        label[label == label[second]] = label[first]
    groups: dict[int, list[int]] = {}
    for photo in range(photos):
        groups.setdefault(int(label[photo]), []).append(photo)
    return sorted(groups.values(), key=len, reverse=True)


def spanning_tree(edges: npt.NDArray[np.int64], scores: Float64) -> list[tuple[int, bool]]:
    """The spanning tree of edges [E, 2] with the highest scores [E], by Prim's algorithm.

    Returns:
        Per edge of the tree, in order, its index, and whether its first photo was reached before.
    """
    order = np.argsort(-scores, kind="stable")
    reached = {int(edges[order[0], 0])}
    everything = {int(photo) for photo in edges.ravel()}
    tree = []
    while reached != everything:
        for e in order:
            first, second = (int(photo) for photo in edges[e])
            if (first in reached) != (second in reached):
                tree.append((int(e), first in reached))
                reached |= {first, second}
                break
    return tree


def start(
    observations: Observations, photos: Sequence[PhotoToAlign], seed: int
) -> tuple[Placement, dict[int, Float64]] | list[int]:
    """Estimate initial cameras, edges, and the depths [P] of every photo's pixels.

    Returns:
        The placement and depths of connected photos; or the indices of edges to leave out, since
        they contradict others or determine no camera.
    """
    placed, poses, failed = _along_the_tree(observations)
    if failed:
        return failed
    intrinsics = intrinsics_of(observations, photos, placed, seed)
    for photo in observations.photos:
        if photo in intrinsics and photo not in poses:
            size = photos[photo].height, photos[photo].width
            pose = _pose(observations, photo, placed[photo], intrinsics[photo], size, seed)
            if pose is not None:
                poses[photo] = pose
    for photo in observations.photos:
        if photo not in intrinsics or photo not in poses:
            failed += np.flatnonzero((observations.edges == photo).any(axis=1)).tolist()
    if failed:
        return failed
    world = _to_fixed(poses, photos)
    placed = {photo: (world.apply(xyz), conf) for photo, (xyz, conf) in placed.items()}
    for photo, viewmat in poses.items():
        fixed = photos[photo].viewmat
        poses[photo] = mapped_viewmat(world, viewmat) if fixed is None else fixed
    edges = [
        _onto([(observations.side(e, side), placed[int(ends[side])]) for side in (0, 1)])
        for e, ends in enumerate(observations.edges)
    ]
    failed = [e for e, similarity in enumerate(edges) if similarity is None]
    if failed:
        return failed
    placement = Placement(poses, intrinsics, [edge for edge in edges if edge])
    return placement, {photo: _depths(observations, placement, photo) for photo in placed}


def _along_the_tree(
    observations: Observations,
) -> tuple[dict[int, Placed], dict[int, Float64], list[int]]:
    """Points of all photos, world-to-camera [4, 4] of the first photos of the tree's edges, and the
    edge that could not be joined, if any."""
    points: dict[int, Placed] = {}
    poses: dict[int, Float64] = {}
    for e, from_first in spanning_tree(observations.edges, observations.scores):
        photos = [int(photo) for photo in observations.edges[e]]
        old, new = (0, 1) if from_first else (1, 0)
        sides = [observations.side(e, side) for side in (0, 1)]
        points.setdefault(photos[old], sides[old])  # The first edge defines the world.
        similarity = _onto([(sides[old], points[photos[old]])])
        if similarity is None:
            return points, poses, [e]
        xyz, confidence = sides[new]
        points[photos[new]] = similarity.apply(xyz), confidence
        poses.setdefault(photos[0], _camera_of_edge(observations, e, similarity))
    return points, poses, []


def _onto(parts: Sequence[tuple[Placed, Placed]]) -> Similarity | None:
    """The similarity from points to their placed counterparts, weighted by the lower confidence."""
    return similarity_of_points(
        np.concatenate([xyz for (xyz, _), _ in parts], axis=1),
        np.concatenate([xyz for _, (xyz, _) in parts], axis=1),
        np.concatenate([np.log(np.minimum(a, b)) for (_, a), (_, b) in parts]),
    )


def _camera_of_edge(observations: Observations, edge: int, similarity: Similarity) -> Float64:
    """World-to-camera [4, 4] of an edge's first photo."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = similarity.rotation.T
    center = similarity.apply(observations.camera(edge)[:, None])[:, 0]
    viewmat[:3, 3] = -similarity.rotation.T @ center
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

    There are two candidates, from the pixels and from the photo's own frame. The one whose rays
    pass nearer to the points is taken: with noisy points, RANSAC can find many inliers of a wrong
    pose.
    """
    pixels = observations.photos[photo].pixels
    points, confidence = placed
    estimate = absolute_pose(points, pixels, confidence, K, size, seed)
    poses = [] if estimate is None else [estimate[0]]
    own = np.flatnonzero(observations.edges[:, 0] == photo)
    for e in own[np.argsort(-observations.scores[own], kind="stable")]:
        similarity = _onto([(observations.side(int(e), 0), placed)])
        if similarity is not None:
            poses.append(_camera_of_edge(observations, int(e), similarity))
            break
    rays = np.ones((3, len(pixels)))
    rays[:2] = ray_slopes(pixels, K).T
    weights = np.log(confidence)

    def error(viewmat: Float64) -> float:
        local = viewmat[:3, :3] @ points + viewmat[:3, 3:]
        return float(np.linalg.norm(local - rays * np.maximum(local[2], 0.0), axis=0) @ weights)

    return min(poses, key=error, default=None)


def _to_fixed(poses: dict[int, Float64], photos: Sequence[PhotoToAlign]) -> Similarity:
    """The similarity that maps poses to the fixed ones; with a single one, scale is kept."""
    pairs = []
    for photo, viewmat in poses.items():
        fixed = photos[photo].viewmat
        if fixed is not None:
            pairs.append((Camera(viewmat, np.eye(3), 1, 1), Camera(fixed, np.eye(3), 1, 1)))
    if not pairs:
        return Similarity(1.0, np.eye(3), np.zeros(3))
    cameras, others = zip(*pairs, strict=True)
    return similarity_between(cameras, others)


def _depths(observations: Observations, placement: Placement, photo: int) -> Float64:
    """Depths [P] of a photo's pixels; the median for pixels without points ahead of the camera."""
    seen = observations.photos[photo]
    viewmat = placement.viewmats[photo]
    camera = Similarity(1.0, viewmat[:3, :3], viewmat[:3, 3])
    to_camera = [camera @ placement.edges[e] for e in seen.edges]
    depth = depths_on_rays(
        np.stack([edge.apply(xyz) for edge, xyz in zip(to_camera, seen.points, strict=True)]),
        np.log(seen.confidence),
        ray_slopes(seen.pixels, placement.intrinsics[photo]).T,
    )
    with np.errstate(invalid="ignore"):
        ahead = depth > 0.0
    typical = float(np.median(depth[ahead])) if ahead.any() else 1.0
    return np.maximum(np.where(ahead, depth, typical), 1e-3 * typical)
