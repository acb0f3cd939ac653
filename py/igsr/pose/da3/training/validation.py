"""What a network scores on captures that it was not trained on, beside an answer that never looks.

The answer that never looks turns no camera, has all others straight ahead, and all things
equally far.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import numpy.typing as npt
import torch

from igsr.capture import Camera
from igsr.geometry.pose_errors import direction_angle, pose_accuracy, relative_pose, rotation_angle
from igsr.pose.da3.cameras import decode_pose
from igsr.pose.da3.network import Da3Network
from igsr.pose.da3.training.true_pass import TruePass
from igsr.pose.network_arrays import float32_array

Float32 = npt.NDArray[np.float32]

#: Parts of all pairs of photos, as ``igsr study poses`` has them.
PARTS = ("RRA@15", "RTA@15", "mAA@30")
#: Degrees below which a constant answer counts as right.
RIGHT = 15.0


def validated(
    network: Da3Network, passes: Sequence[TruePass], device: torch.device
) -> dict[str, float]:
    """Means over the captures.

    Returns:
        "validation_rotation" and "validation_translation", medians over pairs of photos in degrees;
        "validation_RRA@15", "validation_RTA@15" and "validation_mAA@30", parts of all pairs, all as
        ``igsr.geometry.pose_errors`` has them; "validation_depth_error", the mean error of depths
        that are scaled by their median, as a part of the true ones. With "_constant" at the end,
        what the answer that never looks scores, for all but mAA.
    """
    sums: dict[str, float] = {}
    for true in passes:
        with torch.inference_mode():
            predicted = network(true.pixels.to(device))
        accuracy = pose_accuracy(
            _cameras(float32_array(predicted.pose_encoding), true), true.cameras()
        )
        depth = true.depth.numpy()
        scores = {name: accuracy[name] for name in ("rotation", "translation", *PARTS)}
        scores["depth_error"] = _depth_error(float32_array(predicted.depth), depth)
        constant = constant_scores(true.cameras())
        constant["depth_error"] = _depth_error(np.ones_like(depth), depth)
        scores |= {f"{name}_constant": value for name, value in constant.items()}
        for name, score in scores.items():
            key = f"validation_{name}"
            sums[key] = sums.get(key, 0.0) + float(score) / len(passes)
    return sums


def constant_scores(cameras: Sequence[Camera]) -> dict[str, float]:
    """What an answer scores that turns no camera and has every other straight ahead.

    Args:
        cameras: the true ones.
    """
    relative = [relative_pose(a, b) for a, b in combinations(cameras, 2)]
    rotation = np.array([rotation_angle(one[:3, :3]) for one in relative])
    ahead = np.array([0.0, 0.0, 1.0])
    translation = np.array([direction_angle(one[:3, 3], ahead) for one in relative])
    return {
        "rotation": float(np.median(rotation)),
        "translation": float(np.median(translation)),
        "RRA@15": float(np.mean(rotation < RIGHT)),
        "RTA@15": float(np.mean(translation < RIGHT)),
    }


def _cameras(encoding: Float32, true: TruePass) -> list[Camera]:
    height, width = true.depth.shape[1:]
    viewmats, intrinsics = decode_pose(encoding, height, width)
    bottom = np.array([[0.0, 0.0, 0.0, 1.0]])
    return [
        Camera(np.vstack([viewmat, bottom]), K, width, height)
        for viewmat, K in zip(viewmats, intrinsics, strict=True)
    ]


def _depth_error(depth: Float32, wanted: Float32) -> float:
    known = wanted > 0.0
    if not known.any():
        return 0.0
    ratio = depth[known] / wanted[known]
    return float(np.abs(ratio / np.median(ratio) - 1.0).mean())
