"""Cameras of Depth Anything 3: from and to the network's nine numbers, and from its rays.

arXiv 2511.10647, section 3. A pose encoding is (t, q, fov_h, fov_w): the camera's centre in the
world, its rotation camera to world as a quaternion (x, y, z, w) of any length, and the vertical and
horizontal field of view in radians. The principal point is the image's centre, of which the nine
numbers cannot tell otherwise. Axes are OpenCV's; pixels have their centres at +0.5.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from igsr._internal.rotations import rotations_of
from igsr.capture.types import intrinsic_matrix
from igsr.errors import IgsrError

Float64 = npt.NDArray[np.float64]

#: The least tangent of half a field of view.
LEAST_TANGENT = 1e-6
#: The least distance that the unit of given cameras is taken to be.
LEAST_UNIT = 0.1

#: Part of the rays, the surest, that samples are drawn from; samples, and rays in each.
CANDIDATES, SAMPLES, SAMPLE = 0.3, 100, 8
#: Distance on the plane of 2 x 2 within which a ray agrees with a homography.
AGREES = 0.2
#: A ray's z in the world below which its place on the plane is not known.
LEAST_Z = 1e-4
DECOMPOSITIONS = ("centred", "free", "official")


def decode_pose(
    encoding: npt.ArrayLike | Tensor, height: int, width: int
) -> tuple[Float64, Float64]:
    """Cameras of pose encodings.

    Args:
        encoding: float [S, 9].
        height, width: of the views, pixels.

    Returns:
        World to camera float64 [S, 3, 4] and intrinsics float64 [S, 3, 3] in pixels. A field of
        view of 0, or of pi and more, gives a focal length of 500 000 sides.

    Raises:
        IgsrError: the encoding has another shape.
    """
    numbers = _array(encoding, "encoding", 2, 9)
    # The encoding has w last.
    centre, c2w = numbers[:, :3], rotations_of(np.roll(_unit(numbers[:, 3:7]), 1, axis=-1))
    tangents = np.maximum(np.tan(numbers[:, 7:] / 2.0), LEAST_TANGENT)
    focal_y, focal_x = (height / 2.0) / tangents[:, 0], (width / 2.0) / tangents[:, 1]
    intrinsics = np.stack(
        [
            intrinsic_matrix(float(fx), float(fy), width / 2.0, height / 2.0)
            for fx, fy in zip(focal_x, focal_y, strict=True)
        ]
    )
    return _w2c(c2w, centre), intrinsics


def encode_pose(
    viewmats: npt.ArrayLike | Tensor,
    intrinsics: npt.ArrayLike | Tensor,
    sizes: Sequence[tuple[int, int]],
) -> Tensor:
    """Pose encodings of cameras; their principal points are not encoded.

    Args:
        viewmats: float [S, 4, 4] or [S, 3, 4], world to camera.
        intrinsics: float [S, 3, 3], pixels.
        sizes: height and width of each view, pixels.

    Returns:
        float64 [S, 9], quaternions of length 1 with w not negative.
    """
    w2c = _numpy(viewmats)[:, :3]
    rotation, K = w2c[:, :, :3].swapaxes(1, 2), _numpy(intrinsics)
    centres = -(rotation @ w2c[:, :, 3:])[..., 0]
    sides = np.array(sizes, dtype=np.float64)
    focals = np.stack([K[:, 1, 1], K[:, 0, 0]], axis=-1)
    quaternions = np.stack([_quaternion(one) for one in rotation])
    fields = 2.0 * np.arctan(sides / 2.0 / focals)
    return torch.from_numpy(np.concatenate([centres, quaternions, fields], axis=1))


def normalized_viewmats(viewmats: npt.ArrayLike | Tensor) -> Float64:
    """Cameras in the frame of the first and in the unit that the network was trained with.

    Args:
        viewmats: float [S, 4, 4], world to camera.

    Returns:
        float64 [S, 4, 4]: the first is the identity, and the median distance of the centres from
        the first (the lower one of an even number, the first's own 0 counts) is 1, unless it was
        below 0.1.
    """
    given = _numpy(viewmats)
    relative: Float64 = given @ np.linalg.inv(given[0])
    centres = -(relative[:, :3, :3].swapaxes(1, 2) @ relative[:, :3, 3:])[..., 0]
    distances = np.sort(np.linalg.norm(centres - centres[0], axis=1))
    relative[:, :3, 3] /= max(LEAST_UNIT, float(distances[(len(distances) - 1) // 2]))
    return relative


def cameras_of_rays(
    rays: npt.ArrayLike | Tensor,
    confidence: npt.ArrayLike | Tensor,
    height: int,
    width: int,
    samples: npt.ArrayLike | Tensor | None = None,
    decomposition: str = "centred",
    seed: int = 0,
) -> tuple[Float64, Float64]:
    """Cameras that explain the rays of views best.

    The rays' directions are a homography of their places in the image, which RANSAC finds and a fit
    to all rays that agree with it refines.

    Args:
        rays: float [S, h, w, 6], direction and origin, evenly over the image.
        confidence: float [S, h, w], weights of rays, not negative.
        height, width: of the views, pixels.
        samples: int [samples, 8], counting the surest 30 % of a view's rays from the surest; drawn
            by ``seed`` if None.
        decomposition: how rotation and intrinsics are had from a homography. "centred", for photos
            whose principal point is in the middle: a lower triangular factor gives rotation and
            focal lengths, so that noise moves no principal point. "free", for photos that were cut:
            an upper triangular one, which is exact for any principal point. "official": as
            "centred", with the principal point that the lower triangular factor has, which is
            wrong for photos that were cut.
        seed: random seed.

    Returns:
        World to camera float64 [S, 3, 4] and intrinsics float64 [S, 3, 3] in pixels.

    Raises:
        IgsrError: an array has another shape, the decomposition is unknown, or a view's rays fit no
            camera.
    """
    if decomposition not in DECOMPOSITIONS:
        raise IgsrError(
            f"decomposition is {decomposition!r}; give one of {', '.join(DECOMPOSITIONS)}"
        )
    all_rays, weights = _array(rays, "rays", 4, 6), _numpy(confidence)
    if weights.shape != all_rays.shape[:3]:
        raise IgsrError(
            f"confidence has shape {list(weights.shape)}; give {list(all_rays.shape[:3])}, a "
            "weight per ray"
        )
    rows, columns = weights.shape[1:]
    x = -1.0 + (2.0 * np.arange(columns) + 1.0) / columns
    y = -1.0 + (2.0 * np.arange(rows) + 1.0) / rows
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    candidates = max(SAMPLE, int(CANDIDATES * len(places)))
    if samples is None:
        drawn = np.random.default_rng(seed).random((SAMPLES, SAMPLE))
        samples = (drawn * min(candidates, len(places))).astype(np.int64)
    chosen = np.asarray(_numpy(samples), dtype=np.int64)
    rotations, centres, intrinsics = [], [], []
    for n, (view, weight) in enumerate(zip(all_rays, weights, strict=True)):
        directions, origins = view.reshape(-1, 6)[:, :3], view.reshape(-1, 6)[:, 3:]
        known = np.isfinite(view.reshape(-1, 6)).all(axis=1) & np.isfinite(weight.ravel())
        directions, origins = (np.where(known[:, None], one, 1.0) for one in (directions, origins))
        weight = np.where(known, weight.ravel(), 0.0)
        # Published code divides by the world's z, which is near 0 for views across the reference.
        towards = np.eye(3) if decomposition == "official" else _turn_ahead(directions, weight)
        directions = directions @ towards.T
        weight = np.where(np.abs(directions[:, 2]) > LEAST_Z, weight, 0.0)
        directions[weight == 0.0] = 1.0
        targets = directions[:, :2] / directions[:, 2:]
        surest = np.argsort(-weight, kind="stable")[:candidates]
        homography = _homography_of(places, targets, weight, surest[chosen])
        if homography is None:
            raise IgsrError(f"the rays of view {n} fit no camera; its prediction is of no use")
        rotation, K = _decomposed(homography, decomposition)
        rotations.append(towards.T @ rotation)
        total = weight.sum()
        centres.append(weight @ origins / total)
        half = np.array([width / 2.0, height / 2.0])
        centre = half if decomposition == "centred" else (K[:2, 2] + 1.0) * half
        intrinsics.append(
            intrinsic_matrix(K[0, 0] * half[0], K[1, 1] * half[1], centre[0], centre[1])
        )
    return _w2c(np.stack(rotations), np.stack(centres)), np.stack(intrinsics)


def _turn_ahead(directions: Float64, weights: Float64) -> Float64:
    """The rotation [3, 3] that turns the mean of directions [N, 3] onto the z axis."""
    x, y, z = _unit(weights @ _unit(directions))
    # The reflection that swaps that direction with z, after one that changes nothing of z.
    between = _unit(np.array([x, y, z + np.copysign(1.0, z)]))
    swap = 2.0 * np.outer(between, between) - np.eye(3)
    turn: Float64 = swap if z >= 0.0 else np.diag([1.0, -1.0, -1.0]) @ swap
    return turn


def _homography_of(
    places: Float64, targets: Float64, weights: Float64, samples: npt.NDArray[np.int64]
) -> Float64 | None:
    """The homography [3, 3] from places [N, 2] to targets [N, 2] that most weight agrees with.

    Args:
        places, targets, weights: [N, 2], [N, 2], [N].
        samples: [samples, 8], indices of N.
    """
    equations = _equations(places, targets)
    best, best_score = None, 0.0
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for sample in samples:
            agrees = _agreeing(_solved(equations, weights, sample), places, targets) & (weights > 0)
            score = float(weights[agrees].sum())
            if score > best_score:
                best, best_score = agrees, score
    if best is None:
        return None
    refined = _solved(equations, weights, np.flatnonzero(best))
    if not (np.isfinite(refined).all() and abs(np.linalg.det(refined)) > 0.0):
        return None
    return refined if np.linalg.det(refined) > 0.0 else -refined


def _equations(places: Float64, targets: Float64) -> Float64:
    """[N, 2, 9]: the rows of the direct linear transform, each zero for the right homography."""
    whole = np.pad(places, ((0, 0), (0, 1)), constant_values=1.0)
    nothing = np.zeros_like(whole)
    u, v = targets[:, :1], targets[:, 1:]
    return np.stack(
        [
            np.concatenate([whole, nothing, -u * whole], axis=1),
            np.concatenate([nothing, whole, -v * whole], axis=1),
        ],
        axis=1,
    )


def _solved(equations: Float64, weights: Float64, used: npt.NDArray[np.int64]) -> Float64:
    """The homography [3, 3] with the least weighted sum of squares, H[2, 2] = 1."""
    rows = (equations[used] * np.sqrt(weights[used])[:, None, None]).reshape(-1, 9)
    # The eigenvector of a 9 x 9 matrix, where a singular value decomposition of all rows would
    # form a matrix of their number squared.
    solution = np.linalg.eigh(rows.T @ rows)[1][:, 0]
    homography: Float64 = (solution / solution[8]).reshape(3, 3)
    return homography


def _agreeing(homography: Float64, places: Float64, targets: Float64) -> npt.NDArray[np.bool_]:
    mapped = places @ homography[:, :2].T + homography[:, 2]
    off = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - targets, axis=1)
    return np.asarray(off < AGREES)


def _decomposed(homography: Float64, decomposition: str) -> tuple[Float64, Float64]:
    """Rotation camera to world [3, 3] and intrinsics [3, 3] on the plane of 2 x 2."""
    if decomposition == "free":
        rotation, factor = np.linalg.qr(homography)
        signs = np.where(np.diag(factor) < 0.0, -1.0, 1.0)
        inverse = signs[:, None] * factor
        K = np.linalg.inv(inverse / inverse[2, 2])
        return rotation * signs, K / K[2, 2]
    # Reversing the columns before a QR makes the triangular factor a lower one.
    rotation, factor = np.linalg.qr(homography[:, ::-1])
    rotation, factor = rotation[:, ::-1], factor[::-1, ::-1]
    signs = np.where(np.diag(factor) < 0.0, -1.0, 1.0)
    lower = signs[:, None] * factor
    lower = lower / lower[2, 2]
    K = intrinsic_matrix(1.0 / lower[0, 0], 1.0 / lower[1, 1], lower[2, 0], lower[2, 1])
    return rotation * signs, K


def _w2c(rotations: Float64, centres: Float64) -> Float64:
    """World to camera [S, 3, 4] of rotations camera to world [S, 3, 3] and centres [S, 3]."""
    back = rotations.swapaxes(1, 2)
    return np.concatenate([back, -back @ centres[..., None]], axis=2)


def _quaternion(rotation: Float64) -> Float64:
    """(x, y, z, w), w not negative, of a rotation [3, 3]: the eigenvector of its Davenport form."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    form = np.array(
        [
            [a - e - i, b + d, c + g, h - f],
            [b + d, e - a - i, f + h, c - g],
            [c + g, f + h, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    quaternion: Float64 = np.linalg.eigh(form)[1][:, 3]
    return -quaternion if quaternion[3] < 0.0 else quaternion


def _unit(vectors: Float64) -> Float64:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: Float64 = vectors / np.where(length > 0.0, length, 1.0)
    return unit


def _numpy(value: npt.ArrayLike | Tensor) -> Float64:
    if isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    return np.asarray(value, dtype=np.float64)


def _array(value: npt.ArrayLike | Tensor, name: str, dimensions: int, last: int) -> Float64:
    array = _numpy(value)
    if array.ndim != dimensions or array.shape[-1] != last:
        sizes = ", ".join(["S", "h", "w"][: dimensions - 1] + [str(last)])
        raise IgsrError(f"{name} has shape {list(array.shape)}; give [{sizes}]")
    return array
