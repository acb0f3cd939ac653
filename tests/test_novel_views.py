"""Novel views: near the photos' cameras, not at them, and outside of the scene."""

from __future__ import annotations

import numpy as np
import pytest
import scenes

import igsr
from igsr.refinement.novel_views import CLOSE, MIN_STEP, STEP, novel_views

BALL = scenes.splats()


def angle(camera, other):
    """Degrees between two cameras about the ball."""
    here, there = (c.center / np.linalg.norm(c.center) for c in (camera, other))
    return np.degrees(np.arccos(np.clip(here @ there, -1.0, 1.0)))


def test_views_lie_near_known_ones_and_apart_and_look_at_the_ball():
    known = [scenes.ring_camera(a) for a in (0.0, 0.6, 1.0)]
    found = novel_views(BALL, known, 10, "cpu")
    assert len(found) == 10
    seen = list(known)
    for view in found:
        nearest = min(angle(view.camera, other) for other in seen)
        # About a point that each camera looks at, near the ball's middle.
        assert nearest > 0.8 * MIN_STEP * STEP
        assert min(angle(view.camera, other) for other in known) < 1.3 * max(STEP, 17.2)
        towards = -view.camera.center / np.linalg.norm(view.camera.center)
        assert towards @ view.camera.viewmat[2, :3] > 0.99
        assert np.linalg.norm(view.camera.center) == pytest.approx(4.0, rel=0.1)
        assert view.camera.viewmat[1, :3] @ (0.0, 1.0, 0.0) > 0.9, "upright as the photos"
        seen.append(view.camera)


def test_those_between_photos_come_first():
    known = [scenes.ring_camera(a) for a in (0.0, 0.6)]
    first, *others = novel_views(BALL, known, 6, "cpu")
    assert first.between
    assert not any(view.between for view in others)
    middle = scenes.ring_camera(0.3)
    assert angle(first.camera, middle) < 2.0
    assert np.allclose(first.camera.viewmat, middle.viewmat, atol=0.1)


def test_each_round_goes_further_out():
    known = [scenes.ring_camera(0.0)]
    first = novel_views(BALL, known, 4, "cpu")
    accepted = known + [view.camera for view in first]
    second = novel_views(BALL, accepted, 40, "cpu")
    reach = [max(angle(view.camera, known[0]) for view in views) for views in (first, second)]
    assert reach[0] < 1.2 * STEP < 1.5 * STEP < reach[1]


def test_a_ring_that_is_full_has_nothing_between():
    known = [scenes.ring_camera(a) for a in np.linspace(0, 2 * np.pi, 40, endpoint=False)]
    assert not any(view.between for view in novel_views(BALL, known, 5, "cpu"))


def with_wall(at):
    """The ball, and a piece of wall."""
    random = np.random.default_rng(0)
    there = (at + random.uniform(-0.25, 0.25, (400, 3))).astype(np.float32)
    return igsr.Splats(
        means=np.concatenate([BALL.means, there]),
        quats=np.tile(np.float32([1, 0, 0, 0]), (440, 1)),
        scales=np.concatenate([BALL.scales, np.full((400, 3), -2.5, np.float32)]),
        opacities=np.full(440, 4.0, np.float32),
        sh=np.concatenate([BALL.sh, np.zeros((400, 4, 3), np.float32)]),
    )


def test_what_is_too_near_goes_by_how_far_a_view_itself_is():
    """Halfway between a camera at 2 and one at 10 a view is 6 away, whichever it is made from."""
    known = [scenes.ring_camera(0.0, distance=2.0), scenes.ring_camera(0.9, distance=10.0)]
    (free,) = (view for view in novel_views(BALL, known, 20, "cpu") if view.between)
    center = free.camera.center
    assert np.linalg.norm(center) == pytest.approx(6.0, rel=0.1)
    for part, stays in ((0.8 * CLOSE, False), (1.3 * CLOSE, True)):
        found = novel_views(with_wall(center * (1.0 - part)), known, 20, "cpu")
        assert any(view.between for view in found) == stays


def test_no_view_stands_inside_or_behind_a_wall():
    known = [scenes.ring_camera(0.0)]
    free = novel_views(BALL, known, 8, "cpu")
    # A wall that begins right of the photo's picture, in the way of views to that side.
    there = max((view.camera.center for view in free), key=lambda center: center[0])
    left = novel_views(with_wall(there * (1.0 - 0.5 * CLOSE)), known, 8, "cpu")
    assert any(np.allclose(view.camera.center, there) for view in free)
    assert left
    assert not any(np.linalg.norm(view.camera.center - there) < 0.2 for view in left)


def test_where_nothing_is_seen_there_is_nowhere_to_look():
    away = scenes.ring_camera(0.0, center=(50.0, 0.0, 0.0))
    assert novel_views(BALL, [away], 5, "cpu") == []
    assert novel_views(BALL, [], 5, "cpu") == []
