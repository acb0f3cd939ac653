"""The part of a photo that shows a block: a box. A fit of the block has no more of the photo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.capture.downscaling import reduced_size, resized_camera
from igsr.capture.types import Camera, View
from igsr.rendering.renders import project
from igsr.splats import Splats

Float64 = npt.NDArray[np.float64]

#: Longest side of the pictures that are asked where they show a block, pixels.
ASKED_SIZE = 32
#: A box leaves out so much of what a photo shows of the block, at each of its sides.
LEFT_OUT = 0.01
#: No box has less than this part of a photo's sides, nor fewer pixels.
LEAST, LEAST_PIXELS = 0.25, 24


@dataclass(frozen=True)
class Box:
    """A part of a photo.

    Attributes:
        left, top, right, bottom: as parts of the photo's width and height, in [0, 1].
    """

    left: float = 0.0
    top: float = 0.0
    right: float = 1.0
    bottom: float = 1.0

    def pixels(self, width: int, height: int) -> tuple[int, int, int, int]:
        """Left, top, right and bottom in a photo of this size; the last two are not in the box."""
        columns = _bounds(self.left, self.right, width)
        rows = _bounds(self.top, self.bottom, height)
        return columns[0], rows[0], columns[1], rows[1]

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Columns and rows of the box in a photo of this size."""
        left, top, right, bottom = self.pixels(width, height)
        return right - left, bottom - top

    @property
    def part(self) -> float:
        """Its part of the photo's pixels."""
        return (self.right - self.left) * (self.bottom - self.top)

    def plain(self) -> list[float]:
        """As JSON has it."""
        return [self.left, self.top, self.right, self.bottom]


#: All of a photo.
ALL = Box()


def _bounds(low: float, high: float, count: int) -> tuple[int, int]:
    first, last = int(np.floor(low * count)), int(np.ceil(high * count))
    short = min(LEAST_PIXELS, count) - (last - first)
    if short > 0:
        first = max(0, min(first - short // 2, count - LEAST_PIXELS))
        last = min(count, first + LEAST_PIXELS)
    return first, last


def cut_out(view: View, box: Box) -> View:
    """The part of a view, which keeps nothing of the rest in memory."""
    camera = view.camera
    left, top, right, bottom = box.pixels(camera.width, camera.height)
    if (right - left, bottom - top) == (camera.width, camera.height):
        return view

    def part(plane: np.ndarray | None) -> np.ndarray | None:
        return None if plane is None else plane[top:bottom, left:right].copy()

    K = camera.K.copy()
    K[:2, 2] -= left, top
    image = part(view.image)
    assert image is not None
    return replace(
        view,
        camera=Camera(camera.viewmat, K, right - left, bottom - top),
        image=image,
        mask=part(view.mask),
        depth=part(view.depth),
        depth_confidence=part(view.depth_confidence),
    )


def boxes_of(
    splats: Splats,
    cameras: Sequence[Camera],
    inside: npt.NDArray[np.bool_],
    wanted: npt.NDArray[np.bool_],
    most: npt.NDArray[np.int64],
    backend: str,
) -> list[dict[int, Box]]:
    """The parts of photos that show splats of some groups.

    Args:
        splats: N splats.
        cameras: P cameras.
        inside: bool [N, C], which splats are in each of C groups, which may overlap.
        wanted: bool [P, C], whose boxes are asked for.
        most: [P], the group that each photo shows most of: where no splat is drawn, a photo shows
            that one; -1 for none.
        backend: "cpu" or "gpu".

    Returns:
        For each photo, boxes by the number of the group.
    """
    # Geometry alone: what colors splats have counts for nothing here.
    plain = replace(splats, sh=np.ascontiguousarray(splats.sh[:, :1]))
    found: list[dict[int, Box]] = []
    for index, camera in enumerate(cameras):
        numbers = np.flatnonzero(wanted[index])
        small = resized_camera(camera, *reduced_size(camera.width, camera.height, ASKED_SIZE))
        drawn = project(plain, small, backend) if len(numbers) else {}
        boxes = {}
        for first in range(0, len(numbers), 3):  # a color channel for each
            those = numbers[first : first + 3]
            colors = np.zeros_like(drawn["colors"])
            colors[:, : len(those)] = inside[:, those]
            picture = _core.rasterize(
                {**drawn, "colors": colors},
                width=small.width,
                height=small.height,
                background=np.zeros(3, colors.dtype),
                backend=backend,
            )
            for channel, number in enumerate(those):
                share = picture["color"][..., channel].astype(np.float64)
                if number == most[index]:
                    share = share + (1.0 - picture["alpha"])
                boxes[int(number)] = box_of(share)
        found.append(boxes)
    return found


def box_of(share: Float64) -> Box:
    """The box of what is shown, by the part that each pixel [H, W] shows of it."""
    left, right = _middle(share.sum(axis=0))
    top, bottom = _middle(share.sum(axis=1))
    return Box(left, top, right, bottom)


def _middle(weight: Float64) -> tuple[float, float]:
    """Where the middle of a profile [N] begins and ends, in [0, 1], a pixel more at each side."""
    total = np.cumsum(np.maximum(weight, 0.0))
    if total[-1] <= 0.0:
        return 0.0, 1.0
    first = int(np.searchsorted(total, LEFT_OUT * total[-1], side="right"))
    last = int(np.searchsorted(total, (1.0 - LEFT_OUT) * total[-1]))
    count = len(weight)
    low, high = max(0.0, (first - 1) / count), min(1.0, (last + 2) / count)
    short = 0.5 * max(0.0, LEAST - (high - low))
    low, high = low - short, high + short
    low, high = low - max(0.0, high - 1.0), high - min(0.0, low)
    return max(0.0, low), min(1.0, high)
