"""The f64 reference, made fast enough for whole workloads without changing its results.

The reference visits all splats at every pixel. Here the picture is divided into crops, and each
crop gets only the splats whose box overlaps it: outside its ``radii``, a splat is below the alpha
threshold. Only the order of the f64 additions of gradients differs. Crops run on all cores.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr_lab.bench.scenes import Arrays, Scene

#: Side of a crop: small, since each of its pixels visits all of its splats.
CROP_PX = 16

Float64 = npt.NDArray[np.float64]

#: Maximum difference of two alphas, relative to the threshold, if implementations get the same 2D
#: splats, and if each projects splats (docs/how-it-works/numerics.md).
ALPHA_BAND_2D = 1e-4
ALPHA_BAND_3D = 2e-2


@dataclass(frozen=True)
class Crop:
    """A rectangle of pixels and the splats that may touch it."""

    left: int
    top: int
    width: int
    height: int
    ids: npt.NDArray[np.intp]

    def of(self, picture: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """This part of an array [H, W, ...]."""
        return picture[self.top : self.top + self.height, self.left : self.left + self.width]


def crops(projected: Arrays, width: int, height: int) -> list[Crop]:
    """Divide the picture into crops, each with the visible splats that may touch it."""
    means2d, radii = projected["means2d"], projected["radii"]
    # One pixel of margin for the rounding of f32 radii.
    low, high = means2d - radii - 1.0, means2d + radii + 1.0
    visible = (radii > 0).all(axis=1)
    result = []
    for top in range(0, height, CROP_PX):
        rows = np.flatnonzero(visible & (high[:, 1] >= top) & (low[:, 1] <= top + CROP_PX))
        row_low, row_high = low[rows, 0], high[rows, 0]
        for left in range(0, width, CROP_PX):
            ids = rows[(row_high >= left) & (row_low <= left + CROP_PX)]
            size = (min(CROP_PX, width - left), min(CROP_PX, height - top))
            result.append(Crop(left, top, *size, ids))
    return result


def _subset(projected: Arrays, crop: Crop) -> Arrays:
    part = {name: np.ascontiguousarray(array[crop.ids]) for name, array in projected.items()}
    part["means2d"] = part["means2d"] - (crop.left, crop.top)
    return part


def _on_all_cores(work: Callable[[Crop], Any], items: Iterable[Crop]) -> list[Any]:
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        return list(pool.map(work, items))


def picture(
    projected: Arrays, chosen: list[Crop], shape: tuple[int, int], background: Any
) -> Arrays:
    """Color, alpha, depth and transmittance in f64; NaN outside the crops."""
    height, width = shape
    background = np.asarray(background, dtype=np.float64)

    def work(crop: Crop) -> Arrays:
        return _core.rasterize(
            _subset(projected, crop),
            width=crop.width,
            height=crop.height,
            background=background,
            backend="reference",
        )

    image: Arrays = {
        "color": np.full((height, width, 3), np.nan),
        **{n: np.full((height, width), np.nan) for n in ("alpha", "depth", "transmittance")},
    }
    for crop, part in zip(chosen, _on_all_cores(work, chosen), strict=True):
        for name, whole in image.items():
            crop.of(whole)[...] = part[name]
    return image


def gradients2d(
    projected: Arrays, chosen: list[Crop], image: Arrays, v_image: Arrays, background: Any
) -> Arrays:
    """Gradients of the 2D splats in f64; pixels outside the crops do not count."""
    background = np.asarray(background, dtype=np.float64)

    def work(crop: Crop) -> Arrays:
        return _core.rasterize_backward(
            _subset(projected, crop),
            {name: np.ascontiguousarray(crop.of(whole)) for name, whole in image.items()},
            **{
                name: np.ascontiguousarray(crop.of(whole), dtype=np.float64)
                for name, whole in v_image.items()
            },
            background=background,
            absolute=False,
            backend="reference",
        )

    count = len(projected["depths"])
    total: Arrays = {}
    for crop, part in zip(chosen, _on_all_cores(work, chosen), strict=True):
        for name, values in part.items():
            if name == "v_background":
                total[name] = total.get(name, 0.0) + values
                continue
            if name not in total:
                total[name] = np.zeros((count, *values.shape[1:]))
            total[name][crop.ids] += values
    return total


def band(projected: Arrays, chosen: list[Crop], shape: tuple[int, int], alpha_band: float) -> Any:
    """Pixels at which an f32 implementation may differ, bool [H, W]."""

    def work(crop: Crop) -> npt.NDArray[np.uint8]:
        return _core.band_pixels(
            _subset(projected, crop), width=crop.width, height=crop.height, alpha_band=alpha_band
        )

    result = np.zeros(shape, dtype=bool)
    for crop, part in zip(chosen, _on_all_cores(work, chosen), strict=True):
        crop.of(result)[...] = part != 0
    return result


@dataclass(frozen=True)
class PairCounts:
    """Amount of work of a set of 2D splats."""

    tiles: int  # (splat, 16x16 tile) pairs with at least one pixel at or above the alpha threshold
    pixels: int  # (splat, pixel) pairs at or above the threshold
    blended: int  # pairs of ``pixels`` that come before their pixel is opaque


def pair_counts(
    projected: Arrays,
    width: int,
    height: int,
    chosen: Callable[[list[Crop]], list[Crop]] = list,
) -> PairCounts:
    """Count pairs in f64 by numpy; ``chosen`` chooses the crops to count in."""
    order = np.argsort(projected["depths"].astype(np.float32), kind="stable")
    rank = np.empty(len(order), dtype=np.intp)
    rank[order] = np.arange(len(order))

    def work(crop: Crop) -> tuple[int, int, int]:
        ids = crop.ids[np.argsort(rank[crop.ids])]
        p, q, r = (projected["factors"][ids, k].astype(np.float64)[:, None, None] for k in range(3))
        mean = projected["means2d"][ids].astype(np.float64)
        dx = crop.left + 0.5 + np.arange(crop.width) - mean[:, :1]
        dy = crop.top + 0.5 + np.arange(crop.height) - mean[:, 1:]
        u = p * dx[:, None, :] + q * dy[:, :, None]
        v = r * dy[:, :, None]
        alpha = projected["opacities"][ids].astype(np.float64)[:, None, None] * np.exp(
            -0.5 * (u * u + v * v)
        )
        seen = alpha >= _core.ALPHA_MIN
        through = np.cumprod(np.where(seen, 1.0 - np.minimum(alpha, _core.ALPHA_MAX), 1.0), axis=0)
        blended = seen & (through >= _core.TRANSMITTANCE_MIN)
        return int(seen.any(axis=(1, 2)).sum()), int(seen.sum()), int(blended.sum())

    counts = _on_all_cores(work, chosen(crops(projected, width, height)))
    return PairCounts(*(sum(column) for column in zip(*counts, strict=True)))


def project(scene: Scene, order_of: Arrays) -> Arrays:
    """Project a scene in f64, with the depths that the backend computed in f32.

    The order of splats at equal depth up to rounding is arbitrary but changes pictures, so the
    reference takes the backend's.
    """
    exact = _core.project(*scene.arrays(np.float64), **scene.options(), backend="reference")
    seen = (order_of["radii"] > 0).all(axis=1) & (exact["radii"] > 0).all(axis=1)
    exact["depths"] = np.where(seen, order_of["depths"].astype(np.float64), exact["depths"])
    return exact


def gradients3d(scene: Scene, projected: Arrays, v_projected: Arrays) -> Arrays:
    """Gradients of splats and camera in f64."""
    return _core.project_backward(
        *scene.arrays(np.float64),
        projected,
        v_projected,
        **scene.options(),
        backend="reference",
    )
