"""Buffers of a render for the denoiser: color, depth, normals, and support by photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from igsr import _core
from igsr.capture import Camera, View
from igsr.errors import IgsrError
from igsr.rendering.normals import facing_normals
from igsr.rendering.renders import project, viewmat_about
from igsr.rendering.splat_weights import splat_weights
from igsr.splats import Splats

Float32 = npt.NDArray[np.float32]

BLACK = (0.0, 0.0, 0.0)
#: A photo sees a splat whose visible area is more than this, pixels.
MIN_SEEN_AREA_PX = 0.05
#: Pixels of a lower alpha are empty.
MIN_ALPHA = 1e-3


@dataclass(frozen=True, eq=False)
class Buffers:
    """One rendered view. All arrays float32, pixel centers at +0.5; zero in empty pixels.

    Only ``color`` is required; None marks buffers that another renderer does not have.

    Attributes:
        color: [H, W, 3] over the background, not clamped.
        alpha: [H, W], accumulated opacity in [0, 1].
        depth: [H, W], mean z along the camera's axis, world units.
        depth_deviation: [H, W], standard deviation of z among the splats of a pixel, in units of
            its depth: high in pixels without a surface.
        normal: [H, W, 3], mean unit normal in the camera frame (OpenCV axes), facing the camera.
        footprint: [H, W], log2 of the splats' mean standard deviation in pixels.
        support: [H, W], mean number of photos that see the splats.
        camera: of the view.
        background: [3], RGB in [0, 1]; None for photos without alpha, which show their own.

    Raises:
        IgsrError: an array does not have the picture's shape, or is not of floats.
    """

    color: Float32
    alpha: Float32 | None = None
    depth: Float32 | None = None
    depth_deviation: Float32 | None = None
    normal: Float32 | None = None
    footprint: Float32 | None = None
    support: Float32 | None = None
    camera: Camera | None = None
    background: Float32 | None = None

    def __post_init__(self) -> None:
        if self.color.ndim != 3 or self.color.shape[2] != 3 or 0 in self.color.shape:
            raise IgsrError(f"color must be [H, W, 3], not {list(self.color.shape)}")
        if not np.issubdtype(self.color.dtype, np.floating):
            raise IgsrError(f"color must be of floats in [0, 1], not {self.color.dtype}")
        size = self.color.shape[:2]
        for name in ("alpha", "depth", "depth_deviation", "normal", "footprint", "support"):
            array = getattr(self, name)
            shape = (*size, 3) if name == "normal" else size
            if array is not None and array.shape != shape:
                raise IgsrError(f"{name} must be {list(shape)} as color, not {list(array.shape)}")
        if self.background is not None and self.background.shape != (3,):
            raise IgsrError(f"background must be [3], not {list(self.background.shape)}")
        if self.camera is not None and (self.camera.height, self.camera.width) != size:
            raise IgsrError(
                f"camera is of a {self.camera.width}x{self.camera.height} picture, color is "
                f"{size[1]}x{size[0]}; give the camera of this render"
            )


def render_buffers(
    splats: Splats,
    camera: Camera,
    support: Float32,
    background: Sequence[float] | None = None,
    backend: str = "auto",
) -> Buffers:
    """Render a view with all buffers that the denoiser uses.

    Args:
        splats: the scene.
        camera: pinhole camera, OpenCV axes, world frame of the capture.
        support: [N], from ``photo_support``.
        background: RGB in [0, 1] if photos have alpha; None if they show their own background,
            and then renders are over black.
        backend: "auto", "cpu", "gpu" or "reference".

    Raises:
        ValueError: the parameters cannot be drawn; the message names the argument.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    backend = _core.resolve_backend(backend)
    dtype = _core.working_dtype(backend)
    projected = project(splats, camera, backend)

    def drawn(colors: Float32, behind: Sequence[float] = BLACK) -> dict[str, Float32]:
        image = _core.rasterize(
            projected | {"colors": colors.astype(dtype)},
            width=camera.width,
            height=camera.height,
            background=np.asarray(behind, dtype),
            backend=backend,
        )
        return {name: value.astype(np.float32, copy=False) for name, value in image.items()}

    image = drawn(projected["colors"], BLACK if background is None else background)
    alpha = image["alpha"]
    filled = alpha > MIN_ALPHA
    weight = np.divide(1.0, alpha, out=np.zeros_like(alpha), where=filled)
    depth = image["depth"] * weight

    viewmat = viewmat_about(splats.origin, camera.viewmat)
    # Splats that are not drawn may have any depth, zero included.
    seen = (np.asarray(projected["radii"]).reshape(len(splats), 2) > 0).all(axis=1)
    z = np.where(seen, projected["depths"], 1.0).astype(np.float32)
    sizes = np.exp(splats.scales.mean(axis=1)) * np.sqrt(camera.K[0, 0] * camera.K[1, 1]) / z
    # The second moment of z is taken about the median depth, to avoid cancellation.
    median = float(np.median(depth[filled])) if filled.any() else 1.0
    features = np.stack(
        [np.log2(np.maximum(sizes, 1e-3)), np.square(z - median) / median**2, support], axis=1
    )
    features = drawn(features.astype(np.float32))["color"] * weight[..., None]
    normals = facing_normals(
        torch.from_numpy(splats.means),
        torch.from_numpy(splats.quats),
        torch.from_numpy(splats.scales),
        torch.from_numpy(viewmat.astype(np.float32)),
        torch.from_numpy(seen),
    ).numpy() @ viewmat[:3, :3].T.astype(np.float32)

    variance = features[..., 1] * median**2 - np.square(depth - median)
    nonzero = np.maximum(depth, np.float32(1e-12))
    deviation = np.where(filled, np.sqrt(np.maximum(variance, 0.0)) / nonzero, 0.0)
    return Buffers(
        color=image["color"],
        alpha=alpha,
        depth=depth,
        depth_deviation=deviation.astype(np.float32),
        normal=drawn(normals)["color"] * weight[..., None],
        footprint=features[..., 0],
        support=features[..., 2],
        camera=camera,
        background=None if background is None else np.asarray(background, np.float32),
    )


def photo_support(splats: Splats, photos: Sequence[View], backend: str = "auto") -> Float32:
    """Count the photos that see each splat.

    Args:
        splats: the scene.
        photos: masked pixels see nothing.
        backend: "auto", "cpu", "gpu" or "reference".

    Returns:
        float32 [N].

    Raises:
        ValueError, RuntimeError: as ``render_buffers``.
    """
    count = np.zeros(len(splats), np.float32)
    for photo in photos:
        count += splat_weights(splats, photo.camera, backend, photo.mask) > MIN_SEEN_AREA_PX
    return count
