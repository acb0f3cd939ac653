"""Rounds improve test views, why a refinement stops, arguments."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from capture_files import assert_refused
from refinements import contented, lying, refine, same, truthful, unsure

import igsr
from igsr.cameras import find
from igsr.refinement import refine_photos, rounds
from igsr.refinement.results import Stop, StopReason
from igsr.refinement.selection import MIN_CONFIDENCE, select_views

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


def darker(buffers, photos):
    """A denoiser that darkens the render by a tenth, with full confidence."""
    color = np.clip(buffers.color, 0.0, 1.0)
    return 0.9 * color, np.ones(color.shape[:2], np.float32)


@pytest.mark.parametrize("denoiser", [lying, darker])
def test_no_round_is_done_if_denoising_makes_the_photos_worse(
    few_photos, helped, rendered, tmp_path, denoiser
):
    refined = refine(few_photos, "auto", denoiser, out=tmp_path)
    assert refined.rounds == []
    assert refined.stop.reason is StopReason.HARMFUL_DENOISER
    assert refined.stop.count > 100.0 * refine_photos.MAX_ERROR_INCREASE
    assert refined.splats is refined.first
    assert same(refined.splats, helped[0].first)
    assert rendered == [], "no novel view is rendered"
    page = (tmp_path / "report.html").read_text()
    assert f"raises their RMSE by {refined.stop.count} %" in page
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
