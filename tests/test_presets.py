"""Settings chosen by photos and quality, and initializations."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from capture_files import assert_refused, save
from made_up_tracks import projected, tracked

import igsr
from igsr.capture import Points
from igsr.capture.types import Tracks
from igsr.fitting import fit_capture, presets, settings_for
from igsr.fitting.checkpoint import load_checkpoint
from igsr.fitting.initialization.initial_splats import (
    MAX_OPACITY,
    MIN_OPACITY,
    UNSURE_SIZE_FACTOR,
    chosen_start,
    initial_splats,
)
from igsr.fitting.initialization.visual_hull import color_disagreement
from igsr.fitting.photo_statistics import (
    PhotoStatistics,
    count_squares,
    detail_of_files,
    photo_statistics,
)


@pytest.fixture(scope="module")
def capture():
    return scenes.capture(views=8, size=40, alpha=True)


def statistics(photos, overlap=8.0, spacing_deg=5.0, pixels=100_000.0):
    return PhotoStatistics(photos, pixels, overlap, spacing_deg)


def test_settings_depend_on_how_many_photos_see_a_place():
    few, many = settings_for(statistics(8)), settings_for(statistics(100, 50.0))
    assert (few.dropout, many.dropout) == (0.15, 0.0)
    assert settings_for(statistics(3, 1.5)).dropout == presets.MAX_DROPOUT
    assert (few.sh_degree, many.sh_degree) == (1, 2)
    assert few.exposure == many.exposure == "off"
    assert few.density == "original"
    assert settings_for(statistics(8, spacing_deg=30.0)).density == "mcmc"


def test_splats_depend_on_pixels_photos_detail_and_quality():
    def max_splats(quality="normal", **changes):
        photos = replace(statistics(8, spacing_deg=30.0), **changes)
        return settings_for(photos, quality).max_splats

    assert (max_splats(), max_splats(photos=100)) == (30_000, 45_000)
    assert max_splats(pixels=1e9) == presets.MAX_SPLATS
    assert max_splats(detail=20_000.0) == 30_000
    assert max_splats(detail=35_000.0) == 35_000
    assert max_splats(detail=35_000.0, photos=16) == round(35_000 * 2**0.4)
    # Finer detail is noise.
    assert max_splats(detail=90_000.0) == 50_000
    assert max_splats("high", detail=90_000.0) == 50_000
    near = [max_splats(quality, spacing_deg=5.0) for quality in presets.QUALITIES]
    assert near == [12_000, 30_000, 75_000]


def test_photos_from_similar_directions_have_more_steps_unless_cameras_move():
    def steps(photos, spacing_deg, quality="normal", **options):
        return settings_for(statistics(photos, spacing_deg=spacing_deg), quality, **options).steps

    assert [steps(photos, 5.0) for photos in (1, 3, 5, 100)] == [2500] * 4
    assert [steps(photos, 30.0) for photos in (1, 3, 8, 100)] == [250, 750, 1700, 2500]
    assert (steps(3, 5.0, "high"), steps(3, 30.0, "high")) == (5000, 1500)
    assert steps(3, 5.0, poses="joint") == steps(3, 30.0, poses="joint") == 1500


def test_given_settings_are_kept():
    settings = settings_for(8, dropout=0.0, backdrop=False, steps=None, learning_rate=1.5)
    assert (settings.dropout, settings.backdrop, settings.learning_rate) == (0.0, False, 1.5)
    assert settings.steps == settings_for(8).steps


@pytest.mark.parametrize(
    ("spacing_deg", "first_steps"),
    [(30.0, 2 * presets.STEPS_PER_PHOTO), (5.0, presets.MAX_STEPS)],
)
def test_settings_change_smoothly_with_the_number_of_photos(spacing_deg, first_steps):
    steps = splats = 0
    dropout = presets.MAX_DROPOUT
    for photos in range(1, 200):
        settings = settings_for(statistics(photos, max(1.0, 0.4 * photos), spacing_deg))
        assert steps <= settings.steps <= max(first_steps, 1.5 * steps)
        assert splats <= settings.max_splats <= max(30_000, 1.32 * splats)
        assert dropout - 0.1 <= settings.dropout <= dropout
        steps, splats, dropout = settings.steps, settings.max_splats, settings.dropout
    assert (steps, dropout) == (presets.MAX_STEPS, 0.0)


def test_better_qualities_have_larger_photos_and_more_steps_and_splats():
    settings = [settings_for(statistics(8), quality) for quality in presets.QUALITIES]
    sizes = [presets.default_max_size("cpu", quality) for quality in presets.QUALITIES]
    for values in (sizes, [s.steps for s in settings], [s.max_splats for s in settings]):
        assert values == sorted(set(values))
    assert presets.default_max_size("gpu") > presets.default_max_size("cpu") == sizes[1]
    for choose, first in ((settings_for, 8), (presets.default_max_size, "cpu")):
        assert_refused("quality must be one of draft, normal, high", choose, first, "best")


def test_short_fits_have_larger_learning_rates():
    rates = [settings_for(8, steps=steps).learning_rate for steps in (10, 7500, 30_000, 90_000)]
    assert rates == [3.0, 2.0, 1.0, 1.0]
    assert settings_for(8).learning_rate == presets.MAX_LEARNING_RATE


@pytest.mark.parametrize("joint", [{"poses": "joint"}, {"focal": "shared"}])
def test_fits_of_cameras_take_more_and_smaller_steps(joint):
    fixed, moving = settings_for(20), settings_for(20, **joint)
    assert (moving.steps, moving.learning_rate) == (2 * fixed.steps, 1.0)
    assert settings_for(20, steps=700, **joint).learning_rate == 1.0


def test_a_fit_uses_the_settings_for_its_photos(capture, tmp_path):
    path = tmp_path / "a.npz"
    result = fit_capture(capture, steps=3, backend="cpu", checkpoint=path)
    assert result.settings == settings_for(photo_statistics(capture.train_views), steps=3)
    expected = result.settings.plain() | {"depth_weight": 0.0}  # the photos have no depths
    # These are applied after the last step.
    del expected["remove_floaters"], expected["backdrop"]
    saved = load_checkpoint(path)[1]
    assert {name: saved[name] for name in expected} == expected


def test_overlap_counts_photos_from_similar_directions():
    ring = scenes.capture(views=12, size=40, alpha=True).views
    all_round, half, one = map(photo_statistics, (ring, ring[::2], ring[:1]))
    assert (all_round.photos, all_round.pixels, all_round.visible_fraction) == (12, 1600.0, 1.0)
    # Within 60 degrees of each, itself included, on a ring with steps of 30 degrees.
    assert 3.0 <= all_round.overlap <= 5.0
    assert half.spacing_deg > all_round.spacing_deg
    assert half.overlap < all_round.overlap
    assert one == PhotoStatistics(1, 1600.0, 1.0, 180.0, one.detail)
    masked = [replace(view, mask=np.arange(1600).reshape(40, 40) < 400) for view in ring]
    assert photo_statistics(masked).pixels == 400.0


def test_few_photos_of_a_large_scene_show_the_same_place():
    views = []
    for k in range(3):
        for view in scenes.capture(views=12, size=40, alpha=True).views:
            viewmat = view.camera.viewmat.copy()
            viewmat[:3, 3] -= viewmat[:3, :3] @ [50.0 * k, 0.0, 0.0]
            views.append(replace(view, camera=replace(view.camera, viewmat=viewmat)))
    rooms = replace(photo_statistics(views), spacing_deg=30.0)
    assert rooms.visible_fraction < presets.MCMC_VISIBLE_FRACTION
    assert settings_for(rooms).density == "original"
    assert settings_for(replace(rooms, visible_fraction=1.0)).density == "mcmc"


def test_count_squares_are_counted():
    plain = np.full((40, 72, 3), 77, np.uint8)
    # Whole squares of 16 pixels; the rest at the edges does not count.
    assert count_squares(plain) == 2 * 4
    half = plain.copy()
    half[:, 24:] = 200  # an edge inside a column of squares: each becomes four of 8 pixels
    assert count_squares(half) == 2 * 3 + 2 * 4
    assert count_squares(half // 20) == 2 * 4
    noise = np.random.default_rng(0).choice(np.uint8([0, 255]), (32, 64, 1)).repeat(3, axis=2)
    assert 0.8 * 32 * 64 < count_squares(noise) <= 32 * 64
    # Squares count by their unmasked fraction.
    mask = np.zeros((32, 64), bool)
    mask[:, :8] = True
    assert count_squares(plain[:32, :64], mask) == 1.0
    # Transparent pixels are white.
    hidden = np.concatenate([noise, np.zeros((32, 64, 1), np.uint8)], axis=2)
    assert count_squares(hidden) == 2 * 4
    assert count_squares(plain[:10]) == 0.0


def test_detail_is_the_mean_of_a_few_photos_or_files(tmp_path):
    views = scenes.capture(views=20, size=48, alpha=True).views
    counts = [count_squares(view.image) for view in views]
    assert photo_statistics(views).detail == pytest.approx(np.mean(counts[::2]))
    files = [save(tmp_path / f"{k}.png", view.image) for k, view in enumerate(views)]
    assert detail_of_files(files, None) == pytest.approx(np.mean(counts[::5]))
    assert 0.0 < detail_of_files(files, 24) < detail_of_files(files, None)
    files[5].write_text("no photo")
    assert detail_of_files(files, None) == pytest.approx(np.mean([counts[k] for k in (0, 10, 15)]))
    assert detail_of_files([], None) == 0.0


def count_outside_hull(splats, capture):
    """Number of splats on a transparent pixel of a photo, more than two pixels from an edge."""
    empty = np.zeros(len(splats), dtype=bool)
    for view in capture.train_views:
        size = view.image.shape[0]
        alpha = np.pad(view.image[..., 3], 2, mode="edge") > 0
        windows = [alpha[y : y + size, x : x + size] for y in range(5) for x in range(5)]
        near = np.any(windows, axis=0)
        pixel = np.floor(projected(view.camera, splats.means + splats.origin)).astype(int)
        seen = ((pixel >= 0) & (pixel < size)).all(axis=1)
        column, row = np.clip(pixel, 0, size - 1).T
        empty |= seen & ~near[row, column]
    return int(empty.sum())


def test_start_depends_on_the_photos(capture):
    assert chosen_start(capture) == "hull"
    assert chosen_start(scenes.capture(views=4, size=24)) == "depths"
    assert chosen_start(scenes.capture(views=16, size=8)) == "depths"
    words = "^made-up has photos without alpha; start hull needs"
    assert_refused(words, initial_splats, scenes.capture(views=4, size=24), 0, 300, 1, "hull")


@pytest.mark.parametrize("start", ["hull", "rays", "random"])
def test_starts_make_splats(capture, start):
    splats, name = initial_splats(capture, 0, 300, 1, start)
    assert (name, len(splats), splats.sh_degree) == (start, 300, 1)


@pytest.mark.parametrize("seed", range(3))
def test_hull_splats_are_inside_the_hull(capture, seed):
    starts = (initial_splats(capture, seed, 1000, 0, start)[0] for start in ("hull", "random"))
    in_hull, at_random = (count_outside_hull(splats, capture) for splats in starts)
    assert in_hull == 0
    assert at_random > 150


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_photos_have_a_hull(capture, count):
    few = igsr.Capture(capture.path, capture.train_views[:count])
    splats, _ = initial_splats(few, 0, 300, 0, "hull")
    assert len(splats) == 300
    assert np.isfinite(splats.means).all()


def test_color_disagreement_allows_for_occluded_photos():
    agreed = np.full((4, 1, 3), 0.5, np.float32)
    occluded = agreed.copy()
    occluded[2:] = [[[0.9, 0.1, 0.0]], [[0.0, 0.8, 0.3]]]
    inside = np.arange(12, dtype=np.float32).reshape(4, 1, 3) / 12.0
    unseen = agreed.copy()
    unseen[1:] = np.nan
    values = color_disagreement(np.concatenate([agreed, occluded, inside, unseen], axis=1))
    assert values[0] == values[1] == 0.0
    assert values[2] > 0.05
    assert np.isinf(values[3])


def test_uncertain_points_start_faint_and_large(capture):
    random = np.random.default_rng(0)
    xyz, rgb = random.normal(size=(200, 3)), np.full((200, 3), 128, dtype=np.uint8)
    confidence = np.exp(random.normal(size=200))

    def start(confidence, max_splats=200):
        given = igsr.Capture(capture.path, capture.views, Points(xyz, rgb, confidence))
        return initial_splats(given, 0, max_splats, 0)[0]

    plain, splats = start(None), start(confidence)
    order = np.argsort(confidence)
    opacity = 1.0 / (1.0 + np.exp(-splats.opacities[order]))
    np.testing.assert_allclose(opacity[[0, -1]], [MIN_OPACITY, MAX_OPACITY], rtol=1e-5)
    assert (np.diff(opacity) > 0).all()
    larger = np.exp(splats.scales - plain.scales)[order]
    np.testing.assert_allclose(larger[[0, -1]], [[UNSURE_SIZE_FACTOR] * 3, [1.0] * 3], rtol=1e-5)
    assert (np.diff(larger[:, 0]) < 0).all()
    # The unit does not matter; equal confidences are as none.
    assert np.array_equal(start(confidence * 1e9).opacities, splats.opacities)
    assert start(np.full(200, 7.0)) == plain
    # Each of the points that the maximum leaves keeps its own confidence.
    half = start(confidence, max_splats=100)
    distances = np.abs(xyz[:, None] - (half.means + half.origin)).sum(axis=2)
    kept = confidence[distances.argmin(axis=0)]
    assert (np.argsort(kept) == np.argsort(half.opacities)).all()


def test_held_out_photos_do_not_contribute_points():
    views = scenes.capture(views=6, size=24).views
    xyz = np.random.default_rng(0).normal(scale=0.3, size=(400, 3))
    points = tracked(views, xyz, miss=0.4)
    points.confidence = np.arange(1.0, 401.0)
    tracks = points.tracks
    counts = np.bincount(tracks.point[tracks.view != 5], minlength=400)
    assert 0 < (counts < 2).sum() < 300, "some points are known from the last photo"
    seen = points.seen_by([view.name for view in views[:5]])
    assert np.array_equal(seen.xyz, xyz[counts >= 2])
    assert np.array_equal(seen.confidence, points.confidence[counts >= 2])
    split = [replace(view, split="train" if view is not views[5] else "test") for view in views]
    capture = igsr.Capture(Path("a"), split, points)
    splats, start = initial_splats(capture, 0, 10_000, 0, "points")
    assert (start, len(splats)) == ("points", (counts >= 2).sum())
    empty = Points(xyz, points.rgb, tracks=Tracks([], *(tracks.view[:0],) * 2, tracks.xy[:0]))
    assert empty.seen_by([]) is empty


def test_few_photos_start_with_points_between_those_of_the_capture(capture):
    xyz = np.random.default_rng(0).normal(size=(150, 3))
    points = Points(xyz, np.full((150, 3), 128, np.uint8), np.linspace(1.0, 2.0, 150))
    few = igsr.Capture(capture.path, capture.train_views[:8], points)
    splats, name = initial_splats(few, 0, 10_000, 0)
    assert (name, len(splats)) == ("points", 1500)
    np.testing.assert_allclose(splats.means[:150] + splats.origin, xyz, atol=1e-5)
    assert len(np.unique(splats.opacities)) > 1000  # confidence is interpolated, too
    assert len(initial_splats(few, 0, 400, 0)[0]) == 400
    assert len(initial_splats(few, 0, 10_000, 0, "points")[0]) == 150
