"""``python -m igsr_lab study``: the protocol's views, rows that survive, sums that are right."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import scenes
from ray_stand_in import stand_in_ray

import igsr
from igsr._internal.resumable_jobs import folder_hash
from igsr.capture import Capture
from igsr.fitting.presets import PRESETS, preset_settings
from igsr.fitting.settings import FitSettings
from igsr_lab.study import blender, blender8, few_photos
from igsr_lab.study import scored_fits as fits
from igsr_lab.study.blender import VIEW_IDS
from igsr_lab.study.real_captures import load_views
from igsr_lab.study.scored_fits import Fit, run_fit
from igsr_lab.study.splits import dtu_views, llff_views, with_train_views
from igsr_lab.study.summary import summarized

#: A preset that is over at once.
SHORT = FitSettings(
    steps=20,
    max_splats=300,
    sh_degree=0,
    density="fixed",
    dropout=0.0,
    start="random",
    coarse_to_fine=False,
    depth_weight=0.0,
    learning_rate=1.0,
    poses="fixed",
    focal="fixed",
    exposure="off",
    transients="off",
    remove_floaters=False,
    backdrop=False,
)


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


def stand_in(one, psnr):
    """The row of a fit that was not made."""
    scores = {"psnr": psnr, "ssim": 0.9, "flip": 0.1, "splats": 10, "seconds": 1.0}
    return {**vars(one), **scores, "protocol": {"views": 2, "ssim": "window", "flip": "LDR"}}


def test_the_protocols_views_are_fitted(data):
    capture = igsr.load_capture(data / "ball")
    chosen = with_train_views(capture, VIEW_IDS["75"])
    names = [view.name for view in chosen.train_views]
    assert names == [f"photos/{i:02d}.png" for i in (26, 86, 2, 55, 75, 93, 16, 73)]
    assert len(chosen.test_views) == 2
    few = Capture(capture.path, capture.views[:50])
    with pytest.raises(igsr.IgsrError, match="needs number 93"):
        with_train_views(few, VIEW_IDS["75"])


def test_a_study_is_written_and_goes_on_where_it_stopped(data, tmp_path, monkeypatch):
    done = []

    def quick(load, folder, one):
        done.append(one)
        if len(done) == 3:
            raise igsr.IgsrError("out of patience")
        return stand_in(one, 20.0 + one.seed + (one.preset == "default"))

    monkeypatch.setattr(fits, "run_fit", quick)
    options = {"scenes": ("ball",), "views": ("75",), "presets": ("default", "3dgs"), "seeds": 2}
    with pytest.raises(igsr.IgsrError, match="out of patience"):
        blender8(data, tmp_path / "out", **options)
    assert len(list((tmp_path / "out/runs").iterdir())) == 2
    report = blender8(data, tmp_path / "out", **options)
    assert len(done) == 5, "two were not done again"
    settings = preset_settings("default", 8) | {"data": folder_hash(data / "ball")}
    assert report["runs"][0]["settings"] == settings
    assert report == json.loads((tmp_path / "out/study.json").read_text())
    assert report["mean"]["default"]["psnr"] == 21.5
    assert report["mean"]["default"]["psnr_spread"] == pytest.approx(np.sqrt(0.5))
    assert report["scenes"]["ball"]["75"]["3dgs"]["psnr"] == 20.5
    table = (tmp_path / "out/study.md").read_text()
    assert "| mean | all | default | 21.50 ± 0.71 |" in table
    assert (tmp_path / "out/study.png").stat().st_size > 1000

    # A preset that has changed since is fitted again.
    file = tmp_path / "out/runs/ball-views75-default-seed0-cpu.json"
    row = json.loads(file.read_text())
    row["settings"]["steps"] += 1
    file.write_text(json.dumps(row))
    assert blender8(data, tmp_path / "out", **options) == report
    assert len(done) == 6

    # And so are photos that have.
    changed = tmp_path / "data"
    shutil.copytree(data, changed)
    photo = next((changed / "ball").rglob("*.png"))
    photo.write_bytes(photo.read_bytes() + b"\0")
    blender8(changed, tmp_path / "out", **options)
    assert len(done) == 6 + 4


def test_a_real_fit_of_the_study(data, monkeypatch):
    from igsr.fitting import presets

    short = replace(SHORT, steps=30, dropout=0.2, start="auto")
    monkeypatch.setattr(presets, "_default", lambda *_: short)
    row = run_fit(blender.load_views, str(data), Fit("ball", "76", "default", 1, "cpu"))
    assert row["psnr"] > 10.0
    assert row["splats"] <= 300
    assert row["protocol"]["views"] == 2
    assert row["protocol"]["background"] == [1.0, 1.0, 1.0]


def test_spread_is_over_seeds_not_scenes():
    rows = [
        {"seed": seed, "psnr": psnr, "ssim": 1.0, "flip": 0.0, "splats": 1, "seconds": 1.0}
        for seed, psnr in [(0, 10.0), (0, 30.0), (1, 12.0), (1, 32.0)]
    ]
    summary = summarized(rows)
    assert summary["psnr"] == 21.0
    assert summary["psnr_spread"] == pytest.approx(np.sqrt(2.0))
    assert summarized(rows[:1])["psnr_spread"] is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scenes": ("leaf",), "views": ("three",)}, "views must be numbers of photos, such as 3"),
        ({"scenes": ("leaf",), "views": ("18",)}, "views must be from 1 to 17, not 18"),
        ({"scenes": ("nothing",)}, "nothing does not exist"),
        ({"scenes": ("leaf",), "presets": ("best",)}, "preset must be one of"),
        ({"scenes": ("leaf",), "jobs": 0}, "at least 1"),
    ],
)
def test_bad_arguments_of_few_photos(real, tmp_path, options, message):
    with pytest.raises(igsr.IgsrError, match=message):
        few_photos(real, tmp_path, **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scenes": ("nothing",)}, "nothing holds no transforms_train.json"),
        ({"scenes": ("ball",), "views": ("77",)}, "views must be of 75, 76"),
        ({"scenes": ("ball",), "presets": ("best",)}, "preset must be one of"),
        ({"scenes": ("ball",), "seeds": 0}, "at least 1"),
    ],
)
def test_bad_arguments(data, tmp_path, options, message):
    with pytest.raises(igsr.IgsrError, match=message):
        blender8(data, tmp_path, **options)


def names(views):
    return [int(view.name.removeprefix("photos/").removesuffix(".png")) for view in views]


def test_llff_holds_out_every_8th_photo_and_spreads_the_rest():
    capture = scenes.capture(views=20, size=16)
    # Whatever order a file has them in.
    chosen = llff_views(Capture(capture.path, capture.views[::-1]), 3)
    assert names(chosen.test_views) == [0, 8, 16]
    assert names(chosen.train_views) == [1, 10, 19]
    assert names(llff_views(capture, 6).train_views) == [1, 4, 7, 12, 15, 19]
    assert len(llff_views(capture, 17).train_views) == 17
    for count in (0, 18):
        with pytest.raises(igsr.IgsrError, match=f"views must be from 1 to 17, not {count}"):
            llff_views(capture, count)


def test_dtu_has_its_own_photos():
    capture = scenes.capture(views=49, size=16)
    chosen = dtu_views(capture, 6)
    assert names(chosen.train_views) == [25, 22, 28, 40, 44, 48]
    assert sorted(names(chosen.views)) == list(range(49))
    with pytest.raises(igsr.IgsrError, match="views must be from 1 to 9 for DTU, not 10"):
        dtu_views(capture, 10)
    few = Capture(capture.path, capture.views[:40])
    with pytest.raises(igsr.IgsrError, match="has 40 photos; DTU's protocol needs number 48"):
        dtu_views(few, 6)


def test_few_photos_has_a_row_by_scene_views_and_preset(real, tmp_path, monkeypatch):
    seen = []

    def quick(load, folder, one, refined):
        seen.append((one.scene, len(load(folder, one).train_views)))
        return stand_in(one, float(one.views)) | {"psnr_refined": float(one.views) + 0.5}

    monkeypatch.setattr(fits, "run_fit", quick)
    report = few_photos(real, tmp_path, scenes=("leaf", "dtu_1"), seeds=1)
    assert seen[:: len(PRESETS)] == [(scene, n) for scene in ("leaf", "dtu_1") for n in (3, 6, 9)]
    assert set(report["mean"]) == set(PRESETS)
    assert report["scenes"]["dtu_1"]["6"]["default"]["psnr"] == 6.0
    split = report["protocol"]["scenes"]["dtu_1"]
    assert split["split"] == "DTU"
    assert split["train_views"]["3"] == [f"photos/{i}.png" for i in (25, 22, 28)]
    table = (tmp_path / "study.md").read_text()
    assert "| preset | PSNR, dB | refined PSNR, dB | SSIM |" in table
    assert "| leaf | 9 | default | 9.00 | 9.50 |" in table


def test_presets_that_move_cameras_are_scored_refined_too(real, monkeypatch):
    from igsr.fitting import presets

    short = replace(SHORT, poses="joint", focal="shared")
    monkeypatch.setattr(presets, "_INSTANTSPLAT", short)
    one = Fit("leaf", "3", "instantsplat", 0, "cpu")
    row = run_fit(load_views, str(real), one, refined=True)
    assert row["psnr_refined"] > row["psnr"], "a camera fitted to its photo scores better"
    assert "psnr_refined" not in run_fit(load_views, str(real), one)


def test_what_a_mask_hides_in_a_scored_photo_changes_no_score(real, monkeypatch):
    from igsr.fitting import presets

    monkeypatch.setattr(presets, "_3DGS", SHORT)
    mask = np.zeros((16, 16), dtype=bool)
    mask[3:13, 4:14] = True

    def scored_with(spoil):
        def load(folder, one):
            capture = load_views(folder, one)
            views = []
            for view in capture.views:
                image = view.image.copy()
                if view.split == "test":
                    image[~mask] = spoil
                views.append(replace(view, image=image, mask=mask))
            return Capture(capture.path, views)

        row = run_fit(load, str(real), Fit("leaf", "3", "3dgs", 0, "cpu"))
        return {name: row[name] for name in fits.SCORES}, row["protocol"]

    assert scored_with(0) == scored_with(255)
    assert "masked pixels left out" in scored_with(0)[1]["pixels"]


def test_fits_over_ray_are_the_same_and_errors_come_through(data, tmp_path, monkeypatch):
    import sys

    def quick(load, folder, one):
        if one.seed == 1 and one.preset == "3dgs":
            raise igsr.IgsrError("out of patience")
        return stand_in(one, 20.0 + one.seed)

    monkeypatch.setattr(fits, "run_fit", quick)
    options = {"scenes": ("ball",), "views": ("75",), "presets": ("default", "3dgs")}
    here = blender8(data, tmp_path / "here", seeds=1, **options)
    ray = stand_in_ray(monkeypatch)
    assert blender8(data, tmp_path / "there", seeds=1, ray=True, **options) == here
    assert (1, {"RAYON_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}) in ray.environments
    with pytest.raises(igsr.IgsrError, match=r"^out of patience$"):
        blender8(data, tmp_path / "there", seeds=2, ray=True, **options)
    assert not ray.running
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(igsr.IgsrError, match="igsr\\[ray\\]"):
        blender8(data, tmp_path / "nowhere", seeds=1, ray=True, **options)
