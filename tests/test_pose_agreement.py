"""Verified matches that agree with a model, and the photos that agree with each other."""

from __future__ import annotations

import numpy as np
import pytest
import rooms

from igsr.cameras.colmap.agreement import agreeing, consistent_part
from igsr.cameras.colmap.attempts import THRESHOLDS
from igsr.cameras.colmap.contradictions import links
from igsr.cameras.colmap.estimator import guarded, matched_photos
from igsr.cameras.colmap.mapping import map_globally, map_photos
from igsr.cameras.colmap.matchers import chosen_matchers
from igsr.cameras.colmap.matching import with_focal_lengths


@pytest.mark.parametrize("mapper", ["incremental", "global"])
def test_matches_of_a_moved_camera_disagree(tmp_path, mapper):
    photos = rooms.photos([rooms.camera(angle) for angle in np.linspace(-0.4, 0.4, 4)])
    with guarded(0):
        matches = matched_photos(photos, tmp_path, chosen_matchers("sift"), 0, lambda *_: None)
        database = with_focal_lengths(matches, 0)
        if mapper == "global":
            model = map_globally(database, THRESHOLDS[1], 0)
        else:
            model = map_photos(4, database, THRESHOLDS[0], 0, lambda *_: None)
        assert model.num_reg_images() == 4
        verified = links(matches)
        counts = agreeing(model, verified, matches)
        assert counts.keys() == verified.keys()
        for pair, count in counts.items():
            assert count > 0.95 * len(verified[pair])
        assert consistent_part(counts, verified) == {1, 2, 3, 4}
        frame = model.frames[model.images[2].frame_id]
        pose = frame.rig_from_world
        pose.translation = pose.translation + np.array([0.0, 1.0, 0.0])
        frame.rig_from_world = pose
        moved = agreeing(model, verified, matches)
        for pair, count in moved.items():
            assert count == counts[pair] if 2 not in pair else count < 0.3 * len(verified[pair])
        assert consistent_part(moved, verified) == {1, 3, 4}


def part(**agreed):
    """The consistent part for agreeing and verified matches of pairs, as in ab=(90, 100)."""
    pairs = {(ord(a), ord(b)): some for (a, b), some in agreed.items()}
    counts = {pair: some[0] for pair, some in pairs.items() if some[0] is not None}
    matches = {pair: np.zeros((some[1], 2)) for pair, some in pairs.items()}
    return "".join(sorted(map(chr, consistent_part(counts, matches))))


def test_parts_that_look_alike_are_cut():
    strong = {"ab": (300, 300), "bc": (300, 300), "de": (200, 200)}
    assert part(**strong, cd=(60, 60), bd=(0, 80), ae=(0, 40)) == "abc"
    # Two pairs without a common photo agree.
    assert part(**strong, cd=(60, 60), be=(60, 60), bd=(0, 80), ae=(0, 40)) == "abcde"


def test_a_photo_whose_matches_are_elsewhere_is_left_out():
    strong = {"ab": (300, 300), "ac": (300, 300), "bc": (300, 300)}
    assert part(**strong, cd=(90, 90)) == "abcd"
    # Its strong pair is with a photo that is not placed.
    assert part(**strong, cd=(90, 90), de=(None, 200)) == "abc"
