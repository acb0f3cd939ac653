"""How fits use novel views: by their weights, and less often than photos."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from capture_files import assert_refused
from refinements import BALL, STEPS, WHITE, same

import igsr
from igsr import _core
from igsr.fitting import fit_capture
from igsr.fitting.inputs import prepare
from igsr.refinement.rounds import seed_of_round
from igsr.rendering.renders import render

ONES = np.ones((40, 40), np.float32)


def pseudo(view, weights=ONES, **fields):
    """A photo as a pseudo-view, with other fields."""
    return scenes.pseudo_view(view, weights=weights, **fields)


def test_weights_of_one_are_as_none_and_weights_of_zero_as_a_mask(ball_photos):
    photos = ball_photos.train_views
    left = ONES.copy()
    left[:, :20] = 0.0

    def fitted(views):
        # From splats: masks also influence the initialization.
        return scenes.fit(igsr.Capture(ball_photos.path, views), 20, backend="cpu", start=BALL)

    whole = fitted(photos)
    half = fitted([pseudo(view, left) for view in photos])
    assert same(whole, fitted([pseudo(view) for view in photos]))
    assert same(half, fitted([replace(view, mask=left > 0) for view in photos]))
    assert not same(whole, half)
    assert_refused("weights must be finite and not negative", pseudo, photos[0], -left)
    assert_refused("weights", pseudo, photos[0], left[1:])


@pytest.mark.filterwarnings("ignore:.*have the same camera", "ignore:.*black or fully")
def test_of_two_pictures_that_disagree_the_one_of_larger_weight_wins(ball_photos):
    view = ball_photos.train_views[0]
    white = np.full((40, 40, 3), 255, np.uint8)
    black = pseudo(view, name="black.png", image=np.zeros((40, 40, 3), np.uint8))
    side = pseudo(black, name="side.png", camera=scenes.ring_camera(1.0, 40))

    def brightness(weight):
        bright = pseudo(view, weight * ONES, name="white.png", image=white)
        photos = igsr.Capture(ball_photos.path, [black, bright, side])
        options = {"start": BALL, "sh_degree": 1, "dropout": 0.0, "backdrop": False}
        splats = scenes.fit(photos, 200, backend="cpu", **options)
        return render(splats, view.camera, backend="cpu").color.mean()

    assert brightness(0.1) < 0.5 * brightness(1.0)


def test_a_fit_continues_from_splats(ball_photos):
    options = {"backend": "cpu", "remove_floaters": False}
    first = scenes.fit(ball_photos, 100, **options)
    last = scenes.fit(ball_photos, 50, start=first, **options)
    before, after = (igsr.evaluate(s, ball_photos, "train")["psnr"] for s in (first, last))
    assert after > before
    assert len(last) >= len(first)
    antialiased = replace(first, antialiased=True)
    for start, settings, message in (
        (first, {"sh_degree": 3}, "sh_degree must be the same, not 3"),
        (first, {"max_splats": 2}, "give at least one and at most max_splats"),
        (antialiased, {}, "antialiased"),
    ):
        assert_refused(message, scenes.fit, ball_photos, 5, start=start, backend="cpu", **settings)


@pytest.mark.filterwarnings("ignore:.*have the same camera")
def test_novel_views_change_neither_settings_nor_initialization(ball_photos):
    train = ball_photos.train_views
    photos = train[:3]
    views = [pseudo(view, name=f"{k}-{view.name}") for k in range(3) for view in train]

    def begun(views):
        capture = igsr.Capture(ball_photos.path, views)
        started = fit_capture(capture, steps=1, backend="cpu").started
        return prepare(capture, backend="cpu").settings, started

    assert begun(photos + views) == begun(photos)
    assert begun(views) != begun(photos)


def test_a_round_fits_photos_and_novel_views_from_the_initialization(helped):
    capture, done = helped[0].capture, helped[0].rounds[0]
    views = []
    for k, chosen in enumerate(done.selected):
        own = {"weights": chosen.confidence, "background": WHITE}
        given = f"whole-round1-{k}.png", chosen.view.camera, "train", chosen.denoised
        views.append(igsr.PseudoView(*given, **own))
    photos = igsr.Capture(capture.path, [*capture.train_views, *views])
    fitted = scenes.fit(photos, STEPS, backend="cpu", seed=seed_of_round(0, 1))
    assert same(fitted, done.splats)
    assert not same(scenes.fit(photos, STEPS, backend="cpu", seed=0), fitted)


def test_novel_views_are_sampled_less_often_and_not_at_the_end(ball_photos, monkeypatch):
    photo, other = ball_photos.train_views[:2]
    view = pseudo(photo, name="novel.png", camera=scenes.ring_camera(1.0, 40))
    second = replace(view, name="second.png", camera=scenes.ring_camera(2.0, 40))

    def schedule(*views, steps=1000, **options):
        """For each view, how often it comes in a round, and the step that ends its use."""
        seen = []

        def record(images, masks, backgrounds, schedule, *rest):
            seen.append(schedule)
            raise scenes.Stop

        monkeypatch.setattr(_core, "Fitter", record)
        with pytest.raises(scenes.Stop):
            scenes.fit(igsr.Capture(ball_photos.path, list(views)), steps, backend="cpu", **options)
        return seen[0]

    assert schedule(photo, view, second, other) == [(5, None), (1, 800), (1, 800), (5, None)]
    assert schedule(photo, other, view) == [(3, None), (3, None), (1, 800)]
    assert schedule(photo, other) == schedule(view, second) == [(1, None), (1, None)]
    # Two photos have 500 steps: the last 100 of them have their own last fifth.
    assert schedule(photo, other, view, steps=100, start=BALL)[-1] == (1, 480)


def test_a_short_fit_that_continues_samples_novel_views(ball_photos):
    photos = ball_photos.train_views[:2]
    view = pseudo(ball_photos.train_views[2])
    start = scenes.fit(igsr.Capture(ball_photos.path, photos), 20, backend="cpu")

    def continued(view):
        capture = igsr.Capture(ball_photos.path, [*photos, view])
        return scenes.fit(capture, 20, backend="cpu", start=start)

    assert not same(continued(view), continued(replace(view, image=255 - view.image)))
