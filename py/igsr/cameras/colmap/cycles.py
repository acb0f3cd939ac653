"""Focal lengths by cycles of photos, and the pairs whose matches contradict them.

The rotation between two photos, by their matches, depends on the focal length. With a wrong one,
the rotations along a cycle of photos, such as those around an object, do not add up to a full turn;
neither do they with a pair of look-alike things (Zach et al. 2010). So the focal length is the one
with which most matches are on pairs that add up.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr._internal.load_pycolmap import load_pycolmap
from igsr.cameras.colmap.contradictions import Pair, links
from igsr.cameras.colmap.matching import known_focals

Float64 = npt.NDArray[np.float64]

#: Focal lengths to try, in units of the longer side, and how many are mapped with.
FOCALS = np.geomspace(0.5, 2.5, 24)
MAPPED_FOCALS = 2
#: Minimum number of matches of a pair.
MIN_MATCHES = 15
#: Number of a pair's matches that focal lengths are tried with.
TRIED_MATCHES = 100
#: Rotations add up if they miss by at most this angle, degrees.
MAX_ERROR_DEG = 12.0


@dataclass(frozen=True)
class _Relative:
    """The geometry of a pair, and the rotation [3, 3] from its first to its second camera."""

    geometry: Any
    rotation: Float64
    matches: int


def consistent_databases(database: Path) -> Iterator[Path]:
    """Copy a database with each of the best focal lengths, without the pairs that contradict it.

    Focal lengths of EXIF stay. Photos without cycles have no copy.

    Args:
        database: from ``with_focal_lengths``.
    """
    verified = {pair: rows for pair, rows in links(database).items() if len(rows) >= MIN_MATCHES}
    known = known_focals(database)
    pairs = _Pairs(database, verified)
    trials = []
    for focal in [1.0] if known >= pairs.camera_ids else FOCALS:
        relative = pairs.relative(float(focal), known, TRIED_MATCHES)
        errors = cycle_errors({pair: (one.rotation, one.matches) for pair, one in relative.items()})
        kept = [pair for pair, error in errors.items() if error <= MAX_ERROR_DEG]
        # A tree has no cycles, so it fits any focal length.
        if len(kept) > len({photo for pair in errors for photo in pair}) - 1:
            trials.append((sum(relative[pair].matches for pair in kept), float(focal), kept))
    for _, focal, kept in sorted(trials, key=lambda trial: -trial[0])[:MAPPED_FOCALS]:
        yield pairs.copy(focal, known, kept)


def cycle_errors(relative: Mapping[Pair, tuple[Float64, int]]) -> dict[Pair, float]:
    """How far each pair's rotation is from the one along the strongest pairs, degrees.

    Args:
        relative: rotation [3, 3] from the first to the second camera, and number of matches.

    Returns:
        0 for the pairs of the maximum spanning tree.
    """
    rotation: dict[int, Float64] = {}
    group: dict[int, list[int]] = {}
    for photo in {photo for pair in relative for photo in pair}:
        rotation[photo], group[photo] = np.eye(3), [photo]
    for (a, b), (turn, _) in sorted(relative.items(), key=lambda row: (-row[1][1], row[0])):
        if group[a] is not group[b]:
            change = rotation[b].T @ turn @ rotation[a]
            moved = group[b]
            for photo in moved:
                rotation[photo], group[photo] = rotation[photo] @ change, group[a]
            group[a].extend(moved)
    return {
        (a, b): _degrees(rotation[b].T @ turn @ rotation[a])
        for (a, b), (turn, _) in relative.items()
    }


def _degrees(rotation: Float64) -> float:
    return float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(rotation) - 1.0), -1.0, 1.0))))


class _Pairs:
    """The verified pairs of a database.

    Attributes:
        camera_ids: of all cameras.
    """

    def __init__(self, database: Path, verified: Mapping[Pair, npt.NDArray[np.uint32]]) -> None:
        pycolmap = load_pycolmap()
        self._database, self._verified = database, verified
        with pycolmap.Database.open(database) as opened:
            self._cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
            self._camera_of = {i.image_id: i.camera_id for i in opened.read_all_images()}
            self._keypoints = {
                photo: opened.read_keypoints(photo)[:, :2].astype(np.float64)
                for photo in {photo for pair in verified for photo in pair}
            }

    @property
    def camera_ids(self) -> set[int]:
        return set(self._cameras)

    def relative(
        self, focal: float, known: Collection[int], most: int | None = None
    ) -> dict[Pair, _Relative]:
        """Estimate the geometry of each pair with a focal length, in units of the longer side.

        Args:
            focal: of the cameras that are not known.
            known: cameras that keep their focal length.
            most: number of matches of a pair to use, or None for all.
        """
        pycolmap = load_pycolmap()
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed, options.compute_relative_pose = 0, True
        cameras = {
            number: camera if number in known else _with_focal(camera, focal)
            for number, camera in self._cameras.items()
        }
        found = {}
        for pair, verified in self._verified.items():
            rows = verified[:: -(-len(verified) // most)] if most else verified
            geometry = pycolmap.estimate_calibrated_two_view_geometry(
                cameras[self._camera_of[pair[0]]],
                self._keypoints[pair[0]][rows[:, 0]],
                cameras[self._camera_of[pair[1]]],
                self._keypoints[pair[1]][rows[:, 1]],
                np.repeat(np.arange(len(rows), dtype=np.uint32)[:, None], 2, axis=1),
                options,
            )
            pose = geometry.cam2_from_cam1
            if pose is not None:
                share = len(geometry.inlier_matches) / len(rows)
                count = round(share * len(verified))
                found[pair] = _Relative(geometry, pose.rotation.matrix(), count)
        return found

    def copy(self, focal: float, known: Collection[int], kept: Collection[Pair]) -> Path:
        """Copy the database with a focal length and the geometry of some pairs."""
        pycolmap = load_pycolmap()
        copied = self._database.with_name(f"cycles_{focal:.3f}_{self._database.name}")
        shutil.copyfile(self._database, copied)
        relative = self.relative(focal, known)
        with pycolmap.Database.open(copied) as opened:
            for number, camera in self._cameras.items():
                if number not in known:
                    opened.update_camera(_with_focal(camera, focal))
            for pair in links(copied):
                opened.delete_two_view_geometry(*pair)
            for pair in kept:
                geometry = relative[pair].geometry
                geometry.inlier_matches = self._verified[pair][geometry.inlier_matches[:, 0]]
                opened.write_two_view_geometry(*pair, geometry)
        return copied


def _with_focal(camera: Any, focal: float) -> Any:
    """The camera with a focal length in units of the longer side."""
    pycolmap = load_pycolmap()
    changed = pycolmap.Camera(camera.todict())
    changed.params = [focal * max(camera.width, camera.height), *camera.params[1:]]
    return changed
