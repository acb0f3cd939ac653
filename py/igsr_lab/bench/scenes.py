"""Scenes of the workloads: 2D splats (W1), the garden (W2), balls of any size (W4, accuracy).

Random numbers are numpy's PCG64, so a seed gives the same bits on every machine.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.untrusted_npz import DAMAGE
from igsr.errors import IgsrError

#: Arrays by name, as ``_core`` takes and returns them.
Arrays = dict[str, Any]

#: Arrays of a scene in the renderer's order.
PARAMETERS = ("means", "quats", "scales", "opacities", "colors")


@dataclass(frozen=True)
class Scene:
    """Splats in front of one camera."""

    #: means [N, 3], quats [N, 4], scales [N, 3], opacities [N], colors [N, 3] or [N, K, 3], float32
    splats: Arrays
    sh_degree: int | None  # degree of ``colors``, or None if they are RGB
    raw_parameters: bool  # whether scales are logarithms and opacities logits
    viewmat: npt.NDArray[np.float64]  # [4, 4] world-to-camera
    intrinsics: npt.NDArray[np.float64]  # [4] fx, fy, cx, cy
    width: int  # picture size in pixels
    height: int
    background: npt.NDArray[np.float32]  # [3] RGB
    antialiased: bool = False  # whether opacities are reduced by the blur

    def arrays(self, dtype: Any) -> tuple[Any, Any, Any, Any, Any]:
        """The parameters as arguments of ``_core.project``."""
        means, quats, scales, opacities, colors = (
            np.ascontiguousarray(self.splats[name], dtype=dtype) for name in PARAMETERS
        )
        return means, quats, scales, opacities, colors

    def options(self) -> dict[str, Any]:
        """Keywords of ``_core.project``, except the backend."""
        return {
            "sh_degree": self.sh_degree,
            "raw_parameters": self.raw_parameters,
            "viewmat": self.viewmat,
            "intrinsics": self.intrinsics,
            "width": self.width,
            "height": self.height,
            "near": _core.NEAR_PLANE,
            "far": _core.FAR_PLANE,
            "eps2d": _core.EPS2D,
            "antialiased": self.antialiased,
        }


def splats2d(seed: int, count: int = 20_000, width: int = 400, height: int = 400) -> Arrays:
    """W1: 2D splats, uniform over the picture, in the format of ``_core.project``.

    sigma = exp(N(ln 3, 0.6)) px per axis at a uniform angle, 0.3 px^2 of blur, opacity U(0.1, 0.9),
    colors U(0, 1), depths U(1, 10).
    """
    random = np.random.default_rng(seed)
    means2d = random.uniform((0.0, 0.0), (width, height), (count, 2))
    sigma = np.exp(random.normal(np.log(3.0), 0.6, (count, 2)))
    angle = random.uniform(0.0, np.pi, count)
    opacities = random.uniform(0.1, 0.9, count)
    colors = random.uniform(0.0, 1.0, (count, 3))
    depths = random.uniform(1.0, 10.0, count)
    cosine, sine = np.cos(angle), np.sin(angle)
    variance = sigma**2
    xx = cosine**2 * variance[:, 0] + sine**2 * variance[:, 1] + _core.EPS2D
    yy = sine**2 * variance[:, 0] + cosine**2 * variance[:, 1] + _core.EPS2D
    xy = cosine * sine * (variance[:, 0] - variance[:, 1])
    determinant = xx * yy - xy * xy
    columns = np.sqrt(yy / determinant), -xy / np.sqrt(yy * determinant), 1.0 / np.sqrt(yy)
    factors = np.stack(columns, axis=1)
    reach = 2.0 * np.log(opacities / _core.ALPHA_MIN)
    radii = np.sqrt(reach[:, None] * np.stack([xx, yy], axis=1))
    arrays = {
        "means2d": means2d,
        "factors": factors,
        "depths": depths,
        "colors": colors,
        "opacities": opacities,
        "radii": radii,
    }
    return _float32(arrays)


def garden(path: Path, seed: int) -> Scene:
    """W2: the points of gsplat's ``test_garden.npz`` with random shapes, and its first camera.

    Scales U(0, 0.02), opacities U(0, 1), quats N(0, 1).
    """
    try:
        # Numbers too large for float32 become infinite and are refused below.
        with np.load(path, allow_pickle=False) as file, np.errstate(over="ignore"):
            means = file["means3d"].astype(np.float32)
            colors = file["colors"].astype(np.float32) / np.float32(255.0)
            viewmat, K = (file[name][0].astype(np.float64) for name in ("viewmats", "Ks"))
            width, height = int(file["width"]), int(file["height"])
        if means.ndim != 2 or means.shape[1] != 3 or colors.shape != means.shape:
            raise ValueError("means3d and colors must be [N, 3]")
        if viewmat.shape != (4, 4) or K.shape != (3, 3):
            raise ValueError("viewmats must be [C, 4, 4] and Ks [C, 3, 3]")
        if not (np.isfinite(means).all() and np.isfinite(colors).all()):
            raise ValueError("means3d and colors must be finite numbers")
        scene = _scene_of_points(means, colors, viewmat, K, width, height, seed)
        # The renderer checks cameras and sizes.
        drawn = _core.project(*scene.arrays(np.float32), **scene.options(), backend="cpu")
        if not (drawn["radii"] > 0).any():
            raise ValueError("its first camera sees none of its points")
    except FileNotFoundError as error:
        raise IgsrError(f"There is no file {path}; give --garden test_garden.npz.") from error
    except (*DAMAGE, IndexError, AttributeError) as error:
        raise IgsrError(
            f"{path} is not the garden fixture of gsplat ({error}); give --garden test_garden.npz."
        ) from error
    return scene


def _scene_of_points(
    means: npt.NDArray[np.float32],
    colors: npt.NDArray[np.float32],
    viewmat: npt.NDArray[np.float64],
    K: npt.NDArray[np.float64],
    width: int,
    height: int,
    seed: int,
) -> Scene:
    random = np.random.default_rng(seed)
    count = len(means)
    splats = {
        "means": means,
        "quats": random.normal(size=(count, 4)),
        "scales": random.uniform(0.0, 0.02, (count, 3)),
        "opacities": random.uniform(0.0, 1.0, count),
        "colors": colors,
    }
    return Scene(
        splats=_float32(splats),
        sh_degree=None,
        raw_parameters=False,
        viewmat=np.ascontiguousarray(viewmat),
        intrinsics=np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]),
        width=width,
        height=height,
        background=np.zeros(3, np.float32),
    )


def ball(
    seed: int,
    count: int,
    width: int,
    height: int,
    sh_degree: int = 2,
    size: float = 1.0,
) -> Scene:
    """W4 and accuracy: a ball of splats that fills the picture.

    A splat's area decreases with their number, so that each pixel always blends about 20 of them (a
    fitted lego of 20 000 splats: 13 to 16). ``size`` scales all splats.
    """
    random = np.random.default_rng(seed)
    direction = random.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    means = direction * random.uniform(0.0, 1.0, (count, 1)) ** (1.0 / 3.0)
    scales = np.log(1.5 * size / np.sqrt(count)) + random.normal(0.0, 0.5, (count, 3))
    colors = random.normal(0.0, 0.1, (count, (sh_degree + 1) ** 2, 3))
    colors[:, 0] = random.normal(0.0, 0.7, (count, 3))
    splats = {
        "means": means,
        "quats": random.normal(size=(count, 4)),
        "scales": scales,
        "opacities": random.normal(0.0, 1.5, count),
        "colors": colors,
    }
    distance = 3.0
    viewmat = np.eye(4)
    viewmat[2, 3] = distance
    # The ball's outline, at 1 / sqrt(distance^2 - 1), touches the shorter sides.
    focal = 0.5 * min(width, height) * np.sqrt(distance**2 - 1.0)
    return Scene(
        splats=_float32(splats),
        sh_degree=sh_degree,
        raw_parameters=True,
        viewmat=viewmat,
        intrinsics=np.array([focal, focal, 0.5 * width, 0.5 * height]),
        width=width,
        height=height,
        background=np.ones(3, np.float32),
    )


def upstream(seed: int, width: int, height: int) -> Arrays:
    """Upstream gradients, float32: N(0, 1) for color and alpha, a tenth of that for depth."""
    random = np.random.default_rng([seed, width, height])
    arrays = {
        "v_color": random.normal(size=(height, width, 3)),
        "v_alpha": random.normal(size=(height, width)),
        "v_depth": 0.1 * random.normal(size=(height, width)),
    }
    return _float32(arrays)


def _float32(arrays: Arrays) -> Arrays:
    return {name: np.ascontiguousarray(a, dtype=np.float32) for name, a in arrays.items()}
