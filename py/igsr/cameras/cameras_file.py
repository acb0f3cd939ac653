"""``cameras.npz``: the cameras that a run found, kept in its folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.atomic_write import atomic_write
from igsr._internal.part_usage import Usage
from igsr._internal.untrusted_npz import DAMAGE, stored_arrays, stored_json
from igsr.cameras.estimate import Estimate
from igsr.cameras.found_cameras import FoundCameras
from igsr.capture import Camera, Points
from igsr.capture.read_transforms import MAX_VALUES
from igsr.capture.types import PoseEvidence, Tracks
from igsr.capture.undistort import Lens
from igsr.errors import IgsrError

#: Of the file; files of another format are not read.
FORMAT = 3
_ABOUT = "about"


@dataclass(frozen=True, eq=False)
class KeptCameras:
    """The content of a cameras file.

    Attributes:
        found: the cameras.
        photos: size in bytes of each photo and video file, by name.
        usage: time and memory that finding the cameras took.
    """

    found: FoundCameras
    photos: dict[str, int]
    usage: Usage


def write_cameras_file(path: Path, kept: KeptCameras) -> None:
    """Write a cameras file, whole or not at all.

    Raises:
        IgsrError: the file cannot be written.
    """
    found = kept.found.estimate
    arrays: dict[str, Any] = {}
    for index, (camera, trusted) in enumerate(zip(found.cameras, found.trusted, strict=True)):
        if camera is not None:
            arrays[f"viewmat_{index}"], arrays[f"K_{index}"] = camera.viewmat, camera.K
        if trusted is not None:
            arrays[f"trusted_{index}"] = trusted
        depth = found.depths[index]
        if depth is not None:
            arrays[f"depth_{index}"] = depth
    points = found.points
    if points is not None:
        arrays |= {"xyz": points.xyz, "rgb": points.rgb}
        if points.confidence is not None:
            arrays["confidence"] = points.confidence
        if points.tracks is not None:
            tracks = points.tracks
            arrays |= {"seen_by": tracks.view, "point": tracks.point, "xy": tracks.xy}
    about = {
        "format": FORMAT,
        "photos": kept.photos,
        "usage": kept.usage.plain(),
        "names": kept.found.names,
        "sizes": [camera and [camera.width, camera.height] for camera in found.cameras],
        "lenses": [lens and vars(lens) for lens in found.lenses],
        "warnings": found.warnings,
        "track_names": points.tracks.names if points and points.tracks else [],
        "made_by": kept.found.made_by,
        "weights": found.weights,
        "evidence": [evidence and vars(evidence) for evidence in found.evidence],
    }
    arrays[_ABOUT] = np.frombuffer(json.dumps(about).encode(), dtype=np.uint8)
    contiguous: dict[str, Any] = {key: np.ascontiguousarray(value) for key, value in arrays.items()}
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **contiguous)


def read_cameras_file(path: Path) -> KeptCameras:
    """Read a cameras file.

    Raises:
        IgsrError: the file is missing, damaged or of another format.
    """
    try:
        arrays = stored_arrays(path)
        about = stored_json(arrays[_ABOUT], MAX_VALUES)
        if about["format"] != FORMAT:
            raise ValueError(f"it is not of format {FORMAT}")
        return KeptCameras(_found(arrays, about), _sizes(about["photos"]), Usage.of(about["usage"]))
    except (*DAMAGE, IndexError, AttributeError, RecursionError, IgsrError) as error:
        raise IgsrError(
            f"{path} cannot be read ({error}); delete it to find the cameras again"
        ) from error


def _found(arrays: Mapping[str, np.ndarray], about: dict[str, Any]) -> FoundCameras:
    names = _texts(about["names"])
    count = len(names)
    indices = range(count)
    estimate = Estimate(
        [_camera(arrays, index, about["sizes"][index]) for index in indices],
        _points(arrays, _texts(about["track_names"])),
        [_depth(arrays.get(f"depth_{index}")) for index in indices],
        [arrays.get(f"trusted_{index}") for index in indices],
        _texts(about["warnings"]),
        [_lens(about["lenses"][index]) for index in indices],
        weights=_weights(about["weights"]),
        evidence=[_evidence(about["evidence"][index]) for index in indices],
    )
    if len(set(names)) < count or not isinstance(about["made_by"], dict):
        raise ValueError("its names or settings are wrong")
    return FoundCameras(names, estimate, about["made_by"])


def _sizes(value: Any) -> dict[str, int]:
    if not isinstance(value, dict) or not all(type(size) is int for size in value.values()):
        raise ValueError("its sizes of photos are not whole numbers")
    return dict(zip(_texts(list(value)), value.values(), strict=True))


def _depth(stored: np.ndarray | None) -> np.ndarray | None:
    if stored is None:
        return None
    if stored.ndim != 2 or 0 in stored.shape or stored.dtype != np.float32:
        raise ValueError("a depth map has another shape or type than float32 [H, W]")
    if not (np.isfinite(stored) & (stored >= 0.0)).all():
        raise ValueError("a depth is negative or not finite")
    return stored


def _texts(value: Any) -> list[str]:
    if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
        raise ValueError("a list of texts is missing")
    return value


def _weights(value: Any) -> dict[str, str] | None:
    if value is None:
        return None
    if not isinstance(value, dict):
        raise ValueError("its weights are not an object")
    return dict(zip(_texts(list(value)), _texts(list(value.values())), strict=True))


def _evidence(fields: Any) -> PoseEvidence | None:
    if fields is None:
        return None
    return PoseEvidence(fields["rests_on"], float(fields["rotation"]), float(fields["center"]))


def _camera(arrays: Mapping[str, np.ndarray], index: int, size: Any) -> Camera | None:
    if size is None:
        return None
    return Camera(arrays[f"viewmat_{index}"], arrays[f"K_{index}"], size[0], size[1])


def _lens(fields: Any) -> Lens | None:
    if fields is None:
        return None
    radial, denominator, tangential, thin_prism = (
        tuple(float(value) for value in fields[name])
        for name in ("radial", "denominator", "tangential", "thin_prism")
    )
    p1, p2 = tangential
    sx, sy = thin_prism
    return Lens(bool(fields["fisheye"]), radial, denominator, (p1, p2), (sx, sy))


def _points(arrays: Mapping[str, np.ndarray], track_names: list[str]) -> Points | None:
    if "xyz" not in arrays:
        return None
    xyz, rgb = arrays["xyz"].astype(np.float64), arrays["rgb"]
    if xyz.ndim != 2 or xyz.shape[1] != 3 or rgb.shape != xyz.shape or rgb.dtype != np.uint8:
        raise ValueError("its points have another shape or type than points")
    if not np.isfinite(xyz).all():
        raise ValueError("a point is not finite")
    tracks = None
    if "seen_by" in arrays:
        view, point = (arrays[name].astype(np.int64) for name in ("seen_by", "point"))
        tracks = Tracks(track_names, view, point, arrays["xy"].astype(np.float64))
    return Points(xyz, rgb, arrays.get("confidence"), tracks)
