"""A room with boxes, all painted with noise, ray traced from any camera in it.

World axes are x right, y down, z forward; the room is ``ROOM`` and its floor is at the largest y.
Functions named after a lens return its rays: from pixel coordinates u, v [N] to rays [N, 3] of the
camera, and whether the pixel has one.
"""

from __future__ import annotations

import numpy as np

#: Lowest and highest corners, in meters.
ROOM = np.array([[-3.0, -1.5, -2.5], [3.0, 1.2, 2.5]])
BOXES = np.array(
    [
        [[1.6, 0.2, 1.2], [2.4, 1.2, 2.0]],
        [[-2.3, -0.2, 1.3], [-1.5, 1.2, 1.9]],
        [[-2.6, 0.4, -2.0], [-1.8, 1.2, -1.1]],
        [[1.5, 0.5, -2.0], [2.5, 1.2, -1.3]],
        [[-0.5, 0.7, 1.5], [0.4, 1.2, 2.1]],
        [[0.2, -1.5, -2.3], [0.7, -0.7, -1.8]],
    ]
)
#: Cells of the noise per meter, and the strength of each.
_OCTAVES = ((0.8, 0.55), (2.5, 0.3), (8.0, 0.15))


def _noise(a, b, cells, seed):
    """Smooth noise in 0..1 at places [N] of surfaces with numbers [N]."""
    a, b = a * cells, b * cells
    left, up = np.floor(a), np.floor(b)
    across, below = (np.clip(t - t0, 0, 1) for t, t0 in ((a, left), (b, up)))
    across, below = (t * t * (3.0 - 2.0 * t) for t in (across, below))

    def at(i, j):
        hashed = (
            i.astype(np.int64) * 73856093 ^ j.astype(np.int64) * 19349663 ^ seed * 83492791
        ).astype(np.uint64)
        hashed = (hashed ^ (hashed >> np.uint64(13))) * np.uint64(0x9E3779B97F4A7C15)
        return ((hashed >> np.uint64(40)) / np.uint64(1 << 24)).astype(np.float64)

    top = at(left, up) * (1 - across) + at(left + 1, up) * across
    bottom = at(left, up + 1) * (1 - across) + at(left + 1, up + 1) * across
    return top * (1 - below) + bottom * below


def colors(origin, rays):
    """RGB in 0..1 [N, 3] of the first surfaces that rays [N, 3] from a place in the room hit."""
    boxes = np.concatenate([ROOM[None], BOXES])
    nearest = np.full(len(rays), np.inf)
    surface = np.zeros(len(rays), dtype=np.int64)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / rays
        for number, (low, high) in enumerate(boxes):
            a, b = (low - origin) * inverse, (high - origin) * inverse
            first, last = np.minimum(a, b), np.maximum(a, b)
            if number == 0:  # from within
                axis, distance = last.argmin(axis=1), last.min(axis=1)
                hit = np.ones(len(rays), dtype=bool)
            else:
                axis, distance = first.argmax(axis=1), first.max(axis=1)
                hit = (distance < last.min(axis=1)) & (distance > 0.0)
            closer = hit & (distance < nearest)
            nearest[closer] = distance[closer]
            side = rays[np.arange(len(rays)), axis] > 0.0
            surface[closer] = (number * 6 + axis * 2 + side)[closer]
    places = origin + nearest[:, None] * rays
    axis = surface // 2 % 3
    a = np.where(axis == 0, places[:, 1], places[:, 0])
    b = np.where(axis == 2, places[:, 1], places[:, 2])
    out = np.zeros((len(rays), 3))
    for channel in range(3):
        for octave, (cells, strength) in enumerate(_OCTAVES):
            seed = surface * 64 + octave * 8 + (channel if octave == 0 else 0)
            out[:, channel] += strength * _noise(a, b, cells, seed)
    return np.clip(0.5 + 1.4 * (out - 0.5), 0.0, 1.0)


def photo(viewmat, size, rays, samples=3):
    """A photo, uint8 [H, W, 3]: the mean of ``samples`` x ``samples`` rays through each pixel.

    Args:
        viewmat: [4, 4], world to camera.
        size: width and height, pixels.
        rays: of the lens; see the module.
        samples: per side of a pixel.
    """
    width, height = size
    total = np.zeros((height * width, 3))
    origin = -viewmat[:3, :3].T @ viewmat[:3, 3]
    for down in range(samples):
        for right in range(samples):
            u, v = np.meshgrid(
                np.arange(width) + (right + 0.5) / samples,
                np.arange(height) + (down + 0.5) / samples,
            )
            local, seen = rays(u.ravel(), v.ravel())
            total += np.where(seen[:, None], colors(origin, local @ viewmat[:3, :3]), 0.0)
    mean = total.reshape(height, width, 3) / samples**2
    return np.rint(255.0 * mean).astype(np.uint8)


def pinhole(K):
    def rays(u, v):
        x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
        return np.stack([x, y, np.ones_like(x)], axis=1), np.ones(len(u), dtype=bool)

    return rays


def panorama(width):
    """An equirectangular camera of width x width / 2 pixels."""

    def rays(u, v):
        longitude = (u / width - 0.5) * 2.0 * np.pi
        latitude = (2.0 * v / width - 0.5) * np.pi
        across = np.cos(latitude)
        rays = [across * np.sin(longitude), np.sin(latitude), across * np.cos(longitude)]
        return np.stack(rays, axis=1), np.ones(len(u), dtype=bool)

    return rays


def fisheye(size, degrees):
    """An equidistant fisheye of ``degrees`` across, black outside that circle."""

    def rays(u, v):
        x, y = u - 0.5 * size, v - 0.5 * size
        radius = np.hypot(x, y)
        angle = radius / fisheye_focal(size, degrees)
        part = np.sin(angle) / np.maximum(radius, 1e-12)
        return np.stack([x * part, y * part, np.cos(angle)], axis=1), radius <= 0.5 * size

    return rays


def fisheye_focal(size, degrees):
    """Pixels per radian of that lens."""
    return 0.5 * size / np.radians(0.5 * degrees)


def stands(count, seed=0):
    """World-to-camera matrices [4, 4] around the middle of the room, turned at random."""
    random = np.random.default_rng(seed)
    viewmats = []
    for k in range(count):
        angle = 2.0 * np.pi * (k + 0.3 * random.random()) / count
        place = np.array([1.1 * np.cos(angle), 0.35 * random.normal(), 0.8 * np.sin(angle)])
        place[1] = np.clip(place[1], -0.6, 0.5)
        turn, tilt = random.uniform(-np.pi, np.pi), 0.15 * random.normal()
        c, s = np.cos((turn, tilt)), np.sin((turn, tilt))
        yaw = np.array([[c[0], 0, -s[0]], [0, 1, 0], [s[0], 0, c[0]]])
        pitch = np.array([[1, 0, 0], [0, c[1], -s[1]], [0, s[1], c[1]]])
        viewmat = np.eye(4)
        viewmat[:3, :3] = pitch @ yaw
        viewmat[:3, 3] = -viewmat[:3, :3] @ place
        viewmats.append(viewmat)
    return viewmats
