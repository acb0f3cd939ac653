"""The estimator "auto": COLMAP, and a pose network for the photos that COLMAP leaves unplaced."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from igsr.cameras.estimate import Estimate, Estimator, Progress
from igsr.cameras.registry import ESTIMATORS, NETWORKS
from igsr.capture import Camera
from igsr.capture.photo_folder import Photo
from igsr.capture.types import PoseEvidence
from igsr.geometry.similarity import similarity_between

#: Minimum number of photos placed by both COLMAP and the network to place further photos.
MIN_COMMON_PHOTOS = 3


def auto_estimate(
    photos: Sequence[Photo], options: Mapping[str, Any], seed: int, progress: Progress
) -> Estimate:
    """Estimate cameras by COLMAP; add those of a network for the photos that COLMAP cannot place.

    Args:
        photos: at least two.
        options: of COLMAP and of the network.
        seed: random seed.
        progress: called with a stage, how much of it is done, and the total.

    Raises:
        IgsrError: COLMAP or the network fails.
    """
    found = _made("colmap", options)(photos, seed=seed, progress=progress)
    if all(camera is not None for camera in found.cameras):
        return found
    network = next((name for name in NETWORKS if ESTIMATORS[name].ready(options)), None)
    if network is None:
        return found
    predicted = _made(network, options)(photos, seed=seed, progress=progress)
    return with_predicted_cameras(photos, found, predicted, network)


def with_predicted_cameras(
    photos: Sequence[Photo], found: Estimate, predicted: Estimate, network: str
) -> Estimate:
    """Add a network's cameras for the photos that features did not place.

    A similarity transform maps the network's world to the features' world; its residuals are the
    standard deviations of the added cameras.

    Args:
        photos: of both estimates.
        found: by features; its cameras stay as they are.
        predicted: by the network.
        network: its name, for the warning.

    Returns:
        The network's estimate if too few photos are in both.
    """
    common = [
        index
        for index, (placed, camera) in enumerate(zip(found.cameras, predicted.cameras, strict=True))
        if placed is not None and camera is not None
    ]
    if len(common) < MIN_COMMON_PHOTOS:
        return predicted
    similarity = similarity_between(
        [_camera(predicted, index) for index in common], [_camera(found, index) for index in common]
    )
    moved = [None if camera is None else similarity.camera(camera) for camera in predicted.cameras]
    turns, shifts = [], []
    for index in common:
        right, wrong = _camera(found, index), moved[index]
        assert wrong is not None
        trace = np.trace(right.viewmat[:3, :3] @ wrong.viewmat[:3, :3].T)
        turns.append(np.degrees(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))))
        shifts.append(np.linalg.norm(right.center - wrong.center))
    # Per axis, from the root mean square over photos.
    rotation, shift = (float(np.sqrt(np.mean(np.square(e)) / 3.0)) for e in (turns, shifts))
    cameras = list(found.cameras)
    evidence: list[PoseEvidence | None] = []
    added: list[str] = []
    given = list(found.evidence) or [None] * len(photos)
    for index, camera in enumerate(found.cameras):
        if camera is None and moved[index] is not None:
            cameras[index] = moved[index]
            evidence.append(PoseEvidence("network", rotation, shift))
            added.append(photos[index].name)
        else:
            evidence.append(given[index])
    if not added:
        return found
    warning = (
        f"Cameras of {', '.join(added)} are those that {network} predicts, about {rotation:.1f} "
        "degrees off per axis; the photos share too few features with the others."
    )
    lost = [photo.name for photo, camera in zip(photos, cameras, strict=True) if camera is None]
    warnings = [warning, *([f"Not placed: {', '.join(lost)}."] if lost else [])]
    return replace(
        found, cameras=cameras, evidence=evidence, warnings=warnings, weights=predicted.weights
    )


def _made(name: str, options: Mapping[str, Any]) -> Estimator:
    """The estimator with those of the options that are its own."""
    make = ESTIMATORS[name].make
    known = inspect.signature(make).parameters
    return make(**{key: value for key, value in options.items() if key in known})


def _camera(estimate: Estimate, index: int) -> Camera:
    camera = estimate.cameras[index]
    assert camera is not None
    return camera
