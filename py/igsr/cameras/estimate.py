"""The interface of pose estimators: what they take and what they return."""

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
    """Cameras of photos in one world frame, and what else an estimator found.

    Attributes:
        cameras: per photo, pinhole, in pixels of the photo (centers at +0.5), or None where the
            photo is not registered.
        points: in the world frame, with confidence, or None.
        depths: per photo float32 [h, w], z-depth along the camera's axis in world units, NaN where
            it is not known, at any resolution; or None.
        trusted: per photo bool of the shape of its depth, True where the depth is confident; or
            None.
        warnings: messages for the user: which photos are not registered, and why.
        lenses: per photo the distortion that ``cameras`` leave out, None for none; an empty list
            says none for all. ``igsr.estimate_poses`` undoes it.
        grids: per photo where its depth lies in the photo, None for depths of the whole photo; an
            empty list says that all are.
        weights: of the network that was used: its "name", the "license" that the publisher states
            for weights of that name, and the "sha256" of its file, which tells whether it is those;
            None where there is none.
        evidence: per photo what its camera rests on, None where that is not known; an empty list
            says that of all.
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
