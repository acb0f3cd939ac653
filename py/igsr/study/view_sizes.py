"""Make the views of a capture smaller."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr.capture import Capture, Points, View

Planes = npt.NDArray[np.float32]


def at_most(capture: Capture, side: int | None) -> Capture:
    """The capture with photos whose longest side is at most ``side`` pixels.

    Pixels are averaged over their area, weighted by alpha and by the mask; K is scaled exactly.

    Args:
        capture: photos without weights.
        side: pixels; None leaves the photos as they are.
    """
    if side is None:
        return capture
    views = [_smaller(view, side) for view in capture.views]
    points = capture.points
    if points is not None and points.tracks is not None:
        tracks = points.tracks
        ratios = {
            new.name: (new.camera.width / old.camera.width, new.camera.height / old.camera.height)
            for new, old in zip(views, capture.views, strict=True)
        }
        scale = np.array([ratios.get(name, (1.0, 1.0)) for name in tracks.names])
        moved = replace(tracks, xy=tracks.xy * scale[tracks.view])
        points = Points(points.xyz, points.rgb, points.confidence, moved)
    return Capture(capture.path, views, points)


def _smaller(view: View, side: int) -> View:
    camera = view.camera
    longest = max(camera.width, camera.height)
    if longest <= side:
        return view
    width = max(1, round(camera.width * side / longest))
    height = max(1, round(camera.height * side / longest))
    shape = (camera.height, camera.width)

    def averaged(plane: Planes) -> Planes:
        smaller = Image.fromarray(plane).resize((width, height), Image.Resampling.BOX)
        return np.asarray(smaller, np.float32)

    weight = np.ones(shape, np.float32) if view.mask is None else view.mask.astype(np.float32)
    used = averaged(weight)
    of_color, planes = weight, []
    if view.image.shape[2] == 4:
        of_color = weight * view.image[..., 3]
        planes = [averaged(of_color) / np.maximum(used, 1e-6)]
    whole = np.maximum(averaged(of_color), 1e-6)
    colors = [averaged(of_color * view.image[..., c].astype(np.float32)) / whole for c in range(3)]
    K = camera.K.copy()
    K[0] *= width / camera.width
    K[1] *= height / camera.height
    image = np.stack([*colors, *planes], axis=-1)
    return replace(
        view,
        camera=replace(camera, K=K, width=width, height=height),
        image=np.floor(np.clip(image, 0.0, 255.0) + 0.5).astype(np.uint8),
        mask=None if view.mask is None else used > 0.5,
    )
