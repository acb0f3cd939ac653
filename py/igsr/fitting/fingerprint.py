"""Hashes of a fit's inputs, recorded in checkpoints."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.capture import View
from igsr.capture.types import PseudoView, Tracks


def fingerprint(views: list[View], tracks: Tracks | None = None) -> str:
    """SHA-256 of photos, cameras, rigs and tracks, in hexadecimal."""
    arrays: list[npt.NDArray[Any] | None] = []
    for view in views:
        camera = view.camera
        arrays += [camera.viewmat, camera.K, view.image, view.mask, _weights(view)]
        arrays += [view.depth, view.depth_confidence]
        background = view.background if isinstance(view, PseudoView) else None
        arrays.append(None if background is None else np.asarray(background))
        arrays.append(None if view.rig is None else np.frombuffer(view.rig.encode(), np.uint8))
    if tracks is not None:
        arrays += [tracks.view, tracks.point, tracks.xy]
    return hash_of(arrays)


def _weights(view: View) -> npt.NDArray[np.float32] | None:
    return view.weights if isinstance(view, PseudoView) else None


def hash_of(arrays: Iterable[npt.NDArray[Any] | None]) -> str:
    """SHA-256 of arrays with their types and shapes, in hexadecimal; None is skipped."""
    digest = hashlib.sha256()
    for array in arrays:
        if array is not None:
            digest.update(str((array.dtype.str, array.shape)).encode())
            digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
