"""Where photos and pairs of photos lie in the world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr.capture import Camera
from igsr.geometry.similarity import Similarity, apply

Float64 = npt.NDArray[np.float64]


@dataclass(eq=False)
class Placement:
    """Cameras and edges in one world frame.

    Attributes:
        viewmats: float64 [4, 4] per photo, world to camera.
        intrinsics: float64 [3, 3] per photo, pixels of the photo.
        edges: per edge, from its stored frame (``Observations``) to the world.
    """

    viewmats: dict[int, Float64]
    intrinsics: dict[int, Float64]
    edges: list[Similarity]

    def mapped(self, world: Similarity) -> Placement:
        """The same in another world frame."""
        return Placement(
            {photo: mapped_viewmat(world, viewmat) for photo, viewmat in self.viewmats.items()},
            self.intrinsics,
            [joined(world, edge) for edge in self.edges],
        )


def joined(then: Similarity, first: Similarity) -> Similarity:
    """One similarity after the other."""
    return Similarity(
        then.scale * first.scale,
        then.rotation @ first.rotation,
        apply(then, first.translation[:, None])[:, 0],
    )


def inverse(similarity: Similarity) -> Similarity:
    """What undoes a similarity."""
    rotation, scale = similarity.rotation.T, 1.0 / similarity.scale
    return Similarity(scale, rotation, -scale * rotation @ similarity.translation)


def mapped_viewmat(world: Similarity, viewmat: Float64) -> Float64:
    """The world-to-camera [4, 4] that sees the mapped world as ``viewmat`` sees its own."""
    return world.camera(Camera(viewmat, np.eye(3), 1, 1)).viewmat
