"""The objective of the alignment, and its gradient.

    sum_e sum_p ln(c_first) ||X_first(p) - s_e R_e q_first(p) - t_e|| / sum_e pixels of e's first
    + the same over the second photos

X_i(p) = C_i + R_i d_i(p) (x, y, 1) is the world point of a pixel, q_e(p) its prediction on edge e,
and c_e(p) the raw confidence (Wang et al. 2024, equation 5; the logarithm and the two means are
as in the published code).
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from igsr.cameras.alignment.camera_solvers import BATCH_NUMBERS
from igsr.cameras.alignment.initial_alignment import Placement
from igsr.cameras.alignment.predictions import Observations, PhotoToAlign
from igsr.cameras.grid import ray_slopes
from igsr.geometry.similarity import Similarity

Float64 = npt.NDArray[np.float64]

#: Minimum distance in the weights, world units.
MIN_DISTANCE = 1e-9


@dataclass(eq=False)
class _Photo:
    """Terms of one photo: P pixels on K edges."""

    points: Tensor  # float32 [K, 3, P]
    weights: Tensor  # float32 [K, P]
    edges: Tensor  # [K]
    slopes: Tensor  # float32 [2, P], (x, y) of the initial rays
    depths: Tensor  # float32 [P], initial
    part: slice  # of all photos' depths
    focal: int  # index into the free focal lengths, or -1


class Objective:
    """Cameras, depths and edges, as differences to an initial placement.

    Rotations are Gibbs vectors (axis times the tangent of half the angle) after the initial
    rotation; depths, focal lengths and scales are logarithms of ratios. All begin at zero.
    """

    def __init__(
        self,
        observations: Observations,
        initial: Placement,
        depths: dict[int, Float64],
        photos: Sequence[PhotoToAlign],
    ) -> None:
        """Begin at an initial placement.

        Args:
            observations: to be aligned.
            initial: the placement.
            depths: [P] of each photo's pixels, positive.
            photos: all of them. Unless poses are fixed at two places, the mean scale of the edges
                is fixed: otherwise everything would shrink to a point.
        """
        self._initial = initial
        self.photos = sorted(observations.photos)
        free_groups: dict[Hashable, int] = {}
        for i in self.photos:
            if photos[i].intrinsics is None:
                free_groups.setdefault(photos[i].group, len(free_groups))
        first = torch.from_numpy(observations.edges[:, 0])
        second = torch.from_numpy(observations.edges[:, 1])
        pixels = torch.zeros(max(self.photos) + 1)
        for i, seen in observations.photos.items():
            pixels[i] = len(seen.pixels)
        areas = float(pixels[first].sum()), float(pixels[second].sum())
        self._parts: list[_Photo] = []
        begin = 0
        for i in self.photos:
            seen = observations.photos[i]
            slopes = ray_slopes(seen.pixels, initial.intrinsics[i])
            weights = torch.from_numpy(seen.confidence).log()
            weights /= torch.where(torch.from_numpy(seen.is_first), *areas)[:, None]
            end = begin + len(seen.pixels)
            self._parts.append(
                _Photo(
                    torch.from_numpy(seen.points),
                    weights,
                    torch.from_numpy(seen.edges),
                    torch.from_numpy(slopes.T.astype(np.float32)).contiguous(),
                    torch.from_numpy(depths[i].astype(np.float32)),
                    slice(begin, end),
                    free_groups[photos[i].group] if photos[i].intrinsics is None else -1,
                )
            )
            begin = end
        views = np.stack([initial.viewmats[i] for i in self.photos])
        self._rotations = torch.from_numpy(views[:, :3, :3].transpose(0, 2, 1).copy())
        self._centers = -(self._rotations @ torch.from_numpy(views[:, :3, 3:]))[..., 0]
        self._edge_rotations = torch.from_numpy(np.stack([e.rotation for e in initial.edges]))
        self._edge_translations = torch.from_numpy(np.stack([e.translation for e in initial.edges]))
        self._edge_scales = torch.tensor([e.scale for e in initial.edges], dtype=torch.float64)
        free = [float(photos[i].viewmat is None) for i in self.photos]
        self._free = torch.tensor(free, dtype=torch.float64)[:, None]
        fixed = self._centers[self._free[:, 0] == 0.0]
        self._fix_scale = len(fixed) < 2 or float((fixed - fixed[0]).abs().max()) < 1e-9

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(*shape, dtype=torch.float64, requires_grad=True)

        edge_count, count = len(first), len(self.photos)
        self.edge_turns, self.edge_moves = zeros(edge_count, 3), zeros(edge_count, 3)
        self.edge_scales = zeros(edge_count)
        self.turns, self.moves = zeros(count, 3), zeros(count, 3)
        self.focals = zeros(len(free_groups))  # one per group of photos whose focal length is free
        self.depths = torch.zeros(begin, dtype=torch.float32, requires_grad=True)  # of all photos
        self.parameters = [
            *(self.edge_turns, self.edge_moves, self.edge_scales),
            *(self.turns, self.moves, self.focals, self.depths),
        ]

    def edges(self) -> tuple[Tensor, Tensor]:
        """Scaled rotations [E, 3, 3] and translations [E, 3] of edges to the world."""
        ratios = self.edge_scales
        if self._fix_scale:
            ratios = ratios - ratios.mean()
        scales = self._edge_scales * ratios.exp()
        turned = _rotations(self.edge_turns) @ self._edge_rotations
        return scales[:, None, None] * turned, self._edge_translations + self.edge_moves

    def cameras(self) -> tuple[Tensor, Tensor]:
        """Rotations [N, 3, 3] from cameras to the world, and camera centers [N, 3]."""
        turned = _rotations(self.turns * self._free) @ self._rotations
        return turned, self._centers + self.moves * self._free

    def placement(self) -> Placement:
        """Cameras and edges at the current parameters."""
        rotations, centers = (x.detach().numpy() for x in self.cameras())
        matrices, translations = (x.detach().numpy() for x in self.edges())
        viewmats, intrinsics = {}, {}
        for n, (i, photo) in enumerate(zip(self.photos, self._parts, strict=True)):
            viewmats[i] = np.eye(4)
            viewmats[i][:3, :3] = rotations[n].T
            viewmats[i][:3, 3] = -rotations[n].T @ centers[n]
            intrinsics[i] = self._initial.intrinsics[i].copy()
            if photo.focal >= 0:
                intrinsics[i][[0, 1], [0, 1]] *= float(self.focals.detach()[photo.focal].exp())
        edges = []
        for matrix, translation in zip(matrices, translations, strict=True):
            scale = float(np.cbrt(np.linalg.det(matrix)))
            edges.append(Similarity(scale, matrix / scale, translation))
        return Placement(viewmats, intrinsics, edges)

    def loss(self) -> float:
        """Compute the loss, and set ``grad`` of the parameters."""
        edges, cameras = self.edges(), self.cameras()
        A, t, R, C = (x.detach().float() for x in (*edges, *cameras))
        gradients = [torch.zeros_like(x) for x in (A, t, R, C)]
        total = 0.0
        focals = torch.zeros_like(self.focals)
        depths = torch.empty_like(self.depths)
        for n, photo in enumerate(self._parts):
            zoom = float(torch.exp(-self.focals.detach()[photo.focal])) if photo.focal >= 0 else 1.0
            edge_A, edge_t = A[photo.edges], t[photo.edges]
            sums = [torch.zeros_like(edge_A), torch.zeros_like(edge_t)]
            step = max(1, BATCH_NUMBERS // (3 * len(photo.edges)))
            for begin in range(0, len(photo.depths), step):
                part = slice(begin, begin + step)
                own = slice(
                    photo.part.start + begin, min(photo.part.start + begin + step, photo.part.stop)
                )
                z = photo.depths[part] * self.depths.detach()[own].exp()
                local = torch.cat([photo.slopes[:, part] * (z * zoom), z[None]])
                world = torch.addmm(C[n][:, None], R[n], local)
                points, weights = photo.points[:, :, part], photo.weights[:, part]
                off = world - edge_t[:, :, None]
                off.baddbmm_(edge_A, points, alpha=-1.0)
                # linalg.vector_norm over the middle dimension is fifty times slower.
                distance = off.square().sum(dim=1).sqrt_()
                total += float((weights * distance).sum())
                weights = weights / distance.clamp_(min=MIN_DISTANCE)
                off *= weights[:, None]
                sums[0] -= torch.bmm(off, points.transpose(1, 2))
                sums[1] -= off.sum(dim=2)
                pull = off.sum(dim=0)
                gradients[2][n] += pull @ local.T
                gradients[3][n] += pull.sum(dim=1)
                pull = (R[n].T @ pull).mul_(local)
                depths[own] = pull.sum(dim=0)
                if photo.focal >= 0:
                    focals[photo.focal] -= float(pull[:2].sum())
            gradients[0].index_add_(0, photo.edges, sums[0])
            gradients[1].index_add_(0, photo.edges, sums[1])
        for parameter in self.parameters:
            parameter.grad = None
        torch.autograd.backward([*edges, *cameras], [x.double() for x in gradients])
        self.focals.grad, self.depths.grad = focals, depths
        return total


def _rotations(gibbs: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of Gibbs vectors [N, 3]; smooth up to half a turn."""
    x, y, z = gibbs.unbind(dim=1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
    square = gibbs.square().sum(dim=1)[:, None, None]
    return torch.eye(3, dtype=gibbs.dtype) + 2.0 / (1.0 + square) * (cross + cross @ cross)
