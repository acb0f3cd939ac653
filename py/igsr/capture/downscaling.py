"""Downscale views to half their size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from igsr.capture import View


def halved(view: View) -> View:
    """Average each 2 x 2 pixels of a view into one; an odd last row or column is dropped.

    Colors are weighted by alpha and by the mask, if the view has them: masked pixels do not count.
    A pixel of the result is masked if all four were. Weights are averaged. The camera's focal
    lengths and principal point are halved.
    """
    camera = view.camera
    height, width = camera.height // 2, camera.width // 2
    pixels = view.image[: 2 * height, : 2 * width].astype(np.float64)
    weight = np.ones((2 * height, 2 * width, 1))
    if view.mask is not None:
        weight = view.mask[: 2 * height, : 2 * width, None].astype(np.float64)

    def pooled(values: np.ndarray) -> np.ndarray:
        return np.asarray(values.reshape(height, 2, width, 2, -1).mean(axis=(1, 3)))

    used = pooled(weight)
    of_color = weight * pixels[..., 3:] if pixels.shape[2] == 4 else weight
    planes = [pooled(pixels[..., :3] * of_color) / np.maximum(pooled(of_color), 1e-9)]
    if pixels.shape[2] == 4:
        planes.append(pooled(pixels[..., 3:] * weight) / np.maximum(used, 1e-9))
    weights = None
    if view.weights is not None:
        weights = pooled(view.weights[: 2 * height, : 2 * width])[..., 0].astype(np.float32)
    K = camera.K.copy()
    K[:2] /= 2.0
    return replace(
        view,
        camera=replace(camera, K=K, width=width, height=height),
        image=np.floor(np.concatenate(planes, axis=2) + 0.5).astype(np.uint8),
        mask=None if view.mask is None else used[..., 0] > 0.0,
        weights=weights,
    )
