"""What the rasterizer knows of a render beside its colours: depth, normals, support by photos."""

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
from igsr.splats import Splats

Float32 = npt.NDArray[np.float32]

#: A splat counts as seen by a photo if it adds as much to it as this many fully covered pixels.
SEEN_WEIGHT = 0.05
#: Below this alpha, means over what a pixel shows are of nothing.
EMPTY = 1e-3


@dataclass(frozen=True, eq=False)
class Buffers:
    """One rendered view. All float32, pixel centres at +0.5; zero where nothing is drawn.

    Only the colour must be there: what another renderer does not know is None.

    Attributes:
        color: [H, W, 3] over the background, not clamped.
        alpha: [H, W], accumulated opacity in [0, 1].
        depth: [H, W], mean z along the camera's axis, world units.
        depth_deviation: [H, W], standard deviation of z among what the pixel blends, in units of
            its depth: high where it shows no surface.
        normal: [H, W, 3], mean unit normal in the camera frame (OpenCV axes), facing the camera.
        footprint: [H, W], log2 of the splats' mean standard deviation in pixels.
        support: [H, W], mean number of photos that see the splats shown.
        camera: the view's.
        background: [3], the colour that stands behind the scene, in [0, 1]; None where there is
            none, as behind photos without alpha.

    Raises:
        IgsrError: an array has another shape than the colour's picture, or is not of floats.
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
        """Check that all are of one picture."""
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
    """Render a view with everything the denoiser looks at.

    Args:
        splats: the scene.
        camera: pinhole camera, OpenCV axes, world frame of the capture.
        support: [N], of ``photo_support``.
        background: RGB in [0, 1] that stands behind the scene, where photos have alpha; None draws
            over black, which stands for nothing.
        backend: "auto", "cpu", "gpu" or "reference".

    Raises:
        ValueError: the parameters cannot be drawn; the message names the argument.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    backend = _core.resolve_backend(backend)
    dtype = _core.working_dtype(backend)
    projected = project(splats, camera, backend)

    def drawn(colors: Float32, behind: Sequence[float]) -> dict[str, Float32]:
        image = _core.rasterize(
            projected | {"colors": colors.astype(dtype)},
            width=camera.width,
            height=camera.height,
            background=np.asarray(behind, dtype),
            backend=backend,
        )
        return {name: value.astype(np.float32, copy=False) for name, value in image.items()}

    image = drawn(projected["colors"], (0.0, 0.0, 0.0) if background is None else background)
    alpha = image["alpha"]
    weight = np.divide(1.0, alpha, out=np.zeros_like(alpha), where=alpha > EMPTY)
    depth = image["depth"] * weight

    viewmat = viewmat_about(splats.origin, camera.viewmat)
    # What is not drawn may lie anywhere, at a depth of zero too.
    seen = (np.asarray(projected["radii"]).reshape(len(splats), 2) > 0).all(axis=1)
    z = np.where(seen, projected["depths"], 1.0).astype(np.float32)
    sizes = np.exp(splats.scales.mean(axis=1)) * np.sqrt(camera.K[0, 0] * camera.K[1, 1]) / z
    middle = float(np.median(depth[alpha > EMPTY])) if (alpha > EMPTY).any() else 1.0
    features = np.stack(
        [np.log2(np.maximum(sizes, 1e-3)), np.square(z - middle) / middle**2, support], axis=1
    )
    features = drawn(features.astype(np.float32), (0.0, 0.0, 0.0))["color"] * weight[..., None]
    normals = facing_normals(
        torch.from_numpy(splats.means),
        torch.from_numpy(splats.quats),
        torch.from_numpy(splats.scales),
        torch.from_numpy(viewmat.astype(np.float32)),
        torch.from_numpy(seen),
    ).numpy() @ viewmat[:3, :3].T.astype(np.float32)
    normal = drawn(normals, (0.0, 0.0, 0.0))["color"] * weight[..., None]

    # The second moment is taken about the picture's middle depth, or it would cancel.
    variance = features[..., 1] * middle**2 - np.square(depth - middle)
    nonzero = np.maximum(depth, np.float32(1e-12))
    deviation = np.where(alpha > EMPTY, np.sqrt(np.maximum(variance, 0.0)) / nonzero, 0.0)
    return Buffers(
        color=image["color"],
        alpha=alpha,
        depth=depth,
        depth_deviation=deviation.astype(np.float32),
        normal=normal,
        footprint=features[..., 0],
        support=features[..., 2],
        camera=camera,
        background=None if background is None else np.asarray(background, np.float32),
    )


def photo_support(splats: Splats, photos: Sequence[View], backend: str = "auto") -> Float32:
    """Number of photos [N] that see each splat: that it adds more to than ``SEEN_WEIGHT`` pixels.

    Args:
        splats: the scene.
        photos: their cameras say what they see; pixels that their masks leave out see nothing.
        backend: "auto", "cpu", "gpu" or "reference".

    Raises:
        IgsrError, RuntimeError: as ``render_buffers``.
    """
    backend = _core.resolve_backend(backend)
    dtype = _core.working_dtype(backend)
    count = np.zeros(len(splats), np.float32)
    for photo in photos:
        camera = photo.camera
        projected = project(splats, camera, backend)
        black = np.zeros(3, dtype)
        image = _core.rasterize(
            projected, width=camera.width, height=camera.height, background=black, backend=backend
        )
        counted = np.ones_like(image["color"])
        if photo.mask is not None:
            counted *= photo.mask[..., None]
        # The derivative of a colour by a splat's colour is the splat's weight in it.
        gradients = _core.rasterize_backward(
            projected,
            image,
            v_color=counted,
            v_alpha=np.zeros_like(image["alpha"]),
            v_depth=np.zeros_like(image["alpha"]),
            background=black,
            absolute=False,
            backend=backend,
        )
        count += gradients["v_colors"][:, 0] > SEEN_WEIGHT
    return count
