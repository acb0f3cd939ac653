"""The loop: what it accepts, what it rolls back, what it writes, and that it can be resumed."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace

import numpy as np
import pytest
import scenes
from PIL import Image

import igsr
from igsr.fitting import fitter, presets
from igsr.pose import registry
from igsr.pose.estimate import Estimate
from igsr.refinement import loop as refinement
from igsr.refinement.report import seconds_so_far
from igsr.rendering.renders import render

BALL = scenes.splats(60)
WHITE = (1.0, 1.0, 1.0)
STEPS = 800
SHIPPED_PHOTO_STEPS = fitter.PHOTO_STEPS


@pytest.fixture(scope="module", autouse=True)
def small_fits():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(presets, "_FEW", replace(presets._FEW, max_splats=1000))
        # So few steps would hardly see the views at all.
        patch.setattr(fitter, "PHOTO_STEPS", 1)
        yield


@pytest.fixture(scope="module")
def capture():
    return scenes.capture(views=12, size=40, alpha=True, scene=BALL)


def truthful(buffers, photos):
    """A denoiser that knows the scene."""
    color = render(BALL, buffers.camera, WHITE, backend="cpu").color
    return np.clip(color, 0.0, 1.0), np.full(color.shape[:2], 0.95, np.float32)


def lying(buffers, photos):
    """A denoiser that makes all worse and is sure of it."""
    return 1.0 - np.clip(buffers.color, 0.0, 1.0), np.full(buffers.color.shape[:2], 1.0, np.float32)


def contented(buffers, photos):
    """A denoiser that finds all as it should be: nothing is left to learn, or all is black."""
    return np.clip(buffers.color, 0.0, 1.0), np.full(buffers.color.shape[:2], 1.0, np.float32)


def unsure(buffers, photos):
    """A denoiser that trusts nothing."""
    return np.clip(buffers.color, 0.0, 1.0), np.full(buffers.color.shape[:2], 0.05, np.float32)


def refine(capture, rounds, denoiser, **options):
    given = {"steps": STEPS, "backend": "cpu", **options}
    return igsr.refine(capture, rounds, denoiser=denoiser, **given)


def same(one, other):
    return all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("means", "quats", "scales", "opacities", "sh")
    )


@pytest.fixture(scope="module")
def helped(capture, tmp_path_factory):
    out = tmp_path_factory.mktemp("helped")
    seen = []
    refined = refine(capture, 2, truthful, out=out, progress=seen.append)
    return refined, out, seen


def test_rounds_that_help_are_accepted_and_make_views_better(helped):
    refined, _, seen = helped
    assert [one.accepted for one in refined.rounds] == [True, True]
    assert refined.stopped == "2 rounds are done"
    for one in refined.rounds:
        for name, sign in (("psnr", 1), ("ssim", 1), ("flip", -1)):
            assert sign * one.left_out[name] > sign * one.before[name]
        assert 0 < len(one.chosen) <= len(one.chosen) + len(one.passed) <= refinement.CANDIDATES
    psnr = [refined.first_test["psnr"], *(one.test["psnr"] for one in refined.rounds)]
    assert psnr[0] + 0.1 < psnr[1] < psnr[2]
    done = [now.done for now in seen]
    assert done == sorted(done)
    assert done[-1] <= 1.0
    assert {now.doing for now in seen} == {"fit", "look", "judge", "refit", "test"}


def test_a_round_helps_with_as_many_steps_on_photos_as_igsr_has(capture, helped, monkeypatch):
    monkeypatch.setattr(fitter, "PHOTO_STEPS", SHIPPED_PHOTO_STEPS)
    refined = refine(capture, 1, truthful)
    assert same(refined.first, helped[0].first)
    (one,) = refined.rounds
    assert one.accepted
    assert not same(refined.splats, helped[0].rounds[0].splats)
    assert one.test["psnr"] > refined.first_test["psnr"] + 0.1


def test_everything_it_did_is_in_its_folder(helped):
    refined, out, _ = helped
    assert same(igsr.Splats.load(out / "scene.ply"), refined.splats)
    assert same(igsr.Splats.load(out / "rounds/0/scene.ply"), refined.first)
    assert same(igsr.Splats.load(out / "rounds/1/scene.ply"), refined.rounds[0].splats)
    one = refined.rounds[1].chosen[0]
    assert np.array_equal(np.asarray(Image.open(out / "rounds/2/view-0.after.png")), one.picture)
    assert np.asarray(Image.open(out / "rounds/2/view-0.trust.png")).shape == one.trust.shape
    cameras = json.loads((out / "cameras.json").read_text())["frames"]
    assert len(cameras) == len(refined.capture.train_views)
    report = json.loads((out / "report.json").read_text())
    assert report["stopped"] == refined.stopped
    assert report["rounds"][2]["left_out"]["with"] == refined.rounds[1].left_out
    assert report["rounds"][2]["test"]["psnr"] == refined.rounds[1].test["psnr"]
    assert set(report["seconds"]) == {"fit", "look", "judge", "refit", "test"}
    page = (out / "report.html").read_text()
    assert refined.stopped in page
    assert "Round 2: accepted" in page
    assert page.count("data:image/jpeg;base64,") == 9 + 3 * sum(
        len(one.chosen) for one in refined.rounds
    )
    assert "http" not in page, "the page needs nothing from elsewhere"
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


def test_a_round_that_does_not_help_is_rolled_back(capture, helped, tmp_path):
    refined = refine(capture, "auto", lying, out=tmp_path)
    assert [one.accepted for one in refined.rounds] == [False]
    assert refined.stopped == "round 1 did not make photos that were left out better"
    assert refined.splats is refined.first
    assert same(refined.splats, helped[0].first)
    assert refined.rounds[0].splats is refined.rounds[0].test is None
    page = (tmp_path / "report.html").read_text()
    drawn = json.loads(page.split('id="cameras">')[1].split("</script>")[0])
    looked_at = len(refined.rounds[0].chosen) + len(refined.rounds[0].passed)
    kinds = [kind for kind, _ in drawn]
    assert (kinds.count(0), kinds.count(1), kinds.count(2)) == (9, 0, looked_at)


def test_nothing_is_fitted_twice_where_there_is_nothing_to_add(capture, helped):
    refined = refine(capture, "auto", unsure)
    assert not refined.rounds
    assert "unseen views can be trusted" in refined.stopped
    assert "judge" not in refined.seconds
    assert same(refined.splats, helped[0].first)
    content = refine(capture, "auto", contented)
    assert not content.rounds
    assert content.stopped.endswith("unseen views can be trusted to add anything")
    assert len(content.passed) > 5
    assert all(one.worth == 0.0 for one in content.passed)
    assert "judge" not in content.seconds
    none = refine(capture, 0, truthful)
    assert none.stopped == "0 rounds are done"
    assert same(none.splats, helped[0].first)
    two = igsr.Capture(capture.path, capture.train_views[:2])
    assert "fewer than 3 photos" in refine(two, 1, truthful).stopped


@pytest.mark.parametrize(
    "moment",
    [(0, "fit"), (1, "look"), (1, "fit"), (1, "judge"), (1, "refit"), (2, "look"), (2, "refit")],
)
def test_stopped_at_any_moment_and_resumed_it_ends_the_same(capture, helped, tmp_path, moment):
    def stop(now):
        return (now.round, now.doing) != moment

    with pytest.raises(igsr.IgsrError, match="was stopped; go on with resume"):
        refine(capture, 2, truthful, out=tmp_path, progress=stop)
    refined = refine(capture, 2, truthful, out=tmp_path, resume=True)
    assert same(refined.splats, helped[0].splats)
    assert [one.left_out for one in refined.rounds] == [one.left_out for one in helped[0].rounds]


@pytest.mark.parametrize("renames", [2, 12, 40])
def test_killed_between_two_files_and_resumed_it_ends_the_same(
    capture, helped, tmp_path, renames, monkeypatch
):
    left, real = [renames], os.replace

    def killed(*paths):
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt
        real(*paths)

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        refine(capture, 2, truthful, out=tmp_path)
    monkeypatch.setattr(os, "replace", real)
    left_behind = tmp_path / "checkpoints/.whole-1.unfinished.npz"
    left_behind.write_bytes(b"by a process that was killed")
    assert same(refine(capture, 2, truthful, out=tmp_path, resume=True).splats, helped[0].splats)
    files = {path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file()}
    assert files == {p.relative_to(helped[1]) for p in helped[1].rglob("*") if p.is_file()}


def test_what_lies_there_stays_until_resuming_has_more(capture, helped, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(helped[1], out)

    def contents():
        files = (path for path in out.rglob("*") if path.is_file())
        return {path: path.read_bytes() for path in files}

    before = contents()
    with pytest.raises(igsr.IgsrError, match="was made from other photos"):
        refine(capture, 2, lambda *given: (truthful(*given)[0] * 0.99, truthful(*given)[1]),
               out=out, resume=True)  # fmt: skip
    with pytest.raises(igsr.IgsrError, match="was stopped"):
        refine(capture, 2, truthful, out=out, resume=True, progress=lambda now: now.round < 2)
    assert contents() == before
    seconds = json.loads((out / "report.json").read_text())["seconds"]
    refine(capture, 2, truthful, out=out, resume=True)
    resumed = json.loads((out / "report.json").read_text())["seconds"]
    assert resumed["fit"] >= seconds["fit"] > 0.0, "what was done before took time too"
    after = contents()
    for name in ("scene.ply", "rounds/2/scene.ply", "rounds/2/view-0.after.png"):
        assert after[out / name] == before[out / name]


def test_without_resume_nothing_of_an_earlier_run_is_in_the_way(capture, tmp_path):
    out = tmp_path / "out"
    refine(capture, 1, truthful, out=out, steps=40, judge=False)
    others = out / "checkpoints/of-my-own.npz"
    others.write_bytes(b"mine")

    def stop(now):
        return now.doing != "look"

    with pytest.raises(igsr.IgsrError, match="was stopped"):
        refine(capture, 1, truthful, out=out, steps=60, judge=False, progress=stop)
    assert not (out / "checkpoints/whole-round1.npz").exists()
    assert "refit" not in seconds_so_far(out), "those of the earlier run are not gone on from"
    assert others.read_bytes() == b"mine"
    resumed = refine(capture, 1, truthful, out=out, steps=60, judge=False, resume=True)
    assert len(resumed.rounds) == 1


def test_a_fit_that_is_stopped_is_saved(capture, tmp_path):
    def stop(now):
        return now.done == 0.0

    with pytest.raises(igsr.IgsrError, match="was stopped"):
        refine(capture, 0, truthful, out=tmp_path, steps=400, progress=stop)
    assert (tmp_path / "checkpoints/whole.npz").is_file()


def test_folds_are_fitted_as_all_photos_are(capture, monkeypatch):
    """With a photo more than few photos, its folds have few: they are fitted as many, too."""
    monkeypatch.setattr(presets, "FEW_PHOTOS", 8)
    assert len(capture.train_views) == 9
    settings = []
    real = refinement.fit

    def watched(made, **given):
        settings.append((len(made.views), given["density"], given["sh_degree"], given["dropout"]))
        return real(made, **given)

    monkeypatch.setattr(refinement, "fit", watched)
    refine(capture, 1, lying, steps=40)
    assert [photos for photos, *_ in settings][:3] == [9, 7, 8]
    assert {tuple(some) for _, *some in settings} == {("original", 2, 0.0)}


def test_what_masks_leave_out_is_not_learned(capture):
    """Photos of one half alone: views say nothing of what only the other half would have shown."""
    half = np.zeros((40, 40), np.bool_)
    half[:, :20] = True
    views = [replace(view, mask=half) for view in capture.train_views]
    trusted = []
    real = igsr.refinement.select

    def choose(found, count):
        trusted.append([one.trust for one in found])
        return real(found, count)

    def sure(buffers, photos):
        return truthful(buffers, photos)[0], np.full(buffers.color.shape[:2], 1.0, np.float32)

    given = {"judge": False, "choose": choose}
    refine(igsr.Capture(capture.path, views), 1, sure, **given)
    refine(igsr.Capture(capture.path, capture.train_views), 1, sure, **given)
    masked, whole = (np.stack(some) for some in trusted)
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
        (1, {"backend": "reference"}, "backend reference renders but does not fit"),
        (1, {"steps": 0}, "steps must be from 1 to 10000000, not 0"),
        (1, {"steps": 20_000_000}, "steps must be from 1 to 10000000, not 20000000"),
        (1, {"steps": 2.9}, "steps must be a whole number, not 2.9"),
        (1, {"steps": "many"}, "steps must be"),
        (1, {"seed": -1}, "seed must be from 0 to"),
    ],
)
def test_bad_arguments(capture, rounds, options, message, monkeypatch, tmp_path):
    earlier = tmp_path / "checkpoints/whole.npz"
    earlier.parent.mkdir()
    earlier.write_bytes(b"of an earlier run")
    given = options if "resume" in options else {**options, "out": tmp_path}
    with pytest.raises(igsr.IgsrError, match=message):
        refine(capture, rounds, truthful, **given)
    assert earlier.is_file()
    monkeypatch.setattr(refinement, "_posed", lambda *_: pytest.fail("cameras are looked for"))
    with pytest.raises(igsr.IgsrError, match=message):
        refine("a folder", rounds, truthful, **options)


def test_photos_that_cannot_be_fitted_or_scored_are_told_before_anything_is_done(
    capture, monkeypatch, tmp_path
):
    monkeypatch.setattr(refinement, "fit", lambda *_, **__: pytest.fail("it is fitted"))
    earlier = tmp_path / "checkpoints/whole.npz"
    earlier.parent.mkdir()
    earlier.write_bytes(b"of an earlier run")
    nothing = np.zeros((40, 40), np.bool_)
    for split, message in (("train", "no pixel to fit"), ("test", "no pixel to score")):
        views = [replace(v, mask=nothing) if v.split == split else v for v in capture.views]
        with pytest.raises(igsr.IgsrError, match=message):
            refine(igsr.Capture(capture.path, views), 1, truthful, out=tmp_path)
    assert earlier.is_file()


def test_a_folder_that_cannot_be_written_is_one_sentence(capture, tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(igsr.IgsrError, match="out"):
        refine(capture, 0, truthful, out=tmp_path / "out")


def test_on_a_full_disk_what_is_done_stays_and_it_goes_on_from_there(
    capture, helped, tmp_path, monkeypatch
):
    save = Image.Image.save

    def full(image, file, **options):
        if options["format"] == "PNG":
            raise OSError(28, "No space left on device")
        save(image, file, **options)

    monkeypatch.setattr(Image.Image, "save", full)
    with pytest.raises(igsr.IgsrError, match=r"Cannot write .*png: No space left on device"):
        refine(capture, 2, truthful, out=tmp_path)
    assert same(igsr.Splats.load(tmp_path / "rounds/0/scene.ply"), helped[0].first)
    monkeypatch.setattr(Image.Image, "save", save)
    assert same(refine(capture, 2, truthful, out=tmp_path, resume=True).splats, helped[0].splats)


def test_photos_that_cannot_be_placed_are_left_out_with_a_warning(tmp_path, monkeypatch):
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
    assert "unseen views can be trusted" in refined.stopped

    given = {"steps": 40, "backend": "cpu", "denoiser": unsure, "out": tmp_path / "out"}
    with pytest.raises(igsr.IgsrError, match="was stopped"):
        igsr.refine(tmp_path / "photos", 1, lambda now: now.doing != "pose", **given)
    own = tmp_path / "out/capture/of-my-own.txt"
    own.parent.mkdir(parents=True)
    own.write_text("mine")
    for resume in (False, True):
        with pytest.raises(igsr.IgsrError, match="capture holds something already"):
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
    assert report["not_placed"] == missing
    assert ", ".join(missing) in (tmp_path / "out/report.html").read_text()
    some = igsr.Capture(first.capture.path, first.capture.views[:3])  # as with --photos 3
    igsr.refine(some, 0, out=tmp_path / "some", steps=5, backend="cpu", denoiser=unsure)
    assert json.loads((tmp_path / "some/report.json").read_text())["not_placed"] == missing
    (tmp_path / "photos" / missing[0]).unlink()
    with pytest.raises(igsr.IgsrError, match="has the cameras of other photos than"):
        igsr.refine(tmp_path / "photos", 1, **given, resume=True)


def test_weights_of_one_are_as_none_and_of_zero_as_a_mask(capture):
    def fitted(**fields):
        views = [replace(view, **fields) for view in capture.train_views]
        made = igsr.Capture(capture.path, views)
        # From given splats: masks also have a say in the first ones of a fit.
        return igsr.fit(made, steps=20, backend="cpu", start=BALL)

    size = (40, 40)
    left = np.ones(size, np.float32)
    left[:, :20] = 0.0
    assert same(fitted(), fitted(weights=np.ones(size, np.float32)))
    assert same(fitted(mask=left > 0), fitted(weights=left))
    assert not same(fitted(), fitted(weights=left))
    with pytest.raises(igsr.IgsrError, match="weights must be finite and not negative"):
        replace(capture.views[0], weights=-left)
    with pytest.raises(igsr.IgsrError, match="weights"):
        replace(capture.views[0], weights=left[1:])


@pytest.mark.filterwarnings("ignore:.*one and the same camera", "ignore:.*black or wholly")
def test_a_picture_of_small_weights_counts_less_than_a_photo(capture):
    """Two pictures of one camera that disagree: the splats side with the heavier."""
    view = capture.train_views[0]
    white = replace(view, name="white.png", image=np.full((40, 40, 3), 255, np.uint8))
    black = replace(view, name="black.png", image=np.zeros((40, 40, 3), np.uint8))
    side = scenes.ring_camera(1.0, 40)
    ones = np.ones((40, 40), np.float32)  # or photos would come up more often
    means = []
    for weight in (0.1, 1.0):
        weighed = replace(white, weights=np.full((40, 40), weight, np.float32))
        pair = [black, weighed, replace(black, name="side.png", camera=side)]
        pair = [view if view.weights is not None else replace(view, weights=ones) for view in pair]
        splats = igsr.fit(
            igsr.Capture(capture.path, pair),
            steps=200,
            backend="cpu",
            start=BALL,
            sh_degree=BALL.sh_degree,
            dropout=0.0,
        )
        means.append(render(splats, view.camera, backend="cpu").color.mean())
    assert means[0] < 0.5 * means[1]


def test_a_warm_start_goes_on_from_splats(capture):
    first = igsr.fit(capture, steps=100, backend="cpu")
    on = igsr.fit(capture, steps=50, backend="cpu", start=first)
    before, after = (igsr.evaluate(s, capture, "train")["psnr"] for s in (first, on))
    assert after > before
    assert len(on) >= len(first)
    with pytest.raises(igsr.IgsrError, match="sh_degree must be the same, not 3"):
        igsr.fit(capture, steps=5, backend="cpu", start=first, sh_degree=3)
    with pytest.raises(igsr.IgsrError, match="give at least one, and no more than max_splats"):
        igsr.fit(capture, steps=5, backend="cpu", start=first, max_splats=2)
    with pytest.raises(igsr.IgsrError, match="antialiased"):
        igsr.fit(capture, steps=5, backend="cpu", start=replace(first, antialiased=True))


def test_the_command(capture, tmp_path, igsr_here, monkeypatch):
    from igsr.denoiser import save_network
    from igsr.denoiser.network import Architecture, DenoiserNetwork

    scenes.write_capture(tmp_path / "ball", capture)
    save_network(DenoiserNetwork(Architecture(4, (0, 0, 0))), tmp_path / "a.safetensors", {})
    command = ["refine", tmp_path / "ball", "--out", tmp_path / "out", "--steps", "60"]
    command += ["--weights", tmp_path / "a.safetensors", "--backend", "cpu", "--rounds", "1"]
    command += ["--photos", "5"]
    stale, own = tmp_path / "out/rounds/7/scene.ply", tmp_path / "out/rounds/8/notes.txt"
    for path in (stale, own):
        path.parent.mkdir(parents=True)
        path.write_text("of before")
    done = igsr_here(*command)
    assert done.returncode == 0, done.stderr
    assert not stale.parent.exists()
    assert own.exists()
    assert "rounds accepted; stopped: " in done.stdout
    assert (tmp_path / "out/report.html").is_file()
    again = igsr_here(*command, "--resume", "--json")
    summary = json.loads(again.stdout)
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert len(report["photos"]) == 5
    assert summary["tried"] == len(report["rounds"]) - 1
    assert summary["stopped"] == report["stopped"] != ""
    assert summary["splats"] == len(igsr.Splats.load(tmp_path / "out/scene.ply"))
    bad = igsr_here(*command[:4], "--photos", "99")
    assert bad.returncode == 1
    assert "the train photos of" in bad.stderr
    assert bad.stderr.startswith("--photos must be from 1 to ")
    next((tmp_path / "ball").rglob("*.png")).unlink()
    lacking = igsr_here(*command[:2], "--out", tmp_path / "other", *command[4:])
    assert lacking.returncode == 1
    assert len(lacking.stderr.splitlines()) == 1
    assert ".png" in lacking.stderr
    bad = igsr_here(*command[:4], "--rounds", "some")
    assert bad.returncode == 1
    assert bad.stderr.startswith("--rounds must be a whole number or auto, not 'some'.")


def test_photos_that_lie_where_cameras_would_be_kept_stay(tmp_path):
    photo = tmp_path / "capture" / "0.png"
    photo.parent.mkdir()
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(photo)
    with pytest.raises(igsr.IgsrError, match="lies where the fit would write"):
        igsr.refine(tmp_path / "capture", out=tmp_path, backend="cpu", denoiser=unsure)
    assert photo.is_file()


@pytest.mark.parametrize("count", [3, 4, 6, 9])
def test_each_fold_leaves_out_photos_that_no_other_does(capture, count, monkeypatch):
    fewer = igsr.Capture(capture.path, capture.train_views[:count])
    left = []
    real = refinement._Loop.folds

    def watched(loop):
        folds = real(loop)
        left.extend([view.name for view in fold.left] for fold in folds)
        assert all(len(fold.left) + len(fold.chain.photos) == count for fold in folds)
        return folds

    monkeypatch.setattr(refinement._Loop, "folds", watched)
    refine(fewer, 1, lying, steps=40)
    assert len(left) == 2
    assert all(left)
    assert not set(left[0]) & set(left[1])


def test_folds_of_halved_photos_have_as_many_splats_per_pixel(capture, monkeypatch):
    monkeypatch.setattr(refinement, "FOLD_SIDE", 16)
    counts = []
    real = refinement._Loop.folds

    def watched(loop):
        folds = real(loop)
        counts.extend(len(fold.chain.splats) for fold in folds)
        return folds

    monkeypatch.setattr(refinement._Loop, "folds", watched)
    whole, folds = len(refine(capture, 1, lying, steps=400).first), counts
    assert len(folds) == 2
    assert 250 < whole <= 1000
    assert all(0 < fold <= 250 for fold in folds)


def test_a_round_is_judged_by_three_errors_together():
    def error(psnr, ssim, flip):
        return refinement._error({"psnr": psnr, "ssim": ssim, "flip": flip})

    assert error(20.0, 0.9, 0.1) == pytest.approx(0.1)
    before = error(26.755, 0.9279, 0.0780)
    assert error(26.850, 0.9297, 0.0782) < before, "a little more FLIP does not outweigh the rest"
    assert error(26.750, 0.9279, 0.0780) > before
    assert error(26.755, 0.9278, 0.0780) > before
    assert error(26.755, 0.9279, 0.0781) > before


@pytest.mark.filterwarnings("ignore:.*one and the same camera")
def test_views_that_are_no_photos_change_neither_settings_nor_first_splats(capture):
    photos = capture.train_views[:3]
    weights = np.ones((40, 40), np.float32)
    views = [
        replace(view, name=f"{k}-{view.name}", weights=weights)
        for k in range(3)
        for view in capture.train_views
    ]

    def begun(some):
        seen = []

        def stop(now):
            seen.append(now)
            return False

        igsr.fit(igsr.Capture(capture.path, some), backend="cpu", progress=stop)
        return seen[0].steps, seen[0].started

    assert len(views) > presets.FEW_PHOTOS
    assert begun(photos + views) == begun(photos)
    assert begun(views) != begun(photos)


def test_a_round_fits_photos_and_views_from_the_start(capture, helped):
    refined = helped[0]
    views = list(refined.capture.train_views)
    for k, one in enumerate(refined.rounds[0].chosen):
        camera, picture = one.view.camera, one.picture
        views.append(igsr.View(f"whole-round1-{k}.png", camera, "train", picture, None, one.trust))
    given = [*views[:9], *(replace(view, background=WHITE) for view in views[9:])]
    fitted = igsr.fit(igsr.Capture(capture.path, given), STEPS, backend="cpu")
    assert same(fitted, refined.rounds[0].splats)


def test_photos_come_up_more_often_than_views_that_are_none_and_alone_at_the_end(
    capture, monkeypatch
):
    photos = capture.train_views[:2]
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


def test_a_short_fit_that_goes_on_sees_views_that_are_no_photos(capture):
    photos = capture.train_views[:2]
    view = replace(capture.train_views[2], weights=np.ones((40, 40), np.float32))
    start = igsr.fit(igsr.Capture(capture.path, photos), 20, backend="cpu")

    def gone_on(view):
        given = igsr.Capture(capture.path, [*photos, view])
        return igsr.fit(given, 20, backend="cpu", start=start)

    assert not same(gone_on(view), gone_on(replace(view, image=255 - view.image)))


def test_seconds_that_a_report_cannot_have_are_not_gone_on_from(tmp_path):
    (tmp_path / "report.json").write_text('{"seconds": {"fit": NaN, "look": 2.5, "judge": 1e999}}')
    assert seconds_so_far(tmp_path) == {"look": 2.5}
    for text in (
        '{"seconds": {"fit": "long"}}',
        '{"seconds": {"fit": -50}}',
        f'{{"seconds": {{"fit": 1{"0" * 400}}}}}',
        "[" * 100_000,
    ):
        (tmp_path / "report.json").write_text(text)
        assert seconds_so_far(tmp_path) == {}
