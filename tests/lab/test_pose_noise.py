"""Study ``pose_noise``: fits with noise on their cameras."""

import json
from dataclasses import replace

import numpy as np
import pytest
import scenes

import igsr
from igsr.capture import Capture
from igsr.fitting import presets
from igsr_lab.camera_noise import Noise
from igsr_lab.study import Study, noisy_poses, pose_noise
from igsr_lab.study.noisy_poses import CLEAN, PoseFit, compared, run_fit


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("noise")
    full = scenes.capture(views=98, size=16, alpha=True, scene=scenes.splats(count=10))
    for split, views in (("train", full.views[:96]), ("test", full.views[96:])):
        scenes.write_capture(folder / "ball", Capture(full.path, views))
        (folder / "ball/transforms.json").rename(folder / f"ball/transforms_{split}.json")
    return folder


def fake_row(data, fit):
    psnrs = {"clean": 28.0, "fixed": 18.0, "joint": 27.0}
    level = psnrs["clean" if fit.noise == CLEAN else fit.poses]
    scores = {
        way: {"psnr": level + more, "ssim": 0.9, "flip": 0.1}
        for way, more in (("raw", -1.0), ("aligned", 0.0), ("refined", 0.5 * fit.seed))
    }
    errors = {
        when: dict.fromkeys(noisy_poses.ERRORS, by)
        for when, by in (("before", 0.6), ("after", 0.1))
    }
    rest = {"splats": 10, "seconds": 1.0, "protocol": {"views": 2}}
    return {**vars(fit), "noise": str(fit.noise), **errors, **rest, **scores}


def test_joint_poses_are_compared_with_fixed_and_clean_ones(data, tmp_path, monkeypatch):
    monkeypatch.setattr(noisy_poses, "run_fit", fake_row)
    study = Study(data, tmp_path, seeds=2)
    report = pose_noise(study, scenes=("ball",), turns=(2.0,), raw_affine=True)
    kinds = [line["noise"] for line in report["summary"][::2]]
    assert kinds == ["matrix 0.01", "turn 2°", "raw-affine 0.01"]
    line = report["summary"][0]
    assert line["recovered"] == pytest.approx(0.9)
    assert line["short_of_clean"] == pytest.approx(1.0)
    assert line["joint"]["psnr_spread"] == pytest.approx(0.5 / np.sqrt(2.0))
    assert json.loads((tmp_path / "study.json").read_text()) == report
    table = (tmp_path / "study.md").read_text()
    assert "| 90 % | 1.00 | 0.600 → 0.100 (6.0 ×) | 0.6000 → 0.1000 (6.0 ×) |" in table
    assert (tmp_path / "study.png").stat().st_size > 1000
    assert compared(report["runs"], "turn 2°", "ball") == report["summary"][2]


def test_a_scene_with_noise_is_fitted_and_scored(data, monkeypatch):
    short = replace(presets.settings_for(8), steps=40, max_splats=300, sh_degree=0, poses="joint")
    monkeypatch.setattr(presets, "_default", lambda *_: short)
    row = run_fit(str(data), PoseFit("ball", Noise("turn", 1.0), "joint", 0, "cpu"))
    assert row["before"].keys() == row["after"].keys() == noisy_poses.ERRORS.keys()
    assert row["before"]["rotation"] == pytest.approx(1.0, abs=0.2)
    assert set(row["refined"]) == {"psnr", "ssim", "flip"}
    assert row["refined"]["psnr"] > 10.0


def test_bad_arguments_are_refused(data, tmp_path):
    for options, message in (
        ({"noise": -1.0}, "noise and turns"),
        ({"turns": (float("nan"),)}, "noise and turns"),
        ({"scenes": ("nothing",)}, "holds no transforms_train.json"),
    ):
        with pytest.raises(igsr.IgsrError, match=message):
            pose_noise(Study(data, tmp_path), **{"scenes": ("ball",), **options})


@pytest.mark.parametrize(
    ("study", "option"),
    [
        ("pose-noise", ["--preset", "3dgs"]),
        ("blender8", ["--raw-affine"]),
        ("few-photos", ["--noise", "0.1"]),
        ("own-photos", ["--ray"]),
        ("poses", ["--backend", "cpu"]),
    ],
)
def test_a_study_has_no_options_of_others(data, tmp_path, lab_here, study, option):
    done = lab_here("study", study, data, "--out", tmp_path, *option)
    assert done.returncode == 2
    assert f"No such option: {option[0]}" in done.stderr
