"""Global alignment: from pointmaps of pairs of photos to cameras and depths of all of them.

DUSt3R's (Wang et al. 2024, section 3.4). ``docs/how-it-works/alignment.md`` says where
ours differs and why.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from igsr.capture import Camera
from igsr.errors import IgsrError
from igsr.geometry.similarity import Similarity, apply
from igsr.pose.alignment.aligned_photo import AlignedPhoto
from igsr.pose.alignment.depths_on_rays import CHUNK, depths_on_rays
from igsr.pose.alignment.initial_alignment import start
from igsr.pose.alignment.objective import Objective
from igsr.pose.alignment.observations import (
    Edge,
    Observations,
    observe,
    sides,
    strong_edges,
    usable_confidence,
)
from igsr.pose.alignment.placement import Placement, inverse, joined
from igsr.pose.alignment.predictions import PairPrediction, PhotoToAlign, checked_predictions
from igsr.pose.alignment.spanning_tree import components
from igsr.pose.grid import Grid

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]

#: Steps of the optimiser.
STEPS = 300
#: Its rate falls from the first to the last by a cosine; both momenta, as in DUSt3R.
FIRST_RATE, LAST_RATE, BETAS = 0.01, 1e-6, (0.9, 0.9)
#: Gradients are per pixel of millions: what Adam adds to their size must be far below.
ADAM_EPSILON = 1e-15


@dataclass(eq=False)
class Alignment:
    """What the alignment found.

    Attributes:
        photos: None where one is not registered.
        pairs: the directed pairs that were aligned.
        start_loss: the objective after the start; its unit is the median depth.
        loss: the objective at the end.
        warnings: messages that name the photos that are not registered.
    """

    photos: list[AlignedPhoto | None]
    pairs: list[tuple[int, int]]
    start_loss: float
    loss: float
    warnings: list[str]


def align(
    predictions: Sequence[PairPrediction],
    photos: Sequence[PhotoToAlign],
    *,
    steps: int = STEPS,
    seed: int = 0,
    progress: Callable[[str, int, int], None] | None = None,
) -> Alignment:
    """Cameras and depths that agree best with what was predicted for pairs of photos.

    Without fixed poses the world is the camera frame of the strongest pair's first photo, and its
    unit that in which this pair's points lie 1 from their middle on average. One fixed pose sets
    the world but not its unit, two or more at different places set both.

    Pairs that have nothing in common are left out. Of photos that then fall into groups, the group
    with most fixed poses is placed, and of those with equally many the largest.

    Deterministic for given predictions, seed and number of threads.

    Args:
        predictions: of directed pairs.
        photos: in the order that predictions count them.
        steps: of the optimiser; 0 ends with the start.
        seed: what RANSAC draws from.
        progress: called as progress("alignment", done, all).

    Raises:
        IgsrError: a prediction does not fit its photos, steps is not a whole number of at least 0,
            or no two photos have anything in common.
    """
    if isinstance(steps, bool) or not isinstance(steps, (int, np.integer)) or steps < 0:
        raise IgsrError(f"steps is {steps!r}; give a whole number that is not negative")
    edges, observations, begun, depths = _started(
        strong_edges(checked_predictions(photos, predictions)), photos, seed
    )
    normal = _normal_frame(begun, depths)
    objective = Objective(
        observations,
        begun.mapped(normal),
        {i: normal.scale * depth for i, depth in depths.items()},
        photos,
    )
    start_loss, loss = _optimise(objective, steps, progress)
    found = objective.found().mapped(inverse(normal))
    if all(photos[i].viewmat is None for i in found.viewmats):
        anchor = found.viewmats[int(observations.edges[np.argmax(observations.scores), 0])]
        found = found.mapped(Similarity(1.0, anchor[:3, :3], anchor[:3, 3]))

    placed: list[AlignedPhoto | None] = []
    warnings = []
    for i, photo in enumerate(photos):
        if i not in found.viewmats:
            placed.append(None)
            warnings.append(
                f"{photo.name} could not be aligned: the network sees nothing in it that the "
                "other photos show too"
            )
            continue
        viewmat = found.viewmats[i] if photo.viewmat is None else photo.viewmat
        camera = Camera(viewmat, found.intrinsics[i], photo.width, photo.height)
        depth, confidence = _depth(edges, observations, found.edges, i, camera, photo.grid)
        placed.append(AlignedPhoto(camera, photo.grid, depth, confidence))
    pairs = [(edge.prediction.first, edge.prediction.second) for edge in edges]
    return Alignment(placed, pairs, start_loss, loss, warnings)


def _started(
    edges: list[Edge], photos: Sequence[PhotoToAlign], seed: int
) -> tuple[list[Edge], Observations, Placement, dict[int, Float64]]:
    """The edges of the photos that are placed, what they say, and where the alignment starts."""
    while True:
        if not edges:
            raise IgsrError(
                "no two of the photos show the same thing, as far as the network can tell; give "
                "photos that overlap more"
            )
        group = _group_to_place(edges, photos)
        edges = [edge for edge in edges if edge.prediction.first in group]
        observations = observe(edges, photos)
        begun = start(observations, photos, seed)
        if not isinstance(begun, list):
            return edges, observations, *begun
        edges = [edge for e, edge in enumerate(edges) if e not in begun]


def _group_to_place(edges: list[Edge], photos: Sequence[PhotoToAlign]) -> set[int]:
    """The connected photos with most fixed poses, then most photos, then the highest scores."""
    ends = [(edge.prediction.first, edge.prediction.second) for edge in edges]

    def rank(group: list[int]) -> tuple[int, int, float]:
        fixed = sum(photos[i].viewmat is not None for i in group) if len(group) > 1 else 0
        return fixed, len(group), sum(e.score for e in edges if e.prediction.first in group)

    best = max(components(len(photos), ends), key=rank)
    return set(best)


def _normal_frame(start: Placement, depths: dict[int, Float64]) -> Similarity:
    """What brings the cameras' mean to zero and the median depth to one."""
    unit = float(np.median(np.concatenate(list(depths.values()))))
    centres = [-viewmat[:3, :3].T @ viewmat[:3, 3] for viewmat in start.viewmats.values()]
    return Similarity(1.0 / unit, np.eye(3), -np.mean(centres, axis=0) / unit)


def _optimise(
    objective: Objective, steps: int, progress: Callable[[str, int, int], None] | None
) -> tuple[float, float]:
    """Adam from the start to the best that it comes by: the objective at the start, and there.

    What is exact already has no gradient worth the name, and steps of the first rate lead away.
    """
    optimiser = torch.optim.Adam(
        objective.parameters, lr=FIRST_RATE, betas=BETAS, eps=ADAM_EPSILON, foreach=True
    )
    least, best, begun = np.inf, [p.detach().clone() for p in objective.parameters], 0.0
    for step in range(steps + 1):
        loss = objective.loss()
        if step == 0:
            begun = loss
        if loss < least:
            least = loss
            for kept, parameter in zip(best, objective.parameters, strict=True):
                kept.copy_(parameter.detach())
        if progress is not None:
            progress("alignment", step, steps)
        if step < steps:
            done = 0.5 - 0.5 * np.cos(np.pi * step / steps)
            optimiser.param_groups[0]["lr"] = FIRST_RATE + (LAST_RATE - FIRST_RATE) * done
            optimiser.step()
    with torch.no_grad():
        for parameter, kept in zip(objective.parameters, best, strict=True):
            parameter.copy_(kept)
    return begun, least


def _depth(
    edges: Sequence[Edge],
    observations: Observations,
    placed: Sequence[Similarity],
    photo: int,
    camera: Camera,
    grid: Grid,
) -> tuple[Float32, Float32]:
    """Depth and confidence [h, w] of all pixels of a photo's grid, thinned or not."""
    slopes = ((grid.photo_pixels() - camera.K[[0, 1], 2]) / camera.K[[0, 1], [0, 1]]).T
    to_camera = Similarity(1.0, camera.viewmat[:3, :3], camera.viewmat[:3, 3])
    seen = observations.photos[photo]
    maps, frames = [], []
    for e, is_first in zip(seen.edges, seen.is_first, strict=True):
        unit = observations.units[e]
        stored = Similarity(1.0 / unit, np.eye(3), -observations.centres[e] / unit)
        frames.append(joined(to_camera, joined(placed[e], stored)))
        points, confidence = sides(edges[e].prediction)[0 if is_first else 1]
        maps.append((points, usable_confidence(points, confidence)))
    depth = np.empty((grid.height, grid.width), dtype=np.float32)
    confidence = np.max([sure for _, sure in maps], axis=0)
    # All maps at once would be a second copy of them.
    step = max(1, CHUNK // (3 * len(maps) * grid.width))
    for begin in range(0, grid.height, step):
        rows = slice(begin, begin + step)
        sure = np.stack([c[rows].ravel() for _, c in maps])
        local = [
            apply(frame, np.where(c > 1.0, xyz[rows].reshape(-1, 3).T, 0.0).astype(np.float64))
            for frame, (xyz, _), c in zip(frames, maps, sure, strict=True)
        ]
        own = slice(begin * grid.width, begin * grid.width + sure.shape[1])
        found = depths_on_rays(np.stack(local), np.log(sure), slopes[:, own])
        depth[rows] = found.reshape(-1, grid.width)
    depth[~(depth > 0.0)] = np.nan
    return depth, confidence
