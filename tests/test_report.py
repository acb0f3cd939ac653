"""Scores, and the reports of a fit: report.json, report.html and views.png."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from PIL import Image

import igsr
from igsr._internal.atomic_write import atomic_write
from igsr._internal.json_file import write_json
from igsr._internal.part_usage import Usage
from igsr.capture import Capture
from igsr.evaluation import evaluate, metrics, report_page, score_views
from igsr.evaluation.contact_sheet import contact_sheet, error_picture, sheet_names
from igsr.evaluation.quick_scores import MAX_TRAIN_PHOTOS, train_photos, train_scores
from igsr.evaluation.scores import BLACK, ScoredView, over_background
from igsr.fitting.fit_page import write_fit_page
from igsr.fitting.fit_report import FitScores, fit_report
from igsr.fitting.presets import settings_for
from igsr.fitting.result import FitResult
from igsr.run import Run


def test_only_the_true_scene_scores_perfectly():
    scene = scenes.splats()
    capture = scenes.capture(views=8, scene=scene)
    scores = igsr.evaluate(scene, capture, backend="reference")
    assert scores["psnr"] == metrics.PSNR_CAP
    assert scores["flip"] == 0.0
    assert [row["name"] for row in scores["views"]] == [view.name for view in capture.test_views]
    worse = igsr.evaluate(scenes.splats(seed=1), capture, backend="reference")
    assert worse["psnr"] < 30
    train = igsr.evaluate(scene, capture, split="train", backend="reference")
    assert train["protocol"]["views"] == 6
    with pytest.raises(igsr.IgsrError, match="split"):
        igsr.evaluate(scene, capture, split="validation")
    no_test = igsr.Capture(capture.path, capture.train_views)
    with pytest.raises(igsr.IgsrError, match="no test views"):
        igsr.evaluate(scene, no_test)


def test_alpha_photos_are_scored_over_the_background():
    scene = scenes.splats()
    capture = scenes.capture(views=8, alpha=True, scene=scene)
    for background in (None, (0.0, 0.0, 0.0), (0.1, 0.5, 0.9)):
        scores = igsr.evaluate(scene, capture, background=background, backend="reference")
        # Colors and alpha are each rounded to 8 bits, and SH colors above 1 are clipped.
        assert scores["psnr"] > 35
        assert scores["protocol"]["background"] == list(background or (1.0, 1.0, 1.0))
    image = np.array([[[200, 100, 0, 255], [200, 100, 0, 0], [200, 100, 0, 51]]], dtype=np.uint8)
    over = over_background(image, (0.0, 1.0, 1.0))
    assert over.tolist() == [[[200, 100, 0], [0, 255, 255], [40, 224, 204]]]


def test_masked_pixels_do_not_count():
    scene = scenes.splats()
    views = []
    for view in scenes.capture(views=8, scene=scene).views:
        mask = np.ones(view.image.shape[:2], dtype=bool)
        mask[:, :20] = False
        image = view.image.copy()
        image[:, :20] = 77
        views.append(replace(view, image=image, mask=mask))
    capture = igsr.Capture(scenes.capture(views=4).path, views)
    assert igsr.evaluate(scene, capture, backend="reference")["psnr"] == metrics.PSNR_CAP
    assert "masked" in igsr.evaluate(scene, capture, backend="cpu")["protocol"]["pixels"]
    unmasked = [replace(view, mask=None) for view in views]
    assert igsr.evaluate(scene, igsr.Capture(capture.path, unmasked))["psnr"] < 25
    views[0].mask = np.zeros_like(views[0].mask)
    with pytest.raises(igsr.IgsrError, match=r"00\.png"):
        igsr.evaluate(scene, capture)


def scored(name="a/b.png", size=(30, 50), mask=None):
    random = np.random.default_rng(0)
    photo = random.integers(0, 256, size=(*size, 3), dtype=np.uint8)
    render = photo.copy()
    render[:, :10] = 255 - render[:, :10]
    return ScoredView(name, photo, render, mask, {"psnr": 12.345})


def test_error_picture_shows_where_the_error_is():
    view = scored()
    picture = error_picture(view)
    assert not picture[:, 10:].reshape(-1, 3).max(axis=0)[:2].any()
    assert picture[:, :10].mean() > 60
    mask = np.ones(view.photo.shape[:2], dtype=bool)
    mask[:, :10] = False
    masked = error_picture(replace(view, mask=mask))
    assert (masked[:, :10] == 96).all()


@pytest.mark.parametrize("count", [1, 3, 4, 8])
@pytest.mark.parametrize("size", [(4, 4), (30, 700), (900, 40)])
def test_contact_sheet_fits_all_views(count, size):
    sheet = contact_sheet([scored(name="x" * 200, size=size) for _ in range(count)])
    assert sheet.width < 2600
    assert sheet.height < 8 * 420
    colors = np.asarray(sheet).reshape(-1, 3)
    assert len(np.unique(colors, axis=0)) > 10


def test_sheet_names_spread_over_all_views():
    names = [str(i) for i in range(25)]
    chosen = sheet_names(names)
    assert len(chosen) == 8
    assert {"0", "24"} <= chosen
    assert sheet_names(names[:5]) == set(names[:5])


def test_report_is_strict_json(tmp_path):
    write_json(tmp_path / "report.json", {"psnr": 1.5, "ms_ssim": None})
    assert json.loads((tmp_path / "report.json").read_text()) == {"psnr": 1.5, "ms_ssim": None}
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "report.json", {"psnr": float("nan")})
    assert json.loads((tmp_path / "report.json").read_text())["psnr"] == 1.5


def test_atomic_write_keeps_the_old_file_on_any_failure(tmp_path):
    path = tmp_path / "picture.png"
    path.write_bytes(b"old")

    def fail_half_way():
        with atomic_write(path) as temporary:
            temporary.write_bytes(b"half of the ne")
            raise KeyError

    with pytest.raises(KeyError):
        fail_half_way()
    with pytest.raises(igsr.IgsrError, match=r"picture\.png"), atomic_write(path):
        raise OSError(28, "No space left on device")
    assert path.read_bytes() == b"old"
    with atomic_write(path) as temporary:
        assert temporary.suffix == ".png"
        Image.new("RGB", (2, 2)).save(temporary)
        assert path.read_bytes() == b"old"
    assert Image.open(path).size == (2, 2)
    assert [entry.name for entry in tmp_path.iterdir()] == ["picture.png"]


def test_at_most_ten_fitted_photos_are_scored_evenly_spaced():
    splats = scenes.splats(10)
    made = scenes.capture(views=25, size=16, scene=splats)
    views = [replace(view, split="train") for view in made.views]
    capture = Capture(made.path, views)
    names = [view.name for view in train_photos(capture)]
    assert len(names) == MAX_TRAIN_PHOTOS == 10
    assert (names[0], names[-1]) == (views[0].name, views[-1].name)
    scores = train_scores(splats, capture, BLACK, "reference")
    assert (scores["views"], scores["of"]) == (10, 25)
    assert scores["psnr"] > 45.0
    few = Capture(made.path, views[:4])
    whole = evaluate(splats, few, "train", BLACK, "cpu")
    quick = train_scores(splats, few, BLACK, "cpu")
    for name in ("psnr", "ssim"):
        assert quick[name] == pytest.approx(whole[name], abs=1e-12)


def test_the_page_of_a_fit_escapes_names(tmp_path, monkeypatch):
    name = '"><script>alert("photo")</script>\udcff.png'
    made = scenes.capture(views=5, size=16)
    views = [replace(view, name=f"{k}{name}") for k, view in enumerate(made.views)]
    capture = Capture(Path("a<b>&c"), views)
    splats = scenes.splats(5)
    sheet = list(score_views(splats, capture.test_views, BLACK, "cpu"))
    scores = evaluate(splats, capture, "test", BLACK, "cpu")
    train = train_scores(splats, capture, BLACK, "cpu")
    asked = {"capture": "a<b>&c", "start": "<i>", "backend": "cpu"}
    device = {"backend": "cpu", "device": "a CPU", "instruction_set": "some"}
    settings, started = settings_for(3), ("rays", 5)
    result = FitResult(splats, capture, settings, device, started, 9, 1.0, 0.1)
    result = replace(result, not_placed=("<i>lost</i>.png",))
    run = Run()
    run.parts.add("<fit>", Usage(1.0, 2.0, None))
    scored = FitScores(scores, sheet, train, {"psnr": 20.0, "ssim": 0.5, "flip": 0.1})
    report = fit_report(result, scored, run, asked)
    assert report["limit"]["camera_gain"] is not None
    write_fit_page(tmp_path / "report.html", report, splats, capture, sheet)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "alert(" in page
    for unsafe in ('"photo"', "a<b>", "<i>", "<script>alert", "<fit>"):
        assert unsafe not in page
    assert "a&lt;b&gt;&amp;c" in page
    assert "&lt;i&gt;lost&lt;/i&gt;.png" in page
    assert "the same with refined cameras" in page
    assert "<iframe srcdoc=" in page

    def refuse(*_, **__):
        raise igsr.IgsrError("no")

    # The page links to scenes that it cannot hold.
    for name, value in (("MAX_COMPARED_SPLATS", 4), ("scene_page", refuse)):
        with monkeypatch.context() as patch:
            patch.setattr(report_page, name, value)
            write_fit_page(tmp_path / "report.html", report, splats, capture, sheet)
        page = (tmp_path / "report.html").read_text(encoding="utf-8")
        assert "<iframe" not in page
        assert '<a href="scene.html">' in page
