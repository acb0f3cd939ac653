"""Studies ``blender8`` and ``few_photos``: splits, kept runs, tables."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import scenes
from ray_stand_in import stand_in_ray

import igsr
from igsr.capture import Capture
from igsr.evaluation import metrics
from igsr.evaluation.scores import ScoredView
from igsr_lab.presets import PRESETS, preset_settings
from igsr_lab.resumable_jobs import folder_hash
from igsr_lab.study import Study, blender8, few_photos, preset_fits
from igsr_lab.study.preset_fits import Fit, load_blender8, load_few_photos, run_fit
from igsr_lab.study.splits import dtu_views, llff_views, with_train_views
from igsr_lab.study.study import summarized

#: Keywords of a preset that takes no time.
SHORT = {
    "steps": 20,
    "max_splats": 300,
    "sh_degree": 0,
    "density": "fixed",
    "transients": "off",
    "start": "random",
}


#: Keywords of a study of one scene.
OPTIONS = {"scenes": ("ball",), "views": ("75",), "presets": ("default", "3dgs")}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder with one scene of 100 train and 2 test views of 16 x 16 pixels."""
    folder = tmp_path_factory.mktemp("data")
    made = scenes.capture(views=102, size=16, alpha=True, scene=scenes.splats(count=10))
    for split, views in (("train", made.views[:100]), ("test", made.views[100:])):
        scenes.write_capture(folder / "ball", Capture(made.path, views))
        (folder / "ball/transforms.json").rename(folder / f"ball/transforms_{split}.json")
    return folder


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """A folder with two captures without alpha, of 20 and 49 photos of 16 x 16 pixels."""
    folder = tmp_path_factory.mktemp("real")
    scene = scenes.splats(count=10)
    for name, views in (("leaf", 20), ("dtu_1", 49)):
        scenes.write_capture(folder / name, scenes.capture(views=views, size=16, scene=scene))
    return folder


def fake_row(fit, psnr):
    scores = {"psnr": psnr, "ssim": 0.9, "flip": 0.1, "splats": 10, "seconds": 1.0}
    return {**vars(fit), **scores, "protocol": {"views": 2, "ssim": "window", "flip": "LDR"}}


def names(views):
    return [int(view.name.removeprefix("photos/").removesuffix(".png")) for view in views]


def test_blender8_fits_the_views_of_the_protocol(data):
    capture = igsr.load_capture(data / "ball")
    numbers = preset_fits.VIEW_IDS["75"]
    chosen = with_train_views(capture, numbers)
    assert names(chosen.train_views) == [26, 86, 2, 55, 75, 93, 16, 73]
    assert len(chosen.test_views) == 2
    with pytest.raises(igsr.IgsrError, match="needs number 93"):
        with_train_views(Capture(capture.path, capture.views[:50]), numbers)


def test_a_study_continues_after_an_interruption(data, tmp_path, monkeypatch):
    done = []

    def quick(load, folder, fit):
        done.append(fit)
        if len(done) == 3:
            raise igsr.IgsrError("out of patience")
        return fake_row(fit, 20.0 + fit.seed + (fit.preset == "default"))

    monkeypatch.setattr(preset_fits, "run_fit", quick)
    study = Study(data, tmp_path / "out", seeds=2)
    with pytest.raises(igsr.IgsrError, match="out of patience"):
        blender8(study, **OPTIONS)
    assert len(list((tmp_path / "out/runs").iterdir())) == 2
    report = blender8(study, **OPTIONS)
    assert len(done) == 5
    settings = preset_settings("default", 8) | {"data": folder_hash(data / "ball")}
    assert report["runs"][0]["settings"] == settings, "fits of other photos are repeated"
    assert report == json.loads((tmp_path / "out/study.json").read_text())
    assert report["mean"]["default"]["psnr"] == 21.5
    assert report["mean"]["default"]["psnr_spread"] == pytest.approx(np.sqrt(0.5))
    assert report["scenes"]["ball"]["75"]["3dgs"]["psnr"] == 20.5
    table = (tmp_path / "out/study.md").read_text()
    assert "| mean | all | default | 21.50 ± 0.71 |" in table
    assert (tmp_path / "out/study.png").stat().st_size > 1000

    # Fits with other settings are repeated.
    file = tmp_path / "out/runs/ball-views75-default-seed0-cpu.json"
    row = json.loads(file.read_text())
    row["settings"]["steps"] += 1
    file.write_text(json.dumps(row))
    assert blender8(study, **OPTIONS) == report
    assert len(done) == 6


def test_photos_are_fitted_and_scored(data, monkeypatch):
    monkeypatch.setattr(preset_fits, "preset_keywords", lambda preset, capture: SHORT)
    row = run_fit(load_blender8, str(data), Fit("ball", "76", "default", 1, "cpu"))
    assert row["psnr"] > 10.0
    assert row["splats"] <= 300
    assert row["protocol"]["views"] == 2
    assert row["protocol"]["background"] == [1.0, 1.0, 1.0]


def test_spread_is_over_seeds_not_scenes():
    psnrs = [(0, 10.0), (0, 30.0), (1, 12.0), (1, 32.0)]
    rows = [{"seed": seed, "psnr": psnr} for seed, psnr in psnrs]
    summary = summarized(rows, ["psnr"])
    assert summary == {"fits": 4, "psnr": 21.0, "psnr_spread": pytest.approx(np.sqrt(2.0))}
    assert summarized(rows[:1], ["psnr"])["psnr_spread"] is None


@pytest.mark.parametrize(
    ("run", "options", "message"),
    [
        (few_photos, {"views": ("three",)}, "views must be numbers of photos, such as 3"),
        (few_photos, {"views": ("18",)}, "views must be from 1 to 17, not 18"),
        (few_photos, {"scenes": ("nothing",)}, "nothing does not exist"),
        (few_photos, {"presets": ("best",)}, "preset must be one of"),
        (blender8, {"scenes": ("nothing",)}, "nothing holds no transforms_train.json"),
        (blender8, {"views": ("77",)}, "views must be of 75, 76"),
    ],
)
def test_bad_arguments_are_refused_before_the_first_fit(real, tmp_path, run, options, message):
    with pytest.raises(igsr.IgsrError, match=message):
        run(Study(real, tmp_path), **{"scenes": ("leaf",), **options})
    for name in ("seeds", "jobs"):
        with pytest.raises(igsr.IgsrError, match=f"{name} must be at least 1, not 0"):
            Study(real, tmp_path, **{name: 0})
    assert not list(tmp_path.iterdir())


def test_llff_holds_out_every_8th_photo():
    capture = scenes.capture(views=20, size=16)
    chosen = llff_views(Capture(capture.path, capture.views[::-1]), 3)
    assert names(chosen.test_views) == [0, 8, 16]
    assert names(chosen.train_views) == [1, 10, 19]
    assert names(llff_views(capture, 6).train_views) == [1, 4, 7, 12, 15, 19]
    assert len(llff_views(capture, 17).train_views) == 17
    with pytest.raises(igsr.IgsrError, match="views must be from 1 to 17, not 0"):
        llff_views(capture, 0)


def test_dtu_has_a_list_of_train_photos():
    capture = scenes.capture(views=49, size=16)
    chosen = dtu_views(capture, 6)
    assert names(chosen.train_views) == [25, 22, 28, 40, 44, 48]
    tested = names(chosen.test_views)
    assert (len(tested), tested[0], tested[-1]) == (25, 1, 47)
    assert not {0, 8, 13, 25, 22, 28, 40, 44, 48} & set(tested)
    with pytest.raises(igsr.IgsrError, match="views must be from 1 to 9 for DTU, not 10"):
        dtu_views(capture, 10)
    with pytest.raises(igsr.IgsrError, match="has 40 photos; DTU's protocol needs number 47"):
        dtu_views(Capture(capture.path, capture.views[:40]), 3)
    masked = [replace(view, mask=np.ones((16, 16), bool)) for view in capture.views]
    chosen = dtu_views(Capture(capture.path, masked), 3)
    assert all(view.mask is None for view in chosen.train_views)
    assert all(view.mask is not None for view in chosen.test_views)


def test_pictures_of_dtu_are_white_outside_their_masks():
    photo = np.full((16, 16, 3), 200, np.uint8)
    mask = np.zeros((16, 16), bool)
    mask[4:12, 4:12] = True
    render = np.where(mask[..., None], photo, np.uint8(7))
    view = ScoredView("1", photo, render, mask, {"psnr": 100.0})
    for white, same in ((True, True), (False, None)):
        more = preset_fits.MoreScores(white_outside=white, lpips=None)
        more.add(view)
        assert more.means() == ({"ssim": pytest.approx(1.0)} if same else {})
    more = preset_fits.MoreScores(white_outside=True, lpips=None)
    more.add(replace(view, render=np.full_like(photo, 100)))
    white_photo, white_render = photo.copy(), np.full_like(photo, 100)
    white_photo[~mask] = white_render[~mask] = 255
    assert more.means()["ssim"] == pytest.approx(metrics.ssim(white_render, white_photo))
    assert more.means()["ssim"] < 0.999


def test_published_results_are_in_the_table():
    rows = preset_fits.published_rows([("fern", "3"), ("dtu_1", "3"), ("leaf", "3")])
    assert {row["scene"] for row in rows} == {"fern", "dtu_1"}
    assert max(row["psnr"] for row in rows if row["scene"] == "fern") == 23.84


def test_few_photos_has_a_row_by_scene_views_and_preset(real, tmp_path, monkeypatch, lab_here):
    seen = []

    def quick(load, folder, fit, refined):
        seen.append((fit.scene, len(load(folder, fit).train_views)))
        return fake_row(fit, float(fit.views)) | {"psnr_refined": float(fit.views) + 0.5}

    monkeypatch.setattr(preset_fits, "run_fit", quick)
    study = ["study", "few-photos", real, "--out", tmp_path, "--scene", "leaf", "--scene", "dtu_1"]
    done = lab_here(*study, "--seeds", "1")
    assert done.returncode == 0, done.stderr
    assert f"1 of {6 * len(PRESETS)}: leaf views 3 default seed 0: 3.00 dB" in done.stderr
    assert seen[:: len(PRESETS)] == [(scene, n) for scene in ("leaf", "dtu_1") for n in (3, 6, 9)]
    report = json.loads((tmp_path / "study.json").read_text())
    assert set(report["mean"]) == set(PRESETS)
    assert report["scenes"]["dtu_1"]["6"]["default"]["psnr"] == 6.0
    split = report["protocol"]["scenes"]["dtu_1"]
    assert split["split"] == "DTU"
    assert split["train_views"]["3"] == [f"photos/{i}.png" for i in (25, 22, 28)]
    assert "| preset | PSNR, dB | refined PSNR, dB | SSIM |" in done.stdout
    assert "| leaf | 9 | default | 9.00 | 9.50 |" in done.stdout
    refused = lab_here(*study, "--views", "18")
    assert refused.returncode == 1
    assert "leaf has 17 photos" in refused.stderr


def test_test_cameras_are_refined_for_presets_that_move_cameras(real, monkeypatch):
    joint = {**SHORT, "poses": "joint"}
    monkeypatch.setattr(preset_fits, "preset_keywords", lambda preset, capture: joint)
    fit = Fit("leaf", "3", "instantsplat", 0, "cpu")
    row = run_fit(load_few_photos, str(real), fit, refined=True)
    assert row["psnr_refined"] > row["psnr"]
    assert "psnr_refined" not in run_fit(load_few_photos, str(real), fit)


def test_masked_pixels_of_scored_photos_do_not_count(real, monkeypatch):
    monkeypatch.setattr(preset_fits, "preset_keywords", lambda preset, capture: SHORT)
    mask = np.zeros((16, 16), dtype=bool)
    mask[3:13, 4:14] = True

    def scored_with(value):
        def load(folder, fit):
            capture = load_few_photos(folder, fit)
            views = []
            for view in capture.views:
                image = view.image.copy()
                if view.split == "test":
                    image[~mask] = value
                views.append(replace(view, image=image, mask=mask))
            return Capture(capture.path, views)

        row = run_fit(load, str(real), Fit("leaf", "3", "3dgs", 0, "cpu"))
        return {name: row[name] for name in preset_fits.SCORES}, row["protocol"]

    assert scored_with(0) == scored_with(255)
    assert "masked pixels left out" in scored_with(0)[1]["pixels"]


def test_fits_on_ray_are_the_same_and_errors_come_through(data, tmp_path, monkeypatch):
    def quick(load, folder, fit):
        if fit.seed == 1 and fit.preset == "3dgs":
            raise igsr.IgsrError("out of patience")
        return fake_row(fit, 20.0 + fit.seed)

    monkeypatch.setattr(preset_fits, "run_fit", quick)
    here = blender8(Study(data, tmp_path / "here", seeds=1), **OPTIONS)
    ray = stand_in_ray(monkeypatch)
    on_ray = Study(data, tmp_path / "there", seeds=1, ray=True)
    assert blender8(on_ray, **OPTIONS) == here
    assert (1, {"RAYON_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}) in ray.environments
    with pytest.raises(igsr.IgsrError, match=r"^out of patience$"):
        blender8(replace(on_ray, seeds=2), **OPTIONS)
    assert not ray.running
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(igsr.IgsrError, match="igsr\\[ray\\]"):
        blender8(replace(on_ray, out=tmp_path / "nowhere"), **OPTIONS)
