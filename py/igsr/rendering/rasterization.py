"""``rasterization``: the renderer as a differentiable torch function, called like gsplat's.

Argument names, defaults, shapes and the returned triple follow gsplat 1.5 and its development
branch of 2026, so that gsplat's users change an import, and gsplat's strategies run on it.

Two autograd functions do the work: ``_Project`` and ``_Rasterize``. Between them are ``means2d``
(density control reads ``meta["means2d"].grad``) and ``factors``, the upper-triangular factor of
each conic, which avoids the cancellation that a covariance has for long needles. Further channels,
normals, and backgrounds and masks per pixel are composed of the two in torch.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
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

#: Color channels that one pass of the kernels draws.
CHANNELS_PER_PASS = 3
COLOR_MODES = ("RGB", "RGB+D", "RGB+ED")

#: Outputs of ``_Project``; "radii" has no gradient.
DIFFERENTIABLE = ("means2d", "factors", "depths", "colors", "opacities")
PROJECTED = (*DIFFERENTIABLE, "radii")
IMAGE = ("color", "alpha", "depth", "transmittance")


#: Arguments of ``_core.project`` that do not depend on the camera.
Options = dict[str, Any]


def _array(tensor: Tensor, dtype: Any) -> npt.NDArray[Any]:
    """The tensor as a contiguous array in host memory; a copy only if necessary."""
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=dtype)


def _tensor(array: npt.NDArray[Any], like: Tensor) -> Tensor:
    """The array as a tensor with the device and dtype of ``like``; a copy only if necessary.

    Numbers too large for float32, such as the gradient of a splat of 1e38 units, are clipped so
    that their sum over a thousand cameras is finite.
    """
    if array.dtype == np.float64 and like.dtype == torch.float32:
        limit = FLOAT32_MAX / 1024.0
        array = array.clip(-limit, limit)
    return torch.from_numpy(array).to(like)


class _Project(torch.autograd.Function):
    """Project splats to the 2D Gaussians of one camera."""

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
        options: Options,
    ) -> tuple[Tensor, ...]:
        dtype = _core.working_dtype(options["backend"])
        names = ("means", "quats", "scales", "opacities", "colors")
        splats = (means, quats, scales, opacities, colors)
        inputs: dict[str, Any] = {
            name: _array(tensor, dtype) for name, tensor in zip(names, splats, strict=True)
        }
        options = {
            **options,
            "viewmat": _array(viewmat, np.float64),
            "intrinsics": _array(K, np.float64)[[0, 1, 0, 1], [0, 1, 2, 2]],
        }
        projected = _core.project(**inputs, **options)
        outputs = tuple(_tensor(projected[name], means) for name in PROJECTED)
        # The arrays share memory with these tensors. autograd detects changes in place only of
        # tensors that are saved here; backward() then raises.
        ctx.save_for_backward(*splats, viewmat, K, *outputs)
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
        return (
            *(_tensor(v[f"v_{name}"], means) for name in ctx.inputs),
            _tensor(v["v_viewmat"], viewmat),
            _tensor(v_K, K),
            None,
        )


class _Rasterize(torch.autograd.Function):
    """Draw 2D Gaussians."""

    @staticmethod
    def forward(
        ctx: Any,
        background: Tensor,
        options: Options,
        keep_absolute: Callable[[Tensor], None] | None,
        *projected: Tensor,
    ) -> tuple[Tensor, ...]:
        dtype = _core.working_dtype(options["backend"])
        # Gradients of unused outputs come as None, not as zeros.
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(background, *projected)
        ctx.projected = {n: _array(t, dtype) for n, t in zip(PROJECTED, projected, strict=True)}
        ctx.keep_absolute = keep_absolute
        ctx.background, ctx.backend = _array(background, dtype), options["backend"]
        ctx.image = _core.rasterize(
            ctx.projected,
            width=options["width"],
            height=options["height"],
            background=ctx.background,
            backend=ctx.backend,
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
        if v_transmittance is not None:  # transmittance is 1 - alpha
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
    backgrounds: Tensor | None = None,
    render_mode: RenderMode = "RGB",
    absgrad: bool = False,
    rasterize_mode: RasterizeMode = "classic",
    backend: Backend = "auto",
    masks: Tensor | None = None,
    render_normals: bool = False,
    **unsupported: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians from C cameras, differentiably.

    ``rasterization(**splats.to_torch(), viewmats=..., Ks=..., width=..., height=...)`` renders
    ``Splats``.

    Gradients reach ``means``, ``quats``, ``scales``, ``opacities``, ``colors``, ``viewmats``,
    ``Ks`` (fx, fy, cx, cy) and ``backgrounds``. Splat tensors are float32; with backend
    "reference" they may all be float64, and the results are, too. Cameras are float32 or float64.

    All tensors are on one torch device, and the results are on it. The kernels take arrays in host
    memory: tensors that are not contiguous on the CPU are copied for each camera.

    Args:
        means: [N, 3] centers, world frame.
        quats: [N, 4] rotations w x y z, normalized internally.
        scales: [N, 3] standard deviations, world units, not logarithms. Splats with a negative one
            are not drawn.
        opacities: [N] in [0, 1], not logits.
        colors: [N, D] or [C, N, D] colors or other features, D >= 1; with ``sh_degree``, [N, K, 3]
            or [C, N, K, 3] spherical-harmonics coefficients, K >= (sh_degree + 1)^2, and D = 3.
            Three channels take one pass over the 2D splats.
        viewmats: [C, 4, 4] rigid world-to-camera matrices, OpenCV axes.
        Ks: [C, 3, 3] pinhole matrices without skew, pixels; pixel centers at +0.5.
        width: of the picture, pixels.
        height: of the picture, pixels.
        near_plane: splats with a smaller camera-space z are not drawn, world units.
        far_plane: splats with a larger camera-space z are not drawn; may be inf.
        radius_clip: splats with both ``radii`` at most this are not drawn, pixels.
        eps2d: variance added to projected Gaussians, square pixels.
        sh_degree: spherical-harmonics degree to evaluate, 0-4; None for direct colors.
        packed: whether ``meta`` has entries per splat only for the nnz visible (camera, splat)
            pairs, [nnz, ...], with ``camera_ids`` and ``gaussian_ids``; else [C, N, ...] with zero
            ``radii`` for invisible splats. Give gsplat's strategies the same value.
        backgrounds: [C, D] colors behind the splats, or [C, height, width, D]; None is black.
            Depth and normals have no background.
        render_mode: "RGB"; "D" accumulated depth; "ED" expected depth (accumulated / alpha, 0 if
            alpha is 0); "RGB+D" and "RGB+ED" with the depth as last channel.
        absgrad: whether ``backward()`` leaves the sum over pixels of the absolute gradients of
            ``means2d`` in ``meta["means2d"].absgrad``, for ``DefaultStrategy(absgrad=True)``.
            Needs at most three channels and no ``render_normals``.
        rasterize_mode: "classic", or "antialiased": opacities, also in ``meta``, are multiplied by
            sqrt(det(S) / det(S + eps2d I)) with S the 2D covariance (Mip-Splatting's 2D filter).
        backend: "auto" (a real GPU if one answers, else "cpu"), "cpu", "gpu", "reference".
        masks: bool [C, height, width]; False pixels show the background, have alpha, depth and
            normal 0, and no gradient. gsplat's ``rasterize_to_pixels`` has such masks for tiles.
        render_normals: whether ``meta`` has ``render_normals``.
        unsupported: gsplat's other arguments; only their default is accepted. ``channel_chunk``
            has no effect.

    Returns:
        ``render_colors`` [C, height, width, X] with X = D, 1 or D + 1 by ``render_mode``,
        ``render_alphas`` [C, height, width, 1], and ``meta``: ``means2d`` (in the graph: call
        ``retain_grad()`` before ``backward()``), ``radii`` (int32 pixels, x and y, rounded up),
        ``depths``, ``conics`` (xx, xy, yy), ``opacities``, ``batch_ids``, ``camera_ids``,
        ``gaussian_ids``, ``width``, ``height``, ``tile_size``, ``tile_width``, ``tile_height``,
        ``n_batches``, ``n_cameras``, but not gsplat's lists of tiles; and if asked for,
        ``render_normals`` [C, height, width, 3]: the splats' shortest axes, facing the camera, in
        the world frame, accumulated like colors, as in gsplat's ``rasterization_2dgs``.

    Raises:
        ValueError: an argument has the wrong type, dtype, shape, device or value, or is not
            supported. The message begins with the argument's name.
        TypeError: an argument is unknown.
        RuntimeError: backend "gpu" was asked for and no adapter answers; or, in ``backward()``,
            a tensor that it needs was changed in place.
    """
    check_arguments(locals())
    options = {
        "sh_degree": sh_degree,
        "raw_parameters": False,
        "width": width,
        "height": height,
        "near": near_plane,
        "far": min(far_plane, FLOAT32_MAX),
        "eps2d": eps2d,
        "antialiased": rasterize_mode == "antialiased",
        "backend": _core.resolve_backend(backend),
    }
    channels = colors.shape[-1]
    per_camera_colors = colors.dim() == (3 if sh_degree is None else 4)
    further: Tensor | None = None
    if sh_degree is None and channels != CHANNELS_PER_PASS:
        colors, further = _grouped(colors)
        if render_mode not in COLOR_MODES:
            further = None

    views, ids = [], []
    for c in range(len(viewmats)):
        of_camera = (colors[c] if per_camera_colors else colors, viewmats[c], Ks[c])
        outputs = _Project.apply(means, quats, scales, opacities, *of_camera, options)
        view = dict(zip(PROJECTED, outputs, strict=True))
        if radius_clip > 0.0:
            radii = view["radii"]
            # gsplat compares the rounded radii.
            view["radii"] = radii * (torch.ceil(radii) > radius_clip).any(dim=-1, keepdim=True)
        if further is not None:
            view["further"] = further[c] if per_camera_colors else further
        drawn = view["radii"].amin(dim=-1) > 0 if packed or render_normals else None
        if drawn is not None and render_normals:
            view["normals"] = facing_normals(means, quats, scales, viewmats[c], drawn)
        if drawn is not None and packed:
            ids.append(drawn.nonzero().squeeze(1))
            view = {name: per_splat.index_select(0, ids[-1]) for name, per_splat in view.items()}
        views.append(view)

    # The graph has one tensor for all cameras, since the strategies read its gradient.
    joined = {name: _joined([view[name] for view in views], packed) for name in PROJECTED}
    means2d = joined["means2d"]
    ends = list(itertools.accumulate(len(view["means2d"]) for view in views))
    drawings = []
    for c, view in enumerate(views):
        segment = slice(ends[c] - len(view["means2d"]), ends[c]) if packed else c
        drawings.append(
            _draw(
                {**view, "means2d": means2d[segment]},
                None if backgrounds is None else backgrounds[c],
                None if masks is None else masks[c],
                channels,
                render_mode,
                options,
                _absgrad_keeper(means2d, segment) if absgrad else None,
            )
        )
    pictures, alphas, normals = zip(*drawings, strict=True)
    meta = _meta(joined, ids if packed else None, width, height, len(views))
    if render_normals:
        meta["render_normals"] = torch.stack(normals)
    return _joined(list(pictures), packed=False), torch.stack(alphas), meta


def _meta(
    joined: dict[str, Tensor], ids: list[Tensor] | None, width: int, height: int, cameras: int
) -> dict[str, Any]:
    """gsplat's ``meta``; if packed, ``ids`` are the visible splats of each camera."""
    p, q, r = joined["factors"].unbind(dim=-1)
    meta: dict[str, Any] = {
        "batch_ids": None,
        "camera_ids": None,
        "gaussian_ids": None,
        # Clamped, since a cast of inf to int32 is undefined.
        "radii": torch.ceil(joined["radii"]).clamp(max=2.0**30).to(torch.int32),
        "means2d": joined["means2d"],
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
    if ids is not None:
        device = joined["means2d"].device
        counts = torch.tensor([len(of_camera) for of_camera in ids]).to(device)
        meta["gaussian_ids"] = torch.cat(ids)
        meta["camera_ids"] = torch.arange(cameras, device=device).repeat_interleave(counts)
        meta["batch_ids"] = torch.zeros_like(meta["camera_ids"])
    return meta


def _joined(tensors: list[Tensor], packed: bool) -> Tensor:
    """Concatenate the cameras' tensors if packed, else stack them."""
    if len(tensors) == 1:  # without a copy
        return tensors[0] if packed else tensors[0][None]
    return torch.cat(tensors) if packed else torch.stack(tensors)


def _absgrad_keeper(means2d: Tensor, of_camera: int | slice) -> Callable[[Tensor], None]:
    """A callback of the backward pass that writes a camera's part of ``means2d.absgrad``."""

    def keep(absolute: Tensor) -> None:
        if not hasattr(means2d, "absgrad"):
            means2d.absgrad = torch.zeros_like(means2d)  # type: ignore[attr-defined]
        means2d.absgrad[of_camera] = absolute  # type: ignore[attr-defined]

    return keep


def _grouped(colors: Tensor) -> tuple[Tensor, Tensor | None]:
    """Split colors [..., D] into the first three channels and further ones, padded with zeros.

    The projection drops splats whose first three channels are not finite, so NaN in further ones is
    added to them.
    """
    channels = colors.shape[-1]
    missing = CHANNELS_PER_PASS - channels
    if missing >= 0:
        return torch.nn.functional.pad(colors, (0, missing)), None
    first, further = colors.split([CHANNELS_PER_PASS, -missing], dim=-1)
    zero_or_nan = (further.detach() * 0.0).sum(dim=-1, keepdim=True)
    padding = (0, -channels % CHANNELS_PER_PASS)
    return first + zero_or_nan, torch.nn.functional.pad(further, padding)


def _draw(
    view: dict[str, Tensor],
    background: Tensor | None,
    mask: Tensor | None,
    channels: int,
    render_mode: RenderMode,
    options: Options,
    keep_absolute: Callable[[Tensor], None] | None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Draw one camera's picture [H, W, X], alpha [H, W, 1] and normals [H, W, 3], if asked for.

    ``background`` is [D] or [H, W, D], ``mask`` [H, W]. Each group of three channels is a pass over
    the same 2D splats; autograd adds their gradients.
    """
    in_color = render_mode in COLOR_MODES
    groups = [view["colors"]]
    if "further" in view:
        groups += view["further"].split(CHANNELS_PER_PASS, dim=-1)
    color_groups = len(groups) if in_color else 0
    if "normals" in view:
        groups = [*groups[:color_groups], view["normals"]]

    behind = view["means2d"].new_zeros(CHANNELS_PER_PASS * len(groups))
    if background is not None and in_color and background.dim() == 1:
        behind = torch.nn.functional.pad(background, (0, len(behind) - channels))
    passes = [
        _Rasterize.apply(
            group_behind,
            options,
            keep_absolute,
            *(group if name == "colors" else view[name] for name in PROJECTED),
        )
        for group, group_behind in zip(groups, behind.split(CHANNELS_PER_PASS), strict=True)
    ]
    # Alpha and depth are equal in all passes, so the gradient of one pass is complete.
    _, alpha, depth, transmittance = (image[..., None] for image in passes[0])

    pieces = [color for color, *_ in passes[:color_groups]]
    if in_color and channels % CHANNELS_PER_PASS:
        pieces[-1] = pieces[-1][..., : channels % CHANNELS_PER_PASS]
    if render_mode.endswith("ED"):
        # Depth is 0 in empty pixels; in other pixels alpha is at least 1/255.
        depth = depth / alpha.clamp(min=1e-3)
    if render_mode != "RGB":
        pieces.append(depth)
    # A copy, since the backward pass needs the pieces and the caller may change the picture.
    picture = torch.cat(pieces, dim=-1) if len(pieces) > 1 else pieces[0].clone()
    normals = passes[-1][0] if "normals" in view else None

    if background is not None and in_color:
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
