"""Rounds improve test views, why a refinement stops, arguments."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from capture_files import assert_refused
from refinements import contented, lying, refine, same, truthful, unsure

import igsr
from igsr.cameras import find
from igsr.refinement import refine_photos, rounds
from igsr.refinement.results import Stop, StopReason
from igsr.refinement.selection import MIN_CONFIDENCE, select_views
from igsr.refinement.settings import RefineSettings

SEEDS = range(5)
#: Stages of a refinement's events.
STAGES = {"fit photos", "denoise novel views", "refit with novel views", "score test views"}


def test_rounds_by_a_truthful_denoiser_improve_test_views_on_average(few_photos):
    gains = []
    for seed in SEEDS:
        refined = refine(few_photos, 2, truthful, seed=seed)
        last = refined.rounds[-1]
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


def darker(buffers, photos):
    """A denoiser that darkens the render by a tenth, with full confidence."""
    color = np.clip(buffers.color, 0.0, 1.0)
    return 0.9 * color, np.ones(color.shape[:2], np.float32)


def undefined(buffers, photos):
    """A denoiser that returns NaN."""
    return np.full_like(buffers.color, np.nan), np.ones(buffers.color.shape[:2], np.float32)


@pytest.mark.parametrize("denoiser", [lying, darker, undefined])
def test_no_round_is_done_if_denoising_makes_the_photos_worse(
    few_photos, helped, rendered, tmp_path, denoiser
):
    refined = refine(few_photos, "auto", denoiser, out=tmp_path)
    assert refined.rounds == []
    assert refined.stop == Stop(StopReason.HARMFUL_DENOISER)
    assert refined.splats is refined.first
    assert same(refined.splats, helped[0].first)
    assert rendered == [], "no novel view is rendered"
    page = (tmp_path / "report.html").read_text()
    assert "the denoiser makes renders of the photos much worse" in page
    drawn = json.loads(page.split('id="cameras">')[1].split("</script>")[0])
    assert [kind for kind, _ in drawn] == [0, 0, 0], "photos alone, no novel view"


def test_a_number_of_rounds_is_done_with_any_denoiser(few_photos):
    refined = refine(few_photos, 1, darker, steps=20)
    assert refined.stop == Stop(StopReason.ROUNDS_DONE, 1)


def test_the_denoiser_is_checked_without_the_photo_and_behind_no_mask(few_photos, helped):
    seen = []

    def denoiser(buffers, photos):
        seen.append((buffers.camera, [photo.camera for photo in photos]))
        picture = np.clip(buffers.color, 0.0, 1.0)
        picture[:, :20] = 0.0
        return picture, np.ones(picture.shape[:2], np.float32)

    half = np.ones((40, 40), np.bool_)
    half[:, :20] = False
    views = few_photos.train_views

    def errors(views):
        context = SimpleNamespace(
            backend="cpu",
            background=(1.0, 1.0, 1.0),
            known_background=(1.0, 1.0, 1.0),
            denoiser=denoiser,
            progress=SimpleNamespace(report=lambda stage: None),
        )
        fitted = rounds.Reconstruction(list(views), helped[0].first, helped[0].first)
        return rounds.denoiser_errors(context, fitted)

    before, after = errors(views)
    assert after > 2.0 * before > 0.0
    assert [camera for camera, _ in seen] == [view.camera for view in views]
    for camera, cameras in seen:
        assert cameras == [view.camera for view in views if view.camera is not camera]
    before, after = errors([replace(view, mask=half) for view in views])
    assert before == pytest.approx(after)
    seen.clear()
    before, after = errors(views[:1])
    assert after > before
    assert seen[0][1] == [], "a single photo has no other"
    seen.clear()
    errors([views[k % 3] for k in range(20)])
    assert len(seen) == rounds.CHECKED_VIEWS


@pytest.mark.parametrize(("quality", "count"), [("draft", 1), ("normal", 2), ("high", 4)])
def test_auto_rounds_depend_on_alpha_and_quality(quality, count):
    settings = RefineSettings(quality=quality)
    assert (settings.most_rounds(True), settings.most_rounds(False)) == (count, 1)
    assert RefineSettings(quality=quality, rounds=3).most_rounds(False) == 3


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


def test_pixels_behind_masks_get_no_weight(ball_photos):
    """Photos of one half: novel views have no weight in pixels that only show the hidden half."""
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
        refine(photos, 1, sure, select=select)
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
