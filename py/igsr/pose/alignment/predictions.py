"""What a pointmap network says of pairs of photos, and how its pixels lie in the photos."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from igsr.capture.types import Camera, intrinsic_matrix, nearest_rigid
from igsr.errors import IgsrError
from igsr.pose.grid import Grid

if TYPE_CHECKING:
    from igsr.capture.photo_folder import Photo

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PairPrediction:
    """The pointmaps of one directed pair of photos (DUSt3R, Wang et al. 2024).

    All points are in the camera frame of ``first``, OpenCV axes, in a unit that may differ from
    pair to pair. What is not finite is no prediction.

    Attributes:
        first: index of the photo whose camera frame this is.
        second: index of the other photo.
        first_points: float32 [h, w, 3], on the grid of photo ``first``.
        first_confidence: float32 [h, w], raw: above 1, where 1 says nothing.
        second_points: float32 [h2, w2, 3], on the grid of photo ``second``.
        second_confidence: float32 [h2, w2].
    """

    first: int
    second: int
    first_points: np.ndarray
    first_confidence: np.ndarray
    second_points: np.ndarray
    second_confidence: np.ndarray


class Predictor(Protocol):
    """What stands where the network stands."""

    def __call__(
        self,
        photos: Sequence[Photo],
        pairs: Sequence[tuple[int, int]],
        progress: Callable[[str, int, int], None] | None = None,
    ) -> tuple[list[Grid], list[PairPrediction]]:
        """The grid of every photo, and a prediction for every pair that one could be made for.

        Args:
            photos: in the order that ``pairs`` counts them.
            pairs: (first, second).
            progress: called as progress("pairs", done, all).
        """
        ...


@dataclass(frozen=True, eq=False)
class PhotoToAlign:
    """What is known of a photo before the alignment.

    Attributes:
        name: for messages.
        height: rows of the photo.
        width: columns of the photo.
        grid: where its predictions lie in it.
        group: photos of one group that have no intrinsics share their focal length; None is a group
            like any other.
        viewmat: float64 [4, 4], world to camera, to be kept as it is, or None.
        intrinsics: float64 [3, 3], pixels of the photo, to be kept as they are, or None: then the
            principal point is the photo's middle and one focal length for both axes is found.

    Raises:
        IgsrError: the pose is not rigid, or the intrinsics or the size are no camera's.
    """

    name: str
    height: int
    width: int
    grid: Grid
    group: Hashable = None
    viewmat: np.ndarray | None = None
    intrinsics: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Check and normalise the fields."""
        if self.viewmat is not None:
            viewmat = nearest_rigid(self.viewmat, f"the pose of {self.name}")
            object.__setattr__(self, "viewmat", viewmat)
        intrinsics = np.eye(3) if self.intrinsics is None else self.intrinsics
        try:
            camera = Camera(np.eye(4), intrinsics, self.width, self.height)
        except IgsrError as error:
            raise IgsrError(f"{self.name}: {error}") from error
        if self.intrinsics is not None:
            object.__setattr__(self, "intrinsics", camera.K)

    def centred(self, focal: float) -> Float64:
        """Intrinsics [3, 3] with a focal length in pixels, and the photo's middle."""
        return intrinsic_matrix(focal, focal, self.width / 2, self.height / 2)


def checked_predictions(
    photos: Sequence[PhotoToAlign], predictions: Sequence[PairPrediction]
) -> list[PairPrediction]:
    """The predictions as float32, after a look at what the alignment relies on.

    Raises:
        IgsrError: a prediction names a photo that is not there, or the same one twice, or its
            arrays have not the shape of the photos' grids.
    """
    checked = []
    for pair in predictions:
        pair_name = f"the prediction for photos {pair.first} and {pair.second}"
        if pair.first == pair.second or not all(
            0 <= photo < len(photos) for photo in (pair.first, pair.second)
        ):
            raise IgsrError(
                f"{pair_name} must be for two different photos, counted from 0 to {len(photos) - 1}"
            )
        arrays: dict[str, Any] = {}
        for side, photo in (("first", pair.first), ("second", pair.second)):
            size = (photos[photo].grid.height, photos[photo].grid.width)
            for what, shape in (("points", (*size, 3)), ("confidence", size)):
                name = f"{side}_{what}"
                array = np.asarray(getattr(pair, name))
                if array.shape != shape or not np.issubdtype(array.dtype, np.floating):
                    raise IgsrError(
                        f"{pair_name} has {name} {array.dtype} {list(array.shape)} where the "
                        f"photo's grid needs float32 {list(shape)}"
                    )
                with np.errstate(over="ignore"):
                    arrays[name] = array.astype(np.float32, copy=False)
        checked.append(PairPrediction(int(pair.first), int(pair.second), **arrays))
    return checked
