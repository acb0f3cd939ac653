"""Render splats from one camera, with numpy arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.array_equality import ArrayEquality
from igsr._internal.choices import Backend
from igsr._internal.notebook import NotebookPicture
from igsr.capture import Camera
from igsr.errors import IgsrError
from igsr.splats import FloatArray, Splats


@dataclass(frozen=True, eq=False, repr=False)
class Render(ArrayEquality, NotebookPicture):
    """A rendered view. All arrays are float32.

    Two renders are equal (``==``) if all their arrays are. Notebooks show the picture.

    Attributes:
        color: [H, W, 3], RGB over the background. Not clamped: SH may exceed 1.
        alpha: [H, W], accumulated opacity in [0, 1].
        depth: [H, W], accumulated camera-space z, the sum of weight * z, world units.
        expected_depth: [H, W], depth / alpha, 0 if alpha is 0, world units.
        transmittance: [H, W], visible fraction of the background, more precise than 1 - alpha.
    """

    _pictures_by: ClassVar[str] = "igsr.rendering.thumbnails:render_pictures"

    color: FloatArray
    alpha: FloatArray
    depth: FloatArray
    expected_depth: FloatArray
    transmittance: FloatArray

    def __repr__(self) -> str:
        height, width = self.alpha.shape
        return f"Render({width}x{height})"

    def to_uint8(self) -> npt.NDArray[np.uint8]:
        """Return ``color`` clamped to [0, 1] and rounded to 8 bits, uint8 [H, W, 3]."""
        finite = np.nan_to_num(self.color, nan=0.0, posinf=1.0, neginf=0.0)
        return (np.clip(finite, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def render(
    splats: Splats,
    camera: Camera,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    backend: Backend = "auto",
) -> Render:
    """Render ``splats`` from one camera.

    The result is deterministic, with any number of threads.

    Args:
        splats: the scene.
        camera: pinhole camera, OpenCV axes, pixel centers at +0.5, world frame of the capture.
        background: RGB in [0, 1] behind the splats.
        backend: "auto" (a real GPU if one answers, else "cpu"), "cpu", "gpu", or "reference"
            (computes in float64).

    Raises:
        IgsrError: an argument cannot be used; the message names it.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    try:
        background_color = np.asarray(background, dtype=np.float64)
    except (TypeError, ValueError):
        background_color = np.zeros(0)
    if background_color.shape != (3,) or not np.isfinite(background_color).all():
        raise IgsrError("background must be three finite numbers")
    try:
        resolved = _core.resolve_backend(backend)
        image = _core.rasterize(
            project(splats, camera, resolved),
            width=camera.width,
            height=camera.height,
            background=background_color.astype(_core.working_dtype(resolved)),
            backend=resolved,
        )
    except ValueError as error:
        raise IgsrError(f"{error}.") from error
    color, alpha, depth, transmittance = (
        image[name].astype(np.float32, copy=False)
        for name in ("color", "alpha", "depth", "transmittance")
    )
    expected = np.divide(depth, alpha, out=np.zeros_like(depth), where=alpha > 0)
    return Render(color, alpha, depth, expected, transmittance)


def project(splats: Splats, camera: Camera, backend: str) -> dict[str, npt.NDArray[Any]]:
    """Project splats to 2D Gaussians: the arrays of ``_core.project``, for ``_core.rasterize``."""
    dtype = _core.working_dtype(backend)
    parameters = (splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)
    projected: dict[str, npt.NDArray[Any]] = _core.project(
        *(parameter.astype(dtype, order="C", copy=False) for parameter in parameters),
        sh_degree=splats.sh_degree,
        raw_parameters=True,
        viewmat=viewmat_about(splats.origin, camera.viewmat),
        intrinsics=intrinsics_of(camera.K),
        width=camera.width,
        height=camera.height,
        near=splats.extent[2],
        far=_core.FAR_PLANE,
        eps2d=_core.EPS2D,
        antialiased=splats.antialiased,
        backend=backend,
    )
    return projected


def viewmat_about(
    origin: npt.NDArray[np.float64], viewmat: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return the world-to-camera matrix, float64 [4, 4], for points relative to ``origin`` [3]."""
    composed = np.array(viewmat, dtype=np.float64)
    composed[:3, 3] += composed[:3, :3] @ origin
    return composed


def intrinsics_of(K: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return fx, fy, cx, cy, float64 [4], of a pinhole matrix [3, 3]."""
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], dtype=np.float64)
