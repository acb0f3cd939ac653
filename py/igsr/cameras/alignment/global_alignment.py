"""Global alignment of pointmaps (Wang et al. 2024, section 3.4).

``docs/how-it-works/alignment.md`` describes how it differs from DUSt3R's, and why.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from igsr.cameras.alignment.camera_solvers import BATCH_NUMBERS, depths_on_rays
from igsr.cameras.alignment.initial_alignment import Placement, components, start
from igsr.cameras.alignment.objective import Objective
from igsr.cameras.alignment.predictions import (
    Edge,
    Observations,
    PairPrediction,
    PhotoToAlign,
    observe,
    overlapping_edges,
    usable_confidence,
)
from igsr.cameras.depth_maps import AlignedPhoto
from igsr.cameras.grid import Grid, ray_slopes
from igsr.capture import Camera
from igsr.errors import IgsrError
from igsr.geometry.similarity import Similarity

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]

#: Default number of optimizer steps.
STEPS = 300
#: Learning rates of the first and the last step, with cosine decay between them.
FIRST_RATE = 0.01
LAST_RATE = 1e-6
#: Momenta, as in DUSt3R.
BETAS = (0.9, 0.9)
#: Gradients are of millions of pixels each, so Adam's epsilon must be far smaller.
ADAM_EPSILON = 1e-15


@dataclass(eq=False)
class Alignment:
    """Result of the alignment."""

    photos: list[AlignedPhoto | None]  # None for unregistered ones
    pairs: list[tuple[int, int]]  # the aligned ordered pairs
    start_loss: float  # initial objective, in units of the median depth
    loss: float  # final objective
    warnings: list[str]  # name unregistered photos


def align(
    predictions: Sequence[PairPrediction],
    photos: Sequence[PhotoToAlign],
    *,
    steps: int = STEPS,
    seed: int = 0,
    progress: Callable[[str, int, int], None] | None = None,
) -> Alignment:
    """Estimate the cameras and depths that best agree with the predictions for pairs of photos.

    Without fixed poses, the world is the camera frame of the best pair's first photo, and its unit
    the mean distance of that pair's points from their center. One fixed pose defines the world but
    not its unit; two or more at different places define both.

    Pairs that do not overlap are ignored. If photos then form several groups, the group with the
    most fixed poses, then the largest, is placed.

    Deterministic for given predictions, seed and number of threads.

    Args:
        predictions: for ordered pairs.
        photos: in the order that predictions count them.
        steps: of the optimizer; 0 keeps the initialization.
        seed: of RANSAC.
        progress: called as progress("alignment", done, total).

    Raises:
        IgsrError: no two photos overlap.
    """
    edges, observations, initial, depths = _initialized(
        overlapping_edges(predictions), photos, seed
    )
    # Optimize with the cameras' mean at zero and the median depth at one.
    unit = float(np.median(np.concatenate(list(depths.values()))))
    centers = [-viewmat[:3, :3].T @ viewmat[:3, 3] for viewmat in initial.viewmats.values()]
    normal = Similarity(1.0 / unit, np.eye(3), -np.mean(centers, axis=0) / unit)
    objective = Objective(
        observations,
        initial.mapped(normal),
        {i: normal.scale * depth for i, depth in depths.items()},
        photos,
    )
    start_loss, loss = _optimize(objective, steps, progress)
    placement = objective.placement().mapped(normal.inverse())
    if all(photos[i].viewmat is None for i in placement.viewmats):
        anchor = placement.viewmats[int(observations.edges[np.argmax(observations.scores), 0])]
        placement = placement.mapped(Similarity(1.0, anchor[:3, :3], anchor[:3, 3]))

    aligned: list[AlignedPhoto | None] = []
    warnings = []
    for i, photo in enumerate(photos):
        if i not in placement.viewmats:
            aligned.append(None)
            warnings.append(
                f"{photo.name} could not be aligned: the network sees no overlap with the other "
                "photos"
            )
            continue
        viewmat = placement.viewmats[i] if photo.viewmat is None else photo.viewmat
        camera = Camera(viewmat, placement.intrinsics[i], photo.width, photo.height)
        depth, confidence = _depth_map(edges, observations, placement.edges, i, camera, photo.grid)
        aligned.append(AlignedPhoto(camera, photo.grid, depth, confidence))
    return Alignment(
        aligned, [edge.prediction.photos for edge in edges], start_loss, loss, warnings
    )


def _initialized(
    edges: list[Edge], photos: Sequence[PhotoToAlign], seed: int
) -> tuple[list[Edge], Observations, Placement, dict[int, Float64]]:
    """Edges and observations of the photos that are placed, and their initial placement."""

    def rank(group: list[int]) -> tuple[int, int, float]:
        fixed = sum(photos[i].viewmat is not None for i in group) if len(group) > 1 else 0
        return fixed, len(group), sum(e.score for e in edges if e.prediction.first in group)

    while edges:
        groups = components(len(photos), [edge.prediction.photos for edge in edges])
        group = max(groups, key=rank)
        edges = [edge for edge in edges if edge.prediction.first in group]
        observations = observe(edges, photos)
        initial = start(observations, photos, seed)
        if not isinstance(initial, list):
            return edges, observations, *initial
        edges = [edge for e, edge in enumerate(edges) if e not in initial]
    raise IgsrError(
        "the network sees no overlap between any two photos; give photos that overlap more"
    )


def _optimize(
    objective: Objective, steps: int, progress: Callable[[str, int, int], None] | None
) -> tuple[float, float]:
    """Run Adam and keep the best parameters; the initial and the best objective.

    The last parameters may be worse than the first: if the predictions are exact, the gradients
    are only noise.
    """
    optimizer = torch.optim.Adam(
        objective.parameters, lr=FIRST_RATE, betas=BETAS, eps=ADAM_EPSILON, foreach=True
    )
    least, best, initial = np.inf, [p.detach().clone() for p in objective.parameters], 0.0
    for step in range(steps + 1):
        loss = objective.loss()
        if step == 0:
            initial = loss
        if loss < least:
            least = loss
            for kept, parameter in zip(best, objective.parameters, strict=True):
                kept.copy_(parameter.detach())
        if progress is not None:
            progress("alignment", step, steps)
        if step < steps:
            decay = 0.5 - 0.5 * np.cos(np.pi * step / steps)
            optimizer.param_groups[0]["lr"] = FIRST_RATE + (LAST_RATE - FIRST_RATE) * decay
            optimizer.step()
    with torch.no_grad():
        for parameter, kept in zip(objective.parameters, best, strict=True):
            parameter.copy_(kept)
    return initial, least


def _depth_map(
    edges: Sequence[Edge],
    observations: Observations,
    placed: Sequence[Similarity],
    photo: int,
    camera: Camera,
    grid: Grid,
) -> tuple[Float32, Float32]:
    """Depth and confidence [h, w] of all pixels of a photo's grid, also of a thinned one."""
    slopes = ray_slopes(grid.photo_pixels(), camera.K).T
    to_camera = Similarity(1.0, camera.viewmat[:3, :3], camera.viewmat[:3, 3])
    seen = observations.photos[photo]
    maps, frames = [], []
    for e, is_first in zip(seen.edges, seen.is_first, strict=True):
        unit = observations.units[e]
        stored = Similarity(1.0 / unit, np.eye(3), -observations.centers[e] / unit)
        frames.append(to_camera @ (placed[e] @ stored))
        points, confidence = edges[e].prediction.sides[0 if is_first else 1]
        maps.append((points, usable_confidence(points, confidence)))
    depth = np.empty((grid.height, grid.width), dtype=np.float32)
    # In batches: all maps at once would be a second copy of them.
    step = max(1, BATCH_NUMBERS // (3 * len(maps) * grid.width))
    for begin in range(0, grid.height, step):
        rows = slice(begin, begin + step)
        usable = np.stack([c[rows].ravel() for _, c in maps])
        local = [
            frame.apply(np.where(c > 1.0, xyz[rows].reshape(-1, 3).T, 0.0).astype(np.float64))
            for frame, (xyz, _), c in zip(frames, maps, usable, strict=True)
        ]
        own = slice(begin * grid.width, begin * grid.width + usable.shape[1])
        part = depths_on_rays(np.stack(local), np.log(usable), slopes[:, own])
        depth[rows] = part.reshape(-1, grid.width)
    depth[~(depth > 0.0)] = np.nan
    return depth, np.max([c for _, c in maps], axis=0)
