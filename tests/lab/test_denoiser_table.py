"""Study ``denoiser_table``: renders of degraded fits before and after denoising."""

import json
from dataclasses import replace

import capture_files
import numpy as np
import pytest
import scenes
import torch

import igsr
from igsr.capture import Capture
from igsr.denoiser.architecture import Architecture
from igsr.denoiser.inputs import CHANNELS
from igsr.denoiser.network import DenoiserNetwork
from igsr.denoiser.weights import save_network
from igsr.fitting import presets
from igsr_lab.denoiser.pair_files import Pairs, write_pairs
from igsr_lab.study import Study, degraded_fits, denoiser_study, denoiser_table
from igsr_lab.study.cleaned_renders import SCORES, Cleaning, run_cleaning
from igsr_lab.study.degraded_fits import DegradedFit, degraded_capture, scenes_in

SMALL = Architecture(4, (1, 0, 0))


def weights(path, brighter=0.0, log_error=-3.0):
    """A denoiser that adds ``brighter`` to every color and expects the same error everywhere."""
    network = DenoiserNetwork(SMALL)
    with torch.no_grad():
        # Before pixel shuffle each output has four channels; the offset of log errors is -3.
        network.tail.bias[:12] = brighter
        network.tail.bias[12:16] = log_error + 3.0
        network.tail.bias[16:] = -100.0  # photos do not count
    save_network(network, path, {})
    return str(path)


def pairs(path, hidden=0):
    """Two views whose left half is right and whose right half is 20 too dark."""
    random = np.random.default_rng(0)
    truth = random.integers(30, 200, (2, 3, 40, 48), dtype=np.uint8)
    inputs = np.zeros((2, CHANNELS, 40, 48), np.uint8)
    inputs[:, :3] = truth
    inputs[:, :3, :, 24:] -= 20
    masks = np.ones((2, 40, 48), np.bool_)
    masks[..., :hidden] = False
    write_pairs(path, Pairs(inputs, truth, masks))
    return str(path)


@pytest.fixture
def scores(tmp_path):
    """A function that scores pairs, and the same after a denoiser."""

    def both(hidden=0, **denoiser):
        file = pairs(tmp_path / "pairs.npz", hidden)
        found = [None, weights(tmp_path / "a.safetensors", **denoiser)]
        return [run_cleaning("", Cleaning(file, one, None)) for one in found]

    return both


def test_a_denoiser_that_does_nothing_changes_no_score(scores):
    before, same = scores()
    assert before["psnr"] == pytest.approx(-10 * np.log10(np.square(20 / 255) / 2))
    assert before["best_quarter"] == 100.0
    assert before["perceptual"] is None
    for name in SCORES:
        assert same[name] == before[name]
    found = same["confidence"]
    assert found["mean_error"] == pytest.approx(10 / 255, rel=1e-5)
    assert found["weighted_error"] == pytest.approx(10 / 255, rel=1e-5)
    claimed = 0.05 / (0.05 + np.exp(-3.0))
    assert sum(found["confidence"]) / sum(found["pixels"]) == pytest.approx(claimed, rel=1e-2)


def test_the_best_quarter_shows_harm_to_good_pixels_and_hidden_ones_do_not_count(scores):
    # A confident denoiser makes all of its change: good pixels become 10 too bright.
    _, brighter = scores(brighter=10.2 / 255, log_error=-7.0)
    before, same = scores(hidden=24)
    for name in ("psnr", "best_quarter"):
        assert brighter[name] == pytest.approx(-20 * np.log10(10 / 255), abs=0.05)
        assert before[name] == pytest.approx(-20 * np.log10(20 / 255))
    assert sum(same["confidence"]["pixels"]) == 2 * 40 * 24


def test_photos_of_degraded_fits():
    made = scenes.capture(views=40, size=16)

    def degraded(kind, seed=0, capture=made, scene="ball"):
        return degraded_capture(capture, DegradedFit(scene, kind, seed, "cpu"))

    few, noisy, paper = degraded("3"), degraded("noise"), degraded("paper")
    expected = [made.train_views[i].name for i in (0, 14, 29)]
    assert [view.name for view in few.train_views] == expected
    assert len(few.test_views) == 8, "of ten"
    assert len(noisy.train_views) == 20
    assert noisy.points is None
    by_name = {view.name: view for view in made.views}
    for view in noisy.train_views:
        assert not np.allclose(view.camera.viewmat, by_name[view.name].camera.viewmat, atol=1e-4)
    for view in noisy.test_views:
        assert np.array_equal(view.camera.viewmat, by_name[view.name].camera.viewmat)
    K = paper.train_views[0].camera.K
    assert abs(K[0, 0] / K[1, 1] - 1.0) > 1e-3, "affine noise is kept"
    other = degraded("noise", seed=1).train_views[0].camera.viewmat
    assert not np.array_equal(noisy.train_views[0].camera.viewmat, other)

    whole = Capture(made.path, [replace(view, split="train") for view in made.views])
    assert len(degraded("6", capture=whole, scene="leaf").train_views) == 6
    assert len(degraded("noise", capture=whole, scene="leaf").train_views) == 20
    with pytest.raises(igsr.IgsrError, match="has 3 photos to fit, not 6"):
        degraded("6", capture=scenes.capture(views=4, size=16))


@pytest.fixture
def data(tmp_path, monkeypatch):
    """A folder of scenes whose fits are short."""
    short = replace(presets.settings_for(8), steps=20, max_splats=200)
    monkeypatch.setattr(presets, "_default", lambda *_: short)
    monkeypatch.setattr(denoiser_study, "SHIPPED", tmp_path / "same.safetensors")
    weights(tmp_path / "same.safetensors")
    scenes.write_capture(tmp_path / "data/ball", scenes.capture(views=6, size=24))
    scenes.write_capture(tmp_path / "data/more/cube", scenes.capture(views=6, size=24))
    (tmp_path / "data/empty").mkdir()
    return tmp_path / "data"


def test_images_of_a_capture_are_not_another_scene(data, tmp_path):
    assert scenes_in(data) == ("ball", "more/cube")
    for name in ("leaf", "stone"):
        (tmp_path / "two" / name / "images").mkdir(parents=True)
        capture_files.write_transforms(tmp_path / "two" / name)
    assert scenes_in(tmp_path / "two") == ("leaf", "stone")
    with pytest.raises(igsr.IgsrError, match="holds no folder of photos with cameras"):
        scenes_in(data / "empty")


def test_denoisers_are_compared_and_other_weights_are_scored_again(
    data, tmp_path, monkeypatch, lab_here
):
    dark = weights(tmp_path / "dark.safetensors", brighter=-0.2)
    command = ["study", "denoiser-table", data, "--out", tmp_path / "out", "--kind", "3"]
    command += ["--denoiser", f"dark={dark}", "--json", "--backend", "cpu"]
    refused = lab_here(*command, "--denoiser", "mine")
    assert refused.returncode == 1
    assert "--denoiser must be NAME=FILE, each name once, not 'mine'" in refused.stderr
    done = lab_here(*command, "--kind", "noise")
    assert done.returncode == 0, done.stderr
    assert "4 of 4: more/cube noise seed 0: 1 renders" in done.stderr
    report = json.loads(done.stdout)
    assert report == json.loads((tmp_path / "out/study.json").read_text())
    ball, cube = (report["scenes"][name] for name in ("ball", "cube"))
    assert ball["after"] == ball["before"]
    assert ball["others"]["dark"]["psnr"] < ball["before"]["psnr"]
    of_kinds = [ball["kinds"][kind]["before"]["psnr"] for kind in ("3", "noise")]
    assert ball["before"]["psnr"] == pytest.approx(np.mean(of_kinds))
    noise = [scene["kinds"]["noise"]["before"]["psnr"] for scene in (ball, cube)]
    assert report["mean"]["noise"]["before"]["psnr"] == pytest.approx(np.mean(noise))
    assert "| ball | 3 | dark |" in (tmp_path / "out/study.md").read_text()
    for picture in ("study.png", "confidence.png", "ball.png", "cube.png"):
        assert (tmp_path / "out" / picture).stat().st_size > 1000

    weights(tmp_path / "same.safetensors", brighter=0.1)
    pairs(tmp_path / "pairs/a-sparse-0.npz")
    (tmp_path / "pairs/.b-sparse-0.npz.unfinished.npz").write_bytes(b"killed")
    study = Study(data, tmp_path / "out", seeds=1)
    monkeypatch.setattr(denoiser_study, "run_fit", lambda *given: 1 / 0)  # not called
    changed = denoiser_table(study, kinds=("3", "noise"), pairs=tmp_path / "pairs")
    assert changed["artifacts"]["renders"] == {"real": 2, "synthetic": 2}
    assert "octaves from the training pairs'" in (tmp_path / "out/study.md").read_text()
    assert changed["scenes"]["ball"]["before"] == ball["before"]
    assert changed["scenes"]["ball"]["after"] != ball["after"]


def test_fits_of_other_photos_are_repeated(data, tmp_path, monkeypatch):
    monkeypatch.setattr(degraded_fits, "PAPER_STEPS", 5)
    study = Study(data, tmp_path / "out", seeds=1)
    options = {"scenes": ("ball",), "kinds": ("3", "paper")}
    first = denoiser_table(study, **options)
    assert set(first["mean"]) == {"sparse", "paper"}
    assert first["protocol"]["kinds"]["paper"] == "at most 20 photos, raw-affine 0.01, 5 steps"
    made = scenes.capture(views=6, size=24)
    darker = [replace(view, image=view.image // 2) for view in made.views]
    scenes.write_capture(data / "ball", replace(made, views=darker))
    second = denoiser_table(study, **options)
    other = denoiser_table(replace(study, out=tmp_path / "other"), **options)
    ball = [report["scenes"]["ball"] for report in (first, second, other)]
    assert ball[1] == ball[2] != ball[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kinds": ("4",)}, "kinds must be of 3, 6, 9, noise, paper, not '4'"),
        ({"kinds": ()}, "kinds must be of"),
        ({"scenes": ("ball", "more/ball")}, "two scenes are called ball"),
        ({"scenes": ("nothing",)}, "nothing does not exist"),
        ({"denoisers": {"igsr": "a"}}, "denoisers cannot be called igsr or before"),
        ({"denoisers": {"mine": "nothing.safetensors"}}, "nothing.safetensors does not exist"),
        ({"pairs": "nothing"}, "nothing holds no pairs of recipe sparse"),
        ({"kinds": ("9",)}, "views must be from 1 to 5, not 9"),
        ({"scenes": ("more/cube", "more-cube")}, "more/cube and more-cube would have one name"),
    ],
)
def test_bad_arguments_are_refused_before_the_first_fit(data, tmp_path, options, message):
    paths = {name: tmp_path / value for name, value in options.items() if name == "pairs"}
    with pytest.raises(igsr.IgsrError, match=message):
        denoiser_table(Study(data, tmp_path / "out"), **{**options, **paths})
    assert not (tmp_path / "out").exists()
