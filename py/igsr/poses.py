"""Cameras that are not exact: how far two sets of them are apart, and finding a photo's camera.

Splats and cameras that were fitted together may be turned, moved and scaled as a whole without any
photo showing it. Scores of held-out views say which of three things was done about that:

* raw: the held-out cameras as they were given;
* aligned: moved by the similarity that maps the true train cameras onto the fitted ones;
* refined: each held-out camera fitted to its own photo while the splats stay as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from . import _core
from .capture import Camera, View
from .errors import IgsrError
from .fitter import fitted_cameras, fitter_of
from .splats import Splats

Float64 = npt.NDArray[np.float64]

#: Cameras nearer together than this, in units of their coordinates, stand at one place.
ONE_PLACE = 1e-9
#: Steps that refining spends on each camera.
REFINE_STEPS = 30


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation @ x + translation, between two worlds.

    Attributes:
        scale: positive.
        rotation: [3, 3].
        translation: [3], units of the world that is mapped to.
    """

    scale: float
    rotation: Float64
    translation: Float64

    def camera(self, camera: Camera) -> Camera:
        """The camera that sees the mapped world as ``camera`` sees its own."""
        viewmat = np.eye(4)
        viewmat[:3, :3] = camera.viewmat[:3, :3] @ self.rotation.T
        centre = self.scale * self.rotation @ camera.centre + self.translation
        viewmat[:3, 3] = -viewmat[:3, :3] @ centre
        return replace(camera, viewmat=viewmat)


def similarity_between(cameras: Sequence[Camera], others: Sequence[Camera]) -> Similarity:
    """The similarity that brings ``cameras`` nearest to ``others``, pair by pair.

    The rotation is the one that turns both the viewing axes and the centres' offsets from their
    mean best (Procrustes); scale and translation are those of the centres. One camera alone, or
    cameras at one place, keep their scale.

    Raises:
        IgsrError: there are no cameras, or not as many of one as of the other.
    """
    if not cameras or len(cameras) != len(others):
        raise IgsrError(
            f"cameras and others must be pairs; there are {len(cameras)} and {len(others)}."
        )
    centres = np.stack([camera.centre for camera in cameras])
    targets = np.stack([camera.centre for camera in others])
    offsets, target_offsets = centres - centres.mean(axis=0), targets - targets.mean(axis=0)
    spread, target_spread = (float(np.linalg.norm(x)) for x in (offsets, target_offsets))
    # Rows of a world-to-camera rotation are the camera's axes in the world.
    covariance = sum(
        other.viewmat[:3, :3].T @ camera.viewmat[:3, :3]
        for camera, other in zip(cameras, others, strict=True)
    ) / len(cameras)
    # Centres come from matrix products: what rounding leaves is no direction.
    least = ONE_PLACE * (1.0 + max(float(np.abs(centres).max()), float(np.abs(targets).max())))
    if min(spread, target_spread) > least:
        covariance = covariance + target_offsets.T @ offsets / (spread * target_spread)
    u, _, vt = np.linalg.svd(covariance)
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    scale = 1.0
    if min(spread, target_spread) > least:
        matched = float(np.sum((offsets @ rotation.T) * target_offsets)) / spread**2
        scale = matched if matched > 0.0 else 1.0
    translation = targets.mean(axis=0) - scale * rotation @ centres.mean(axis=0)
    return Similarity(scale, rotation, translation)


def pose_errors(cameras: Sequence[Camera], true_cameras: Sequence[Camera]) -> dict[str, float]:
    """How far cameras are from the true ones once the true ones have been aligned to them.

    Returns:
        "rotation": mean angle in degrees; "centre": mean distance in units of the true world.

    Raises:
        IgsrError: as ``similarity_between``.
    """
    to_cameras = similarity_between(true_cameras, cameras)
    angles, distances = [], []
    for camera, true_camera in zip(cameras, true_cameras, strict=True):
        aligned = to_cameras.camera(true_camera)
        angles.append(rotation_angle(camera.viewmat[:3, :3] @ aligned.viewmat[:3, :3].T))
        distances.append(np.linalg.norm(camera.centre - aligned.centre) / to_cameras.scale)
    return {"rotation": float(np.mean(angles)), "centre": float(np.mean(distances))}


def rotation_angle(rotation: Float64) -> float:
    """Degrees that a rotation matrix turns by; accurate for small ones too."""
    sine = 0.5 * np.linalg.norm(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    return float(np.degrees(np.arctan2(sine, 0.5 * (np.trace(rotation) - 1.0))))


def refine_cameras(
    splats: Splats,
    views: Sequence[View],
    background: Sequence[float],
    *,
    steps: int = REFINE_STEPS,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> list[View]:
    """The views with poses fitted to their photos; splats and focal lengths stay as they are.

    Photo, mask and given camera of each view are used, one view at a time, and nothing is learnt
    about the scene: this is how few-view papers score scenes whose cameras were fitted too.

    Args:
        splats: the scene.
        views: what to find the cameras of; their own are where the search starts.
        background: RGB in [0, 1] behind splats and photos with alpha.
        steps: steps per view; each moves the picture by at most about a third of a pixel, at the
            end by a hundredth.
        backend: "auto", "cpu" or "gpu".
        progress: called with (steps done, of all) now and then.

    Raises:
        IgsrError: ``steps`` is not positive, or a view cannot be used.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    if steps < 1:
        raise IgsrError(f"steps must be at least 1, not {steps}.")
    if splats.antialiased:
        raise IgsrError("Cameras cannot be refined to antialiased splats: fits draw without that.")
    if not views:
        return []
    total = steps * len(views)
    apart = ("origin", "antialiased")
    state = {name: value for name, value in vars(splats).items() if name not in apart}
    settings = {
        "steps": total,
        "sh_degree": splats.sh_degree,
        "density": "fixed",
        "background": [float(channel) for channel in background],
        "poses": "joint",
        "frozen": True,
        "camera_warm_up": 0.0,
    }
    try:
        fitter = fitter_of(views, splats.origin, state, settings, _core.resolve_backend(backend))
        for done in range(len(views), total + 1, len(views)):
            fitter.step(len(views))
            if progress is not None:
                progress(done, total)
    except ValueError as error:
        raise IgsrError(f"{error}.") from error
    cameras = fitted_cameras(views, fitter, splats.origin)
    return [replace(view, camera=camera) for view, camera in zip(views, cameras, strict=True)]
