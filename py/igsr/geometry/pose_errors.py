"""Pose errors and accuracy, by the measures of the literature.

RRA@t and RTA@t are the fractions of all pairs of photos whose relative rotation, and whose
direction of relative translation, are off by less than t degrees; mAA@30 is the area under the
curve of the smaller of the two for t from 1 to 30 degrees (Wang et al., PoseDiffusion, ICCV 2023).
Pairs with a photo that is not registered count as wrong. ATE is the root mean square distance
of the cameras' centres (Sturm et al., IROS 2012) after alignment by the similarity of
``igsr.geometry.similarity``, for which two cameras suffice.
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

#: Degrees.
THRESHOLDS = (5.0, 15.0)
LARGEST = 30


def pose_accuracy(
    cameras: Sequence[Camera | None], true_cameras: Sequence[Camera]
) -> dict[str, Any]:
    """Compare estimated cameras with true ones; neither scale nor frame of the world matters.

    Args:
        cameras: per photo; None where it is not registered.
        true_cameras: per photo.

    Returns:
        "photos" and "registered", counts; "RRA@5", "RTA@5", "RRA@15", "RTA@15" and "mAA@30", parts
        in 0..1 of all pairs; "rotation" and "translation" (its direction), the medians over
        registered pairs in degrees, "ATE" in units of the true world and "ATE_relative", in units
        of the root mean square distance of the registered photos' true centres from their mean:
        None with fewer than two registered.

    Raises:
        IgsrError: the lists are not equally long or shorter than two.
    """
    if len(cameras) != len(true_cameras) or len(cameras) < 2:
        raise IgsrError(
            f"cameras and true_cameras must be pairs, two at least; there are {len(cameras)} and "
            f"{len(true_cameras)}."
        )
    rotations, translations = [], []
    for i, j in combinations(range(len(cameras)), 2):
        a, b = cameras[i], cameras[j]
        if a is None or b is None:
            rotations.append(180.0)
            translations.append(180.0)
            continue
        found, true = relative_pose(a, b), relative_pose(true_cameras[i], true_cameras[j])
        rotations.append(rotation_angle(found[:3, :3] @ true[:3, :3].T))
        translations.append(direction_angle(found[:3, 3], true[:3, 3]))
    rotation, translation = np.array(rotations), np.array(translations)
    worse = np.maximum(rotation, translation)
    result: dict[str, Any] = {
        "photos": len(cameras),
        "registered": sum(camera is not None for camera in cameras),
    }
    for limit in THRESHOLDS:
        result[f"RRA@{limit:g}"] = float(np.mean(rotation < limit))
        result[f"RTA@{limit:g}"] = float(np.mean(translation < limit))
    result[f"mAA@{LARGEST}"] = float(np.mean([np.mean(worse < t) for t in range(1, LARGEST + 1)]))
    return {**result, **_absolute(cameras, true_cameras, rotation, translation)}


def _absolute(
    cameras: Sequence[Camera | None],
    true_cameras: Sequence[Camera],
    rotation: Float64,
    translation: Float64,
) -> dict[str, float | None]:
    pairs = [(c, t) for c, t in zip(cameras, true_cameras, strict=True) if c is not None]
    if len(pairs) < 2:
        return dict.fromkeys(("rotation", "translation", "ATE", "ATE_relative"))
    placed = [
        cameras[i] is not None and cameras[j] is not None
        for i, j in combinations(range(len(cameras)), 2)
    ]
    found, true = (list(side) for side in zip(*pairs, strict=True))
    to_true = similarity_between(found, true)
    centres = np.stack([camera.center for camera in true])
    aligned = np.stack([to_true.camera(camera).center for camera in found])
    error = float(np.sqrt(((aligned - centres) ** 2).sum(axis=1).mean()))
    size = float(np.sqrt(((centres - centres.mean(axis=0)) ** 2).sum(axis=1).mean()))
    return {
        "rotation": float(np.median(rotation[placed])),
        "translation": float(np.median(translation[placed])),
        "ATE": error,
        "ATE_relative": error / size if size > 0.0 else None,
    }


def relative_pose(a: Camera, b: Camera) -> Float64:
    """From the frame of camera a to that of camera b, [4, 4]."""
    relative: Float64 = b.viewmat @ np.linalg.inv(a.viewmat)
    return relative


def direction_angle(a: Float64, b: Float64) -> float:
    """Degrees between two directions; a camera that did not move has none, which is wrong."""
    lengths = np.linalg.norm(a), np.linalg.norm(b)
    if min(lengths) == 0.0:
        return 180.0
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def pose_errors(cameras: Sequence[Camera], true_cameras: Sequence[Camera]) -> dict[str, float]:
    """How far cameras are from the true ones once the true ones have been aligned to them.

    Args:
        cameras: the estimated cameras.
        true_cameras: as many true ones, in the same order.

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
        distances.append(np.linalg.norm(camera.center - aligned.center) / to_cameras.scale)
    return {"rotation": float(np.mean(angles)), "centre": float(np.mean(distances))}


def rotation_angle(rotation: Float64) -> float:
    """Degrees that a rotation matrix turns by; accurate for small ones too.

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
