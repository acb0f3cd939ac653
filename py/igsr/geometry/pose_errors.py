"""Errors and accuracy of estimated cameras, by the measures of the literature.

RRA@t and RTA@t are the fractions of all pairs of photos whose relative rotation, and direction of
relative translation, are off by less than t degrees. mAA@30 is the area under the curve of the
smaller of the two for t from 1 to 30 degrees (Wang et al., PoseDiffusion, ICCV 2023). Pairs with an
unregistered photo count as wrong. ATE is the root mean square distance of the cameras' centers
(Sturm et al., IROS 2012) after alignment by ``similarity_between``, which needs two cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera
from igsr.errors import IgsrError
from igsr.geometry.similarity import similarity_between

Float64 = npt.NDArray[np.float64]

#: Thresholds of RRA and RTA, degrees.
THRESHOLDS_DEGREES = (5.0, 15.0)
#: Largest threshold of mAA, degrees.
MAX_DEGREES = 30


def pose_accuracy(
    cameras: Sequence[Camera | None], true_cameras: Sequence[Camera]
) -> dict[str, Any]:
    """Compare estimated cameras with true ones, in any world frame and unit.

    Args:
        cameras: per photo; None for an unregistered one.
        true_cameras: per photo.

    Returns:
        "photos" and "registered", counts; "RRA@5", "RTA@5", "RRA@15", "RTA@15" and "mAA@30",
        fractions of all pairs; "rotation" and "translation" (its direction), medians over
        registered pairs in degrees; "ATE" in units of the true world; "ATE_relative", in units of
        the root mean square distance of the registered photos' true centers from their mean. The
        last four are None with fewer than two registered photos.

    Raises:
        IgsrError: the numbers of cameras differ or are less than two.
    """
    if len(cameras) != len(true_cameras) or len(cameras) < 2:
        raise IgsrError(
            f"cameras and true_cameras must be pairs, at least two; there are {len(cameras)} and "
            f"{len(true_cameras)}."
        )
    errors, registered = [], []
    for i, j in combinations(range(len(cameras)), 2):
        a, b = cameras[i], cameras[j]
        registered.append(a is not None and b is not None)
        if a is None or b is None:
            errors.append((180.0, 180.0))
            continue
        estimated = b.viewmat @ np.linalg.inv(a.viewmat)
        true = true_cameras[j].viewmat @ np.linalg.inv(true_cameras[i].viewmat)
        errors.append(
            (
                rotation_angle(estimated[:3, :3] @ true[:3, :3].T),
                _direction_angle(estimated[:3, 3], true[:3, 3]),
            )
        )
    rotation, translation = np.array(errors).T
    worse = np.maximum(rotation, translation)
    result: dict[str, Any] = {
        "photos": len(cameras),
        "registered": sum(camera is not None for camera in cameras),
    }
    for limit in THRESHOLDS_DEGREES:
        result[f"RRA@{limit:g}"] = float(np.mean(rotation < limit))
        result[f"RTA@{limit:g}"] = float(np.mean(translation < limit))
    areas = [np.mean(worse < limit) for limit in range(1, MAX_DEGREES + 1)]
    result[f"mAA@{MAX_DEGREES}"] = float(np.mean(areas))
    result |= dict.fromkeys(("rotation", "translation", "ATE", "ATE_relative"))
    pairs = [(c, t) for c, t in zip(cameras, true_cameras, strict=True) if c is not None]
    if len(pairs) >= 2:
        estimates, truths = (list(side) for side in zip(*pairs, strict=True))
        to_true = similarity_between(estimates, truths)
        centers = np.stack([camera.centre for camera in truths])
        aligned = np.stack([to_true.camera(camera).centre for camera in estimates])
        error = float(np.sqrt(((aligned - centers) ** 2).sum(axis=1).mean()))
        size = float(np.sqrt(((centers - centers.mean(axis=0)) ** 2).sum(axis=1).mean()))
        result["rotation"] = float(np.median(rotation[registered]))
        result["translation"] = float(np.median(translation[registered]))
        result["ATE"] = error
        result["ATE_relative"] = error / size if size > 0.0 else None
    return result


def _direction_angle(a: Float64, b: Float64) -> float:
    """Degrees between two directions; a camera that did not move has none, which is wrong."""
    if min(np.linalg.norm(a), np.linalg.norm(b)) == 0.0:
        return 180.0
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def pose_errors(cameras: Sequence[Camera], true_cameras: Sequence[Camera]) -> dict[str, float]:
    """Errors of estimated cameras after the true ones have been aligned to them.

    Args:
        cameras: the estimated cameras.
        true_cameras: the corresponding true ones.

    Returns:
        "rotation": mean angle in degrees; "centre": mean distance in units of the true world.

    Raises:
        IgsrError: as ``similarity_between``.
    """
    to_cameras = similarity_between(true_cameras, cameras)
    angles, distances = [], []
    for camera, true_camera in zip(cameras, true_cameras, strict=True):
        aligned = to_cameras.camera(true_camera)
        angles.append(rotation_angle(camera.viewmat[:3, :3] @ aligned.viewmat[:3, :3].T))
        distances.append(np.linalg.norm(camera.centre - aligned.centre) / to_cameras.scale)
    return {"rotation": float(np.mean(angles)), "centre": float(np.mean(distances))}


def rotation_angle(rotation: Float64) -> float:
    """The angle of a rotation in degrees, accurate also for small angles.

    Args:
        rotation: float64 [3, 3], a rotation matrix.
    """
    sine = 0.5 * np.linalg.norm(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    return float(np.degrees(np.arctan2(sine, 0.5 * (np.trace(rotation) - 1.0))))
