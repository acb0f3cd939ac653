"""The loop: rounds that it accepts and others, why it stops, cross-validation, arguments."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from refinements import SEED, contented, lying, refine, same, truthful, unsure

import igsr
from igsr.fitting import fitter, presets
from igsr.fitting.photo_statistics import photo_statistics
from igsr.fitting.presets import settings_for
from igsr.refinement import cross_validation, stages
from igsr.refinement.cross_validation import CrossValidation, combined_error
from igsr.refinement.results import Stop, StopReason
from igsr.refinement.run import RefineRun
from igsr.refinement.selection import select_views

SHIPPED_PHOTO_STEPS = fitter.PHOTO_STEPS


pytestmark = pytest.mark.usefixtures("small_fits")


def test_rounds_that_help_are_accepted_and_make_views_better(helped):
    refined, _, seen = helped
    assert [one.accepted for one in refined.rounds] == [True, True]
    assert refined.stop == Stop(StopReason.ROUNDS_DONE, 2)
    first = refined.rounds[0]
    for name, sign in (("psnr", 1), ("ssim", 1), ("flip", -1)):
        assert sign * first.validation_after[name] > sign * first.validation_before[name]
    for one in refined.rounds:  # a second round may lose a little of one score for another's gain
        assert combined_error(one.validation_after) < combined_error(one.validation_before)
        assert 0 < len(one.selected) <= len(one.selected) + len(one.rejected) <= stages.CANDIDATES
    psnr = [refined.first_test["psnr"], *(one.test["psnr"] for one in refined.rounds)]
    # On three photos, a second round's own gain is chance (seeds 0 to 7: -0.3 to +0.5 dB, 0.0 in
    # the mean); what rounds give over none is not.
    assert psnr[0] + 0.1 < psnr[1]
    assert psnr[0] + 0.1 < psnr[2]
    done = [now.done for now in seen]
    assert done == sorted(done)
    assert done[-1] <= 1.0
    assert {now.stage for now in seen} == {"fit", "novel_views", "cross_validate", "refit", "test"}


def test_a_round_helps_with_as_many_steps_on_photos_as_igsr_has(ball_photos, helped, monkeypatch):
    monkeypatch.setattr(fitter, "PHOTO_STEPS", SHIPPED_PHOTO_STEPS)
    gains = []
    for seed in (SEED, SEED + 1, SEED + 2):
        refined = refine(ball_photos, 1, truthful, seed=seed)
        assert same(refined.first, helped[0].first) is (seed == SEED)
        (one,) = refined.rounds
        assert not same(refined.splats, helped[0].rounds[0].splats)
        # None of a round that is not accepted.
        gains.append(one.test["psnr"] - refined.first_test["psnr"] if one.accepted else 0.0)
    # On three photos a round gives 0.0 to 0.7 dB by the seed; seeds 0 to 7: one of none, 0.3 in the
    # mean.
    assert sum(gain != 0.0 for gain in gains) >= 2
    assert np.mean(gains) > 0.1


def test_a_round_that_does_not_help_is_not_accepted(ball_photos, helped, tmp_path):
    refined = refine(ball_photos, "auto", lying, out=tmp_path)
    assert [one.accepted for one in refined.rounds] == [False]
    assert refined.stop == Stop(StopReason.NOT_ACCEPTED, 1)
    assert refined.splats is refined.first
    assert same(refined.splats, helped[0].first)
    assert refined.rounds[0].splats is refined.rounds[0].test is None
    page = (tmp_path / "report.html").read_text()
    drawn = json.loads(page.split('id="cameras">')[1].split("</script>")[0])
    kinds = [kind for kind, _ in drawn]
    assert (kinds.count(0), kinds.count(1), kinds.count(2)) == (9, 0, 0)


def test_a_round_that_is_not_accepted_renders_nothing_of_the_whole_fit(ball_photos, rendered):
    """It costs what its folds cost."""
    assert refine(ball_photos, 1, lying, steps=40).stop == Stop(StopReason.NOT_ACCEPTED, 1)
    assert [one.name for one in rendered] == ["fold0", "fold1", "fold2"]


def test_nothing_is_fitted_twice_where_there_is_nothing_to_add(ball_photos, helped, monkeypatch):
    monkeypatch.setattr(stages.Stages, "refit", lambda *_: pytest.fail("it is fitted again"))
    refined = refine(ball_photos, "auto", unsure)
    assert not refined.rounds
    assert refined.stop == Stop(StopReason.NONE_SELECTED, len(refined.rejected))
    assert same(refined.splats, helped[0].first)
    content = refine(ball_photos, "auto", contented)
    assert not content.rounds
    assert content.stop.reason is StopReason.NONE_SELECTED
    assert len(content.rejected) > 5
    assert all(one.gain == 0.0 for one in content.rejected)
    none = refine(ball_photos, 0, truthful)
    assert none.stop == Stop(StopReason.ROUNDS_DONE, 0)
    assert same(none.splats, helped[0].first)
    two = igsr.Capture(ball_photos.path, ball_photos.train_views[:2])
    assert refine(two, 1, truthful).stop == Stop(StopReason.TOO_FEW_PHOTOS, 3)


def test_one_panorama_is_too_few_to_hold_any_out(ball_photos):
    """Its views are held out together."""
    of_one = [replace(view, rig="panorama.jpg") for view in ball_photos.train_views]
    refined = refine(igsr.Capture(ball_photos.path, of_one), 1, truthful, steps=40)
    assert refined.stop == Stop(StopReason.TOO_FEW_PHOTOS, 3)


def test_folds_are_fitted_as_all_photos_are(ball_photos, monkeypatch):
    """The folds have fewer photos, further apart, but are fitted with the settings for all."""
    photos = ball_photos.train_views
    assert len(photos) == 9
    monkeypatch.setattr(presets, "WIDE_APART", photo_statistics(photos).apart + 0.1)
    monkeypatch.setattr(presets, "SH2_PHOTOS", photo_statistics(photos).seen_by)
    monkeypatch.setattr(presets, "MOST_DROPOUT", 0.9)
    dropout = settings_for("default", photo_statistics(photos)).dropout
    assert settings_for("default", photo_statistics(photos[::2])).dropout != dropout
    settings = []
    real = stages.fit_with_cameras

    def watched(made, **given):
        settings.append((len(made.views), given["density"], given["sh_degree"], given["dropout"]))
        return real(made, **given)

    monkeypatch.setattr(stages, "fit_with_cameras", watched)
    refine(ball_photos, 1, lying, steps=40)
    assert [photos for photos, *_ in settings][:3] == [9, 7, 8]
    assert {tuple(some) for _, *some in settings} == {("original", 2, dropout)}


def test_what_masks_hide_has_no_weight(ball_photos):
    """Photos of one half alone: what only the other half would have shown has no weight."""
    half = np.zeros((40, 40), np.bool_)
    half[:, :20] = True
    views = [replace(view, mask=half) for view in ball_photos.train_views]
    confidences = []
    real = select_views

    def select(found, count):
        confidences.append([one.confidence for one in found])
        return real(found, count)

    def sure(buffers, photos):
        return truthful(buffers, photos)[0], np.full(buffers.color.shape[:2], 1.0, np.float32)

    given = {"cross_validate": False, "select": select}
    refine(igsr.Capture(ball_photos.path, views), 1, sure, **given)
    refine(igsr.Capture(ball_photos.path, ball_photos.train_views), 1, sure, **given)
    masked, whole = (np.stack(some) for some in confidences)
    assert (whole == whole.max()).all(), "without masks what the denoiser says counts"
    assert masked.min() == 0.0
    assert 0.1 < (masked > 0.5).mean() < 0.9


@pytest.mark.parametrize(
    ("rounds", "options", "message"),
    [
        ("many", {}, 'rounds must be a whole number or "auto"'),
        (-1, {}, "rounds must not be negative"),
        (True, {}, "rounds must be a whole number"),
        (1, {"resume": True}, "resume needs out"),
        (1, {"backend": "reference"}, "backend must be one of auto, cpu, gpu, not 'reference'"),
        (1, {"steps": 0}, "steps must be from 1 to 10000000, not 0"),
        (1, {"steps": 20_000_000}, "steps must be from 1 to 10000000, not 20000000"),
        (1, {"steps": 2.9}, "steps must be a whole number, not 2.9"),
        (1, {"steps": "many"}, "steps must be"),
        (1, {"seed": -1}, "seed must be from 0 to"),
    ],
)
def test_bad_arguments(ball_photos, rounds, options, message, monkeypatch, tmp_path):
    earlier = tmp_path / "checkpoints/whole.npz"
    earlier.parent.mkdir()
    earlier.write_bytes(b"of an earlier run")
    given = options if "resume" in options else {**options, "out": tmp_path}
    with pytest.raises(igsr.IgsrError, match=message):
        refine(ball_photos, rounds, truthful, **given)
    assert earlier.is_file()
    searched = lambda *_: pytest.fail("cameras are looked for")  # noqa: E731
    monkeypatch.setattr(RefineRun, "find_cameras", searched)
    with pytest.raises(igsr.IgsrError, match=message):
        refine("a folder", rounds, truthful, **options)


def test_photos_that_cannot_be_fitted_or_scored_are_told_before_anything_is_done(
    ball_photos, monkeypatch, tmp_path
):
    monkeypatch.setattr(stages, "fit_with_cameras", lambda *_, **__: pytest.fail("it is fitted"))
    earlier = tmp_path / "checkpoints/whole.npz"
    earlier.parent.mkdir()
    earlier.write_bytes(b"of an earlier run")
    nothing = np.zeros((40, 40), np.bool_)
    for split, message in (("train", "no pixel to fit"), ("test", "no pixel to score")):
        views = [replace(v, mask=nothing) if v.split == split else v for v in ball_photos.views]
        with pytest.raises(igsr.IgsrError, match=message):
            refine(igsr.Capture(ball_photos.path, views), 1, truthful, out=tmp_path)
    assert earlier.is_file()


@pytest.mark.parametrize("count", [3, 4, 6, 9])
def test_each_fold_holds_out_photos_that_no_other_does(ball_photos, count, monkeypatch):
    fewer = igsr.Capture(ball_photos.path, ball_photos.train_views[:count])
    held_out = []
    real = CrossValidation._fitted

    def watched(validation):
        folds = real(validation)
        held_out.extend([view.name for view in fold.held_out] for fold in folds)
        photos = [len(fold.held_out) + len(fold.reconstruction.photos) for fold in folds]
        assert photos == 3 * [count]
        return folds

    monkeypatch.setattr(CrossValidation, "_fitted", watched)
    refine(fewer, 1, lying, steps=40)
    assert len(held_out) == 3
    assert all(held_out)
    names = [name for of_fold in held_out for name in of_fold]
    assert len(set(names)) == len(names)


def test_folds_of_smaller_photos_have_as_many_splats_per_pixel(ball_photos, monkeypatch):
    monkeypatch.setattr(cross_validation, "LEAST_FOLD_SIDE", 16)
    counts = []
    real = CrossValidation._fitted

    def watched(validation):
        folds = real(validation)
        counts.extend(len(fold.reconstruction.splats) for fold in folds)
        return folds

    monkeypatch.setattr(CrossValidation, "_fitted", watched)
    whole, folds = len(refine(ball_photos, 1, lying, steps=400).first), counts
    assert len(folds) == 3
    assert 250 < whole <= 1000
    assert all(0 < fold <= 250 for fold in folds)


@pytest.mark.parametrize(
    ("side", "small", "steps"), [(127, 127, 1.0), (129, 64, 1.0), (256, 64, 0.5), (800, 200, 0.5)]
)
def test_folds_fit_photos_that_are_halved_at_most_twice(side, small, steps):
    image = np.zeros((side, 2 * side, 3), np.uint8)
    K = np.array([[side, 0.0, side], [0.0, side, side / 2], [0.0, 0.0, 1.0]])
    camera = igsr.Camera(np.eye(4), K, 2 * side, side)
    photos = [igsr.View(f"{k}.png", camera, "train", image) for k in range(3)]
    made, share, part = cross_validation._fold_photos(photos)
    assert {photo.camera.height for photo in made} == {small}
    assert share == pytest.approx((small / side) ** 2, rel=0.02)
    assert part == steps


def test_a_round_is_validated_by_three_errors_together():
    def error(psnr, ssim, flip):
        return combined_error({"psnr": psnr, "ssim": ssim, "flip": flip})

    assert error(20.0, 0.9, 0.1) == pytest.approx(0.1)
    before = error(26.755, 0.9279, 0.0780)
    assert error(26.850, 0.9297, 0.0782) < before, "a little more FLIP does not outweigh the rest"
    assert error(26.750, 0.9279, 0.0780) > before
    assert error(26.755, 0.9278, 0.0780) > before
    assert error(26.755, 0.9279, 0.0781) > before
