"""Checks of ``rasterization``'s arguments; each message begins with the argument's name."""

from __future__ import annotations

import math
import numbers
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from igsr import _core
from igsr.splats import MAX_SH_DEGREE

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
RASTERIZE_MODES = ("classic", "antialiased")
FLOAT32_MAX = float(np.finfo(np.float32).max)

#: Arguments of gsplat that accept only this default.
UNSUPPORTED: dict[str, Any] = {
    "tile_size": _core.TILE_SIZE,
    "camera_model": "pinhole",
    "global_z_order": True,
    **dict.fromkeys(
        ("sparse_grad", "distributed", "segmented", "with_ut", "with_eval3d", "macro_tile"), False
    ),
    "return_normals": False,
    **dict.fromkeys(
        ("covars", "radial_coeffs", "tangential_coeffs", "thin_prism_coeffs", "ftheta_coeffs")
    ),
    **dict.fromkeys(("rolling_shutter", "viewmats_rs", "rays", "lidar_coeffs", "ut_params")),
    **dict.fromkeys(("external_distortion_coeffs", "extra_signals", "extra_signals_sh_degree")),
    **dict.fromkeys(("renderer_config", "nht_params")),
}
#: Arguments of gsplat that have no effect here.
IGNORED = ("channel_chunk",)
UNDISTORT = "undistort the photos first, as igsr.load_capture does"
ALTERNATIVES = {
    "covars": "give quats and scales",
    "radial_coeffs": UNDISTORT,
    "tangential_coeffs": UNDISTORT,
    "thin_prism_coeffs": UNDISTORT,
    "return_normals": "render_normals=True adds normals to meta",
    "extra_signals": "append the signals to colors as further channels",
}
FISHEYE = "give pinhole views of the photos, as igsr.load_capture makes of fisheye lenses"
#: Alternatives to gsplat's other camera models.
CAMERA_MODELS = {
    "ortho": "nearly the same is a pinhole far off: move it back along its axis by a distance d of "
    "100 times the scene's depth, and give fx and fy in pixels per unit of length, times d",
    "fisheye": FISHEYE,
    "ftheta": FISHEYE,
    "lidar": "give pinhole views",
}


def check_arguments(arguments: dict[str, Any]) -> None:
    """Check all arguments of ``rasterization``, by name.

    Raises:
        TypeError: an argument is unknown to gsplat, too.
        ValueError: an argument cannot be used; the message begins with its name.
    """
    _check_unsupported(arguments["unsupported"])
    _check_settings(arguments)
    _check_splats(arguments)
    _check_cameras(arguments)
    _check_colors(arguments)
    _check_pixels(arguments)
    _check_absgrad(arguments)


def _check_unsupported(arguments: dict[str, Any]) -> None:
    for name, value in arguments.items():
        if name in IGNORED:
            continue
        if name not in UNSUPPORTED:
            raise TypeError(f"rasterization() got an unexpected keyword argument {name!r}")
        if name == "tile_size" and value is None:
            continue  # the default of gsplat's development branch
        if name == "rolling_shutter" and getattr(value, "name", None) == "GLOBAL":
            continue  # gsplat's default is its own enum
        default = UNSUPPORTED[name]
        # Arrays do not compare to a single truth value.
        is_plain = isinstance(value, (str, bool, numbers.Number))
        if value is default or (is_plain and value == default):
            continue
        shown = repr(value) if is_plain else f"a {type(value).__name__}"
        alternative = ALTERNATIVES.get(name, "")
        if name == "camera_model":
            others = f"gsplat's others are {', '.join(CAMERA_MODELS)}, which are not supported"
            alternative = CAMERA_MODELS.get(value, others) if is_plain else others
        advice = f"; {alternative}" if alternative else ""
        raise ValueError(f"{name}: only {default!r} is supported, not {shown}{advice}")


def _check_settings(arguments: dict[str, Any]) -> None:
    for name in ("width", "height"):
        size = arguments[name]
        if not isinstance(size, (int, np.integer)) or isinstance(size, bool) or size < 1:
            raise ValueError(f"{name}: must be a positive whole number of pixels, not {size!r}")
        if size > _core.SIDE_MAX:
            raise ValueError(
                f"{name}: must be at most {_core.SIDE_MAX} pixels, not {size}; render a large "
                "picture in parts"
            )
    for name in ("near_plane", "far_plane", "radius_clip", "eps2d"):
        number = arguments[name]
        is_real = isinstance(number, numbers.Real) and not isinstance(number, bool)
        upper = math.inf if name == "far_plane" else FLOAT32_MAX
        if not is_real or not 0 <= number <= upper:
            kind = "a number" if name == "far_plane" else "a finite number"
            raise ValueError(f"{name}: must be {kind} of at least 0, not {number!r}")
    near_plane, far_plane = arguments["near_plane"], arguments["far_plane"]
    if far_plane <= near_plane:
        raise ValueError(f"far_plane: must exceed near_plane ({near_plane}), not {far_plane}")
    sh_degree = arguments["sh_degree"]
    is_whole = isinstance(sh_degree, numbers.Integral) and not isinstance(sh_degree, bool)
    if sh_degree is not None and not (is_whole and sh_degree in range(MAX_SH_DEGREE + 1)):
        raise ValueError(f"sh_degree: must be None or 0 to 4, not {sh_degree!r}")
    for name in ("packed", "absgrad", "render_normals"):
        if not isinstance(arguments[name], bool):
            raise ValueError(f"{name}: must be True or False, not {arguments[name]!r}")
    for name, choices in (("render_mode", RENDER_MODES), ("rasterize_mode", RASTERIZE_MODES)):
        # Arrays may not even compare with the choices.
        if not isinstance(arguments[name], str) or arguments[name] not in choices:
            raise ValueError(f"{name}: must be one of {choices}, not {arguments[name]!r}")
    if not isinstance(arguments["backend"], str):
        raise ValueError(f"backend: must be a name such as 'auto', not {arguments['backend']!r}")


def _check_splats(arguments: dict[str, Any]) -> None:
    means = arguments["means"]
    dtypes: tuple[torch.dtype, ...] = (torch.float32,)
    if arguments["backend"] == "reference":
        dtypes = (torch.float32, torch.float64)
    _check_tensor("means", means, [("N", 3)], dtypes)
    count = len(means)
    for name, shape in (("quats", (count, 4)), ("scales", (count, 3)), ("opacities", (count,))):
        _check_tensor(name, arguments[name], [shape], (means.dtype,), means.device)


def _check_cameras(arguments: dict[str, Any]) -> None:
    device = arguments["means"].device
    viewmats, Ks = arguments["viewmats"], arguments["Ks"]
    dtypes = (torch.float32, torch.float64)
    _check_tensor("viewmats", viewmats, [("C", 4, 4)], dtypes, device)
    if len(viewmats) == 0:
        raise ValueError("viewmats: needs at least one camera")
    _check_tensor("Ks", Ks, [(len(viewmats), 3, 3)], dtypes, device)
    for c, viewmat in enumerate(viewmats.detach().cpu().double().numpy()):
        _check_viewmat(f"viewmats[{c}]", viewmat)
    for c, K in enumerate(Ks.detach().cpu().double().numpy()):
        _check_intrinsics(f"Ks[{c}]", K)


def _check_colors(arguments: dict[str, Any]) -> None:
    means, colors, sh_degree = arguments["means"], arguments["colors"], arguments["sh_degree"]
    count, cameras = len(means), len(arguments["viewmats"])
    per_splat: tuple[int | str, ...] = ("D",) if sh_degree is None else ("K", 3)
    shapes = [(count, *per_splat), (cameras, count, *per_splat)]
    _check_tensor("colors", colors, shapes, (means.dtype,), means.device)
    if sh_degree is None:
        if colors.shape[-1] == 0:
            raise ValueError("colors: needs at least one channel")
        return
    bands = colors.shape[-2]
    lower, upper = (sh_degree + 1) ** 2, (MAX_SH_DEGREE + 1) ** 2
    if not lower <= bands <= upper:
        raise ValueError(
            f"colors: sh_degree {sh_degree} needs {lower} to {upper} coefficients, not {bands}"
        )


def _check_pixels(arguments: dict[str, Any]) -> None:
    means, backgrounds, masks = arguments["means"], arguments["backgrounds"], arguments["masks"]
    cameras, channels = len(arguments["viewmats"]), arguments["colors"].shape[-1]
    picture = (cameras, arguments["height"], arguments["width"])
    if backgrounds is not None:
        shapes: list[tuple[int | str, ...]] = [(cameras, channels), (*picture, channels)]
        _check_tensor("backgrounds", backgrounds, shapes, (means.dtype,), means.device)
        if not torch.isfinite(backgrounds).all():
            raise ValueError("backgrounds: must be finite")
    if masks is not None:
        _check_tensor("masks", masks, [picture], (torch.bool,), means.device)


def _check_absgrad(arguments: dict[str, Any]) -> None:
    if not arguments["absgrad"] or arguments["render_mode"] in ("D", "ED"):
        return
    # Absolute gradients of several passes cannot be added.
    if arguments["colors"].shape[-1] > 3:
        raise ValueError("absgrad: needs colors of at most 3 channels, which are drawn in one pass")
    if arguments["render_normals"]:
        raise ValueError("absgrad: cannot be combined with render_normals; ask in two calls")


def _check_tensor(
    name: str,
    tensor: object,
    shapes: list[tuple[int | str, ...]],
    dtypes: tuple[torch.dtype, ...],
    device: torch.device | None = None,
) -> None:
    """Check a tensor; letters in ``shapes`` stand for any size."""
    if not isinstance(tensor, Tensor):
        raise ValueError(f"{name}: must be a torch tensor, not {type(tensor).__name__}")
    if tensor.dtype not in dtypes:
        expected = " or ".join(str(dtype) for dtype in dtypes)
        advice = ""
        if tensor.dtype == torch.float64 and dtypes == (torch.float32,):
            advice = "; convert it with .float()"
            if name == "means":
                advice += ', or take backend="reference", which computes in float64'
        raise ValueError(f"{name}: must be {expected}, not {tensor.dtype}{advice}")
    if tensor.layout != torch.strided or tensor.device.type == "meta":
        raise ValueError(
            f"{name}: must be a dense tensor with values, not {tensor.layout} on {tensor.device}"
        )
    if not any(
        tensor.dim() == len(shape)
        and all(isinstance(s, str) or s == t for s, t in zip(shape, tensor.shape, strict=True))
        for shape in shapes
    ):
        expected = " or ".join("[" + ", ".join(map(str, shape)) + "]" for shape in shapes)
        raise ValueError(f"{name}: must have shape {expected}, not {list(tensor.shape)}")
    if device is not None and tensor.device != device:
        raise ValueError(f"{name}: must be on {device} like means, not on {tensor.device}")


def _check_viewmat(name: str, viewmat: npt.NDArray[np.float64]) -> None:
    if not np.isfinite(viewmat).all():
        raise ValueError(f"{name}: must be finite")
    rotation = viewmat[:3, :3]
    is_rigid = np.abs(rotation @ rotation.T - np.eye(3)).max() <= _core.RIGID_TOLERANCE
    if not is_rigid or np.linalg.det(rotation) < 0:
        raise ValueError(
            f"{name}: its 3 x 3 part is not a rotation; give a rigid world-to-camera matrix "
            "without scale, shear or reflection"
        )
    if np.abs(viewmat[3] - (0.0, 0.0, 0.0, 1.0)).max() > _core.RIGID_TOLERANCE:
        raise ValueError(f"{name}: its last row must be 0 0 0 1")


def _check_intrinsics(name: str, K: npt.NDArray[np.float64]) -> None:
    if not np.isfinite(K).all():
        raise ValueError(f"{name}: must be finite")
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise ValueError(f"{name}: focal lengths must be positive, not {K[0, 0]}, {K[1, 1]}")
    if K[0, 1] != 0 or K[1, 0] != 0 or (K[2] != (0.0, 0.0, 1.0)).any():
        raise ValueError(f"{name}: must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] (no skew)")
