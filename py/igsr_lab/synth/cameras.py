"""Cameras around synthetic scenes: orbits, turns, arcs and forward-facing groups."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from igsr_lab.synth.description import Description

#: Powers of the plastic number: the additive recurrence that covers a square most evenly (Roberts
#: 2018, "The unreasonable effectiveness of quasirandom sequences").
_STEPS = np.array([0.7548776662466927, 0.5698402909980532])


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A pinhole camera with square pixels and a centered principal point."""

    camera_to_world: np.ndarray  # float64 [4, 4], OpenGL axes (x right, y up, z back), rigid
    field_of_view: float  # horizontal, radians
    width: int  # pixels
    height: int

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return 0.5 * self.width / math.tan(0.5 * self.field_of_view)

    def project(self, point: np.ndarray) -> np.ndarray:
        """Pixel coordinates [2] (x right, y down; pixel centers at + 0.5) of a world point."""
        right, up, back = (point - self.camera_to_world[:3, 3]) @ self.camera_to_world[:3, :3]
        middle = 0.5 * np.array([self.width, self.height])
        return np.asarray(np.array([right, -up]) / -back * self.focal + middle)


def look_at(center: np.ndarray, target: np.ndarray, roll: float = 0.0) -> np.ndarray:
    """Camera-to-world [4, 4] in OpenGL axes; world z up, then rolled by ``roll`` radians."""
    back = np.asarray(center, dtype=np.float64) - target
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    matrix = np.eye(4)
    matrix[:3, 0] = math.cos(roll) * right + math.sin(roll) * up
    matrix[:3, 1] = math.cos(roll) * up - math.sin(roll) * right
    matrix[:3, 2] = back
    matrix[:3, 3] = center
    return matrix


@dataclass(frozen=True, eq=False)
class Rig:
    """The cameras of one scene."""

    kind: str  # "hemisphere", "sphere", "turntable", "arc", "forward" or "triangles"
    center: np.ndarray  # [3], the point that the cameras look at
    distance: float  # mean distance of the cameras from ``center``, world units
    azimuth: tuple[float, float]  # range, radians
    elevation_sine: tuple[float, float]  # range
    #: Fraction of a camera's offset from the rig's middle that its target also has: 0 for one
    #: common target, 1 for parallel cameras.
    follow: float
    unsteadiness: float  # relative standard deviation of distances, and of targets
    roll: float  # standard deviation, radians
    zoom: float  # standard deviation of the logarithm of focal lengths
    field_of_view: float  # of the image's width, radians
    width: int  # pixels
    height: int

    def _offset(self, position: np.ndarray, distance: float) -> np.ndarray:
        azimuth = self.azimuth[0] + position[0] * (self.azimuth[1] - self.azimuth[0])
        low, high = self.elevation_sine
        rise = low + position[1] * (high - low)
        ring = math.sqrt(max(1.0 - rise**2, 0.0))
        way = np.array([ring * math.cos(azimuth), ring * math.sin(azimuth), rise])
        return distance * way

    def viewpoint(self, rng: np.random.Generator, position: np.ndarray) -> Viewpoint:
        """A camera near ``position``, [2] in [0, 1] over the rig's azimuths and heights."""
        distance = self.distance * math.exp(rng.normal(0.0, self.unsteadiness))
        offset = self._offset(position, distance)
        middle = self._offset(np.array([0.5, 0.5]), self.distance)
        target = self.center + self.follow * (offset - middle)
        target = target + rng.normal(0.0, self.unsteadiness * self.distance * 0.3, 3)
        view = self.field_of_view
        half = math.tan(0.5 * view) * math.exp(rng.normal(0.0, self.zoom))
        matrix = look_at(self.center + offset, target, rng.normal(0.0, self.roll))
        return Viewpoint(matrix, 2.0 * math.atan(half), self.width, self.height)


def draw_rig(rng: np.random.Generator, description: Description, size: int) -> Rig:
    """Draw the cameras of a scene; ``size`` is the images' longer side in pixels."""
    turn = float(rng.uniform(0, 2 * math.pi))
    around = (turn, turn + 2 * math.pi)
    width = height = size
    follow = 0.0
    if description.family == "object":
        kind = str(rng.choice(["hemisphere", "sphere", "turntable"], p=[0.6, 0.2, 0.2]))
        heights = {"hemisphere": (0.02, 0.95), "sphere": (-0.9, 0.95), "turntable": (0.1, 0.6)}
        view = math.radians(rng.uniform(26.0, 60.0))
        # The ball around the objects fits, or is cropped a little.
        distance = description.radius * rng.uniform(0.95, 1.2) / math.sin(0.5 * view)
        rise, azimuth = heights[kind], around
    else:
        aspect = float(rng.choice([1.0, 4 / 3, 3 / 2, 3 / 4], p=[0.3, 0.4, 0.2, 0.1]))
        width, height = (
            (size, round(size / aspect)) if aspect >= 1 else (round(size * aspect), size)
        )
        view = math.radians(rng.uniform(38.0, 68.0)) * min(aspect, 1.0)
        fits = min(view, 2 * math.atan(math.tan(0.5 * view) * height / width))
        distance = description.radius * rng.uniform(0.6, 1.1) / math.sin(0.5 * fits)
        distance = min(distance, description.room)
        kind = str(rng.choice(["turntable", "arc", "forward"], p=[0.4, 0.25, 0.35]))
        if description.open_towards is not None:
            turn = description.open_towards + float(rng.normal(0.0, 0.15))
            kind = "forward" if rng.random() < 0.75 else "arc"
        low = float(rng.uniform(0.12, 0.4))
        if kind == "turntable":
            azimuth, rise = around, (low, low + float(rng.uniform(0.15, 0.45)))
        else:
            half = rng.uniform(0.1, 0.3) if kind == "forward" else rng.uniform(0.5, 1.0)
            azimuth = (turn - half, turn + half)
            rise = (low, low + float(rng.uniform(0.5, 1.3)) * min(half, 0.3))
            follow = float(rng.uniform(0.0, 0.8)) if kind == "forward" else 0.0
    return Rig(
        kind=kind,
        center=description.center,
        distance=float(distance),
        azimuth=(float(azimuth[0]), float(azimuth[1])),
        elevation_sine=(float(rise[0]), float(rise[1])),
        follow=follow,
        unsteadiness=float(rng.uniform(0.0, 0.1)),
        roll=math.radians(rng.uniform(0.0, 5.0)) if rng.random() < 0.6 else 0.0,
        zoom=0.1 if rng.random() < 0.2 else 0.0,
        field_of_view=float(view),
        width=width,
        height=height,
    )


def spread(rng: np.random.Generator, count: int, margin: float) -> np.ndarray:
    """Positions for ``Rig.viewpoint``, [count, 2], evenly over the square without its margin."""
    start = rng.random(2)
    positions = (start + np.arange(1, count + 1)[:, None] * _STEPS) % 1.0
    return np.asarray(margin + (1.0 - 2.0 * margin) * positions)


def at_angle(rig: Rig, turn: float, angle: float, count: int) -> tuple[Rig, np.ndarray]:
    """A rig with cameras in a strip of triangles with sides of ``angle``, seen from the center.

    Args:
        rig: its distance, unsteadiness and lens are kept.
        turn: azimuth of the strip's middle, radians.
        angle: between each camera and the next two, radians, up to 4 % less to the next.
        count: number of cameras.

    Returns:
        The rig and the positions [count, 2] for ``Rig.viewpoint``.
    """
    height = 0.25 * math.sqrt(3.0) * angle
    step = 0.5 * math.acos((math.cos(angle) - math.sin(height) ** 2) / math.cos(height) ** 2)
    along = step * (np.arange(count) - 0.5 * (count - 1))
    up = height * (-1.0) ** np.arange(count)
    # All cameras are at least 6 degrees above the center.
    tilt = max(math.asin(0.5 * sum(rig.elevation_sine)), height + math.radians(6.0))
    ahead, aside = np.cos(up) * np.cos(along), np.cos(up) * np.sin(along)
    azimuth = turn + np.arctan2(aside, math.cos(tilt) * ahead - math.sin(tilt) * np.sin(up))
    rise = math.sin(tilt) * ahead + math.cos(tilt) * np.sin(up)
    plain = replace(
        rig, kind="triangles", azimuth=(0.0, 1.0), elevation_sine=(0.0, 1.0), follow=0.0
    )
    return plain, np.stack([azimuth, rise], axis=1)
