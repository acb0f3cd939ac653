"""Files of a refinement, and resuming from them."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import scenes
from capture_files import assert_refused
from PIL import Image
from refinements import contented, refine, same, truthful, unsure

import igsr
from igsr.cameras import registry
from igsr.cameras.estimate import Estimate
from igsr.fitting import followed_run
from igsr.refinement.report import parts_so_far
from igsr.refinement.results import StopReason


def stop_in(stage, number=None):
    """A listener that ends a refinement in a stage of a round."""

    def listener(event):
        if event.stage == stage and number in (None, event.values.get("round")):
            raise scenes.Stop

    return listener


def files_in(folder):
    """Content of each file below a folder, by path."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder): path.read_bytes() for path in files}


def test_the_folder_holds_all_results(helped):
    refined, out, _ = helped
    last = refined.rounds[1]
    scenes_of_rounds = {"": last, "rounds/1/": refined.rounds[0], "rounds/2/": last}
    for folder, done in scenes_of_rounds.items():
        assert same(igsr.Splats.load(out / f"{folder}scene.ply"), done.splats)
    assert same(igsr.Splats.load(out / "rounds/0/scene.ply"), refined.first)
    added = last.selected[0]
    assert np.array_equal(np.asarray(Image.open(out / "rounds/2/view-0.after.png")), added.denoised)
    weights = np.asarray(Image.open(out / "rounds/2/view-0.confidence.png"))
    assert np.abs(weights / 255.0 - added.confidence).max() < 0.003
    assert len(json.loads((out / "cameras.json").read_text())["frames"]) == 3


def test_the_report_has_scores_and_times(helped):
    refined, out, _ = helped
    report = json.loads((out / "report.json").read_text())
    assert report["format"] == 4
    assert report["stopped"] == str(refined.stop)
    assert report["stop_reason"] == "rounds_done"
    second, done = report["rounds"][2], refined.rounds[1]
    assert report["test"] == second["test"] == done.test
    assert set(report["parts"]) == {"fit", "novel_views", "refit", "test"}
    assert report["seconds"] > 0.0
    peaks = [part["peak_memory_bytes"] for part in report["parts"].values()]
    assert report["peak_memory_bytes"] == max(peaks)
    assert report["train"]["views"] == report["train"]["of"] == 3
    page = (out / "report.html").read_text()
    assert report["limit"]["sentence"] in page
    assert f"Ended because:</b> {refined.stop}." in page
    assert "<h2>Round 2</h2>" in page
    # Three pictures of each test view and each added view.
    in_rounds = sum(len(done.selected) for done in refined.rounds)
    tests = len(refined.capture.test_views)
    assert page.count("data:image/jpeg;base64,") == 3 + 3 * tests + 3 * in_rounds
    assert "://" not in page, "the page needs no other file"


def test_the_sheet_shows_test_views_before_and_after_the_rounds(helped):
    refined, out, _ = helped
    views = refined.capture.test_views
    sheet = np.asarray(Image.open(out / "views.png"), np.float32)
    width, height, margin, title = 196, (sheet.shape[0] - 12) // len(views), 12, 24
    assert len(views) == 2
    for row, view in enumerate(views):
        top = margin + row * height + title
        pictures = [sheet[top : top + 40, margin + k * width :][:, :40] for k in range(3)]
        for picture, splats in zip(pictures[1:], (refined.first, refined.splats), strict=True):
            shown = igsr.render(splats, view.camera, (1.0, 1.0, 1.0), "cpu").to_uint8()
            assert np.abs(picture - shown).max() <= 1.0


def long(*values):
    return pytest.param(*values, marks=pytest.mark.long)


MOMENTS = [(0, "fit photos"), (1, "refit with novel views"), (2, "refit with novel views")]
MOMENTS += [long(1, "denoise novel views"), long(2, "denoise novel views")]


@pytest.mark.parametrize(("number", "stage"), MOMENTS)
def test_stopped_at_any_moment_and_resumed_it_ends_the_same(
    few_photos, helped, tmp_path, number, stage
):
    with pytest.raises(scenes.Stop):
        refine(few_photos, 2, truthful, out=tmp_path, progress=stop_in(stage, number))
    refined = refine(few_photos, 2, truthful, out=tmp_path, resume=True)
    assert same(refined.splats, helped[0].splats)
    for done, expected in zip(refined.rounds, helped[0].rounds, strict=True):
        assert same(done.splats, expected.splats)


@pytest.mark.parametrize("renames", [long(2), 12, long(40)])
def test_killed_between_two_files_and_resumed_it_ends_the_same(
    few_photos, helped, tmp_path, renames, monkeypatch
):
    left, replace = [renames], os.replace

    def killed(*paths):
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt
        replace(*paths)

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        refine(few_photos, 2, truthful, out=tmp_path)
    monkeypatch.setattr(os, "replace", replace)
    unfinished = tmp_path / ".report.json-0000.unfinished"
    unfinished.mkdir()
    (unfinished / "new.json").write_bytes(b"by a process that was killed")
    os.utime(unfinished, (0, 0))
    refined = refine(few_photos, 2, truthful, out=tmp_path, resume=True)
    assert same(refined.splats, helped[0].splats)
    assert files_in(tmp_path).keys() == files_in(helped[1]).keys()


def test_earlier_results_stay_until_a_resumed_run_has_more(few_photos, helped, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(helped[1], out)
    before = files_in(out)

    def other(buffers, photos):
        picture, confidence = truthful(buffers, photos)
        return 0.99 * picture, confidence

    words = "was made from other photos"
    assert_refused(words, refine, few_photos, 2, other, out=out, resume=True)
    stop = stop_in("score test views", 2)
    with pytest.raises(scenes.Stop):
        refine(few_photos, 2, truthful, out=out, resume=True, progress=stop)
    assert files_in(out) == before
    refine(few_photos, 2, truthful, out=out, resume=True)
    after = files_in(out)
    first, both = (json.loads(files[Path("report.json")])["parts"] for files in (before, after))
    assert both["fit"]["seconds"] >= first["fit"]["seconds"] > 0.0, "the first run's time counts"
    for path in before:
        if path.name == "scene.ply" or path.name.startswith("view-"):
            assert after[path] == before[path]


def test_a_new_run_uses_nothing_of_an_earlier_one(few_photos, tmp_path):
    options = {"out": tmp_path}
    refine(few_photos, 1, truthful, steps=40, **options)
    own = tmp_path / "checkpoints/of-my-own.npz"
    own.write_bytes(b"mine")
    stop = stop_in("denoise novel views")
    with pytest.raises(scenes.Stop):
        refine(few_photos, 1, truthful, steps=60, progress=stop, **options)
    assert not (tmp_path / "checkpoints/whole-round1.npz").exists()
    assert "refit" not in parts_so_far(tmp_path), "times of the earlier run do not count"
    assert own.read_bytes() == b"mine"
    assert len(refine(few_photos, 1, truthful, steps=60, resume=True, **options).rounds) == 1


@pytest.mark.parametrize("held_out", [True, False])
def test_without_a_round_the_pictures_show_the_fit(few_photos, held_out, tmp_path):
    views = few_photos.views if held_out else few_photos.train_views
    photos = igsr.Capture(few_photos.path, views)
    refined = refine(photos, 1, unsure, out=tmp_path, steps=20)
    assert not refined.rounds
    report = json.loads((tmp_path / "report.json").read_text())
    page = (tmp_path / "report.html").read_text()
    assert report["limit"]["sentence"] in page
    assert (report["limit"]["held_out_gap"] is not None) == held_out
    shown = photos.test_views or photos.train_views
    assert page.count("data:image/jpeg;base64,") == 3 * len(shown) + len(photos.train_views)
    assert np.asarray(Image.open(tmp_path / "views.png")).shape[0] > 40 * len(shown)


def test_after_a_full_disk_a_run_resumes(few_photos, helped, tmp_path, monkeypatch):
    save = Image.Image.save

    def full(image, file, **options):
        if options["format"] == "PNG":
            raise OSError(28, "No space left on device")
        save(image, file, **options)

    monkeypatch.setattr(Image.Image, "save", full)
    words = r"Cannot write .*png: No space left on device"
    assert_refused(words, refine, few_photos, 2, truthful, out=tmp_path)
    assert same(igsr.Splats.load(tmp_path / "rounds/0/scene.ply"), helped[0].first)
    monkeypatch.setattr(Image.Image, "save", save)
    refined = refine(few_photos, 2, truthful, out=tmp_path, resume=True)
    assert same(refined.splats, helped[0].splats)


def test_impossible_times_in_a_report_are_ignored(tmp_path):
    part = '{"parts": {"fit": {"seconds": %s, "cpu_seconds": 1, "peak_memory_bytes": null}}}'
    (tmp_path / "report.json").write_text(part % 2.5)
    assert parts_so_far(tmp_path)["fit"].seconds == 2.5
    impossible = '"long"', -50, "NaN", "1e999", f"1{'0' * 400}"
    for text in (*(part % value for value in impossible), "[" * 100_000):
        (tmp_path / "report.json").write_text(text)
        assert parts_so_far(tmp_path) == {}


@pytest.mark.filterwarnings("ignore:4 of 8 photos could not be placed")
def test_photos_that_are_not_placed_are_named(tmp_path, monkeypatch):
    made = scenes.capture(views=8, size=40)
    photos, out = tmp_path / "photos", tmp_path / "out"
    photos.mkdir()
    for k, view in enumerate(made.views):
        Image.fromarray(view.image).save(photos / f"{k}.png")

    def every_other(photos, *, seed, progress):
        progress("matching", 1, 2)
        cameras = [view.camera if k % 2 else None for k, view in enumerate(made.views)]
        nothing = [None] * len(photos)
        return Estimate(cameras, None, nothing, nothing, ["4 of 8 photos could not be placed."])

    def only(estimator):
        entry = registry.Entry(lambda: estimator, lambda options: True)
        for name in registry.ESTIMATORS:
            monkeypatch.setitem(registry.ESTIMATORS, name, entry)

    only(every_other)
    given = {"steps": 40, "backend": "cpu", "denoiser": contented, "out": out}
    with pytest.raises(scenes.Stop):
        igsr.refine(photos, 1, **given, progress=stop_in("find cameras"))
    assert not (out / "cameras.npz").exists()
    with pytest.warns(UserWarning, match="4 of 8 photos could not be placed") as warned:
        first = igsr.refine(photos, 1, **given)
    assert {warning.filename for warning in warned} == {__file__}
    assert len(first.capture.train_views) == 4
    assert first.not_placed == ("0.png", "2.png", "4.png", "6.png")
    assert first.stop.reason is StopReason.NONE_SELECTED
    only(lambda *_, **__: pytest.fail("cameras were sought again"))
    assert same(igsr.refine(photos, 1, **given, resume=True).splats, first.splats)
    report = json.loads((out / "report.json").read_text())
    assert report["photos"]["not_placed"] == list(first.not_placed)
    assert ", ".join(first.not_placed) in (out / "report.html").read_text()
    (photos / "0.png").unlink()
    with pytest.raises(igsr.IgsrError, match="have changed since"):
        igsr.refine(photos, 1, **given, resume=True)


def test_the_result_shows_itself_in_a_notebook(helped):
    refined = helped[0]
    assert repr(refined).startswith("Refined(2 rounds, ")
    assert "<img" in refined._repr_html_()
    assert refined == refined
    assert refined != "a scene"


def test_a_run_publishes_its_progress_and_photos(few_photos, tmp_path, monkeypatch):
    monkeypatch.setattr(followed_run, "WRITE_EVERY_S", 0.0)
    view, published = tmp_path / "view", []

    def listener(event):
        if (view / "progress.json").exists():
            published.append(json.loads((view / "progress.json").read_text()))
        stop_in("denoise novel views")(event)

    with pytest.raises(scenes.Stop):
        refine(few_photos, 1, truthful, out=tmp_path, steps=40, progress=listener)
    assert published[0]["text"].startswith("fit photos, round 0: loss ")
    parts = [progress["done"] for progress in published]
    assert parts == sorted(parts)
    assert 0.0 < parts[-1] < 1.0
    assert not (view / "progress.json").exists(), "the run has ended"
    photos = json.loads((view / "cameras.json").read_text())["frames"]
    assert [photo["file_path"] for photo in photos] == [
        f"held-out/{photo.name.removesuffix('.png')}.jpg" for photo in few_photos.test_views
    ]
    corner = np.asarray(Image.open(view / photos[0]["file_path"]))[0, 0]
    assert corner.min() > 240, "photos with alpha are shown over white"
    assert json.loads((view / "run.json").read_text()) == {"background": [1.0, 1.0, 1.0]}


def test_out_must_be_a_folder_but_progress_need_not_be_written(few_photos, tmp_path):
    (tmp_path / "out").write_text("a file")
    assert_refused("out", refine, few_photos, 0, truthful, out=tmp_path / "out")
    (tmp_path / "view").write_text("a file of one's own")
    refined = refine(few_photos, 1, truthful, out=tmp_path, steps=40)
    assert len(refined.rounds) == 1
    assert (tmp_path / "view").read_text() == "a file of one's own"
