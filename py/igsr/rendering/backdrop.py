"""The backdrop: a sphere of a few large splats behind a scene.

Between and behind the splats of photographs is nothing, and renders show the background there,
which is black. A novel view that sees past what was photographed has black holes and edges. The
sphere has the colors of the photos in its direction, smoothed. Where a render of the scene is
transparent, its difference to the photo gives the color. The splats are ordinary ones behind the
others, which any viewer draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from igsr._internal.choices import Backend
from igsr.capture import View
from igsr.capture.downscaling import reduced_size, reduced_view
from igsr.geometry.camera_paths import even_directions
from igsr.geometry.pixel_rays import pixel_rays
from igsr.rendering.renders import render
from igsr.splats import BACKDROP_OPACITY, Splats, joined
from igsr.splats import BACKDROP_SPLATS as COUNT

Float64 = npt.NDArray[np.float64]

#: Standard deviation of the sphere's splats, in units of their distance to each other, about 14
#: degrees. With it the sphere lets 1 % through at most.
WIDTH = 0.75
#: Radius of the sphere in units of the distance of the farthest splat (but at most so many of the
#: median one), and at least in units of the farthest camera's: viewers go back to see the whole.
FAR, MOST_FAR, BEYOND_CAMERAS = 1.5, 1000.0, 10.0
#: No sphere is larger: its covariance is computed in float32.
LARGEST = 1e15
#: Colors are smoothed over directions by a Gaussian of this standard deviation, degrees.
SMOOTH = 15.0
#: Pixels that are transparent by this much tell as much of the color as the photos' own colors do.
TOLD = 0.05
#: What the mean color of all directions counts beside a direction's own pixels, in parts of what
#: directions have.
MEAN_COUNTS = 1e-4
#: Fits of fewer splats have none: what frames a scene by its splats would frame the sphere.
LEAST_SPLATS = 25 * COUNT
#: Photos of which masks hide more than this part show an object that is cut out.
CUT_OUT = 0.25
#: Photos that are asked at most, evenly spread, and the longest side that they are reduced to.
MOST_ASKED, SIDE = 24, 64
#: Where photos see through the scene in more of their pixels than this, and renders before black
#: lack less there than this, black is what stands behind it, and no sphere is added.
OPEN, BLACK = 0.1, 8.0 / 255.0
#: Of the first spherical harmonic.
_SH_0 = 0.28209479177387814


def wants_backdrop(photos: Sequence[View], background: Sequence[float] | None = None) -> bool:
    """Whether something has to be behind what is fitted to these photos.

    Not where photos have alpha, or masks that cut an object out, or a background is given.

    Args:
        photos: that are fitted.
        background: RGB in [0, 1], if one was asked for.
    """
    if background is not None or any(
        photo.image.shape[2] == 4 or photo.background is not None for photo in photos
    ):
        return False
    hidden = [0.0 if photo.mask is None else 1.0 - photo.mask.mean() for photo in photos]
    return bool(np.mean(hidden) <= CUT_OUT)


def with_backdrop(splats: Splats, photos: Sequence[View], backend: Backend = "auto") -> Splats:
    """The splats, and behind them 200 more; none where the background of the photos is black.

    Args:
        splats: of a fit before black, without a backdrop.
        photos: that it was fitted to, with the scene's colors; pixels outside masks do not count.
        backend: what renders: "auto", "cpu", "gpu" or "reference".

    Raises:
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    if len(splats) < LEAST_SPLATS:
        return splats
    evenly = np.linspace(0, len(photos) - 1, min(len(photos), MOST_ASKED)).round()
    asked = [photos[int(i)] for i in evenly]
    cameras = np.array([photo.camera.center for photo in photos])
    middle = cameras.mean(axis=0)
    apart = np.linalg.norm(splats.means[splats.finite] + splats.origin - middle, axis=1)
    if not len(apart) or not 0.0 < apart.max() < np.inf:
        return splats
    radius = max(
        min(FAR * apart.max(), MOST_FAR * np.median(apart)),
        BEYOND_CAMERAS * np.linalg.norm(cameras - middle, axis=1).max(),
    )
    if not 0.0 < radius < LARGEST:
        return splats
    directions = even_directions(COUNT)
    colors = _colors(splats, asked, directions, backend)
    if colors is None:
        return splats
    sh = np.zeros((COUNT, *splats.sh.shape[1:]), np.float32)
    sh[:, 0] = (colors - 0.5) / _SH_0
    size = np.log(WIDTH * radius * np.sqrt(4.0 * np.pi / COUNT))
    sphere = replace(
        splats,
        means=(middle + radius * directions - splats.origin).astype(np.float32),
        quats=np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (COUNT, 1)),
        scales=np.full((COUNT, 3), size, np.float32),
        opacities=np.full(COUNT, BACKDROP_OPACITY, np.float32),
        sh=sh,
    )
    return joined([splats, sphere])


def _colors(
    splats: Splats, photos: Sequence[View], directions: Float64, backend: Backend
) -> Float64 | None:
    """Colors [COUNT, 3] in [0, 1] by least squares; None where the background is black.

    With the transmittance T of a pixel, what its render lacks is T times the sphere's color; beside
    that the sphere has the photos' own colors, with ``TOLD`` in place of T.
    """
    lacking, weight = np.zeros((COUNT, 3)), np.zeros(COUNT)
    pixels, open_pixels, open_lacks = 0.0, 0.0, 0.0
    for photo in photos:
        size = reduced_size(photo.camera.width, photo.camera.height, SIDE)
        small = reduced_view(photo, *size)
        shown = render(splats, small.camera, backend=backend)
        through = 1.0 - np.nan_to_num(shown.alpha, nan=1.0).reshape(-1)
        color = small.image[..., :3].reshape(-1, 3) / 255.0
        lacks = color - np.nan_to_num(shown.color, nan=0.0).reshape(-1, 3)
        counts = np.ones(len(color)) if small.mask is None else small.mask.reshape(-1) * 1.0
        is_open = counts * (through > 0.5)
        pixels += counts.sum()
        open_pixels += is_open.sum()
        open_lacks += (is_open * lacks.mean(axis=1)).sum()
        rays = pixel_rays(small.camera) @ small.camera.viewmat[:3, :3]
        cosines = directions @ (rays / np.linalg.norm(rays, axis=1, keepdims=True)).T
        near = counts * np.exp((cosines - 1.0) / (1.0 - np.cos(np.radians(SMOOTH))))
        lacking += near @ (through[:, None] * lacks + TOLD**2 * color)
        weight += near @ (through**2 + TOLD**2)
    if pixels == 0.0 or (open_pixels > OPEN * pixels and open_lacks < BLACK * open_pixels):
        return None
    # Where no photo looks, all directions' mean.
    few = MEAN_COUNTS * weight.mean()
    mean = lacking.sum(axis=0) / weight.sum()
    return np.clip((lacking + few * mean) / (weight + few)[:, None], 0.0, 1.0)
