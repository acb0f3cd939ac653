"""What a refinement writes, and that it can be resumed from there."""

from __future__ import annotations

import json
import os
import shutil

import numpy as np
import pytest
import scenes
from PIL import Image
from refinements import refine, same, truthful, unsure

import igsr
from igsr.fitting import followed_run
from igsr.pose import registry
from igsr.pose.estimate import Estimate
from igsr.refinement.report import seconds_so_far
from igsr.refinement.results import StopReason

pytestmark = pytest.mark.usefixtures("small_fits")


def test_everything_it_did_is_in_its_folder(helped):
    refined, out, _ = helped
    assert same(igsr.Splats.load(out / "scene.ply"), refined.splats)
    assert same(igsr.Splats.load(out / "rounds/0/scene.ply"), refined.first)
    assert same(igsr.Splats.load(out / "rounds/1/scene.ply"), refined.rounds[0].splats)
    one = refined.rounds[1].selected[0]
    assert np.array_equal(np.asarray(Image.open(out / "rounds/2/view-0.after.png")), one.denoised)
    weights = np.asarray(Image.open(out / "rounds/2/view-0.confidence.png"))
    assert np.abs(weights / 255.0 - one.confidence).max() < 0.003
    cameras = json.loads((out / "cameras.json").read_text())["frames"]
    assert len(cameras) == len(refined.capture.train_views)
    report = json.loads((out / "report.json").read_text())
    assert report["format"] == 2
    assert report["stopped"] == str(refined.stop)
    assert report["stop_reason"] == "rounds_done"
    assert report["rounds"][2]["cross_validation"]["after"] == refined.rounds[1].validation_after
    assert report["rounds"][2]["test"]["psnr"] == refined.rounds[1].test["psnr"]
    assert set(report["seconds"]) == {"fit", "novel_views", "cross_validate", "refit", "test"}
    assert set(report["parts"]) == set(report["seconds"])
    assert report["peak_memory_bytes"] == max(
        part["peak_memory_bytes"] for part in report["parts"].values()
    )
    assert report["train"]["views"] == report["train"]["of"] == 9
    assert report["test"] == report["rounds"][2]["test"]
    page = (out / "report.html").read_text()
    assert report["limit"]["sentence"] in page
    assert f"Why it ended:</b> {refined.stop}." in page
    assert "Round 2: accepted" in page
    beside = 3 * len(refined.capture.test_views)
    # Three pictures of each added view, and of each held-out photo of a round.
    in_rounds = sum(len(one.selected) + len(one.held_out) for one in refined.rounds)
    assert all(len(one.held_out) > 0 for one in refined.rounds)
    assert page.count("data:image/jpeg;base64,") == 9 + beside + 3 * in_rounds
    assert "://" not in page, "the page needs nothing from elsewhere"
    # Photo, before and after of three test views; after is nearer to the photo.
    sheet = np.asarray(Image.open(out / "views.png"), np.float32)
    views = len(refined.capture.test_views)
    assert views == 3
    width, height = 190 + 6, (sheet.shape[0] - 12) // views
    photo, before, after = (
        np.stack(
            [
                sheet[12 + v * height + 24 : 12 + v * height + 64, 12 + k * width :][:, :40]
                for v in range(views)
            ]
        )
        for k in range(3)
    )
    assert np.abs(photo - after).mean() < np.abs(photo - before).mean()


@pytest.mark.parametrize(
    "moment",
    [
        (0, "fit"),
        *(
            pytest.param(moment, marks=pytest.mark.long)
            for moment in (
                (1, "novel_views"),
                (1, "fit"),
                (1, "cross_validate"),
                (2, "novel_views"),
            )
        ),
        (1, "refit"),
        (2, "refit"),
    ],
)
def test_stopped_at_any_moment_and_resumed_it_ends_the_same(ball_photos, helped, tmp_path, moment):
    def stop(now):
        return (now.round, now.stage) != moment

    with pytest.raises(igsr.IgsrError, match="was stopped; go on with resume"):
        refine(ball_photos, 2, truthful, out=tmp_path, progress=stop)
    refined = refine(ball_photos, 2, truthful, out=tmp_path, resume=True)
    assert same(refined.splats, helped[0].splats)
    for done, wanted in zip(refined.rounds, helped[0].rounds, strict=True):
        assert done.validation_after == wanted.validation_after


@pytest.mark.parametrize(
    "renames",
    [pytest.param(2, marks=pytest.mark.long), 12, pytest.param(40, marks=pytest.mark.long)],
)
def test_killed_between_two_files_and_resumed_it_ends_the_same(
    ball_photos, helped, tmp_path, renames, monkeypatch
):
    left, real = [renames], os.replace

    def killed(*paths):
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt
        real(*paths)

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        refine(ball_photos, 2, truthful, out=tmp_path)
    monkeypatch.setattr(os, "replace", real)
    left_behind = tmp_path / "checkpoints/.whole-1.unfinished.npz"
    left_behind.write_bytes(b"by a process that was killed")
    assert same(
        refine(ball_photos, 2, truthful, out=tmp_path, resume=True).splats, helped[0].splats
    )
    files = {path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file()}
    assert files == {p.relative_to(helped[1]) for p in helped[1].rglob("*") if p.is_file()}


def test_what_lies_there_stays_until_resuming_has_more(ball_photos, helped, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(helped[1], out)

    def contents():
        files = (path for path in out.rglob("*") if path.is_file())
        return {path: path.read_bytes() for path in files}

    before = contents()
    with pytest.raises(igsr.IgsrError, match="was made from other photos"):
        refine(ball_photos, 2, lambda *given: (truthful(*given)[0] * 0.99, truthful(*given)[1]),
               out=out, resume=True)  # fmt: skip
    with pytest.raises(igsr.IgsrError, match="was stopped"):
        refine(ball_photos, 2, truthful, out=out, resume=True, progress=lambda now: now.round < 2)
    assert contents() == before
    seconds = json.loads((out / "report.json").read_text())["seconds"]
    refine(ball_photos, 2, truthful, out=out, resume=True)
    resumed = json.loads((out / "report.json").read_text())["seconds"]
    assert resumed["fit"] >= seconds["fit"] > 0.0, "what was done before took time too"
    after = contents()
    for name in ("scene.ply", "rounds/2/scene.ply", "rounds/2/view-0.after.png"):
        assert after[out / name] == before[out / name]


def test_without_resume_nothing_of_an_earlier_run_is_in_the_way(ball_photos, tmp_path):
    out = tmp_path / "out"
    refine(ball_photos, 1, truthful, out=out, steps=40, cross_validate=False)
    others = out / "checkpoints/of-my-own.npz"
    others.write_bytes(b"mine")

    def stop(now):
        return now.stage != "novel_views"

    with pytest.raises(igsr.IgsrError, match="was stopped"):
        refine(ball_photos, 1, truthful, out=out, steps=60, cross_validate=False, progress=stop)
    assert not (out / "checkpoints/whole-round1.npz").exists()
    assert "refit" not in seconds_so_far(out), "those of the earlier run are not gone on from"
    assert others.read_bytes() == b"mine"
    resumed = refine(ball_photos, 1, truthful, out=out, steps=60, cross_validate=False, resume=True)
    assert len(resumed.rounds) == 1


def test_pictures_are_there_where_no_round_was_accepted(ball_photos, tmp_path):
    alone = igsr.Capture(ball_photos.path, ball_photos.train_views)
    for name, photos in (("held", ball_photos), ("all", alone)):
        out = tmp_path / name
        refined = refine(photos, 1, unsure, out=out, steps=20, cross_validate=False)
        assert not refined.rounds
        report = json.loads((out / "report.json").read_text())
        assert report["limit"]["sentence"] in (out / "report.html").read_text()
        assert (report["limit"]["held_out_gap"] is None) == (name == "all")
        shown = 3 * len(photos.test_views or photos.train_views[:8])
        photos_of_page = len(photos.train_views)
        page = (out / "report.html").read_text()
        assert page.count("data:image/jpeg;base64,") == shown + photos_of_page
        sheet = np.asarray(Image.open(out / "views.png"))
        assert sheet.shape[0] > 40


def test_a_fit_that_is_stopped_is_saved(ball_photos, tmp_path):
    def stop(now):
        return now.done == 0.0

    with pytest.raises(igsr.IgsrError, match="was stopped"):
        refine(ball_photos, 0, truthful, out=tmp_path, steps=400, progress=stop)
    assert (tmp_path / "checkpoints/whole.npz").is_file()


def test_a_folder_that_cannot_be_written_is_one_error_message(ball_photos, tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(igsr.IgsrError, match="out"):
        refine(ball_photos, 0, truthful, out=tmp_path / "out")


def test_on_a_full_disk_what_is_done_stays_and_it_goes_on_from_there(
    ball_photos, helped, tmp_path, monkeypatch
):
    save = Image.Image.save

    def full(image, file, **options):
        if options["format"] == "PNG":
            raise OSError(28, "No space left on device")
        save(image, file, **options)

    monkeypatch.setattr(Image.Image, "save", full)
    with pytest.raises(igsr.IgsrError, match=r"Cannot write .*png: No space left on device"):
        refine(ball_photos, 2, truthful, out=tmp_path)
    assert same(igsr.Splats.load(tmp_path / "rounds/0/scene.ply"), helped[0].first)
    monkeypatch.setattr(Image.Image, "save", save)
    assert same(
        refine(ball_photos, 2, truthful, out=tmp_path, resume=True).splats, helped[0].splats
    )


def test_photos_that_lie_where_cameras_would_be_kept_stay(tmp_path):
    photo = tmp_path / "capture" / "0.png"
    photo.parent.mkdir()
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(photo)
    with pytest.raises(igsr.IgsrError, match="lies where the fit would write"):
        igsr.refine(tmp_path / "capture", out=tmp_path, backend="cpu", denoiser=unsure)
    assert photo.is_file()


def test_seconds_that_a_report_cannot_have_are_not_gone_on_from(tmp_path):
    (tmp_path / "report.json").write_text(
        '{"seconds": {"fit": NaN, "novel_views": 2.5, "cross_validate": 1e999}}'
    )
    assert seconds_so_far(tmp_path) == {"novel_views": 2.5}
    for text in (
        '{"seconds": {"fit": "long"}}',
        '{"seconds": {"fit": -50}}',
        f'{{"seconds": {{"fit": 1{"0" * 400}}}}}',
        "[" * 100_000,
    ):
        (tmp_path / "report.json").write_text(text)
        assert seconds_so_far(tmp_path) == {}


def test_photos_that_cannot_be_registered_are_named(tmp_path, monkeypatch):
    made = scenes.capture(views=8, size=40)
    for view in made.views:
        path = tmp_path / "photos" / f"{view.name[-6:-4]}.png"
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(view.image).save(path)

    def every_other(photos, *, seed=0, progress=None):
        progress("matching", 1, 2)
        cameras = [v.camera if k % 2 else None for k, v in enumerate(made.views)]
        nothing = [None] * len(photos)
        return Estimate(cameras, None, nothing, nothing, ["4 of 8 photos could not be placed."])

    known = registry.Entry(lambda: every_other, lambda options: True)
    for name in registry.ESTIMATORS:
        monkeypatch.setitem(registry.ESTIMATORS, name, known)
    with pytest.warns(UserWarning, match="4 of 8 photos could not be placed"):
        refined = igsr.refine(tmp_path / "photos", 1, steps=40, backend="cpu", denoiser=unsure)
    assert len(refined.capture.train_views) == 4
    assert refined.stop.reason is StopReason.NONE_SELECTED

    given = {"steps": 40, "backend": "cpu", "denoiser": unsure, "out": tmp_path / "out"}
    with pytest.raises(igsr.IgsrError, match="was stopped"):
        igsr.refine(tmp_path / "photos", 1, lambda now: now.stage != "pose", **given)
    own = tmp_path / "out/capture/of-my-own.txt"
    own.parent.mkdir(parents=True)
    own.write_text("mine")
    for resume in (False, True):
        with pytest.raises(igsr.IgsrError, match="capture is not empty"):
            igsr.refine(tmp_path / "photos", 1, **given, resume=resume)
    assert own.read_text() == "mine"
    own.unlink()
    with pytest.warns(UserWarning, match="4 of 8 photos could not be placed"):
        first = igsr.refine(tmp_path / "photos", 1, **given)

    def once_more(photos, *, seed=0, progress=None):
        raise AssertionError("cameras are looked for again")

    unwanted = registry.Entry(lambda: once_more, lambda options: True)
    for name in registry.ESTIMATORS:
        monkeypatch.setitem(registry.ESTIMATORS, name, unwanted)
    again = igsr.refine(tmp_path / "photos", 1, **given, resume=True)
    assert same(first.splats, again.splats)
    report = json.loads((tmp_path / "out/report.json").read_text())
    missing = sorted(path.name for path in (tmp_path / "photos").iterdir())[::2]
    assert report["not_registered"] == missing
    assert ", ".join(missing) in (tmp_path / "out/report.html").read_text()
    some = igsr.Capture(first.capture.path, first.capture.views[:3])  # as with --photos 3
    igsr.refine(some, 0, out=tmp_path / "some", steps=5, backend="cpu", denoiser=unsure)
    assert json.loads((tmp_path / "some/report.json").read_text())["not_registered"] == missing
    (tmp_path / "photos" / missing[0]).unlink()
    with pytest.raises(igsr.IgsrError, match="has the cameras of other photos than"):
        igsr.refine(tmp_path / "photos", 1, **given, resume=True)


#: Seconds that an older report tells of: more than any test takes.
LONG = 100_000.0


def test_what_it_returns_shows_itself_in_a_notebook(helped):
    refined = helped[0]
    assert repr(refined).startswith("Refined(2 of 2 rounds accepted, ")
    assert "<img" in refined._repr_html_()
    assert refined == refined
    assert (refined == "a scene") is False


def test_it_says_where_it_stands_while_it_runs(ball_photos, tmp_path, monkeypatch):
    monkeypatch.setattr(followed_run, "TELL_EVERY", 0.0)
    out, told = tmp_path / "out", []

    def look(now):
        told.append(json.loads((out / "view/progress.json").read_text()))
        return now.stage != "cross_validate"

    with pytest.raises(igsr.IgsrError, match="was stopped"):
        refine(ball_photos, 1, truthful, out=out, steps=40, progress=look)
    assert told[0]["text"] == "round 0: fit photos"
    assert told[-1]["text"] == "round 1: cross-validate"
    parts = [one["done"] for one in told]
    assert parts == sorted(parts)
    assert 0.0 < parts[-1] < 1.0
    assert not (out / "view/progress.json").exists(), "it has ended, though not well"
    held_out = [view.name for view in ball_photos.test_views]
    photos = json.loads((out / "view/cameras.json").read_text())["frames"]
    assert [one["file_path"] for one in photos] == [
        f"held-out/{name.removesuffix('.png')}.jpg" for name in held_out
    ]
    # White is what the photos' alpha is laid over.
    corner = np.asarray(Image.open(out / "view" / photos[0]["file_path"]))[0, 0]
    assert corner.min() > 240
    assert json.loads((out / "view/run.json").read_text()) == {"background": [1.0, 1.0, 1.0]}


def test_a_view_that_cannot_be_written_ends_no_run(ball_photos, tmp_path):
    (tmp_path / "view").write_text("a file of one's own")
    refined = refine(ball_photos, 1, truthful, out=tmp_path, steps=40, cross_validate=False)
    assert len(refined.rounds) == 1
    assert (tmp_path / "view").read_text() == "a file of one's own"
