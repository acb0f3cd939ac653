"""The interface of what finds and matches features, where it is not COLMAP's SIFT."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from igsr.errors import IgsrError


@dataclass(frozen=True, eq=False)
class PhotoFeatures:
    """The features of a photo.

    Attributes:
        xy: float32 [N, 2], in pixels, the centre of the first one at 0.5.
        descriptors: float32 [N, D].
        size: width and height of the photo in pixels.
    """

    xy: npt.NDArray[np.float32]
    descriptors: npt.NDArray[np.float32]
    size: tuple[int, int]

    def kept(self, rows: npt.NDArray[np.bool_]) -> PhotoFeatures:
        """Those of some rows, bool [N]."""
        return PhotoFeatures(self.xy[rows], self.descriptors[rows], self.size)


class Matcher(Protocol):
    """Features and matches for the estimator ``colmap``, which verifies them.

    A photo's features are found once and compared with those of every other photo, so that one
    feature may be in many pairs.

    Attributes:
        name: what reports and found cameras call it.
    """

    name: str

    def features(self, image: npt.NDArray[np.uint8]) -> PhotoFeatures:
        """The features of a photo, RGB [H, W, 3]. Those of masked pixels are removed later."""

    def matches(self, first: PhotoFeatures, second: PhotoFeatures) -> npt.NDArray[np.uint32]:
        """Indices into the features of both, [M, 2]; no feature is in two pairs."""


def checked_matcher(matcher: Matcher | None) -> Matcher | None:
    """Check that a custom matcher has a name.

    Raises:
        IgsrError: it has none.
    """
    if matcher is not None and not isinstance(getattr(matcher, "name", None), str):
        raise IgsrError("matcher needs an attribute name, by which found cameras are kept")
    return matcher
