"""Which photos each block is fitted to, and which photos show a seam."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

#: A block is fitted to photos of which it is at least this part (VastGaussian), wherever they were
#: taken.
SHOWN = 0.25
#: Photos that were taken in the block need only show this part of it.
SHOWN_NEAR = 0.05
#: A photo lies across a seam if two cells are at least this part of it each.
ACROSS = 0.1


def photos_of_blocks(shown: Float64, tracked: Float64, near: Bool) -> Bool:
    """Assign photos to blocks.

    A photo that no block would have goes to the one that it shows most of.

    Args:
        shown: [P, C], part of each photo that the coarse splats of each widened cell are.
        tracked: [P, C], part of each photo's tracked points that lie in each widened cell.
        near: bool [P, C], whether the photo was taken in the widened cell.

    Returns:
        bool [P, C].
    """
    share = np.maximum(shown, tracked)
    taken: Bool = (share >= SHOWN) | (near & (share >= SHOWN_NEAR))
    alone = ~taken.any(axis=1) & (share.max(axis=1, initial=0.0) > 0.0)
    taken[alone, share[alone].argmax(axis=1)] = True
    return taken


def photos_across_seams(shown: Float64) -> Bool:
    """Which photos show a seam: two cells are a large part of each.

    Args:
        shown: [P, C], part of each photo that the splats of each cell proper are.

    Returns:
        bool [P].
    """
    across: Bool = (shown >= ACROSS).sum(axis=1) >= 2
    return across
