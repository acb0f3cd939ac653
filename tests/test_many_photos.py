"""Refinements of many photos: bounded memory, and no round if photos overlap enough."""

from __future__ import annotations

import numpy as np
import pytest
from refinements import refine, truthful

from igsr.fitting.photo_statistics import photo_statistics
from igsr.refinement import near_sources, refine_photos
from igsr.refinement.near_sources import NearSources
from igsr.refinement.results import StopReason


def test_the_nearest_photos_are_held_and_no_more(ball_photos, helped, monkeypatch):
    monkeypatch.setattr(near_sources, "NEAR", 3)
    monkeypatch.setattr(near_sources, "CACHED", 4)
    made = []
    real = near_sources.photo_sources

    def watched(splats, views, *rest):
        made.extend(view.name for view in views)
        return real(splats, views, *rest)

    monkeypatch.setattr(near_sources, "photo_sources", watched)
    photos = ball_photos.train_views
    sources = NearSources(helped[0].first, photos, (1.0, 1.0, 1.0), "cpu")
    assert made == []
    for photo in [*photos, photos[0]]:
        near = sources.of(photo.camera)
        assert len(near) == 3
        assert any(one.camera is photo.camera for one in near)
        distances = [np.linalg.norm(p.camera.center - photo.camera.center) for p in photos]
        farthest = max(np.linalg.norm(one.camera.center - photo.camera.center) for one in near)
        assert farthest <= np.sort(distances)[2] + 1e-9
        assert len(sources._cached) <= 4
    assert len(made) > len(photos), "a freed photo is made again"
    again = len(made)
    sources.of(photos[0].camera)
    assert len(made) == again, "a held one is not"


def test_all_of_few_photos_are_near(ball_photos, helped):
    photos = ball_photos.train_views
    sources = NearSources(helped[0].first, photos, (1.0, 1.0, 1.0), "cpu")
    near = sources.of(photos[4].camera)
    assert [one.camera for one in near] == [photo.camera for photo in photos]


def test_auto_does_no_round_if_many_photos_see_the_same_place(ball_photos, monkeypatch):
    monkeypatch.setattr(refine_photos, "ENOUGH_PHOTOS", 2.0)
    refined = refine(ball_photos, "auto", truthful, steps=20)
    assert refined.stop.reason is StopReason.ENOUGH_PHOTOS
    assert refined.rounds == []
    assert "every point is seen by" in str(refined.stop)
    asked = refine(ball_photos, 1, truthful, steps=20)
    assert len(asked.rounds) == 1 or asked.stop.reason is not StopReason.ENOUGH_PHOTOS


@pytest.mark.parametrize("count", [1, 9])
def test_a_ring_of_few_photos_gets_rounds(ball_photos, count):
    photos = ball_photos.train_views[:count]
    assert photo_statistics(photos).overlap < refine_photos.ENOUGH_PHOTOS
