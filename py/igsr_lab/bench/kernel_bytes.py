"""Memory traffic of a fit step's kernels, counted from the scene."""

from __future__ import annotations

import numpy as np

from igsr import _core
from igsr_lab.bench import oracle
from igsr_lab.bench.growth import evenly_chosen
from igsr_lab.bench.scenes import Arrays, Scene


def step_bytes(scene: Scene) -> dict[str, float]:
    """Bytes that each kernel moves in a step on a GPU; see ``kernel_bytes``."""
    projected = _core.project(*scene.arrays(np.float32), **scene.options(), backend="cpu")
    visible = int((projected["radii"] > 0).all(axis=1).sum())
    pairs = _pairs(projected, scene.width, scene.height)
    splats, coefficients, _ = scene.splats["colors"].shape
    return kernel_bytes(splats, visible, pairs, scene.width * scene.height, coefficients)


def kernel_bytes(
    splats: int, visible: int, pairs: float, pixels: int, coefficients: int
) -> dict[str, float]:
    """Bytes that each kernel moves, each row once for each load and store.

    Kernels of software drivers that GPUs do not run are left out.

    Args:
        splats: number of splats.
        visible: number that is not culled.
        pairs: number of (splat, tile) pairs, of more than 256 tiles.
        pixels: number of pixels.
        coefficients: SH coefficients of a color.
    """
    n, v, p, x, color = float(splats), float(visible), pairs, float(pixels), 12 * coefficients
    # Rows: geometry and each of its moments 44 bytes, a 2D splat 48 (its radii 8), the notes of a
    # waiting color 36, a gradient of a 2D splat 40.
    return {
        "project": 56 * n + (40 + 2 * 36 + 2 * 3 * color) * v,
        "sort_count": 4 * n + 12 * v + 8 * p,
        "sort_place": 4 * n + 56 * v + 32 * p,
        "tile_counts": 56 * v,
        "scan_apply": 12 * v,
        "emit": 56 * v + 12 * p,
        "ranges": 16 * p,
        "rasterize": 52 * p + 20 * x,
        "loss_slopes": 56 * x,
        "loss_gradient": 76 * x,
        "rasterize_backward": 96 * p + 20 * x,
        "rasterize_backward_sum": 96 * v + 40 * p,
        "fit_geometry": 272 * n + (40 + 40 + 2 * 36 + color) * v,
    }


def _pairs(projected: Arrays, width: int, height: int) -> float:
    """(Splat, tile) pairs, from the fraction of bounding boxes that are pairs in some tiles."""
    crops = oracle.crops(projected, width, height)
    boxes, chosen = (sum(len(crop.ids) for crop in some) for some in (crops, evenly_chosen(crops)))
    counted = oracle.pair_counts(projected, width, height, evenly_chosen).tiles
    return counted * boxes / max(chosen, 1)
