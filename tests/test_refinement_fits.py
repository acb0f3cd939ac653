"""How fits take novel views: by their weights, and less often than photos."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from refinements import BALL, SEED, STEPS, WHITE, same

import igsr
from igsr.fitting import fitter
from igsr.refinement.stages import seed_of_round
from igsr.rendering.renders import render

pytestmark = pytest.mark.usefixtures("small_fits")


def test_weights_of_one_are_as_none_and_of_zero_as_a_mask(ball_photos):
    def fitted(**fields):
        views = [replace(view, **fields) for view in ball_photos.train_views]
        made = igsr.Capture(ball_photos.path, views)
        # From given splats: masks also have a say in the first ones of a fit.
        return scenes.fit(made, steps=20, backend="cpu", start=BALL)

    size = (40, 40)
    left = np.ones(size, np.float32)
    left[:, :20] = 0.0
    assert same(fitted(), fitted(weights=np.ones(size, np.float32)))
    assert same(fitted(mask=left > 0), fitted(weights=left))
    assert not same(fitted(), fitted(weights=left))
    with pytest.raises(igsr.IgsrError, match="weights must be finite and not negative"):
        replace(ball_photos.views[0], weights=-left)
    with pytest.raises(igsr.IgsrError, match="weights"):
        replace(ball_photos.views[0], weights=left[1:])


@pytest.mark.filterwarnings("ignore:.*have the same camera", "ignore:.*black or fully")
def test_a_picture_of_small_weights_counts_less_than_a_photo(ball_photos):
    """Two pictures of one camera that disagree: the splats side with the heavier."""
    view = ball_photos.train_views[0]
    white = replace(view, name="white.png", image=np.full((40, 40, 3), 255, np.uint8))
    black = replace(view, name="black.png", image=np.zeros((40, 40, 3), np.uint8))
    side = scenes.ring_camera(1.0, 40)
    ones = np.ones((40, 40), np.float32)  # or photos would come up more often
    means = []
    for weight in (0.1, 1.0):
        weighed = replace(white, weights=np.full((40, 40), weight, np.float32))
        pair = [black, weighed, replace(black, name="side.png", camera=side)]
        pair = [view if view.weights is not None else replace(view, weights=ones) for view in pair]
        splats = scenes.fit(
            igsr.Capture(ball_photos.path, pair),
            steps=200,
            backend="cpu",
            start=BALL,
            sh_degree=BALL.sh_degree,
            dropout=0.0,
            backdrop=False,
        )
        means.append(render(splats, view.camera, backend="cpu").color.mean())
    assert means[0] < 0.5 * means[1]


def test_a_warm_start_goes_on_from_splats(ball_photos):
    options = {"backend": "cpu", "remove_floaters": False}
    first = scenes.fit(ball_photos, steps=100, **options)
    on = scenes.fit(ball_photos, steps=50, start=first, **options)
    before, after = (igsr.evaluate(s, ball_photos, "train")["psnr"] for s in (first, on))
    assert after > before
    assert len(on) >= len(first)
    with pytest.raises(igsr.IgsrError, match="sh_degree must be the same, not 3"):
        scenes.fit(ball_photos, steps=5, backend="cpu", start=first, sh_degree=3)
    with pytest.raises(igsr.IgsrError, match="give at least one, and no more than max_splats"):
        scenes.fit(ball_photos, steps=5, backend="cpu", start=first, max_splats=2)
    with pytest.raises(igsr.IgsrError, match="antialiased"):
        scenes.fit(ball_photos, steps=5, backend="cpu", start=replace(first, antialiased=True))


@pytest.mark.filterwarnings("ignore:.*have the same camera")
def test_novel_views_change_neither_settings_nor_initialization(ball_photos):
    photos = ball_photos.train_views[:3]
    weights = np.ones((40, 40), np.float32)
    views = [
        replace(view, name=f"{k}-{view.name}", weights=weights)
        for k in range(3)
        for view in ball_photos.train_views
    ]

    def begun(some):
        seen = []

        def stop(now):
            seen.append(now)
            return False

        scenes.fit(igsr.Capture(ball_photos.path, some), backend="cpu", progress=stop)
        return seen[0].steps, seen[0].started

    assert begun(photos + views) == begun(photos)
    assert begun(views) != begun(photos)


def test_a_round_fits_photos_and_novel_views_from_the_initialization(ball_photos, helped):
    refined = helped[0]
    views = list(refined.capture.train_views)
    for k, one in enumerate(refined.rounds[0].selected):
        camera, picture = one.view.camera, one.denoised
        views.append(
            igsr.View(f"whole-round1-{k}.png", camera, "train", picture, None, one.confidence)
        )
    given = [*views[:9], *(replace(view, background=WHITE) for view in views[9:])]
    seed = seed_of_round(SEED, 1)
    fitted = scenes.fit(igsr.Capture(ball_photos.path, given), STEPS, backend="cpu", seed=seed)
    assert same(fitted, refined.rounds[0].splats)
    other = scenes.fit(igsr.Capture(ball_photos.path, given), STEPS, backend="cpu", seed=SEED)
    assert not same(other, fitted)


def test_novel_views_are_sampled_less_often_and_not_at_the_end(ball_photos, monkeypatch):
    photos = ball_photos.train_views[:2]
    views = [replace(view, weights=np.ones((40, 40), np.float32)) for view in photos]
    monkeypatch.setattr(fitter, "PHOTO_STEPS", 5)
    monkeypatch.setattr(fitter, "PHOTOS_LAST", 0.2)

    def schedule(*views, first=0):
        return fitter._schedule(views, 1000, first)

    assert schedule(photos[0], *views, photos[1]) == [(5, None), (1, 800), (1, 800), (5, None)]
    assert schedule(*photos, views[0]) == [(3, None), (3, None), (1, 800)]
    assert schedule(*photos) == schedule(*views) == [(1, None), (1, None)]
    # A fit that enters the schedule late has its own last fifth.
    assert schedule(*photos, views[0], first=900)[-1] == (1, 980)


def test_a_short_fit_that_goes_on_samples_novel_views(ball_photos):
    photos = ball_photos.train_views[:2]
    view = replace(ball_photos.train_views[2], weights=np.ones((40, 40), np.float32))
    start = scenes.fit(igsr.Capture(ball_photos.path, photos), 20, backend="cpu")

    def gone_on(view):
        given = igsr.Capture(ball_photos.path, [*photos, view])
        return scenes.fit(given, 20, backend="cpu", start=start)

    assert not same(gone_on(view), gone_on(replace(view, image=255 - view.image)))
