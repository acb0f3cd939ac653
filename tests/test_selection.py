"""Confidence weights, gains, and which views are selected by them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from igsr.denoiser import Buffers
from igsr.denoiser.confidence import HALF_CONFIDENCE_ERROR
from igsr.refinement.novel_views import NovelView
from igsr.refinement.selection import (
    MIN_CONFIDENCE,
    MIN_GAIN,
    PHOTO_ERROR,
    confidence_weights,
    denoised_candidate,
    select_views,
)

VIEW = NovelView(scenes.ring_camera(0.0, size=8), 12.0, True)


def cleaning(picture, confidence):
    """A denoiser that always answers the same."""
    return lambda render, photos: (picture, confidence)


def test_a_pixel_as_wrong_as_a_photo_counts_half():
    errors = np.array([[0.0, PHOTO_ERROR, 3.0 * PHOTO_ERROR, 1.0]], np.float32)
    weights = confidence_weights(HALF_CONFIDENCE_ERROR / (HALF_CONFIDENCE_ERROR + errors))
    assert weights[0, :3] == pytest.approx([1.0, 0.5, 0.1], rel=1e-4)
    assert weights[0, 3] == pytest.approx(PHOTO_ERROR**2, rel=0.01)
    assert confidence_weights(np.zeros((1, 1), np.float32))[0, 0] == pytest.approx(0.0, abs=1e-9)


def test_the_gain_is_the_change_where_confidence_is_high():
    render = np.full((8, 8, 3), 0.5, np.float32)
    picture = render.copy()
    picture[:4] = 0.75
    sure = np.ones((8, 8), np.float32)
    here = denoised_candidate(VIEW, Buffers(render), [], cleaning(picture, sure))
    assert here.gain == pytest.approx(0.125)
    assert here.mean_confidence == 1.0
    assert here.render.max() == 128
    assert here.denoised[0, 0, 0] == 191
    sure[:4] = 0.0
    there = denoised_candidate(VIEW, Buffers(render), [], cleaning(picture, sure))
    assert there.gain == pytest.approx(0.0, abs=1e-6), "what it changes has no weight"
    assert there.mean_confidence == pytest.approx(0.5)


def test_the_largest_gain_first_and_none_without_confidence_or_gain():
    picture = np.zeros((8, 8, 3), np.float32)
    one = denoised_candidate(
        VIEW, Buffers(picture), [], cleaning(picture, np.ones((8, 8), np.float32))
    )
    known = [replace(one, gain=gain) for gain in (0.1, 0.3, 0.2)]
    doubtful = replace(one, gain=0.9, confidence=np.full((8, 8), 0.9 * MIN_CONFIDENCE, np.float32))
    assert [view.gain for view in select_views([*known, doubtful], 2)] == [0.3, 0.2]
    right = replace(one, gain=0.9 * MIN_GAIN)
    assert select_views([doubtful, right], 2) == []
