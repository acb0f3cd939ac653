"""Frames of scenes, in which the unit and the origin of the world make no difference."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.capture import Camera, Capture, Points, View
from igsr.errors import IgsrError
from igsr.splats import Splats

Float64 = npt.NDArray[np.float64]

#: Extent of the cameras in the frame; usual captures have about this extent. It determines near
#: plane, noise and scale regularizer of fits.
EXTENT = 5.0
#: Radius of given splats in the frame: large, so that the near plane of fits cuts nothing.
RADIUS = 100.0
#: Cameras nearer to each other than this, as a fraction of the distance to the scene, are at one
#: place.
ONE_PLACE = 1e-6
#: Relative error of the centers of cameras.
ROUNDING = 1e-12
#: Maximum extent of cameras, world units.
MAX_EXTENT = 1e9


@dataclass(frozen=True, eq=False)
class Frame:
    """x in the frame is (x in the world - origin) / unit.

    Attributes:
        origin: float64 [3], world units.
        unit: length, world units.
        one_place: whether all cameras are at the origin: their centers differ by rounding, from
            which no distance must be derived.
    """

    origin: Float64
    unit: float
    one_place: bool = False

    @classmethod
    def of_capture(cls, capture: Capture) -> Frame:
        """The frame in which the train cameras have the extent ``EXTENT``.

        Raises:
            IgsrError: the cameras are too far apart for float32.
        """
        centers = np.stack([view.camera.center for view in capture.train_views])
        # An outlier moves the mean far from the scene.
        origin = np.asarray(np.median(centers, axis=0))
        extent = _core.camera_extent(centers)
        distance = _distance(capture, origin)
        if extent > MAX_EXTENT:
            raise IgsrError(
                f"{capture.path}: its cameras are {extent:.1g} units apart, which splats cannot "
                "hold; check its poses."
            )
        rounding = ROUNDING * float(np.abs(centers).max())
        one_place = extent <= max(ONE_PLACE * distance, rounding)
        return cls(origin, _unit(distance if one_place else extent, EXTENT), one_place)

    @classmethod
    def of_splats(cls, splats: Splats) -> Frame:
        """The frame of splats that no fit adds to or moves far."""
        center, radius, _ = splats.extent
        return cls(splats.origin + center, _unit(radius, RADIUS))

    @property
    def inverse(self) -> Frame:
        """The world as a frame of this one: its methods map from the frame to the world."""
        return Frame(-self.origin / self.unit, 1.0 / self.unit)

    def camera(self, camera: Camera) -> Camera:
        """The camera in the frame; it sees the same picture there."""
        viewmat = camera.viewmat.copy()
        viewmat[:3, 3] = (viewmat[:3, 3] + viewmat[:3, :3] @ self.origin) / self.unit
        if self.one_place:
            viewmat[:3, 3] = 0.0
        return replace(camera, viewmat=viewmat)

    def view(self, view: View) -> View:
        """The photo with its camera, depth and evidence in the frame."""
        evidence = view.pose_evidence
        if evidence is not None:
            evidence = replace(evidence, center=evidence.center / self.unit)
        depth = None if view.depth is None else view.depth / np.float32(self.unit)
        camera = self.camera(view.camera)
        return replace(view, camera=camera, depth=depth, pose_evidence=evidence)

    def capture(self, capture: Capture) -> Capture:
        """The capture with views and points in the frame."""
        points = capture.points
        if points is not None:
            points = replace(points, xyz=(points.xyz - self.origin) / self.unit)
        return Capture(capture.path, [self.view(view) for view in capture.views], points)

    def splats(self, splats: Splats) -> Splats:
        """The splats in the frame."""
        return replace(
            splats,
            means=(splats.means / self.unit).astype(np.float32),
            scales=(splats.scales - math.log(self.unit)).astype(np.float32),
            origin=(splats.origin - self.origin) / self.unit,
        )


def world_capture(frame: Frame, capture: Capture, before: Capture, given: Capture) -> Capture:
    """A capture of the frame in the world.

    Args:
        frame: of the capture.
        capture: the result of a fit to ``before``.
        before: ``given`` in the frame. Cameras and depths that are still the same stay exact.
        given: in the world.
    """
    world = frame.inverse

    def view(after: View, inside: View, outside: View) -> View:
        moved = world.view(after)
        camera = outside.camera if after.camera is inside.camera else moved.camera
        depth = outside.depth if after.depth is inside.depth else moved.depth
        return replace(moved, camera=camera, depth=depth, pose_evidence=outside.pose_evidence)

    views = map(view, capture.views, before.views, given.views)
    return Capture(capture.path, list(views), given.points)


def _unit(length: float, inside: float) -> float:
    return length / inside if 0.0 < length < math.inf else 1.0


def _distance(capture: Capture, center: Float64) -> float:
    """Median distance from the cameras to points, or median depth of the photos; else 0."""
    points: Points | None = capture.points
    if points is not None and len(points.xyz):
        return float(np.median(np.linalg.norm(points.xyz - center, axis=1)))
    return _median_depth(capture.train_views)


def _median_depth(views: Sequence[View]) -> float:
    depths = [view.depth[view.depth > 0.0] for view in views if view.depth is not None]
    known = np.concatenate(depths) if depths else np.zeros(0)
    return float(np.median(known)) if len(known) else 0.0
