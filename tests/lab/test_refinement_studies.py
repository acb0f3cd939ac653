"""Studies of the refinement: table2, table3, sweep, photographs, refinement-ablation."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import scenes
import torch
from feature_files import squeezenet_file

import igsr
from igsr.capture import Capture
from igsr.denoiser.network import Architecture, DenoiserNetwork
from igsr.denoiser.weights import save_network
from igsr.fitting import presets
from igsr.refinement.novel_views import NovelView
from igsr.refinement.selection import Candidate
from igsr_lab import study
from igsr_lab.study import Study, refinement_methods
from igsr_lab.study.refinement_methods import METHODS, OURS, Method, select_by_true_picture
from igsr_lab.study.refinement_report import mean_gains, paired_gains
from igsr_lab.study.refinement_runs import RefinementRun, split
from igsr_lab.study.splits import localized, scattered

BALL = scenes.splats(60)


def ball(views, alpha=True):
    return scenes.capture(views=views, size=40, alpha=alpha, scene=BALL)


def test_localized_and_scattered_photos():
    cameras = [view.camera for view in ball(24).views]  # a ring, 15 degrees apart
    assert set(localized(cameras, 5)) == {22, 23, 0, 1, 2}
    assert localized(cameras, 5)[0] == 0
    assert scattered(cameras, 2) == [0, 12]
    assert set(scattered(cameras, 4)) == {0, 6, 12, 18}
    assert len(set(scattered(cameras, 24))) == 24


def test_photos_of_a_run_are_not_held_out():
    made = ball(100)
    photos, held, given = split(made, RefinementRun("ball", "localized", 10, 0, "cpu"))
    assert len(photos.train_views) == 10
    assert not photos.test_views
    assert [len(held), len(given)] == [15, 10]
    assert {view.name for view in (*held, *given)} == {view.name for view in made.test_views}

    alone = Capture(made.path, [replace(view, split="train") for view in made.views[:35]])
    photos, held, given = split(alone, RefinementRun("tankard", "localized", 4, 0, "cpu"))
    names = [{view.name for view in some} for some in (photos.views, held, given)]
    assert [len(some) for some in names] == [4, 7, 6]
    assert len(names[0] | names[1] | names[2]) == 17
    photos, held, given = split(alone, RefinementRun("fern", "even", 3, 0, "cpu"))
    by_name = sorted(view.name for view in alone.views)
    assert [view.name for view in held] == by_name[::8]
    with pytest.raises(igsr.IgsrError, match="has 28 photos to fit, not 29"):
        split(alone, RefinementRun("fern", "scattered", 29, 0, "cpu"))


@pytest.fixture
def data(tmp_path, monkeypatch):
    short = replace(presets.settings_for(8), max_splats=200)
    monkeypatch.setattr(presets, "_default", lambda *_: short)
    scenes.write_capture(tmp_path / "data/ball", ball(20))
    network = DenoiserNetwork(Architecture(4, (0, 0, 0)))
    with torch.no_grad():
        network.tail.bias[:12] = 0.02  # a little brighter
        network.tail.bias[12:16] = -1.0
    save_network(network, tmp_path / "a.safetensors", {})
    squeezenet_file(tmp_path / "features.npz")
    return tmp_path


def study_in(data, out="out", **options):
    return Study(data / "data", data / out, **{"seeds": 1, **options})


def given(data, **options):
    files = {"weights": data / "a.safetensors", "features": data / "features.npz"}
    return {"scenes": ("ball",), **files, "steps": 60, **options}


def test_table2_has_a_row_per_method_and_is_kept(data):
    report = study.table2(study_in(data), **given(data))
    for layout in ("localized", "scattered"):
        firsts = [method["rounds"][0] for method in report[layout].values()]
        assert firsts[0] == firsts[1] == firsts[2], "all continue from one fit"
        for name in ("improvement", "absolute"):
            after = report[layout][name]["rounds"][1]
            assert after["done"] == 1.0
            assert after["psnr"] != firsts[0]["psnr"]
            assert set(after) >= {"psnr", "ssim", "flip", "perceptual", "near", "far"}
    assert report["runs"][0]["methods"]["improvement"]["rounds"][1]["added"] == 2
    text = (data / "out/study.md").read_text()
    assert "| ball | localized 10 | improvement | 1 |" in text
    assert "11.259" in text, "the paper's figures are in the report"
    for name in ("study", "ball-localized10", "ball-scattered10"):
        assert (data / f"out/{name}.png").stat().st_size > 5000
    assert json.loads((data / "out/study.json").read_text()) == report
    ran = []
    again = study_in(data, on_run=lambda *done: ran.append(done))
    assert study.table2(again, **given(data)) == report
    assert not ran


def test_other_settings_remove_the_files_of_a_run_and_pictures_may_be_missing(data):
    options = given(data, methods=("ours",), features=None)
    study.table3(study_in(data), **{**options, "steps": 40})
    left = data / "out/rounds/ball-localized4-seed0-cpu/first.png"
    left.with_name("old.png").write_bytes(left.read_bytes())
    report = study.table3(study_in(data), **options)
    assert left.is_file()
    assert not left.with_name("old.png").exists()
    shutil.rmtree(data / "out/rounds")
    with pytest.warns(UserWarning, match="no sheet of ball-localized4-seed0-cpu is drawn"):
        assert study.table3(study_in(data), **options) == report


@pytest.fixture
def pixel_distance(monkeypatch):
    """A distance of pictures for which the right choice is known."""

    def distance(_, first, second):
        return float(np.abs(first.astype(float) - second).mean())

    monkeypatch.setattr(refinement_methods, "picture_distance", distance)


def candidate(view, render, denoised):
    novel = NovelView(view.camera, 0.0, between=False)
    return Candidate(novel, render, denoised, np.ones((40, 40), np.float32), 1.0)


@pytest.mark.parametrize(
    ("name", "best"), [("absolute", 0), ("improvement", 1), ("absolute-before", 2)]
)
def test_the_papers_methods_select_by_the_true_picture(pixel_distance, name, best):
    views = ball(3, alpha=False).views
    # Errors before and after denoising.
    errors = [(30, 2), (60, 10), (20, 20)]
    found = [
        candidate(view, *(np.clip(view.image.astype(int) + e, 0, 255).astype(np.uint8) for e in by))
        for view, by in zip(views, errors, strict=True)
    ]
    method = Method(name, name, 1, 1)
    (selected,) = select_by_true_picture(views, ball(3, alpha=False), method, None, found, 1)
    assert selected is found[best]


def test_the_papers_methods_ignore_masked_pixels(pixel_distance):
    made = ball(8, alpha=False)
    shown = np.zeros((40, 40), np.bool_)
    shown[:, 20:] = True
    views = [replace(view, mask=shown) for view in made.views[:2]]

    def with_error(view, half):
        picture = view.image.copy()
        columns = slice(20 * half, 20 * half + 20)
        picture[:, columns] = 255 - picture[:, columns]
        return candidate(view, np.zeros((40, 40, 3), np.uint8), picture)

    found = [with_error(views[0], 1), with_error(views[1], 0)]
    method = Method("one", "absolute", 1, 1)
    (best,) = select_by_true_picture(views, made, method, None, found, 1)
    assert best is found[1]


def test_the_papers_methods_add_each_view_once():
    made = ball(3)
    method = Method("one", "absolute", 1, 2)
    given = refinement_methods.refine_keywords(method, None, made, made.views, lambda *_: 0.0)
    proposed = given["propose"](BALL, [made.views[0].camera], 24, "cpu")
    assert [novel.camera for novel in proposed] == [view.camera for view in made.views[1:]]


@pytest.mark.long
def test_the_sweep_and_the_ablation(data):
    swept = study.sweep(study_in(data, "sweep"), views=("4",), **given(data))
    rounds = swept["scenes"]["ball"]["scattered 4"]
    assert set(rounds) == {"ours-1", "ours-2", "ours-4"}
    assert all(len(method["rounds"]) <= 5 for method in rounds.values())
    added = [row["added"] for row in swept["runs"][0]["methods"]["ours-2"]["rounds"][1:]]
    assert 0 < max(added) <= 2

    ablated = study.refinement_ablation(study_in(data, "ablation"), **given(data))
    methods = ablated["even"]
    assert set(methods) == {*OURS, "improvement"}
    after = {name: method["rounds"][-1]["psnr"] for name, method in methods.items()}
    assert len(set(after.values())) >= 4, "parts make a difference"


def test_photographs_report_paired_gains(data):
    report = study.photographs(study_in(data), views=("6", "all"), **given(data))
    assert set(report["gains"]["ball"]) == {"even 6", "even 17"}, "20 photos, every 8th held out"
    six = report["gains"]["ball"]["even 6"]["ours"]
    runs = [row["methods"]["ours"]["rounds"] for row in report["runs"] if row["photos"] == 6]
    assert six["psnr"]["gain"] == pytest.approx(
        np.mean([run[-1]["psnr"] - run[0]["psnr"] for run in runs])
    )
    assert report["protocol"]["max_size"] == presets.default_max_size("cpu")
    assert "| mean |  | ours |" in (data / "out/study.md").read_text()


def test_gains_are_paired_by_held_out_view():
    def run(*gains):
        before = [{"psnr": 10.0 * k, "perceptual": None} for k in range(len(gains))]
        after = [{**row, "psnr": row["psnr"] + by} for row, by in zip(before, gains, strict=True)]
        return {"methods": {"ours": {"rounds": [{"views": before}, {"views": after}]}}}

    gains = paired_gains([run(1.0, 3.0), run(2.0, 4.0)], "ours")
    assert set(gains) == {"psnr"}, "no view has the other scores"
    assert list(gains["psnr"].values()) == pytest.approx([2.5, 1.0, np.sqrt(0.5)])
    single = paired_gains([run(0.5)], "ours")
    assert single["psnr"] == {"gain": 0.5, "standard_error": None, "seeds": None}
    mean = mean_gains([gains, single])["psnr"]
    assert mean == {"gain": pytest.approx(1.5), "standard_error": pytest.approx(1.0)}


@pytest.mark.parametrize(
    ("run", "changes", "message"),
    [
        (study.table2, {"methods": ("best",)}, f"methods must be of {', '.join(METHODS)}, not"),
        (study.table2, {"features": None}, "give --features"),
        (study.table2, {"weights": "none"}, "none does not exist"),
        (study.table2, {"scenes": ("nothing",)}, "nothing does not exist; name --scene"),
        (study.sweep, {"views": ("many",)}, "views must be numbers of photos, not many"),
        (study.photographs, {"views": ("many",)}, 'views must be numbers of photos or "all"'),
        (study.photographs, {"views": ("0",)}, 'views must be numbers of photos or "all"'),
        (study.photographs, {"views": ()}, 'views must be numbers of photos or "all", not none'),
    ],
)
def test_bad_arguments_are_refused_before_the_first_fit(data, run, changes, message):
    with pytest.raises(igsr.IgsrError, match=message):
        run(study_in(data), **given(data, **changes))
    assert not (data / "out").exists()
