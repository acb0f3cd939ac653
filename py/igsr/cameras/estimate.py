"""The interface of pose estimators: their arguments and results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from igsr.cameras.grid import Grid
from igsr.capture import Camera, Points
from igsr.capture.photo_folder import Photo
from igsr.capture.types import PoseEvidence
from igsr.capture.undistort import Lens

#: Called with the stage, how much of it is done, and how much there is.
Progress = Callable[[str, int, int], None]


@dataclass(eq=False)
class Estimate:
    """Cameras of photos in one world frame, with points and depths.

    Attributes:
        cameras: per photo, pinhole, in pixels of the photo (centers at +0.5), or None where the
            photo is not registered.
        points: in the world frame, with confidence, or None.
        depths: per photo float32 [h, w], z-depth along the camera's axis in world units, NaN if
            unknown, at any resolution; or None.
        trusted: per photo bool [h, w], True for confident depths; or None.
        warnings: messages for the user: which photos are not registered, and why.
        lenses: per photo the distortion that ``cameras`` leave out, or None; an empty list means
            None for all. ``igsr.find_cameras`` undoes it.
        grids: per photo the position of its depth in the photo, None for depths of the whole photo;
            an empty list means None for all.
        weights: "name" of the network's weights, the "license" that their publisher states, and the
            "sha256" of the file; None without a network.
        evidence: per photo the evidence for its camera, None if unknown; an empty list means None
            for all.
    """

    cameras: list[Camera | None]
    points: Points | None
    depths: list[np.ndarray | None]
    trusted: list[np.ndarray | None]
    warnings: list[str]
    lenses: list[Lens | None] = field(default_factory=list)
    grids: list[Grid | None] = field(default_factory=list)
    weights: dict[str, str] | None = None
    evidence: list[PoseEvidence | None] = field(default_factory=list)


class Estimator(Protocol):
    """A pose estimator."""

    name: str

    def __call__(
        self, photos: Sequence[Photo], *, seed: int = 0, progress: Progress | None = None
    ) -> Estimate:
        """Find the cameras of at least two photos.

        Args:
            photos: upright, their names unique.
            seed: random seed; deterministic for a given seed.
            progress: called with a stage ("pairs", "passes", "alignment", "features", "matching" or
                "mapping"), how much of it is done, and how much there is.

        Raises:
            IgsrError: the estimator cannot be used at all. Unregistered photos are no error: their
                cameras are None.
        """
