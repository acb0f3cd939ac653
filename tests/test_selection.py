"""Which rendered views are trusted, and where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from igsr.denoiser import Buffers
from igsr.denoiser.cleaning import HALF_CONFIDENCE_ERROR
from igsr.refinement.novel_views import UnseenView
from igsr.refinement.selection import (
    LEAST_TRUST,
    LEAST_WORTH,
    PHOTO_ERROR,
    candidate,
    select,
    trust_of,
)

VIEW = UnseenView(scenes.ring_camera(0.0, size=8), 12.0, True)


def cleaning(picture, confidence):
    """A denoiser that always answers the same."""
    return lambda render, photos: (picture, confidence)


def test_a_pixel_as_wrong_as_a_photo_counts_half():
    errors = np.array([[0.0, PHOTO_ERROR, 3.0 * PHOTO_ERROR, 1.0]], np.float32)
    trust = trust_of(HALF_CONFIDENCE_ERROR / (HALF_CONFIDENCE_ERROR + errors))
    assert trust[0, :3] == pytest.approx([1.0, 0.5, 0.1], rel=1e-4)
    assert trust[0, 3] == pytest.approx(PHOTO_ERROR**2, rel=0.01)
    assert trust_of(np.zeros((1, 1), np.float32))[0, 0] == pytest.approx(0.0, abs=1e-9)


def test_a_view_is_worth_what_it_changes_where_it_can_be_trusted():
    render = np.full((8, 8, 3), 0.5, np.float32)
    picture = render.copy()
    picture[:4] = 0.75
    sure = np.ones((8, 8), np.float32)
    here = candidate(VIEW, Buffers(render), [], cleaning(picture, sure))
    assert here.worth == pytest.approx(0.125)
    assert here.mean_trust == 1.0
    assert here.render.max() == 128
    assert here.picture[0, 0, 0] == 191
    sure[:4] = 0.0
    there = candidate(VIEW, Buffers(render), [], cleaning(picture, sure))
    assert there.worth == pytest.approx(0.0, abs=1e-6), "what it changes is not to be trusted"
    assert there.mean_trust == pytest.approx(0.5)


def test_the_most_worth_first_and_none_that_cannot_be_trusted():
    picture = np.zeros((8, 8, 3), np.float32)
    one = candidate(VIEW, Buffers(picture), [], cleaning(picture, np.ones((8, 8), np.float32)))
    known = [replace(one, worth=worth) for worth in (0.1, 0.3, 0.2)]
    doubtful = replace(one, worth=0.9, trust=np.full((8, 8), 0.9 * LEAST_TRUST, np.float32))
    assert [view.worth for view in select([*known, doubtful], 2)] == [0.3, 0.2]
    right = replace(one, worth=0.9 * LEAST_WORTH)
    assert select([doubtful, right], 2) == []
