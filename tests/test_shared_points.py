"""Points that placed each photo, and pictures of points that pairs of photos share."""

import numpy as np
import scenes

from igsr.capture.types import Tracks
from igsr.evaluation.shared_points import (
    POINTS_AT_ONCE,
    pair_pictures,
    placed_by,
    shared_counts,
)

#: Point 0 in all photos, 1 in the first two, 2 in the last two, a far index in the last.
TRACKS = Tracks(
    ["a", "b", "c"],
    np.array([0, 1, 2, 0, 1, 1, 2, 2]),
    np.array([0, 0, 0, 1, 1, 2, 2, POINTS_AT_ONCE + 5]),
    np.full((8, 2), 4.0),
)


def test_shared_points_are_counted():
    assert shared_counts(TRACKS).tolist() == [[2, 2, 1], [2, 3, 2], [1, 2, 3]]
    nothing = Tracks(["a", "b"], np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    assert shared_counts(nothing).tolist() == [[0, 0], [0, 0]]


def test_photos_are_placed_by_those_that_share_most_points():
    rows = placed_by(TRACKS)
    assert rows["a"] == {"points": 2, "shared": {"b": 2, "c": 1}}
    assert list(rows["c"]["shared"]) == ["b", "a"]


def test_pairs_are_drawn_with_lines():
    views = scenes.capture(views=3, size=32).views
    names = [view.name for view in views]
    tracks = Tracks(names, TRACKS.view, TRACKS.point, TRACKS.xy)
    drawn = pair_pictures(tracks, views)
    assert [caption for caption, _ in drawn] == [
        f"{names[0]} and {names[1]}: 2 points",
        f"{names[1]} and {names[2]}: 2 points",
    ]
    for _, picture in drawn:
        assert picture.shape == (32, 64, 3)
        # A line from (4, 4) to (36, 4).
        assert (picture[4, 8:30].std(axis=0) < 1.0).all()
        assert np.ptp(picture[4, 20]) > 50
    assert pair_pictures(tracks, views[:1]) == []
