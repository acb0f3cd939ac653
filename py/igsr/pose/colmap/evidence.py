"""What is asked for before a photo is placed, and in which steps it falls."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Evidence:
    """Thresholds for registering a photo, by COLMAP's names; the first set has COLMAP's values.

    Attributes:
        init_min_num_inliers: matches of the first pair.
        init_min_tri_angle: degrees that the rays of the first pair part by, in the median.
        abs_pose_min_num_inliers: points that a further photo sees.
        filter_min_tri_angle: degrees that the rays to a point part by.
        ignore_two_view_tracks: whether points that two photos alone see are left out.
        guided_matching: whether more matches are looked for along the epipolar lines of a pair.
    """

    init_min_num_inliers: int
    init_min_tri_angle: float
    abs_pose_min_num_inliers: int
    filter_min_tri_angle: float
    ignore_two_view_tracks: bool
    guided_matching: bool


STEPS = (
    Evidence(100, 16.0, 30, 1.5, True, False),
    Evidence(100, 16.0, 30, 1.5, False, False),
    Evidence(100, 16.0, 30, 1.5, False, True),
    Evidence(40, 6.0, 15, 1.0, False, True),
    Evidence(15, 2.0, 10, 0.5, False, True),
)
#: Steps before this one are no reason to doubt.
DOUBTFUL = 3
