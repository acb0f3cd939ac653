"""Checks of ``rasterization``'s arguments: each message begins with the argument's name."""

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

#: The largest number the renderer can hold.
FLOAT32_MAX = float(np.finfo(np.float32).max)

#: Arguments of gsplat that are not supported, with their default: the only value accepted.
_UNSUPPORTED_DEFAULTS: dict[str, Any] = {
    "tile_size": _core.TILE_SIZE,
    "sparse_grad": False,
    "distributed": False,
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
    "macro_tile": False,
    "return_normals": False,
    "global_z_order": True,
    "rays": None,
    "lidar_coeffs": None,
    "external_distortion_coeffs": None,
    "ut_params": None,
    "extra_signals": None,
    "extra_signals_sh_degree": None,
    "renderer_config": None,
    "nht_params": None,
}
#: What to do instead.
_INSTEAD = {
    "covars": "give quats and scales",
    "radial_coeffs": "undistort the photos first, as igsr.load_capture does",
    "tangential_coeffs": "undistort the photos first, as igsr.load_capture does",
    "thin_prism_coeffs": "undistort the photos first, as igsr.load_capture does",
    "return_normals": "render_normals=True adds normals to meta",
    "extra_signals": "append the signals to colors as further channels",
}


#: gsplat's other camera models, and how to get such pictures with pinholes.
_INSTEAD_OF_MODEL = {
    "ortho": "nearly the same is a pinhole far off: move it back along its axis by a distance d of "
    "100 times the scene's depth, and give fx and fy in pixels per unit of length, times d",
    "fisheye": "give pinhole views of the photos, as igsr.load_capture makes of fisheye lenses",
    "ftheta": "give pinhole views of the photos, as igsr.load_capture makes of fisheye lenses",
    "lidar": "give pinhole views",
}


def check_arguments(arguments: dict[str, Any]) -> None:
    """Check all arguments of ``rasterization``, by name.

    Raises:
        ValueError: an argument cannot be used; the message begins with its name.
    """
    _check_unsupported(arguments)
    _check_settings(arguments)
    _check_splats(arguments)
    _check_cameras(arguments)
    _check_colors(arguments)
    _check_pixels(arguments)
    _check_absgrad(arguments)


def _check_camera_model(model: object) -> None:
    if isinstance(model, str) and model == "pinhole":
        return
    shown = repr(model) if isinstance(model, str) else f"a {type(model).__name__}"
    instead = _INSTEAD_OF_MODEL.get(model) if isinstance(model, str) else None
    known = instead or f"gsplat's others are {', '.join(_INSTEAD_OF_MODEL)}, which are not drawn"
    raise ValueError(f"camera_model: only 'pinhole' is supported, not {shown}; {known}")


def _check_unsupported(arguments: dict[str, Any]) -> None:
    _check_camera_model(arguments["camera_model"])
    for name, default in _UNSUPPORTED_DEFAULTS.items():
        value = arguments[name]
        if name == "tile_size" and value is None:
            continue  # the default of gsplat's development branch
        if name == "rolling_shutter" and getattr(value, "name", None) == "GLOBAL":
            continue  # gsplat's default is its own enum, which is not imported here
        if value is default:
            continue
        # Arrays do not compare to one truth value, and would fill the screen.
        plain = isinstance(value, (str, bool, numbers.Number))
        if not plain or value != default:
            shown = repr(value) if plain else f"a {type(value).__name__}"
            instead = f"; {_INSTEAD[name]}" if name in _INSTEAD else ""
            raise ValueError(f"{name}: only {default!r} is supported, not {shown}{instead}")


def _check_settings(arguments: dict[str, Any]) -> None:
    for name in ("width", "height"):
        if not _is_positive_whole(arguments[name]):
            raise ValueError(
                f"{name}: must be a positive whole number of pixels, not {arguments[name]!r}"
            )
        if arguments[name] > _core.SIDE_MAX:
            raise ValueError(
                f"{name}: must be at most {_core.SIDE_MAX} pixels, not {arguments[name]}; "
                "render a large picture in parts"
            )
    for name in ("near_plane", "far_plane", "radius_clip", "eps2d"):
        number = arguments[name]
        real = isinstance(number, numbers.Real) and not isinstance(number, bool)
        most = math.inf if name == "far_plane" else FLOAT32_MAX
        if not real or not 0 <= number <= most:
            kind = "a number" if name == "far_plane" else "a finite number"
            raise ValueError(f"{name}: must be {kind} of at least 0, not {number!r}")
    near_plane, far_plane = arguments["near_plane"], arguments["far_plane"]
    if far_plane <= near_plane:
        raise ValueError(f"far_plane: must exceed near_plane ({near_plane}), not {far_plane}")
    sh_degree = arguments["sh_degree"]
    whole = isinstance(sh_degree, numbers.Integral) and not isinstance(sh_degree, bool)
    if sh_degree is not None and not (whole and sh_degree in range(MAX_SH_DEGREE + 1)):
        raise ValueError(f"sh_degree: must be None or 0 to 4, not {sh_degree!r}")
    for name in ("packed", "absgrad", "render_normals"):
        if not isinstance(arguments[name], bool):
            raise ValueError(f"{name}: must be True or False, not {arguments[name]!r}")
    for name, choices in (("render_mode", RENDER_MODES), ("rasterize_mode", RASTERIZE_MODES)):
        # A list or an array is no choice either, and may not even compare.
        if not isinstance(arguments[name], str) or arguments[name] not in choices:
            raise ValueError(f"{name}: must be one of {choices}, not {arguments[name]!r}")
    if not _is_positive_whole(arguments["channel_chunk"]):
        raise ValueError(
            f"channel_chunk: must be a positive whole number, not {arguments['channel_chunk']!r}"
        )
    if not isinstance(arguments["backend"], str):
        raise ValueError(f"backend: must be a name such as 'auto', not {arguments['backend']!r}")


def _is_positive_whole(value: object) -> bool:
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    return whole and value >= 1  # type: ignore[operator]


def _check_splats(arguments: dict[str, Any]) -> None:
    means = arguments["means"]
    dtypes: tuple[torch.dtype, ...] = (torch.float32,)
    if arguments["backend"] == "reference":
        dtypes = (torch.float32, torch.float64)
    _check_tensor("means", means, [("N", 3)], dtypes)
    count, device, dtypes = len(means), means.device, (means.dtype,)
    _check_tensor("quats", arguments["quats"], [(count, 4)], dtypes, device)
    _check_tensor("scales", arguments["scales"], [(count, 3)], dtypes, device)
    _check_tensor("opacities", arguments["opacities"], [(count,)], dtypes, device)


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
    needed, most = (sh_degree + 1) ** 2, (MAX_SH_DEGREE + 1) ** 2
    if colors.shape[-2] < needed:
        raise ValueError(
            f"colors: sh_degree {sh_degree} needs {needed} coefficients, not {colors.shape[-2]}"
        )
    if colors.shape[-2] > most:
        raise ValueError(
            f"colors: at most {most} coefficients (degree {MAX_SH_DEGREE}) are supported, "
            f"not {colors.shape[-2]}"
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
    """The absolute values are taken per pixel, of a gradient that only one pass of the kernels has.

    The sum over several passes of their absolute values would be another, larger number.
    """
    if not arguments["absgrad"]:
        return
    in_color = arguments["render_mode"] not in ("D", "ED")
    if in_color and arguments["colors"].shape[-1] > 3:
        raise ValueError("absgrad: needs colors of at most 3 channels, which are drawn in one pass")
    if in_color and arguments["render_normals"]:
        raise ValueError("absgrad: cannot be had together with render_normals; ask in two calls")


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
        mend = ""
        if tensor.dtype == torch.float64 and dtypes == (torch.float32,):
            mend = "; convert it with .float()"
            if name == "means":
                mend += ', or take backend="reference", which computes in float64'
        raise ValueError(f"{name}: must be {wanted}, not {tensor.dtype}{mend}")
    if tensor.layout != torch.strided or tensor.device.type == "meta":
        raise ValueError(
            f"{name}: must be a dense tensor with values, not {tensor.layout} on {tensor.device}"
        )
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
    rigid = np.abs(rotation @ rotation.T - np.eye(3)).max() <= _core.RIGID_TOLERANCE
    if not rigid or np.linalg.det(rotation) < 0:
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
