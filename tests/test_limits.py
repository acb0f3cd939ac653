"""Limits of a scene: the rule, its thresholds and its sentences."""

from __future__ import annotations

import pytest

from igsr.evaluation.limits import MIN_GAIN_DB, REPRODUCED_DB, LimitKind, limit_of

SPLATS, PHOTOS = LimitKind.splats_and_steps, LimitKind.photos
CAMERAS, NOTHING = LimitKind.cameras, LimitKind.nothing


@pytest.mark.parametrize(
    ("train", "held_out", "refined", "kind"),
    [
        (22.0, 21.0, None, SPLATS),  # low, and near held-out photos
        (22.2, 17.1, None, SPLATS),  # 7.8 dB left, 5.1 dB of gap
        (26.0, 17.5, None, PHOTOS),  # 4 dB left, 8.5 dB of gap
        (35.0, 24.0, None, PHOTOS),  # more than reproduced: nothing left there
        (35.0, 34.0, None, NOTHING),
        (24.0, 26.0, None, SPLATS),  # held-out photos may be easier: no gap
        (29.0, 22.0, 28.0, CAMERAS),  # with refined cameras the gap is gone
        (29.0, 22.0, 22.5, PHOTOS),
        (29.0, 22.0, 20.0, PHOTOS),  # refining that does harm says nothing
    ],
)
def test_the_largest_difference_is_the_limit(train, held_out, refined, kind):
    limit = limit_of(train, held_out, refined)
    assert limit.kind is kind
    assert f"{train:.1f} dB" in limit.sentence
    assert f"{held_out:.1f} dB" in limit.sentence
    words = {SPLATS: "more splats and steps would help most", PHOTOS: "more photos would help most"}
    words |= {CAMERAS: "better cameras would help most", NOTHING: "would add little"}
    for other, text in words.items():
        assert (text in limit.sentence) == (other is kind)


def test_the_second_largest_difference_is_mentioned():
    assert "more photos would, too" in limit_of(22.2, 17.1).sentence
    assert "too" not in limit_of(22.0, 21.0).sentence
    assert "more splats and steps would, too" in limit_of(26.0, 18.0).sentence
    assert "too" not in limit_of(REPRODUCED_DB - MIN_GAIN_DB / 2.0, 17.0).sentence


def test_thresholds():
    just_under = MIN_GAIN_DB - 0.01
    assert limit_of(REPRODUCED_DB - just_under, REPRODUCED_DB - just_under).kind is NOTHING
    assert limit_of(REPRODUCED_DB - MIN_GAIN_DB, REPRODUCED_DB - MIN_GAIN_DB).kind is SPLATS
    assert limit_of(40.0, 40.0 - just_under).kind is NOTHING
    assert limit_of(40.0, 40.0 - MIN_GAIN_DB).kind is PHOTOS


def test_limits_without_held_out_photos():
    low, high = limit_of(20.0), limit_of(34.0)
    assert (low.kind, high.kind) == (SPLATS, NOTHING)
    assert "more splats and steps would help;" in low.sentence
    assert "more splats and steps would add little;" in high.sentence
    for limit in (low, high):
        assert "--holdout 8" in limit.sentence
        assert limit.plain()["held_out_gap"] is limit.plain()["camera_gain"] is None
