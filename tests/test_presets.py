"""What few photos need: presets, starts, the visual hull, dropout."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from made_up_tracks import tracked
from PIL import Image

import igsr
from igsr.capture import Points
from igsr.capture.types import Tracks
from igsr.fitting import presets
from igsr.fitting.initialization.initial_splats import chosen_start, initial_splats
from igsr.fitting.photo_support import (
    PhotoSupport,
    detail_of_files,
    squares_of_one_tone,
    support_of,
)
from igsr.fitting.presets import preset_settings, settings_for
from igsr.fitting.settings import FitSettings


@pytest.fixture(scope="module")
def capture():
    return scenes.capture(views=8, size=40, alpha=True)


def fit(capture, **options):
    arguments = {"steps": 200, "backend": "cpu", "max_splats": 400, "sh_degree": 0, **options}
    return scenes.fit(capture, **arguments)


def support(photos, seen_by=8.0, apart=5.0, pixels=100_000.0):
    return PhotoSupport(photos, pixels, seen_by, apart)


def test_default_follows_what_photos_tell_and_gives_way_to_the_caller():
    few, many = settings_for("default", support(8)), settings_for("default", support(100, 50.0))
    assert few.dropout == 0.15
    assert many.dropout == 0.0
    assert settings_for("default", support(3, 1.5)).dropout == presets.MOST_DROPOUT
    assert (few.sh_degree, many.sh_degree) == (1, 2)
    assert few.exposure == many.exposure == "off"
    assert (few.density, settings_for("default", support(8, apart=30.0)).density) == (
        "original",
        "mcmc",
    )
    assert (few.max_splats, many.max_splats) == (30_000, 45_000)
    assert settings_for("default", support(8, pixels=1e9)).max_splats == presets.MOST_SPLATS
    detailed = replace(support(8), detail=35_000.0)
    assert settings_for("default", detailed).max_splats == 35_000
    assert settings_for("default", replace(detailed, detail=20_000.0)).max_splats == 30_000
    noise = replace(detailed, detail=90_000.0)
    assert settings_for("default", noise).max_splats == 50_000
    assert settings_for("default", noise, "high").max_splats == 125_000
    more = replace(detailed, photos=16)
    assert settings_for("default", more).max_splats == round(35_000 * 2**0.4)
    given = preset_settings("default", 8, dropout=0.0, backdrop=False, steps=None)
    assert (given["dropout"], given["backdrop"]) == (0.0, False)
    assert given["steps"] == settings_for("default", 8).steps


def test_the_default_has_no_cliff():
    """One photo more changes little, whatever their number."""
    steps = splats = 0
    dropout = presets.MOST_DROPOUT
    for photos in range(1, 200):
        now = settings_for("default", support(photos, max(1.0, 0.4 * photos)))
        assert steps <= now.steps <= max(2 * presets.STEPS_PER_PHOTO, 1.5 * steps)
        assert splats <= now.max_splats <= max(30_000, 1.32 * splats)
        assert dropout - 0.1 <= now.dropout <= dropout
        steps, splats, dropout = now.steps, now.max_splats, now.dropout
    assert (steps, dropout) == (presets.MOST_STEPS, 0.0)


def test_qualities_move_size_steps_and_splats_together():
    by_quality = [settings_for("default", support(8), quality) for quality in presets.QUALITIES]
    sizes = [presets.default_max_size("cpu", quality) for quality in presets.QUALITIES]
    for values in (
        sizes,
        [one.steps for one in by_quality],
        [one.max_splats for one in by_quality],
    ):
        assert values == sorted(set(values))
    assert presets.default_max_size("gpu") > presets.default_max_size("cpu") == sizes[1]
    for call in (
        lambda: settings_for("default", 8, "best"),
        lambda: presets.default_max_size("cpu", "best"),
    ):
        with pytest.raises(igsr.IgsrError, match="quality must be one of draft, normal, high"):
            call()


def test_the_baseline_is_3dgs(capture):
    """SfM points where there are any, else random ones; no cap of ours; all photos' whole size."""
    plain = settings_for("3dgs", 8)
    assert plain == settings_for("3dgs", 100)
    assert (plain.density, plain.sh_degree, plain.steps) == ("original", 3, 7000)
    assert (plain.dropout, plain.coarse_to_fine) == (0.0, False)
    assert plain.max_splats >= 1_000_000
    assert initial_splats(capture, 0, 500, 1, plain.start)[1] == "random"
    xyz = np.random.default_rng(0).normal(size=(200, 3))
    points = Points(xyz, np.full((200, 3), 128, dtype=np.uint8))
    with_points = igsr.Capture(capture.path, capture.views, points)
    assert initial_splats(with_points, 0, 500, 1, plain.start)[1] == "points"


def test_support_is_what_cameras_show():
    ring = scenes.capture(views=12, size=40, alpha=True).views
    all_round = support_of(ring)
    assert all_round.photos == 12
    assert all_round.pixels == 1600.0
    assert all_round.shown == 1.0
    # Within 60 degrees of each, itself included, on a ring of 30 degrees' steps.
    assert 3.0 <= all_round.seen_by <= 5.0
    half = support_of(ring[::2])
    assert half.apart > all_round.apart
    assert half.seen_by < all_round.seen_by
    masked = [replace(view, mask=np.arange(1600).reshape(40, 40) < 400) for view in ring]
    assert support_of(masked).pixels == 400.0
    assert support_of(ring[:1]) == replace(
        PhotoSupport(1, 1600.0, 1.0, 180.0), detail=support_of(ring[:1]).detail
    )


def test_of_a_large_scene_few_photos_show_the_same_place():
    ring = scenes.capture(views=12, size=40, alpha=True).views

    def moved(view, by):
        viewmat = view.camera.viewmat.copy()
        viewmat[:3, 3] -= viewmat[:3, :3] @ [by, 0.0, 0.0]
        return replace(view, camera=replace(view.camera, viewmat=viewmat))

    rooms = support_of([moved(view, 50.0 * k) for k in range(3) for view in ring])
    assert rooms.shown < presets.SHOWN_BY
    assert settings_for("default", replace(rooms, apart=30.0)).density == "original"
    assert settings_for("default", replace(rooms, apart=30.0, shown=1.0)).density == "mcmc"


def test_squares_of_one_tone_are_counted():
    plain = np.full((40, 72, 3), 77, np.uint8)
    # Whole squares of 16 pixels; what is left over at the edges does not count.
    assert squares_of_one_tone(plain) == 2 * 4
    half = plain.copy()
    half[:, 24:] = 200  # an edge amid a square: two columns of four squares of 8 pixels each
    assert squares_of_one_tone(half) == 2 * 3 + 2 * 4
    faint = half // 20
    assert squares_of_one_tone(faint) == 2 * 4
    noise = np.random.default_rng(0).choice(np.uint8([0, 255]), (32, 64, 1)).repeat(3, axis=2)
    assert 0.8 * 32 * 64 < squares_of_one_tone(noise) <= 32 * 64
    # By a mask, its part of each square.
    mask = np.zeros((32, 64), bool)
    mask[:, :8] = True
    assert squares_of_one_tone(plain[:32, :64], mask) == 1.0
    # Transparent pixels are white, whatever lies under them.
    hidden = np.concatenate([noise, np.zeros((32, 64, 1), np.uint8)], axis=2)
    assert squares_of_one_tone(hidden) == 2 * 4
    assert squares_of_one_tone(plain[:10]) == 0.0


def test_detail_is_of_a_few_photos_and_the_same_from_files(tmp_path):
    views = scenes.capture(views=20, size=48, alpha=True).views
    counts = [squares_of_one_tone(view.image) for view in views]
    assert support_of(views).detail == pytest.approx(np.mean(counts[::2]))
    files = []
    for view in views:
        files.append(tmp_path / f"{len(files)}.png")
        Image.fromarray(view.image).save(files[-1])
    assert detail_of_files(files, None) == pytest.approx(np.mean(counts[::5]))
    assert 0.0 < detail_of_files(files, 24) < detail_of_files(files, None)
    files[5].write_text("no photo")
    assert detail_of_files(files, None) == pytest.approx(np.mean([counts[k] for k in (0, 10, 15)]))
    assert detail_of_files([], None) == 0.0


def test_few_photos_are_fitted_with_the_settings_for_few(capture, tmp_path):
    from igsr.fitting.checkpoint import load_checkpoint

    scenes.fit(capture, steps=3, backend="cpu", checkpoint=tmp_path / "a.npz")
    _, settings = load_checkpoint(tmp_path / "a.npz")
    expected = preset_settings("default", support_of(capture.train_views), steps=3)
    del expected["remove_floaters"], expected["backdrop"]  # nothing of them reaches the checkpoint
    expected["depth_weight"] = 0.0  # these photos have no depths
    assert {name: settings[name] for name in expected} == expected


def test_instantsplat_starts_with_all_its_splats_and_moves_the_cameras(capture):
    splats, fitted = scenes.fit_with_cameras(
        capture, preset="instantsplat", steps=60, backend="cpu", max_splats=777
    )
    assert len(splats) == 777
    given, found = (c.train_views[0].camera for c in (capture, fitted))
    assert not np.array_equal(given.viewmat, found.viewmat)
    assert given.K[0, 0] != found.K[0, 0]
    assert len({view.camera.K[0, 0] for view in fitted.train_views}) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"preset": "best"}, "preset must be one of default, 3dgs, instantsplat"),
        ({"dropout": 0.95}, "dropout must be a number from 0 to 0.9"),
        ({"dropout": float("nan")}, "dropout must be a number from 0 to 0.9"),
        ({"dropout": True}, "dropout must be"),
        ({"backdrop": "yes"}, "backdrop must be True or False"),
        ({"start": "sphere"}, "start must be one of auto"),
        ({"start": "points"}, r"^made-up has no 100 points to start from; use another start\.$"),
    ],
)
def test_bad_settings_are_one_sentence(capture, options, message):
    with pytest.raises(igsr.IgsrError, match=message):
        fit(capture, **options)


def test_dropout_changes_the_fit_repeats_and_resumes(capture, tmp_path):
    dropped = fit(capture, dropout=0.3)
    assert np.array_equal(dropped.means, fit(capture, dropout=0.3).means)
    assert not np.array_equal(dropped.means, fit(capture, dropout=0.0).means)
    path = tmp_path / "a.npz"
    fit(capture, dropout=0.3, checkpoint=path, progress=lambda now: now.step < 90)
    resumed = fit(capture, dropout=0.3, checkpoint=path, resume=True)
    assert np.array_equal(dropped.means, resumed.means)


def outside_hull(splats, capture):
    """How many splats a photo shows empty, by more than the pixel that edges are uncertain by."""
    empty = np.zeros(len(splats), dtype=bool)
    for view in capture.train_views:
        alpha = np.pad(view.image[..., 3], 2, mode="edge") > 0
        sides = range(5)
        size = view.image.shape[:2]
        near = np.any(
            [alpha[y : y + size[0], x : x + size[1]] for y in sides for x in sides], axis=0
        )
        world = splats.means.astype(np.float64) + splats.origin
        local = world @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]
        pixel = np.floor(local[:, :2] / local[:, 2:] * view.camera.K[0, 0] + size[0] / 2).astype(
            int
        )
        seen = ((pixel >= 0) & (pixel < size[0])).all(axis=1)
        column, row = np.clip(pixel, 0, size[0] - 1).T
        empty |= seen & ~near[row, column]
    return int(empty.sum())


def test_starts(capture):
    assert chosen_start(capture) == "hull"
    assert chosen_start(scenes.capture(views=4, size=24)) == "sift"
    assert chosen_start(scenes.capture(views=16, size=8)) == "depths"
    for start in ("hull", "rays", "random"):
        splats, made_from = initial_splats(capture, 0, 300, 1, start)
        assert made_from == start
        assert len(splats) == 300
        assert splats.sh_degree == 1
    with pytest.raises(
        igsr.IgsrError, match=r"^made-up has photos without alpha; start hull needs it in all"
    ):
        initial_splats(scenes.capture(views=4, size=24), 0, 300, 1, "hull")
    assert outside_hull(initial_splats(capture, 0, 1000, 0, "hull")[0], capture) == 0
    assert outside_hull(initial_splats(capture, 0, 1000, 0, "random")[0], capture) > 150


def test_a_start_prefers_points_that_photos_agree_on(capture):
    """Of the hull's points those near the surface; any number of photos will do."""
    from igsr.fitting.initialization.visual_hull import color_disagreement

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
    for count in (1, 2, 3):
        few = igsr.Capture(capture.path, capture.train_views[:count])
        splats, _ = initial_splats(few, 0, 300, 0, "hull")
        assert len(splats) == 300
        assert np.isfinite(splats.means).all()


def test_unsure_points_start_faint_and_large(capture):
    from igsr.fitting.initialization.initial_splats import SURE_OPACITY, UNSURE_OPACITY, UNSURE_SIZE

    random = np.random.default_rng(0)
    xyz, rgb = random.normal(size=(200, 3)), np.full((200, 3), 128, dtype=np.uint8)
    confidence = np.exp(random.normal(size=200))

    def start(confidence, max_splats=200):
        points = igsr.Points(xyz, rgb, confidence)
        return initial_splats(igsr.Capture(capture.path, capture.views, points), 0, max_splats, 0)[
            0
        ]

    plain, sure = start(None), start(confidence)
    order = np.argsort(confidence)
    opacity = 1.0 / (1.0 + np.exp(-sure.opacities[order]))
    np.testing.assert_allclose(opacity[[0, -1]], [UNSURE_OPACITY, SURE_OPACITY], rtol=1e-5)
    assert (np.diff(opacity) > 0).all()
    larger = np.exp(sure.scales - plain.scales)[order]
    np.testing.assert_allclose(larger[[0, -1]], [[UNSURE_SIZE] * 3, [1.0] * 3], rtol=1e-5)
    assert (np.diff(larger[:, 0]) < 0).all()
    # The unit does not matter, and what is equal everywhere says nothing.
    assert np.array_equal(start(confidence * 1e9).opacities, sure.opacities)
    for name in ("opacities", "scales"):
        assert np.array_equal(getattr(start(np.full(200, 7.0)), name), getattr(plain, name))
    # Where the cap leaves points out, each keeps its own confidence.
    half = start(confidence, max_splats=100)
    places, own = half.means + half.origin, []
    for place in places:
        own.append(confidence[np.argmin(np.abs(xyz - place).sum(axis=1))])
    assert (np.argsort(own) == np.argsort(half.opacities)).all()


def test_a_photo_that_is_held_out_has_no_part_in_first_splats():
    views = scenes.capture(views=6, size=24).views
    xyz = np.random.default_rng(0).normal(scale=0.3, size=(400, 3))
    points = tracked(views, xyz, miss=0.4)
    points.confidence = np.arange(1.0, 401.0)
    held, tracks = views[5].name, points.tracks
    named = np.array(tracks.names)[tracks.view] != held
    counts = np.bincount(tracks.point[named], minlength=400)
    assert 0 < (counts < 2).sum() < 300, "some points are known of that photo"
    seen = points.seen_by([view.name for view in views[:5]])
    assert np.array_equal(seen.xyz, xyz[counts >= 2])
    assert np.array_equal(seen.confidence, points.confidence[counts >= 2])
    split = [replace(view, split="test" if view.name == held else "train") for view in views]
    splats, made_from = initial_splats(igsr.Capture(Path("a"), split, points), 0, 10_000, 0)
    assert made_from == "points"
    assert len(splats) == (counts >= 2).sum()
    untold = Points(xyz, points.rgb, tracks=Tracks([], *(tracks.view[:0],) * 2, tracks.xy[:0]))
    assert untold.seen_by([]) is untold


def test_settings_that_presets_decide_have_no_default():
    """The command would hand such a default on as if it had been asked for."""
    defaults = {
        one.name
        for one in dataclasses.fields(FitSettings)
        if one.default is not dataclasses.MISSING
    }
    assert defaults == {"seed", "background", "first_step"}


def test_short_fits_take_larger_steps_and_baselines_do_not():
    rates = [settings_for("default", 8, steps=n).learning_rate for n in (10, 7500, 30_000, 90_000)]
    assert rates == [3.0, 2.0, 1.0, 1.0]
    assert settings_for("default", 8).learning_rate == presets.MOST_LEARNING_RATE
    assert settings_for("default", 8, learning_rate=1.5).learning_rate == 1.5
    assert {settings_for(name, 8).learning_rate for name in ("3dgs", "instantsplat")} == {1.0}


@pytest.mark.parametrize("joint", [{"poses": "joint"}, {"focal": "shared"}])
def test_fits_of_cameras_take_more_and_smaller_steps(joint):
    fixed, moving = settings_for("default", 20), settings_for("default", 20, **joint)
    assert (moving.steps, moving.learning_rate) == (2 * fixed.steps, 1.0)
    assert settings_for("default", 20, steps=700, **joint).learning_rate == 1.0
