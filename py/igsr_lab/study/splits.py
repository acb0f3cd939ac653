"""Which photos of a scene a protocol fits and which it scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera, Capture
from igsr.errors import IgsrError

#: LLFF's protocol holds out every 8th photo for testing.
HOLDOUT = 8
#: DTU's train photos by number, as PixelNeRF chose them: few-view papers take the first 3, 6 or 9.
DTU_TRAIN = (25, 22, 28, 40, 44, 48, 0, 8, 13)


def with_train_views(capture: Capture, ids: Sequence[int]) -> Capture:
    """The capture with these of its train views, by index, and all of its test views.

    Raises:
        IgsrError: it has no train view of such an index, or no test views.
    """
    train = capture.train_views
    if max(ids) >= len(train):
        raise IgsrError(
            f"{capture.path} has {len(train)} train views; the protocol needs number {max(ids)}."
        )
    if not capture.test_views:
        raise IgsrError(f"{capture.path} has no test views to score.")
    return Capture(capture.path, [train[i] for i in ids] + capture.test_views, capture.points)


def llff_views(capture: Capture, count: int) -> Capture:
    """LLFF's few-view split: every 8th photo scored, ``count`` of the rest fitted, evenly spaced.

    Photos are counted in the order of their names, from 0; photo 0 is scored.

    Raises:
        IgsrError: the capture has fewer photos to fit.
    """
    by_name = sorted(capture.views, key=lambda view: view.name)
    rest = [i for i in range(len(by_name)) if i % HOLDOUT]
    if not 1 <= count <= len(rest):
        raise IgsrError(
            f"{capture.path} has {len(rest)} photos to fit beside those held out; views must be "
            f"from 1 to {len(rest)}, not {count}."
        )
    chosen = np.linspace(0, len(rest) - 1, count).round().astype(int)
    return _split(capture, [rest[k] for k in chosen], range(0, len(by_name), HOLDOUT))


def dtu_views(capture: Capture, count: int) -> Capture:
    """DTU's few-view split: the first ``count`` of ``DTU_TRAIN`` fitted, all other photos scored.

    Photos are counted in the order of their names, from 0.

    Raises:
        IgsrError: the protocol names fewer photos, or the capture has not those.
    """
    if not 1 <= count <= len(DTU_TRAIN):
        raise IgsrError(f"views must be from 1 to {len(DTU_TRAIN)} for DTU, not {count}.")
    train = DTU_TRAIN[:count]
    if max(train) >= len(capture.views):
        raise IgsrError(
            f"{capture.path} has {len(capture.views)} photos; DTU's protocol needs number "
            f"{max(train)}."
        )
    return _split(capture, train, [i for i in range(len(capture.views)) if i not in train])


def _split(capture: Capture, train: Sequence[int], test: Sequence[int]) -> Capture:
    """These photos, counted in the order of their names, as train and test views."""
    by_name = sorted(capture.views, key=lambda view: view.name)
    views = [replace(by_name[i], split="train") for i in train]
    views += [replace(by_name[i], split="test") for i in test]
    return Capture(capture.path, views, capture.points)


def localized(cameras: Sequence[Camera], count: int) -> list[int]:
    """The ``count`` cameras whose viewing directions are nearest to camera 0's, that one first."""
    directions = _directions(cameras)
    return [int(i) for i in np.argsort(-(directions @ directions[0]), kind="stable")[:count]]


def scattered(cameras: Sequence[Camera], count: int) -> list[int]:
    """``count`` cameras with viewing directions far apart: farthest points from camera 0 on."""
    directions = _directions(cameras)
    chosen = [0]
    nearest = directions @ directions[0]
    while len(chosen) < min(count, len(cameras)):
        nearest[chosen] = np.inf
        chosen.append(int(np.argmin(nearest)))
        nearest = np.maximum(nearest, directions @ directions[chosen[-1]])
    return chosen


def spread_out(total: int, count: int) -> list[int]:
    """``count`` of ``total`` indices, evenly spaced, both ends among them."""
    return [int(i) for i in np.linspace(0, total - 1, min(count, total)).round()]


def _directions(cameras: Sequence[Camera]) -> npt.NDArray[np.float64]:
    """Viewing direction of each camera, world frame, float64 [N, 3], of length 1."""
    return np.stack([camera.viewmat[2, :3] for camera in cameras]).astype(np.float64)
