"""Rounds that are accepted or not, why a refinement stops, cross-validation, arguments."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from capture_files import assert_refused
from made_up_tracks import projected, tracked
from refinements import contented, lying, refine, same, truthful, unsure

import igsr
from igsr.cameras import find
from igsr.fitting import presets
from igsr.fitting.photo_statistics import photo_statistics
from igsr.fitting.presets import settings_for
from igsr.refinement import cross_validation, refine_photos, rounds
from igsr.refinement.cross_validation import combined_error, fold_photos
from igsr.refinement.results import Stop, StopReason
from igsr.refinement.selection import MIN_CONFIDENCE, select_views

SEEDS = range(5)
#: Stages of a refinement's events.
STAGES = {"fit photos", "cross-validate", "denoise novel views"}
STAGES |= {"refit with novel views", "score test views"}


@pytest.fixture(scope="module")
def by_truth(few_photos):
    """Refinements by a truthful denoiser, with several seeds."""
    return [refine(few_photos, 2, truthful, seed=seed) for seed in SEEDS]


def test_a_round_is_accepted_if_and_only_if_the_combined_error_falls(by_truth, few_photos):
    by_lies = [refine(few_photos, 1, lying, seed=seed) for seed in SEEDS]
    for done in (done for refined in (*by_truth, *by_lies) for done in refined.rounds):
        before, after = map(combined_error, (done.validation_before, done.validation_after))
        assert done.accepted == (after < before)
        assert (done.splats is not None) == (done.test is not None) == done.accepted
        assert bool(done.selected) == done.accepted
    assert all(refined.rounds[0].accepted for refined in by_truth)
    assert not any(done.accepted for refined in by_lies for done in refined.rounds)


def test_rounds_by_a_truthful_denoiser_improve_test_views_on_average(by_truth):
    gains = []
    for refined in by_truth:
        last = [done for done in refined.rounds if done.accepted][-1]
        gains.append(last.test["psnr"] - refined.first_test["psnr"])
        assert same(refined.splats, last.splats)
    assert np.mean(gains) > 0.1, gains


def test_events_cover_all_stages_and_count_up_to_the_end(helped):
    refined, _, events = helped
    assert refined.stop == Stop(StopReason.ROUNDS_DONE, 2)
    for done in refined.rounds:
        assert done.selected
        assert len(done.selected) + len(done.rejected) <= rounds.CANDIDATES
    stages = [event for event in events if event.path is None]
    assert {event.stage for event in stages} == STAGES
    parts = [event.part for event in stages]
    assert parts == sorted(parts)
    assert 0.9 < parts[-1] <= 1.0
    assert [event.values["round"] for event in stages][-1] == 2


def test_after_a_rejected_round_the_first_fit_remains(few_photos, helped, rendered, tmp_path):
    refined = refine(few_photos, "auto", lying, out=tmp_path)
    assert [done.accepted for done in refined.rounds] == [False]
    assert refined.stop == Stop(StopReason.NOT_ACCEPTED, 1)
    assert refined.splats is refined.first
    assert same(refined.splats, helped[0].first)
    # The whole fit renders nothing: a rejected round costs what its folds cost.
    assert [fitted.name for fitted in rendered] == ["fold0", "fold1", "fold2"]
    page = (tmp_path / "report.html").read_text()
    drawn = json.loads(page.split('id="cameras">')[1].split("</script>")[0])
    assert [kind for kind, _ in drawn] == [0, 0, 0], "photos alone, no novel view"


def test_without_a_selected_view_nothing_is_fitted_again(few_photos, helped, monkeypatch):
    for module in (rounds, refine_photos):
        monkeypatch.setattr(module, "refit", lambda *_: pytest.fail("it was fitted again"))
    doubted, unchanged = (refine(few_photos, "auto", denoiser) for denoiser in (unsure, contented))
    assert all(view.mean_confidence < MIN_CONFIDENCE for view in doubted.rejected)
    assert all(view.gain == 0.0 for view in unchanged.rejected)
    for refined in (doubted, unchanged):
        assert refined.rounds == []
        assert refined.stop == Stop(StopReason.NONE_SELECTED, len(refined.rejected))
        assert len(refined.rejected) > 5
        assert same(refined.splats, helped[0].first)
    none = refine(few_photos, 0, truthful)
    assert none.stop == Stop(StopReason.ROUNDS_DONE, 0)
    assert same(none.splats, helped[0].first)


def test_views_of_one_panorama_are_held_out_together_and_count_as_one_photo(ball_photos):
    panorama = [replace(view, rig="panorama.jpg") for view in ball_photos.train_views]
    for views in (ball_photos.train_views[:2], panorama):
        refined = refine(igsr.Capture(ball_photos.path, views), 1, truthful, steps=40)
        assert refined.stop == Stop(StopReason.TOO_FEW_PHOTOS, 3)


def watch(monkeypatch, name, listener):
    """Tell the listener the result and the arguments of each call of a function of ``rounds``."""
    function = getattr(rounds, name)

    def watched(*given, **options):
        result = function(*given, **options)
        listener(result, *given, **options)
        return result

    monkeypatch.setattr(rounds, name, watched)


def test_folds_are_fitted_with_the_settings_for_all_photos(ball_photos, monkeypatch):
    photos = ball_photos.train_views
    measured = photo_statistics(photos)
    monkeypatch.setattr(presets, "MCMC_SPACING_DEG", measured.spacing_deg + 0.1)
    monkeypatch.setattr(presets, "SH2_PHOTOS", measured.overlap)
    monkeypatch.setattr(presets, "MAX_DROPOUT", 0.9)
    dropout = settings_for(measured).dropout
    assert settings_for(photo_statistics(photos[::2])).dropout != dropout
    fits = []

    def seen(_, capture, **given):
        fits.append((len(capture.views), given["density"], given["sh_degree"], given["dropout"]))

    watch(monkeypatch, "fit_capture", seen)
    refine(ball_photos, 1, lying, steps=40)
    assert [count for count, *_ in fits][:4] == [9, 7, 8, 8]
    assert {tuple(settings) for _, *settings in fits} == {("original", 2, dropout)}


def test_tracks_are_in_pixels_of_the_halved_photos(ball_photos, monkeypatch):
    monkeypatch.setattr(cross_validation, "MIN_FOLD_SIDE_PX", 10)
    xyz = np.random.default_rng(0).uniform(-0.4, 0.4, (30, 3))
    photos = replace(ball_photos, points=tracked(ball_photos.views, xyz))
    sizes = set()

    def seen(_, capture, **given):
        tracks = capture.points.tracks
        for view in capture.views:
            if view.name in tracks.names:
                shown = tracks.view == tracks.names.index(view.name)
                at = projected(view.camera, xyz[tracks.point[shown]])
                assert np.abs(tracks.xy[shown] - at).max() < 1e-9
                sizes.add(view.camera.width)

    watch(monkeypatch, "fit_capture", seen)
    refine(photos, 1, lying, steps=10)
    assert sizes == {40, 10}


def test_pixels_behind_masks_get_no_weight(ball_photos):
    """Photos of one half: novel views have no weight where only the other half would show."""
    half = np.zeros((40, 40), np.bool_)
    half[:, :20] = True
    masked = [replace(view, mask=half) for view in ball_photos.train_views]

    def sure(buffers, photos):
        return truthful(buffers, photos)[0], np.full(buffers.color.shape[:2], 1.0, np.float32)

    def confidence(views):
        seen = []

        def select(found, count):
            seen.extend(candidate.confidence for candidate in found)
            return select_views(found, count)

        photos = igsr.Capture(ball_photos.path, views)
        refine(photos, 1, sure, cross_validate=False, select=select)
        return np.stack(seen)

    whole, some = confidence(ball_photos.train_views), confidence(masked)
    assert (whole == whole.max()).all(), "without masks, the denoiser's confidence counts"
    assert some.min() == 0.0
    assert 0.1 < (some > 0.5).mean() < 0.9


@pytest.fixture
def earlier(tmp_path):
    """A checkpoint of an earlier run in the same folder."""
    path = tmp_path / "checkpoints/whole.npz"
    path.parent.mkdir()
    path.write_bytes(b"of an earlier run")
    return path


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rounds": "many"}, 'rounds must be a whole number or "auto"'),
        ({"rounds": -1}, "rounds must not be negative"),
        ({"rounds": True}, "rounds must be a whole number"),
        ({"resume": True, "out": None}, "resume needs out"),
        ({"backend": "reference"}, "backend must be one of auto, cpu, gpu, not 'reference'"),
        ({"steps": 0}, "steps must be from 1 to 10000000, not 0"),
        ({"steps": 20_000_000}, "steps must be from 1 to 10000000, not 20000000"),
        ({"steps": 2.9}, "steps must be a whole number, not 2.9"),
        ({"steps": "many"}, "steps must be"),
        ({"seed": -1}, "seed must be from 0 to"),
    ],
)
def test_bad_arguments(few_photos, options, message, monkeypatch, earlier):
    given = {"rounds": 1, "denoiser": truthful, "out": earlier.parents[1], **options}
    monkeypatch.setattr(find, "estimated_cameras", lambda *_: pytest.fail("cameras were sought"))
    for photos in (few_photos, "a folder"):
        assert_refused(message, refine, photos, **given)
    assert earlier.is_file()


@pytest.mark.parametrize(
    ("split", "message"), [("train", "no pixel to fit"), ("test", "no pixel to score")]
)
def test_unusable_photos_end_it_before_files_are_removed(
    few_photos, split, message, monkeypatch, earlier
):
    monkeypatch.setattr(rounds, "fit_capture", lambda *_, **__: pytest.fail("it was fitted"))
    nothing = np.zeros((40, 40), np.bool_)
    views = [replace(v, mask=nothing) if v.split == split else v for v in few_photos.views]
    photos = igsr.Capture(few_photos.path, views)
    assert_refused(message, refine, photos, 1, truthful, out=earlier.parents[1])
    assert earlier.is_file()


@pytest.mark.parametrize("count", [3, 4, 6, 9])
def test_no_photo_is_held_out_by_two_folds(ball_photos, count, monkeypatch):
    names = {view.name for view in ball_photos.train_views[:count]}
    held_out = []

    def seen(_, context, fold, photos, *rest):
        held_out.append(names - {photo.name for photo in photos})

    watch(monkeypatch, "fit_photos", seen)
    fewer = igsr.Capture(ball_photos.path, ball_photos.train_views[:count])
    (done,) = refine(fewer, 1, lying, steps=40).rounds
    assert len(held_out) == 3
    assert all(held_out)
    reported = [view.name for view in done.held_out]
    assert len(reported) == len(set(reported)) == sum(map(len, held_out))
    assert set(reported) == set.union(*held_out)


def test_folds_of_smaller_photos_have_as_many_splats_per_pixel(ball_photos, monkeypatch):
    monkeypatch.setattr(cross_validation, "MIN_FOLD_SIDE_PX", 16)
    counts = []
    watch(monkeypatch, "fit_photos", lambda fitted, *_: counts.append(len(fitted.splats)))
    refined = refine(ball_photos, 1, lying, steps=400)
    assert len(counts) == 3
    assert 250 < len(refined.first) <= 1000
    assert all(0 < count <= 250 for count in counts)


@pytest.mark.parametrize(
    ("side", "small", "steps"), [(127, 127, 1.0), (129, 64, 1.0), (256, 64, 0.5), (800, 200, 0.5)]
)
def test_folds_fit_photos_that_are_halved_at_most_twice(side, small, steps):
    image = np.zeros((side, 2 * side, 3), np.uint8)
    K = np.array([[side, 0.0, side], [0.0, side, side / 2], [0.0, 0.0, 1.0]])
    camera = igsr.Camera(np.eye(4), K, 2 * side, side)
    folds = fold_photos([igsr.View(f"{k}.png", camera, "train", image) for k in range(3)])
    assert {photo.camera.height for photo in folds.photos} == {small}
    assert folds.share == pytest.approx((small / side) ** 2, rel=0.02)
    assert folds.steps == steps


def test_three_scores_together_decide_about_a_round():
    def error(*scores):
        return combined_error(dict(zip(("psnr", "ssim", "flip"), scores, strict=True)))

    assert error(20.0, 0.9, 0.1) == pytest.approx(0.1)
    before = error(26.755, 0.9279, 0.0780)
    assert error(26.850, 0.9297, 0.0782) < before, "a little more FLIP does not outweigh the rest"
    for worse in ((26.750, 0.9279, 0.0780), (26.755, 0.9278, 0.0780), (26.755, 0.9279, 0.0781)):
        assert error(*worse) > before
