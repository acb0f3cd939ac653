"""``rasterization``: the renderer as a differentiable torch function, called like gsplat's.

Argument names, defaults, shapes and the returned triple follow gsplat 1.5 and its development
branch of 2026. A gsplat user switches by changing an import, and gsplat's strategies run on it.
Arguments that this renderer does not support are refused by name.

Two autograd functions do the work, one per half of the pipeline: ``_Project`` and ``_Rasterize``.
Between them are ``means2d`` (density control reads ``meta["means2d"].grad``) and ``factors``, the
upper-triangular factor of each conic. It has the information of a covariance, without its
cancellation for long needles. Everything that gsplat offers around them (further channels, normals,
backgrounds and masks per pixel) is composed of the two in torch.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from igsr import _core
from igsr._internal.choices import Backend
from igsr.rendering.normals import facing_normals
from igsr.rendering.rasterization_arguments import FLOAT32_MAX, check_arguments

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
RasterizeMode = Literal["classic", "antialiased"]

#: Colour channels that one pass of the kernels draws.
GROUP = 3
#: Render modes whose picture shows the colours.
COLOR_MODES = ("RGB", "RGB+D", "RGB+ED")

#: What passes from ``_Project`` to ``_Rasterize``; the last carries no gradient.
DIFFERENTIABLE = ("means2d", "factors", "depths", "colors", "opacities")
PROJECTED = (*DIFFERENTIABLE, "radii")
IMAGE = ("color", "alpha", "depth", "transmittance")


@dataclass(frozen=True)
class _Settings:
    """Arguments that both halves need and autograd does not track."""

    width: int
    height: int
    near: float
    far: float
    eps2d: float
    antialiased: bool
    sh_degree: int | None
    backend: str


def _array(tensor: Tensor, dtype: Any) -> npt.NDArray[Any]:
    """A tensor as an array in host memory: its own memory if it is contiguous, there, and of that
    dtype."""
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=dtype)


def _tensor(array: npt.NDArray[Any], like: Tensor) -> Tensor:
    """An array as a tensor with the device and dtype of ``like``; its own memory if it can be.

    A number too large for float32, such as the gradient of a splat of 1e38 units, becomes one whose
    sum over a thousand cameras is still finite.
    """
    if array.dtype == np.float64 and like.dtype == torch.float32:
        limit = float(np.finfo(np.float32).max) / 1024.0
        array = array.clip(-limit, limit)
    return torch.from_numpy(array).to(like)


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
        "antialiased": settings.antialiased,
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
        inputs: dict[str, Any] = {
            "means": _array(means, dtype),
            "quats": _array(quats, dtype),
            "scales": _array(scales, dtype),
            "opacities": _array(opacities, dtype),
            "colors": _array(colors, dtype),
        }
        options = _project_options(viewmat, K, settings)
        projected = _core.project(**inputs, **options)
        outputs = tuple(_tensor(projected[name], means) for name in PROJECTED)
        # The arrays share memory with these tensors. autograd notices changes in place only of
        # tensors that are saved here; backward() then refuses.
        ctx.save_for_backward(means, quats, scales, opacities, colors, viewmat, K, *outputs)
        ctx.inputs, ctx.options, ctx.projected = inputs, options, projected
        ctx.mark_non_differentiable(*outputs[len(DIFFERENTIABLE) :])
        return outputs

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *v_outputs: Tensor) -> tuple[Tensor | None, ...]:
        means, _, _, _, _, viewmat, K = ctx.saved_tensors[:7]
        dtype = ctx.inputs["means"].dtype
        v_projected = {
            f"v_{name}": _array(v, dtype)
            for name, v in zip(DIFFERENTIABLE, v_outputs, strict=False)
        }
        v = _core.project_backward(
            **ctx.inputs, projected=ctx.projected, v_projected=v_projected, **ctx.options
        )
        v_fx, v_fy, v_cx, v_cy = v["v_intrinsics"]
        v_K = np.array([[v_fx, 0.0, v_cx], [0.0, v_fy, v_cy], [0.0, 0.0, 0.0]])
        names = ("v_means", "v_quats", "v_scales", "v_opacities", "v_colors")
        return (
            *(_tensor(v[name], means) for name in names),
            _tensor(v["v_viewmat"], viewmat),
            _tensor(v_K, K),
            None,
        )


class _Rasterize(torch.autograd.Function):
    """2D Gaussians to one picture."""

    @staticmethod
    def forward(
        ctx: Any,
        background: Tensor,
        settings: _Settings,
        keep_absolute: Callable[[Tensor], None] | None,
        *projected: Tensor,
    ) -> tuple[Tensor, ...]:
        dtype = _core.working_dtype(settings.backend)
        # Gradients of outputs that the loss does not use come as None, not as zeros.
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(background, *projected)
        ctx.projected = _projected_arrays(projected, dtype)
        ctx.keep_absolute = keep_absolute
        ctx.background, ctx.backend = _array(background, dtype), settings.backend
        ctx.image = _core.rasterize(
            ctx.projected,
            width=settings.width,
            height=settings.height,
            background=ctx.background,
            backend=settings.backend,
        )
        return tuple(_tensor(ctx.image[name], background) for name in IMAGE)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(
        ctx: Any,
        v_color: Tensor | None,
        v_alpha: Tensor | None,
        v_depth: Tensor | None,
        v_transmittance: Tensor | None,
    ) -> tuple[Tensor | None, ...]:
        background = ctx.saved_tensors[0]
        if v_transmittance is not None:  # it is 1 - alpha
            v_alpha = -v_transmittance if v_alpha is None else v_alpha - v_transmittance
        v_image = {
            f"v_{name}": np.zeros_like(ctx.image[name])
            if v is None
            else _array(v, ctx.image[name].dtype)
            for name, v in (("color", v_color), ("alpha", v_alpha), ("depth", v_depth))
        }
        v = _core.rasterize_backward(
            ctx.projected,
            ctx.image,
            **v_image,
            background=ctx.background,
            absolute=ctx.keep_absolute is not None,
            backend=ctx.backend,
        )
        if ctx.keep_absolute is not None:
            ctx.keep_absolute(_tensor(v["v_means2d_absolute"], background))
        v_background = _tensor(v["v_background"], background)
        v_projected = (_tensor(v[f"v_{name}"], background) for name in DIFFERENTIABLE)
        return (v_background, None, None, *v_projected, None)


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
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int | None = _core.TILE_SIZE,
    backgrounds: Tensor | None = None,
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: RasterizeMode = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: Literal["pinhole"] = "pinhole",
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
    macro_tile: bool = False,
    return_normals: bool = False,
    global_z_order: bool = True,
    rays: Tensor | None = None,
    lidar_coeffs: Any = None,
    external_distortion_coeffs: Any = None,
    ut_params: Any = None,
    extra_signals: Tensor | None = None,
    extra_signals_sh_degree: int | None = None,
    renderer_config: Any = None,
    nht_params: Any = None,
    backend: Backend = "auto",
    masks: Tensor | None = None,
    render_normals: bool = False,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians from C cameras, differentiably.

    ``rasterization(**splats.to_torch(), viewmats=..., Ks=..., width=..., height=...)`` renders
    ``Splats``. Arguments behind ``height`` are keyword-only.

    Gradients reach ``means``, ``quats``, ``scales``, ``opacities``, ``colors``, ``viewmats``,
    ``Ks`` (fx, fy, cx, cy) and ``backgrounds``. Splat tensors are float32; with backend
    "reference" they may all be float64, and then everything is computed and returned in it.
    Cameras are float32 or float64.

    Tensors may be on any torch device (all on one); the result is on it too. The kernels take
    arrays in host memory (from which backend "gpu" feeds its own device). Contiguous tensors on the
    CPU are used in place. Others are copied in each call, for every camera: this many bytes in
    float32, with P = ceil(D / 3) passes (one for "D" and "ED"; one more for ``render_normals``
    with colours):

        forward     to the host    44 + 12 K per splat (K = 1 for direct colors), and then
                                   48 P per splat (per drawn splat if ``packed``)
                    to the device  48 per splat, and then 24 P per pixel
        backward    to the host    at most 20 P per pixel (color 12, alpha 4, depth 4; what the
                                   loss does not use is not copied), and then 40 per splat
                    to the device  40 P per splat (8 more with ``absgrad``; per drawn splat if
                                   ``packed``), and then 44 + 12 K per splat

    Args:
        means: [N, 3] centres, world frame.
        quats: [N, 4] rotations w x y z, normalised inside.
        scales: [N, 3] standard deviations in world units (not logarithms; a splat with a negative
            one is not drawn).
        opacities: [N] in [0, 1] (not logits).
        colors: [N, D] or [C, N, D] colors or other features, any D >= 1; with ``sh_degree``,
            [N, K, 3] or [C, N, K, 3] spherical-harmonics coefficients with
            K >= (sh_degree + 1)^2, and D = 3. Channels are drawn three at a time; every three
            cost a whole pass over the 2D splats.
        viewmats: [C, 4, 4] rigid world-to-camera matrices, OpenCV axes.
        Ks: [C, 3, 3] pinhole matrices in pixels without skew; pixel centres at +0.5.
        width: of the picture, pixels.
        height: of the picture, pixels.
        near_plane: world units; splats whose centre has a camera-space z below it are not drawn.
        far_plane: likewise above it; may be inf.
        radius_clip: splats whose ``radii`` are both at most this many pixels are not drawn.
        eps2d: variance in square pixels added to every projected Gaussian.
        sh_degree: spherical-harmonics degree to evaluate, 0-4, or None for direct colors.
        packed: True (gsplat's default) returns per-splat ``meta`` entries only for the nnz
            visible (camera, splat) pairs, [nnz, ...] with ``camera_ids`` and ``gaussian_ids``;
            False returns them [C, N, ...], zero ``radii`` meaning not visible. The picture does
            not depend on it; pass the strategy's ``packed`` the same value, as with gsplat.
        backgrounds: [C, D] color behind the splats, or [C, height, width, D], one per pixel; None
            is black. Depth and normals have no background.
        render_mode: "RGB"; "D" accumulated depth; "ED" expected depth (accumulated / alpha, 0
            where alpha is 0); "RGB+D", "RGB+ED" with the depth as last channel.
        absgrad: True leaves in ``meta["means2d"].absgrad``, after ``backward()``, the sum over
            pixels of the absolute gradients of ``means2d``, shaped like it, for
            ``DefaultStrategy(absgrad=True)``. They are known within one pass only: it needs at
            most three channels, and no ``render_normals``.
        rasterize_mode: "classic", or "antialiased": opacities times
            sqrt(det(S) / det(S + eps2d I)) with S the projected 2D covariance (Mip-Splatting's 2D
            filter); ``meta["opacities"]`` are those.
        channel_chunk: accepted as in gsplat 1.5; it has no effect.
        backend: "auto" (a real GPU if one answers, else "cpu"), "cpu", "gpu", "reference".
        masks: [C, height, width] bool; where False the pixel shows the background, its alpha,
            depth and normal are 0, and it passes no gradient to the splats and the camera. These
            are the tile masks of gsplat's ``rasterize_to_pixels``, per pixel; they save no time.
        render_normals: True adds ``meta["render_normals"]``.
        tile_size: of gsplat 1.5; only its default is accepted.
        sparse_grad: of gsplat 1.5; only its default is accepted.
        distributed: of gsplat 1.5; only its default is accepted.
        camera_model: of gsplat 1.5; only its default is accepted.
        segmented: of gsplat 1.5; only its default is accepted.
        covars: of gsplat 1.5; only its default is accepted.
        with_ut: of gsplat 1.5; only its default is accepted.
        with_eval3d: of gsplat 1.5; only its default is accepted.
        radial_coeffs: of gsplat 1.5; only its default is accepted.
        tangential_coeffs: of gsplat 1.5; only its default is accepted.
        thin_prism_coeffs: of gsplat 1.5; only its default is accepted.
        ftheta_coeffs: of gsplat 1.5; only its default is accepted.
        rolling_shutter: of gsplat 1.5; only its default is accepted.
        viewmats_rs: of gsplat 1.5; only its default is accepted.
        macro_tile: of gsplat's development branch; only its default is accepted.
        return_normals: of gsplat's development branch; only its default is accepted.
        global_z_order: of gsplat's development branch; only its default is accepted.
        rays: of gsplat's development branch; only its default is accepted.
        lidar_coeffs: of gsplat's development branch; only its default is accepted.
        external_distortion_coeffs: of gsplat's development branch; only its default is accepted.
        ut_params: of gsplat's development branch; only its default is accepted.
        extra_signals: of gsplat's development branch; only its default is accepted.
        extra_signals_sh_degree: of gsplat's development branch; only its default is accepted.
        renderer_config: of gsplat's development branch; only its default is accepted.
        nht_params: of gsplat's development branch; only its default is accepted.

    Returns:
        ``render_colors`` [C, height, width, X] with X = D, 1 or D + 1 by ``render_mode``,
        ``render_alphas`` [C, height, width, 1], and ``meta``: ``means2d`` (in the graph: call
        ``retain_grad()`` before ``backward()``), ``radii`` (int32 pixels, x and y, rounded up),
        ``depths``, ``conics`` (xx, xy, yy), ``opacities``, ``batch_ids``, ``camera_ids``,
        ``gaussian_ids``, ``width``, ``height``, ``tile_size``, ``tile_width``, ``tile_height``,
        ``n_batches``, ``n_cameras`` (gsplat's lists of tiles, ``isect_ids`` and the like, are
        not there); and ``render_normals`` [C, height, width, 3] if asked for: the shortest axis
        of each splat, turned to face the camera, in the world frame, accumulated with the weights
        of the colors (so at most alpha long), as gsplat's ``rasterization_2dgs`` returns it.

    Raises:
        ValueError: an argument has the wrong type, dtype, shape, device or value, or is one of
            gsplat's that is not supported. The message begins with the argument's name.
        RuntimeError: backend "gpu" was asked for and no adapter answers; or, in ``backward()``,
            a tensor that it needs was changed in place since.
    """
    check_arguments(locals())
    backend = _core.resolve_backend(backend)
    antialiased = rasterize_mode == "antialiased"
    settings = _Settings(
        width,
        height,
        near_plane,
        min(far_plane, FLOAT32_MAX),
        eps2d,
        antialiased,
        sh_degree,
        backend,
    )
    cameras = len(viewmats)
    channels = colors.shape[-1]
    per_camera_colors = colors.dim() == (3 if sh_degree is None else 4)
    further: Tensor | None = None
    if sh_degree is None and channels != GROUP:
        colors, further = _grouped(colors)
        if render_mode not in COLOR_MODES:
            further = None

    views, ids = [], []
    for c in range(cameras):
        of_camera = (means, quats, scales, opacities, colors[c] if per_camera_colors else colors)
        outputs = _Project.apply(*of_camera, viewmats[c], Ks[c], settings)
        view = dict(zip(PROJECTED, outputs, strict=True))
        if radius_clip > 0.0:
            radii = view["radii"]
            # gsplat compares the whole numbers that ``meta`` has.
            view["radii"] = radii * (torch.ceil(radii) > radius_clip).any(dim=-1, keepdim=True)
        if further is not None:
            view["further"] = further[c] if per_camera_colors else further
        if packed or render_normals:
            drawn = view["radii"].amin(dim=-1) > 0
        if render_normals:
            view["normals"] = facing_normals(means, quats, scales, viewmats[c], drawn)
        if packed:
            ids.append(drawn.nonzero().squeeze(1))
            view = {name: per_splat.index_select(0, ids[-1]) for name, per_splat in view.items()}
        views.append(view)

    # The graph has one tensor for all cameras: the strategies read its gradient.
    joined = {name: _joined([view[name] for view in views], packed) for name in PROJECTED}
    means2d = joined["means2d"]
    counts = [len(view["means2d"]) for view in views]
    ends = list(itertools.accumulate(counts))
    segments = [slice(end - n, end) for end, n in zip(ends, counts, strict=True)]
    drawings = [
        _draw(
            {**view, "means2d": means2d[segments[c] if packed else c]},
            None if backgrounds is None else backgrounds[c],
            None if masks is None else masks[c],
            channels,
            render_mode,
            settings,
            _absgrad_keeper(means2d, segments[c] if packed else c) if absgrad else None,
        )
        for c, view in enumerate(views)
    ]
    pictures, alphas, normals = zip(*drawings, strict=True)

    p, q, r = joined["factors"].unbind(dim=-1)
    meta: dict[str, Any] = {
        "batch_ids": None,
        "camera_ids": None,
        "gaussian_ids": None,
        # The cast of inf to int32 is undefined, and no useful radius is that large.
        "radii": torch.ceil(joined["radii"]).clamp(max=2.0**30).to(torch.int32),
        "means2d": means2d,
        "depths": joined["depths"],
        "conics": torch.stack([p * p, p * q, q * q + r * r], dim=-1),
        "opacities": joined["opacities"],
        "width": width,
        "height": height,
        "tile_size": _core.TILE_SIZE,
        "tile_width": math.ceil(width / _core.TILE_SIZE),
        "tile_height": math.ceil(height / _core.TILE_SIZE),
        "n_batches": 1,
        "n_cameras": cameras,
    }
    if packed:
        meta["gaussian_ids"] = torch.cat(ids)
        camera_ids = torch.arange(cameras, device=means.device)
        meta["camera_ids"] = camera_ids.repeat_interleave(torch.tensor(counts).to(means.device))
        meta["batch_ids"] = torch.zeros_like(meta["camera_ids"])
    if render_normals:
        meta["render_normals"] = torch.stack(normals)
    return _joined(list(pictures), packed=False), torch.stack(alphas), meta


def _joined(tensors: list[Tensor], packed: bool) -> Tensor:
    """Tensors of all cameras: concatenated if packed, else stacked along a new dimension."""
    if len(tensors) == 1:  # nothing to copy
        return tensors[0] if packed else tensors[0][None]
    return torch.cat(tensors) if packed else torch.stack(tensors)


def _absgrad_keeper(means2d: Tensor, of_camera: int | slice) -> Callable[[Tensor], None]:
    """A function for the backward pass that writes a camera's part of ``means2d.absgrad``.

    ``means2d`` comes before the pass in the graph, so a reference to it makes no cycle.
    """

    def keep(absolute: Tensor) -> None:
        if not hasattr(means2d, "absgrad"):
            means2d.absgrad = torch.zeros_like(means2d)  # type: ignore[attr-defined]
        means2d.absgrad[of_camera] = absolute  # type: ignore[attr-defined]

    return keep


def _grouped(colors: Tensor) -> tuple[Tensor, Tensor | None]:
    """Colors [..., D] as the first three channels and the others, padded with zeros.

    The first three go through the projection, which does not draw a splat that is not finite. NaN
    in the others is carried over to them, to have the same effect.
    """
    channels = colors.shape[-1]
    if channels <= GROUP:
        return torch.nn.functional.pad(colors, (0, GROUP - channels)), None
    first, others = colors.split([GROUP, channels - GROUP], dim=-1)
    zero_or_nan = (others.detach() * 0.0).sum(dim=-1, keepdim=True)
    return first + zero_or_nan, torch.nn.functional.pad(others, (0, -channels % GROUP))


def _draw(
    view: dict[str, Tensor],
    background: Tensor | None,
    mask: Tensor | None,
    channels: int,
    render_mode: RenderMode,
    settings: _Settings,
    keep_absolute: Callable[[Tensor], None] | None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """One camera's picture [H, W, X], alpha [H, W, 1] and normals [H, W, 3], if asked for.

    ``background`` is [D] or [H, W, D], ``mask`` [H, W]. Every group of three channels is a pass of
    its own over the same 2D splats; autograd adds up their gradients.
    """
    in_color = render_mode in COLOR_MODES
    groups = [view["colors"]]
    if "further" in view:
        groups += view["further"].split(GROUP, dim=-1)
    color_groups = len(groups) if in_color else 0
    if "normals" in view:
        groups = [*groups[:color_groups], view["normals"]]

    behind = view["means2d"].new_zeros(GROUP * len(groups))
    if background is not None and in_color and background.dim() == 1:
        behind = torch.nn.functional.pad(background, (0, len(behind) - channels))
    passes = [
        _Rasterize.apply(
            group_behind,
            settings,
            keep_absolute,
            *(group if name == "colors" else view[name] for name in PROJECTED),
        )
        for group, group_behind in zip(groups, behind.split(GROUP), strict=True)
    ]
    # These are the same in every pass, so the gradient through one pass is complete.
    _, alpha, depth, transmittance = (image[..., None] for image in passes[0])

    pieces = [color for color, *_ in passes[:color_groups]]
    if in_color and channels % GROUP:
        pieces[-1] = pieces[-1][..., : channels % GROUP]
    if render_mode.endswith("ED"):
        # The depth is 0 where nothing is drawn; elsewhere alpha is at least 1/255.
        depth = depth / alpha.clamp(min=1e-3)
    if render_mode != "RGB":
        pieces.append(depth)
    # A copy, which the caller may change: the backward pass needs the pieces.
    picture = torch.cat(pieces, dim=-1) if len(pieces) > 1 else pieces[0].clone()
    normals = passes[-1][0] if "normals" in view else None

    if background is not None and in_color:
        # The depth has no background.
        background = torch.nn.functional.pad(background, (0, picture.shape[-1] - channels))
        if background.dim() == 3:
            picture = picture + transmittance * background
    else:
        background = picture.new_zeros(1)
    if mask is not None:
        mask = mask[..., None]
        picture = torch.where(mask, picture, background)
        alpha = torch.where(mask, alpha, 0.0)
        normals = None if normals is None else torch.where(mask, normals, 0.0)
    return picture, alpha, normals
