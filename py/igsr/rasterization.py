"""``rasterization``: the renderer as a differentiable torch function, called like gsplat's.

Argument names, order, defaults, shapes and the returned triple follow gsplat 1.5, so that a gsplat
user switches by changing an import and gsplat's strategies run on it. What this renderer does not
do raises ValueError by the argument's name.

Two autograd functions do the work, one per half of the pipeline: ``_Project`` and ``_Rasterize``.
Between them lie ``means2d`` (so that ``meta["means2d"].grad`` exists, which density control reads)
and ``factors``, the upper-triangular factor of each conic: the same information as a covariance
without its cancellation for long needles.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from . import _core
from .splats import MAX_SH_DEGREE

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")

#: A rotation in float32 is orthonormal to about 1e-6; a scaled or sheared pose is far outside (the
#: renderer itself draws the same line).
RIGID_TOLERANCE = 1e-3
#: The tile's side in pixels; it shows in ``meta`` only, no picture depends on it.
TILE_SIZE = 16

#: What passes from ``_Project`` to ``_Rasterize``; the last carries no gradient.
DIFFERENTIABLE = ("means2d", "factors", "depths", "colors", "opacities")
PROJECTED = (*DIFFERENTIABLE, "radii")
IMAGE = ("color", "alpha", "depth")

#: gsplat arguments that exist to be refused by name, with the only value accepted.
_UNSUPPORTED_DEFAULTS: dict[str, Any] = {
    "tile_size": TILE_SIZE,
    "sparse_grad": False,
    "absgrad": False,
    "rasterize_mode": "classic",
    "channel_chunk": 32,
    "distributed": False,
    "camera_model": "pinhole",
    "segmented": False,
    "covars": None,
    "with_ut": False,
    "with_eval3d": False,
    "radial_coeffs": None,
    "tangential_coeffs": None,
    "thin_prism_coeffs": None,
    "ftheta_coeffs": None,
    "rolling_shutter": None,
    "viewmats_rs": None,
}


@dataclass(frozen=True)
class _Settings:
    """What both halves need and autograd does not track."""

    width: int
    height: int
    near: float
    far: float
    eps2d: float
    sh_degree: int | None
    backend: str


def _array(tensor: Tensor, dtype: Any) -> npt.NDArray[Any]:
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=dtype)


def _project_options(viewmat: Tensor, K: Tensor, settings: _Settings) -> dict[str, Any]:
    return {
        "sh_degree": settings.sh_degree,
        "raw_parameters": False,
        "viewmat": _array(viewmat, np.float64),
        "intrinsics": _array(K, np.float64)[[0, 1, 0, 1], [0, 1, 2, 2]],
        "width": settings.width,
        "height": settings.height,
        "near": settings.near,
        "far": settings.far,
        "eps2d": settings.eps2d,
        "antialiased": False,
        "backend": settings.backend,
    }


def _projected_arrays(projected: Iterable[Tensor], dtype: Any) -> dict[str, npt.NDArray[Any]]:
    return {name: _array(t, dtype) for name, t in zip(PROJECTED, projected, strict=True)}


class _Project(torch.autograd.Function):
    """Splats and one camera to 2D Gaussians."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        viewmat: Tensor,
        K: Tensor,
        settings: _Settings,
    ) -> tuple[Tensor, ...]:
        dtype = _core.working_dtype(settings.backend)
        inputs = [_array(t, dtype) for t in (means, quats, scales, opacities, colors)]
        projected = _core.project(*inputs, **_project_options(viewmat, K, settings))
        # The arrays above share memory with the caller's tensors: only what autograd saves is
        # refused in backward() when the caller has changed it in place since.
        ctx.save_for_backward(means, quats, scales, opacities, colors, viewmat, K)
        ctx.settings, ctx.projected = settings, projected
        outputs = tuple(torch.from_numpy(projected[name]).to(means) for name in PROJECTED)
        ctx.mark_non_differentiable(*outputs[len(DIFFERENTIABLE) :])
        return outputs

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *v_outputs: Tensor) -> tuple[Tensor | None, ...]:
        dtype = _core.working_dtype(ctx.settings.backend)
        *splats, viewmat, K = ctx.saved_tensors
        v_projected = {
            f"v_{name}": _array(v, dtype)
            for name, v in zip(DIFFERENTIABLE, v_outputs, strict=False)
        }
        means, quats, scales, opacities, colors = (_array(t, dtype) for t in splats)
        v = _core.project_backward(
            means,
            quats,
            scales,
            opacities,
            colors,
            ctx.projected,
            v_projected,
            **_project_options(viewmat, K, ctx.settings),
        )
        v_fx, v_fy, v_cx, v_cy = v["v_intrinsics"]
        v_K = np.array([[v_fx, 0.0, v_cx], [0.0, v_fy, v_cy], [0.0, 0.0, 0.0]])
        names = ("v_means", "v_quats", "v_scales", "v_opacities", "v_colors")
        return (
            *(torch.from_numpy(v[name]).to(splats[0]) for name in names),
            torch.from_numpy(v["v_viewmat"]).to(viewmat),
            torch.from_numpy(v_K).to(K),
            None,
        )


class _Rasterize(torch.autograd.Function):
    """2D Gaussians to one picture."""

    @staticmethod
    def forward(
        ctx: Any, background: Tensor, settings: _Settings, *projected: Tensor
    ) -> tuple[Tensor, ...]:
        dtype = _core.working_dtype(settings.backend)
        ctx.save_for_backward(background, *projected)
        ctx.backend = settings.backend
        ctx.image = _core.rasterize(
            _projected_arrays(projected, dtype),
            width=settings.width,
            height=settings.height,
            background=_array(background, dtype),
            backend=settings.backend,
        )
        return tuple(torch.from_numpy(ctx.image[name]).to(background) for name in IMAGE)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(
        ctx: Any, v_color: Tensor, v_alpha: Tensor, v_depth: Tensor
    ) -> tuple[Tensor | None, ...]:
        dtype = _core.working_dtype(ctx.backend)
        background, *projected = ctx.saved_tensors
        v = _core.rasterize_backward(
            _projected_arrays(projected, dtype),
            ctx.image,
            v_color=_array(v_color, dtype),
            v_alpha=_array(v_alpha, dtype),
            v_depth=_array(v_depth, dtype),
            background=_array(background, dtype),
            absolute=False,
            backend=ctx.backend,
        )
        v_background = torch.from_numpy(v["v_background"]).to(background)
        v_projected = (torch.from_numpy(v[f"v_{name}"]).to(background) for name in DIFFERENTIABLE)
        return (v_background, None, *v_projected, None)


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = TILE_SIZE,
    backgrounds: Tensor | None = None,
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
    backend: str = "auto",
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians into C cameras, differentiably.

    Gradients reach ``means``, ``quats``, ``scales``, ``opacities``, ``colors``, ``viewmats``,
    ``Ks`` (fx, fy, cx, cy) and ``backgrounds``. Tensors may lie on any torch device (all on one);
    the result lies there too. Splat tensors are float32; with backend "reference" they may all be
    float64, and then everything is computed and returned in it. Cameras are float32 or float64.

    Args:
        means: [N, 3] centres, world frame.
        quats: [N, 4] rotations w x y z, normalised inside.
        scales: [N, 3] standard deviations (not logarithms).
        opacities: [N] in [0, 1] (not logits).
        colors: [N, 3] or [C, N, 3] colours; with ``sh_degree``, [N, K, 3] or [C, N, K, 3]
            spherical-harmonics coefficients with K >= (sh_degree + 1)^2.
        viewmats: [C, 4, 4] rigid world-to-camera matrices, OpenCV axes.
        Ks: [C, 3, 3] pinhole matrices in pixels without skew; pixel centres at +0.5.
        width, height: picture size in pixels.
        near_plane, far_plane: splats whose centre's camera-space z is outside are not drawn.
        radius_clip: splats whose 2D radii are both at most this many pixels are not drawn.
        eps2d: variance in square pixels added to every projected Gaussian.
        sh_degree: degree to evaluate, 0-4, or None for direct colours.
        packed: True (gsplat's default) returns per-splat ``meta`` entries only for the nnz
            visible (camera, splat) pairs, [nnz, ...] with ``camera_ids`` and ``gaussian_ids``;
            False returns them [C, N, ...], zero ``radii`` meaning not visible. The picture does
            not depend on it; pass the strategy's ``packed`` the same value, as with gsplat.
        backgrounds: [C, 3] colour behind the splats; None is black.
        render_mode: "RGB"; "D" accumulated depth; "ED" expected depth (accumulated / alpha);
            "RGB+D", "RGB+ED" with the depth as last channel.
        backend: "auto" (a real GPU if one answers, else "cpu"), "cpu", "gpu", "reference".

        All other arguments are gsplat's and accepted at their defaults only.

    Returns:
        ``render_colors`` [C, height, width, X] with X = 3, 1 or 4 by ``render_mode``,
        ``render_alphas`` [C, height, width, 1], and ``meta``: ``means2d`` (in the graph: call
        ``retain_grad()`` before ``backward()``), ``radii`` (int32 pixels, x and y, rounded up),
        ``depths``, ``conics`` (xx, xy, yy), ``opacities``, ``batch_ids``, ``camera_ids``,
        ``gaussian_ids``, ``width``, ``height``, ``tile_size``, ``tile_width``, ``tile_height``,
        ``n_batches``, ``n_cameras``.

    Raises:
        ValueError: an argument has the wrong type, dtype, shape, device or value, or is one of
            gsplat's that is not supported; the message begins with its name.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    arguments = locals()
    for name, default in _UNSUPPORTED_DEFAULTS.items():
        value = arguments[name]
        if name == "rolling_shutter" and getattr(value, "name", None) == "GLOBAL":
            continue  # gsplat's own default, an enum that is not ours to import
        if value is not default and (isinstance(value, Tensor) or value != default):
            raise ValueError(f"{name}: only {default!r} is supported, not {value!r}")
    _check_settings(
        width,
        height,
        near_plane,
        far_plane,
        radius_clip,
        eps2d,
        sh_degree,
        packed,
        render_mode,
        backend,
    )
    dtypes = (torch.float32, torch.float64) if backend == "reference" else (torch.float32,)
    _check_tensors(
        means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, sh_degree, dtypes
    )
    backend = _core.resolve_backend(backend)
    settings = _Settings(width, height, near_plane, far_plane, eps2d, sh_degree, backend)
    cameras = len(viewmats)
    per_camera_colors = colors.dim() == (3 if sh_degree is None else 4)

    projected = [
        _Project.apply(
            means,
            quats,
            scales,
            opacities,
            colors[c] if per_camera_colors else colors,
            viewmats[c],
            Ks[c],
            settings,
        )
        for c in range(cameras)
    ]
    # Each [C, N, ...]: the strategies read the gradient of the stacked means2d.
    stacked = dict(zip(PROJECTED, map(torch.stack, zip(*projected, strict=True)), strict=True))
    if radius_clip > 0.0:
        radii = stacked["radii"]
        stacked["radii"] = radii * (radii > radius_clip).any(dim=-1, keepdim=True)

    camera_ids: Tensor | None = None
    gaussian_ids: Tensor | None = None
    segments: list[int | slice] = list(range(cameras))
    if packed:
        visible = (stacked["radii"] > 0).all(dim=-1)
        camera_ids, gaussian_ids = torch.where(visible)
        stacked = {name: per_splat[visible] for name, per_splat in stacked.items()}
        ends = torch.cumsum(visible.sum(dim=1), dim=0).tolist()
        segments = [slice(a, b) for a, b in zip([0, *ends[:-1]], ends, strict=True)]

    colors_out, alphas_out = [], []
    for c, segment in enumerate(segments):
        background = means.new_zeros(3) if backgrounds is None else backgrounds[c]
        per_camera = (per_splat[segment] for per_splat in stacked.values())
        color, alpha, depth = _Rasterize.apply(background, settings, *per_camera)
        alpha = alpha[..., None]
        depth = depth[..., None]
        if render_mode.endswith("ED"):
            depth = depth / alpha.clamp(min=1e-10)
        if render_mode == "RGB":
            colors_out.append(color)
        elif render_mode.startswith("RGB+"):
            colors_out.append(torch.cat([color, depth], dim=-1))
        else:
            colors_out.append(depth)
        alphas_out.append(alpha)

    p, q, r = stacked["factors"].unbind(dim=-1)
    meta = {
        "batch_ids": None if camera_ids is None else torch.zeros_like(camera_ids),
        "camera_ids": camera_ids,
        "gaussian_ids": gaussian_ids,
        # Nothing that exceeds int32 is a useful radius, and the cast of inf is undefined.
        "radii": torch.ceil(stacked["radii"]).clamp(max=2.0**30).to(torch.int32),
        "means2d": stacked["means2d"],
        "depths": stacked["depths"],
        "conics": torch.stack([p * p, p * q, q * q + r * r], dim=-1),
        "opacities": stacked["opacities"],
        "width": width,
        "height": height,
        "tile_size": tile_size,
        "tile_width": math.ceil(width / TILE_SIZE),
        "tile_height": math.ceil(height / TILE_SIZE),
        "n_batches": 1,
        "n_cameras": cameras,
    }
    return torch.stack(colors_out), torch.stack(alphas_out), meta


def _check_settings(
    width: object,
    height: object,
    near_plane: Any,
    far_plane: Any,
    radius_clip: Any,
    eps2d: Any,
    sh_degree: Any,
    packed: object,
    render_mode: object,
    backend: object,
) -> None:
    for name, size in (("width", width), ("height", height)):
        if isinstance(size, bool) or not isinstance(size, (int, np.integer)) or size < 1:
            raise ValueError(f"{name}: must be a positive whole number of pixels, not {size!r}")
    for name, number in (
        ("near_plane", near_plane),
        ("far_plane", far_plane),
        ("radius_clip", radius_clip),
        ("eps2d", eps2d),
    ):
        real = isinstance(number, numbers.Real) and not isinstance(number, bool)
        if not real or not math.isfinite(number) or number < 0:
            raise ValueError(f"{name}: must be a finite number of at least 0, not {number!r}")
    if far_plane <= near_plane:
        raise ValueError(f"far_plane: must exceed near_plane ({near_plane}), not {far_plane}")
    whole = isinstance(sh_degree, numbers.Integral) and not isinstance(sh_degree, bool)
    if sh_degree is not None and not (whole and sh_degree in range(MAX_SH_DEGREE + 1)):
        raise ValueError(f"sh_degree: must be None or 0 to 4, not {sh_degree!r}")
    if not isinstance(packed, bool):
        raise ValueError(f"packed: must be True or False, not {packed!r}")
    if render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode: must be one of {RENDER_MODES}, not {render_mode!r}")
    if not isinstance(backend, str):
        raise ValueError(f"backend: must be a name such as 'auto', not {backend!r}")


def _check_tensors(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    backgrounds: Tensor | None,
    sh_degree: int | None,
    dtypes: tuple[torch.dtype, ...],
) -> None:
    _check_tensor("means", means, [("N", 3)], dtypes)
    count, device, dtypes = len(means), means.device, (means.dtype,)
    _check_tensor("quats", quats, [(count, 4)], dtypes, device)
    _check_tensor("scales", scales, [(count, 3)], dtypes, device)
    _check_tensor("opacities", opacities, [(count,)], dtypes, device)
    camera_dtypes = (torch.float32, torch.float64)
    _check_tensor("viewmats", viewmats, [("C", 4, 4)], camera_dtypes, device)
    cameras = len(viewmats)
    if cameras == 0:
        raise ValueError("viewmats: needs at least one camera")
    _check_tensor("Ks", Ks, [(cameras, 3, 3)], camera_dtypes, device)
    if sh_degree is None:
        shapes: list[tuple[int | str, ...]] = [(count, 3), (cameras, count, 3)]
    else:
        shapes = [(count, "K", 3), (cameras, count, "K", 3)]
    _check_tensor("colors", colors, shapes, dtypes, device)
    if sh_degree is not None and colors.shape[-2] < (sh_degree + 1) ** 2:
        raise ValueError(
            f"colors: sh_degree {sh_degree} needs {(sh_degree + 1) ** 2} coefficients, "
            f"not {colors.shape[-2]}"
        )
    if sh_degree is not None and colors.shape[-2] > (MAX_SH_DEGREE + 1) ** 2:
        raise ValueError(
            f"colors: at most {(MAX_SH_DEGREE + 1) ** 2} coefficients (degree {MAX_SH_DEGREE}) "
            f"are supported, not {colors.shape[-2]}"
        )
    if backgrounds is not None:
        _check_tensor("backgrounds", backgrounds, [(cameras, 3)], dtypes, device)
        if not torch.isfinite(backgrounds).all():
            raise ValueError("backgrounds: must be finite")
    for c, viewmat in enumerate(_array(viewmats, np.float64)):
        _check_viewmat(f"viewmats[{c}]", viewmat)
    for c, K in enumerate(_array(Ks, np.float64)):
        _check_intrinsics(f"Ks[{c}]", K)


def _check_tensor(
    name: str,
    tensor: object,
    shapes: list[tuple[int | str, ...]],
    dtypes: tuple[torch.dtype, ...],
    device: torch.device | None = None,
) -> None:
    """Letters in ``shapes`` stand for any size."""
    if not isinstance(tensor, Tensor):
        raise ValueError(f"{name}: must be a torch tensor, not {type(tensor).__name__}")
    if tensor.dtype not in dtypes:
        wanted = " or ".join(str(dtype) for dtype in dtypes)
        raise ValueError(f"{name}: must be {wanted}, not {tensor.dtype}")
    if not any(
        tensor.dim() == len(shape)
        and all(isinstance(s, str) or s == t for s, t in zip(shape, tensor.shape, strict=True))
        for shape in shapes
    ):
        wanted = " or ".join("[" + ", ".join(map(str, shape)) + "]" for shape in shapes)
        raise ValueError(f"{name}: must have shape {wanted}, not {list(tensor.shape)}")
    if device is not None and tensor.device != device:
        raise ValueError(f"{name}: must be on {device} like means, not on {tensor.device}")


def _check_viewmat(name: str, viewmat: npt.NDArray[np.float64]) -> None:
    if not np.isfinite(viewmat).all():
        raise ValueError(f"{name}: must be finite")
    rotation = viewmat[:3, :3]
    rigid = np.abs(rotation @ rotation.T - np.eye(3)).max() <= RIGID_TOLERANCE
    if not rigid or np.linalg.det(rotation) < 0:
        raise ValueError(f"{name}: its 3 x 3 part is not a rotation")
    if np.abs(viewmat[3] - (0.0, 0.0, 0.0, 1.0)).max() > RIGID_TOLERANCE:
        raise ValueError(f"{name}: its last row must be 0 0 0 1")


def _check_intrinsics(name: str, K: npt.NDArray[np.float64]) -> None:
    if not np.isfinite(K).all():
        raise ValueError(f"{name}: must be finite")
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise ValueError(f"{name}: focal lengths must be positive, not {K[0, 0]}, {K[1, 1]}")
    if K[0, 1] != 0 or K[1, 0] != 0 or (K[2] != (0.0, 0.0, 1.0)).any():
        raise ValueError(f"{name}: must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] (no skew)")
