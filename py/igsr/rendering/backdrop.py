"""The backdrop: a sphere of a few large splats behind a scene.

Between and behind the splats of photographs, renders show the black background, so novel views have
black holes and edges. The sphere has the smoothed colors of the photos in its direction; in
transparent pixels of a render, the difference to the photo determines the color. Any viewer can
draw it, since its splats are ordinary ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from igsr._internal.choices import Backend
from igsr.capture import PseudoView, View
from igsr.capture.downscaling import reduced_size, reduced_view
from igsr.geometry.camera_paths import even_directions
from igsr.geometry.pixel_rays import pixel_rays
from igsr.rendering.renders import render
from igsr.splats import BACKDROP_OPACITY, Splats, joined
from igsr.splats import BACKDROP_SPLATS as COUNT

Float64 = npt.NDArray[np.float64]

#: Standard deviation of the sphere's splats, in units of their distance to each other; the sphere
#: is at least 99 % opaque.
SIGMA = 0.75
#: Radius of the sphere, in units of the distance of the farthest splat.
RADIUS_PER_FARTHEST_SPLAT = 1.5
#: Maximum radius, in units of the median distance of splats.
MAX_RADIUS_PER_MEDIAN_SPLAT = 1000.0
#: Minimum radius, in units of the farthest camera's distance, since viewers move back.
MIN_RADIUS_PER_FARTHEST_CAMERA = 10.0
#: Maximum radius, world units: covariances are computed in float32.
MAX_RADIUS = 1e15
#: Standard deviation of the smoothing over directions, degrees.
SMOOTHING_DEGREES = 15.0
#: Weight of the photos' own colors: equal to pixels that are this transparent.
PRIOR_TRANSMITTANCE = 0.05
#: Weight of the mean color of all directions, as a fraction of the mean weight of a direction.
MEAN_WEIGHT = 1e-4
#: Smaller scenes get no sphere, since its splats would determine the framing of the scene.
MIN_SPLATS = 25 * COUNT
#: Photos with a larger masked fraction show an object that is cut out.
MAX_MASKED_FRACTION = 0.25
#: Maximum number of photos to use, evenly spaced, and their longest side.
MAX_PHOTOS = 24
PHOTO_SIDE_PX = 64
#: The background is black, and no sphere is added, if more than this fraction of pixels is
#: transparent, and their mean color is less than ``MAX_BLACK``.
MIN_OPEN_FRACTION = 0.1
MAX_BLACK = 8.0 / 255.0
_SH_0 = 0.28209479177387814


def wants_backdrop(photos: Sequence[View], background: Sequence[float] | None = None) -> bool:
    """Return whether a scene fitted to ``photos`` needs a backdrop.

    It does not if photos have alpha or masks that cut an object out, or if a background is given.
    """
    if background is not None or any(
        photo.image.shape[2] == 4
        or (isinstance(photo, PseudoView) and photo.background is not None)
        for photo in photos
    ):
        return False
    masked = [0.0 if photo.mask is None else 1.0 - photo.mask.mean() for photo in photos]
    return bool(np.mean(masked) <= MAX_MASKED_FRACTION)


def with_backdrop(splats: Splats, photos: Sequence[View], backend: Backend = "auto") -> Splats:
    """Add a backdrop of 200 splats, unless the photos' background is black.

    Args:
        splats: the scene, fitted over black, without a backdrop.
        photos: the fitted photos, with the scene's colors; masked pixels do not count.
        backend: "auto", "cpu", "gpu" or "reference".
    """
    if len(splats) < MIN_SPLATS:
        return splats
    cameras = np.array([photo.camera.centre for photo in photos])
    center = cameras.mean(axis=0)
    distances = np.linalg.norm(splats.means[splats.finite] + splats.origin - center, axis=1)
    if not len(distances) or not 0.0 < distances.max() < np.inf:
        return splats
    radius = max(
        min(
            RADIUS_PER_FARTHEST_SPLAT * distances.max(),
            MAX_RADIUS_PER_MEDIAN_SPLAT * np.median(distances),
        ),
        MIN_RADIUS_PER_FARTHEST_CAMERA * np.linalg.norm(cameras - center, axis=1).max(),
    )
    if not 0.0 < radius < MAX_RADIUS:
        return splats
    directions = even_directions(COUNT)
    evenly = np.linspace(0, len(photos) - 1, min(len(photos), MAX_PHOTOS)).round()
    colors = _colors(splats, [photos[int(i)] for i in evenly], directions, backend)
    if colors is None:
        return splats
    sh = np.zeros((COUNT, *splats.sh.shape[1:]), np.float32)
    sh[:, 0] = (colors - 0.5) / _SH_0
    size = np.log(SIGMA * radius * np.sqrt(4.0 * np.pi / COUNT))
    sphere = replace(
        splats,
        means=(center + radius * directions - splats.origin).astype(np.float32),
        quats=np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (COUNT, 1)),
        scales=np.full((COUNT, 3), size, np.float32),
        opacities=np.full(COUNT, BACKDROP_OPACITY, np.float32),
        sh=sh,
    )
    return joined([splats, sphere])


def _colors(
    splats: Splats, photos: Sequence[View], directions: Float64, backend: Backend
) -> Float64 | None:
    """Colors [COUNT, 3] in [0, 1] by least squares; None if the background is black.

    A render with transmittance T differs from its photo by T times the sphere's color. As a prior,
    the sphere has the photos' own colors, with ``PRIOR_TRANSMITTANCE`` instead of T.
    """
    total, weight = np.zeros((COUNT, 3)), np.zeros(COUNT)
    pixels, open_pixels, open_color = 0.0, 0.0, 0.0
    for photo in photos:
        size = reduced_size(photo.camera.width, photo.camera.height, PHOTO_SIDE_PX)
        small = reduced_view(photo, *size)
        drawn = render(splats, small.camera, backend=backend)
        transmittance = 1.0 - np.nan_to_num(drawn.alpha, nan=1.0).reshape(-1)
        color = small.image[..., :3].reshape(-1, 3) / 255.0
        missing = color - np.nan_to_num(drawn.color, nan=0.0).reshape(-1, 3)
        counts = np.ones(len(color)) if small.mask is None else small.mask.reshape(-1) * 1.0
        is_open = counts * (transmittance > 0.5)
        pixels += counts.sum()
        open_pixels += is_open.sum()
        open_color += (is_open * missing.mean(axis=1)).sum()
        rays = pixel_rays(small.camera) @ small.camera.viewmat[:3, :3]
        cosines = directions @ (rays / np.linalg.norm(rays, axis=1, keepdims=True)).T
        sharpness = 1.0 - np.cos(np.radians(SMOOTHING_DEGREES))
        near = counts * np.exp((cosines - 1.0) / sharpness)
        prior = PRIOR_TRANSMITTANCE**2
        total += near @ (transmittance[:, None] * missing + prior * color)
        weight += near @ (transmittance**2 + prior)
    is_black = open_pixels > MIN_OPEN_FRACTION * pixels and open_color < MAX_BLACK * open_pixels
    if pixels == 0.0 or is_black:
        return None
    few = MEAN_WEIGHT * weight.mean()
    mean = total.sum(axis=0) / weight.sum()
    return np.clip((total + few * mean) / (weight + few)[:, None], 0.0, 1.0)
