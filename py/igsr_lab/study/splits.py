"""Which photos of a scene are fitted and which are scored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera, Capture
from igsr.errors import IgsrError

#: LLFF's protocol holds out every 8th photo.
HOLDOUT = 8
#: DTU's train photos by PixelNeRF; few-view papers take the first 3, 6 or 9.
DTU_TRAIN = (25, 22, 28, 40, 44, 48, 0, 8, 13)
#: DTU's scored photos by PixelNeRF, as few-view papers have them.
DTU_TEST = (1, 2, *range(9, 13), 14, 15, 23, 24, 26, 27, *range(29, 36), 41, 42, 43, 45, 46, 47)


def with_train_views(capture: Capture, ids: Sequence[int]) -> Capture:
    """Select train views by index; keep all test views."""
    train = capture.train_views
    if max(ids) >= len(train):
        raise IgsrError(
            f"{capture.path} has {len(train)} train views; the protocol needs number {max(ids)}."
        )
    if not capture.test_views:
        raise IgsrError(f"{capture.path} has no test views to score.")
    return Capture(capture.path, [train[i] for i in ids] + capture.test_views, capture.points)


def is_dtu(scene: str) -> bool:
    """Whether a scene has DTU's split, by its name."""
    return scene.startswith("dtu")


def llff_views(capture: Capture, count: int) -> Capture:
    """Split by LLFF's few-view protocol, with photos sorted by name.

    Every 8th photo from 0 is scored; ``count`` evenly spaced ones of the rest are fitted.
    """
    rest = [i for i in range(len(capture.views)) if i % HOLDOUT]
    if not 1 <= count <= len(rest):
        raise IgsrError(
            f"{capture.path} has {len(rest)} photos to fit besides those held out; views must be "
            f"from 1 to {len(rest)}, not {count}."
        )
    chosen = np.linspace(0, len(rest) - 1, count).round().astype(int)
    return _split(capture, [rest[k] for k in chosen], range(0, len(capture.views), HOLDOUT))


def dtu_views(capture: Capture, count: int) -> Capture:
    """Split by DTU's few-view protocol, with photos sorted by name.

    The first ``count`` photos of ``DTU_TRAIN`` are fitted, whole; ``DTU_TEST`` are scored, in their
    masks.
    """
    if not 1 <= count <= len(DTU_TRAIN):
        raise IgsrError(f"views must be from 1 to {len(DTU_TRAIN)} for DTU, not {count}.")
    train = DTU_TRAIN[:count]
    last = max(*train, *DTU_TEST)
    if last >= len(capture.views):
        raise IgsrError(
            f"{capture.path} has {len(capture.views)} photos; DTU's protocol needs number {last}."
        )
    chosen = _split(capture, train, DTU_TEST)
    views = [replace(view, mask=None) if view.split == "train" else view for view in chosen.views]
    return Capture(capture.path, views, capture.points)


def _split(capture: Capture, train: Sequence[int], test: Sequence[int]) -> Capture:
    by_name = sorted(capture.views, key=lambda view: view.name)
    views = [replace(by_name[i], split="train") for i in train]
    views += [replace(by_name[i], split="test") for i in test]
    return Capture(capture.path, views, capture.points)


def localized(cameras: Sequence[Camera], count: int) -> list[int]:
    """Choose camera 0 and the cameras with the most similar viewing directions."""
    directions = _directions(cameras)
    return [int(i) for i in np.argsort(-(directions @ directions[0]), kind="stable")[:count]]


def scattered(cameras: Sequence[Camera], count: int) -> list[int]:
    """Choose camera 0 and others by farthest-point sampling of the viewing directions."""
    directions = _directions(cameras)
    chosen = [0]
    nearest = directions @ directions[0]
    while len(chosen) < min(count, len(cameras)):
        nearest[chosen] = np.inf
        chosen.append(int(np.argmin(nearest)))
        nearest = np.maximum(nearest, directions @ directions[chosen[-1]])
    return chosen


def spread_out(total: int, count: int) -> list[int]:
    """Choose ``count`` of ``total`` indices, evenly spaced, including both ends."""
    return [int(i) for i in np.linspace(0, total - 1, min(count, total)).round()]


def _directions(cameras: Sequence[Camera]) -> npt.NDArray[np.float64]:
    """Unit viewing directions in the world frame, float64 [N, 3]."""
    return np.stack([camera.viewmat[2, :3] for camera in cameras]).astype(np.float64)
