"""``python -m igsr_lab study table2 | table3 | sweep | photographs | refinement-ablation``."""

from __future__ import annotations

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
from igsr_lab.study import loop_methods
from igsr_lab.study.loop_gains import mean_gains, paired_gains
from igsr_lab.study.loop_methods import METHODS, OURS, Method
from igsr_lab.study.loop_runs import RunSpec, split
from igsr_lab.study.splits import localized, scattered

BALL = scenes.splats(60)


def ball(views, alpha=True):
    return scenes.capture(views=views, size=40, alpha=alpha, scene=BALL)


def looks(views):
    return np.stack([view.camera.viewmat[2, :3] for view in views])


def test_localized_photos_are_neighbours_and_scattered_ones_go_round():
    cameras = [view.camera for view in ball(24).views]  # a ring, 15 degrees apart
    assert set(localized(cameras, 5)) == {22, 23, 0, 1, 2}
    assert localized(cameras, 5)[0] == 0
    assert scattered(cameras, 2) == [0, 12]
    assert set(scattered(cameras, 4)) == {0, 6, 12, 18}
    assert len(set(scattered(cameras, 24))) == 24


def test_views_of_a_run():
    made = ball(100)
    photos, held, given = split(made, RunSpec("ball", "localized", 10, 0, "cpu"))
    assert len(photos.train_views) == 10
    assert not photos.test_views
    assert [len(held), len(given)] == [15, 10]
    assert {view.name for view in (*held, *given)} == {view.name for view in made.test_views}

    alone = Capture(made.path, [replace(view, split="train") for view in made.views[:35]])
    photos, held, given = split(alone, RunSpec("tankard", "localized", 4, 0, "cpu"))
    names = [{view.name for view in some} for some in (photos.views, held, given)]
    assert [len(some) for some in names] == [4, 7, 6]
    assert len(names[0] | names[1] | names[2]) == 17
    photos, held, given = split(alone, RunSpec("fern", "even", 3, 0, "cpu"))
    by_name = sorted(view.name for view in alone.views)
    assert [view.name for view in held] == by_name[::8], "as in LLFF's protocol"
    with pytest.raises(igsr.IgsrError, match="has 28 photos to fit, not 29"):
        split(alone, RunSpec("fern", "scattered", 29, 0, "cpu"))


@pytest.fixture
def data(tmp_path, monkeypatch):
    short = replace(presets.settings_for("default", 8), max_splats=200)
    monkeypatch.setattr(presets, "_default", lambda *_: short)
    scenes.write_capture(tmp_path / "data/ball", ball(20))
    network = DenoiserNetwork(Architecture(4, (0, 0, 0)))
    with torch.no_grad():
        network.tail.bias[:12] = 0.02  # a little brighter
        network.tail.bias[12:16] = -1.0
    save_network(network, tmp_path / "a.safetensors", {})
    squeezenet_file(tmp_path / "features.npz")
    return tmp_path


def given(data, **options):
    return {
        "scenes": ("ball",),
        "weights": data / "a.safetensors",
        "features": data / "features.npz",
        "steps": 60,
        "seeds": 1,
        **options,
    }


def test_table2_has_a_row_per_method_and_goes_on_where_it_stopped(data):
    report = study.table2(data / "data", data / "out", **given(data))
    for layout in ("localized", "scattered"):
        assert set(report[layout]) == {"ours", "improvement", "absolute"}
        firsts = [method["rounds"][0] for method in report[layout].values()]
        assert firsts[0] == firsts[1] == firsts[2], "all go on from one fit"
        for name in ("improvement", "absolute"):
            one = report[layout][name]["rounds"][1]
            assert one["accepted"] == 1.0, "the paper keeps every round"
            assert one["psnr"] != firsts[0]["psnr"]
            assert set(one) >= {"psnr", "ssim", "flip", "perceptual", "near", "far"}
    rows = report["runs"][0]["methods"]
    assert rows["improvement"]["rounds"][1]["added"] == 2
    text = (data / "out/study.md").read_text()
    assert "| ball | localized 10 | ours | 0 |" in text
    assert "| ball | localized 10 | improvement | 1 |" in text
    assert "11.259" in text, "the paper's figures stand beside"
    for name in ("study", "ball-localized10", "ball-scattered10"):
        assert (data / f"out/{name}.png").stat().st_size > 5000
    assert json.loads((data / "out/study.json").read_text()) == report
    ran = []
    again = study.table2(
        data / "data", data / "out", on_run=lambda *done: ran.append(done), **given(data)
    )
    assert again == report
    assert not ran


def test_other_settings_begin_anew_and_pictures_may_be_gone(data):
    options = {"scenes": ("ball",), "methods": ("ours",), "seeds": 1}
    options |= {"weights": data / "a.safetensors"}
    study.table3(data / "data", data / "out", **options, steps=40)
    left = data / "out/rounds/ball-localized4-seed0-cpu/first.png"
    left.with_name("old.png").write_bytes(left.read_bytes())
    report = study.table3(data / "data", data / "out", **options, steps=50)
    assert left.is_file()
    assert not left.with_name("old.png").exists()
    shutil.rmtree(data / "out/rounds")
    with pytest.warns(UserWarning, match="no sheet of ball-localized4-seed0-cpu is drawn"):
        assert study.table3(data / "data", data / "out", **options, steps=50) == report


def test_the_papers_choice_is_blind_where_masks_are():
    made = ball(8, alpha=False)
    shown = np.zeros((40, 40), np.bool_)
    shown[:, 20:] = True
    views = [replace(view, mask=shown) for view in made.views[:2]]
    black = np.zeros((40, 40, 3), np.uint8)

    def found(view, wrong):
        # One is right where the mask is, the other where it is not.
        picture = view.image.copy()
        picture[:, 20 * wrong : 20 * wrong + 20] = 255 - picture[:, 20 * wrong : 20 * wrong + 20]
        unseen = NovelView(view.camera, 0.0, between=False)
        return Candidate(unseen, black, picture, np.ones((40, 40), np.float32), 1.0)

    given = [found(views[0], 1), found(views[1], 0)]

    def distance(_, one, other):
        return float(np.abs(one.astype(float) - other).mean())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop_methods, "picture_distance", distance)
        method = Method("one", "absolute", 1, 1, cross_validate=False)
        (best,) = loop_methods._by_true_picture(views, made, method, None, given, 1)
    assert best is given[1]


def test_the_papers_choice_is_by_the_true_picture(data, monkeypatch):
    chosen = []
    real = loop_methods._by_true_picture

    def watched(candidates, photos, method, distance, found, count):
        out = real(candidates, photos, method, distance, found, count)
        chosen.append((method.method, candidates, found, out))
        return out

    monkeypatch.setattr(loop_methods, "_by_true_picture", watched)
    # Distances are of mean brightness, so that the right choice is known.
    monkeypatch.setattr(
        loop_methods,
        "picture_distance",
        lambda _, one, other: abs(float(one.mean()) - float(other.mean())),
    )
    study.table3(
        data / "data",
        data / "out",
        **given(data, methods=("absolute", "improvement", "absolute-before")),
    )
    methods = [method for method, *_ in chosen]
    assert methods[::2] == methods[1::2] == ["absolute", "improvement", "absolute-before"]
    for method, candidates, found, out in chosen:

        def rank(one, method=method, candidates=candidates):
            view = next(v for v in candidates if v.camera is one.view.camera)
            rgba = view.image.astype(np.float64) / 255.0
            truth = 255.0 * (rgba[..., :3] * rgba[..., 3:] + 1.0 - rgba[..., 3:]).mean()
            before, after = (abs(p.mean() - truth) for p in (one.render, one.denoised))
            return {"absolute": after, "improvement": after - before}.get(method, before)

        assert len(out) == 1
        assert rank(out[0]) <= min(rank(one) for one in found) + 0.02
    (_, candidates, first, one), (*_, second, other) = chosen[:2]
    assert len(second) == len(first) - 1, "what was added is not chosen again"
    assert one[0].view.camera is not other[0].view.camera


@pytest.mark.long
def test_the_sweep_and_the_ablation(data):
    swept = study.sweep(data / "data", data / "sweep", views=("4",), **given(data))
    rounds = swept["scenes"]["ball"]["scattered 4"]
    assert set(rounds) == {"ours-1", "ours-2", "ours-4"}
    assert all(len(method["rounds"]) <= 5 for method in rounds.values())
    added = [one["added"] for one in swept["runs"][0]["methods"]["ours-2"]["rounds"][1:]]
    assert 0 < max(added) <= 2

    ablated = study.refinement_ablation(data / "data", data / "ablation", **given(data))
    methods = ablated["even"]
    assert set(methods) == {*OURS, "improvement"}
    after = {name: method["rounds"][-1]["psnr"] for name, method in methods.items()}
    assert len(set(after.values())) >= 4, "what is taken out shows"


def test_photographs_tell_what_kept_rounds_gain(data):
    """All photos but every 8th, and the gain of each held-out view."""
    report = study.photographs(data / "data", data / "out", views=("6", "all"), **given(data))
    assert set(report["gains"]["ball"]) == {"even 6", "even 17"}, "20 photos, every 8th held out"
    six = report["gains"]["ball"]["even 6"]["ours"]
    runs = [row["methods"]["ours"]["rounds"] for row in report["runs"] if row["photos"] == 6]
    assert six["psnr"]["gain"] == pytest.approx(
        np.mean([run[-1]["psnr"] - run[0]["psnr"] for run in runs])
    )
    assert report["protocol"]["max_size"] == presets.default_max_size("cpu")
    assert "| mean | | ours |" in (data / "out/study.md").read_text()


def test_gains_are_paired_by_held_out_view():
    def run(*gains):
        before = [{"psnr": 10.0 * k, "perceptual": None} for k in range(len(gains))]
        after = [{**one, "psnr": one["psnr"] + by} for one, by in zip(before, gains, strict=True)]
        return {"methods": {"ours": {"rounds": [{"views": before}, {"views": after}]}}}

    gains = paired_gains([run(1.0, 3.0), run(2.0, 4.0)], "ours")
    assert set(gains) == {"psnr"}, "no view has the other scores"
    assert gains["psnr"]["gain"] == pytest.approx(2.5)
    assert gains["psnr"]["standard_error"] == pytest.approx(1.0), "of 1.5 and 3.5"
    assert gains["psnr"]["seeds"] == pytest.approx(np.sqrt(0.5))
    one = paired_gains([run(0.5)], "ours")
    assert one["psnr"] == {"gain": 0.5, "standard_error": None, "seeds": None}
    assert mean_gains([gains, one])["psnr"]["gain"] == pytest.approx(1.5)
    assert mean_gains([gains, one])["psnr"]["standard_error"] == pytest.approx(1.0)


def test_bad_arguments_are_refused_before_the_first_fit(data, lab_here):
    for changes, message in (
        ({"methods": ("best",)}, f"methods must be of {', '.join(METHODS)}, not 'best'"),
        ({"features": None}, "give --features"),
        ({"weights": "none"}, "none does not exist"),
        ({"seeds": 0}, "seeds and jobs must be at least 1"),
        ({"scenes": ("nothing",)}, "nothing does not exist; name --scene"),
    ):
        with pytest.raises(igsr.IgsrError, match=message):
            study.table2(data / "data", data / "bad", **given(data, **changes))
    with pytest.raises(igsr.IgsrError, match="views must be numbers of photos, not many"):
        study.sweep(data / "data", data / "bad", views=("many",), **given(data))
    for views in (("many",), ("0",), ()):
        with pytest.raises(igsr.IgsrError, match='views must be numbers of photos or "all", not'):
            study.photographs(data / "data", data / "bad", views=views, **given(data))
    assert not (data / "bad").exists()
    command = ["study", "table2", data / "data", "--out", data / "bad"]
    refused = lab_here(*command, "--noise", "0.1")
    assert refused.returncode == 2
    assert "No such option: --noise" in refused.stderr
    refused = lab_here(*command, "--scene", "ball", "--weights", data / "a.safetensors")
    assert "chooses by a perceptual distance; give --features" in refused.stderr
