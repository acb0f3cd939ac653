"""Pairs to train the denoiser with: renders, their photos, and files of them."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import scenes

import igsr
from igsr.capture import Camera, View
from igsr.capture.types import intrinsic_matrix
from igsr.denoiser.inputs import BUFFERS, CHANNELS, COLOR
from igsr.evaluation.scores import BLACK
from igsr_lab.denoiser import pair_files, pairs
from igsr_lab.denoiser.pair_files import Pairs, packed, read_pairs, rendered_pairs, write_pairs
from igsr_lab.denoiser.pairs import FITTED_RENDERED, make_pairs


def camera(x):
    """Looks along +z from (x, 0, -4)."""
    viewmat = np.eye(4)
    viewmat[:3, 3] = [-x, 0.0, 4.0]
    return Camera(viewmat, intrinsic_matrix(40.0, 40.0, 16.0, 16.0), 32, 32)


def test_eight_bits_keep_what_counts(tmp_path):
    random = np.random.default_rng(0)
    inputs = random.uniform(-1, 2, (CHANNELS, 5, 6)).astype(np.float32)
    scale, offset = (one[:, None, None] for one in (pair_files.SCALE, pair_files.OFFSET))
    narrow = pair_files.SCALE < 0.01
    inputs[narrow] = np.clip(inputs[narrow], 0, 1)
    inputs[COLOR + 4] = 0.0
    restored = packed(inputs) * scale + offset
    assert np.abs(restored - inputs)[narrow].max() <= 0.5001 / 255
    assert np.abs(restored - inputs).max() <= 1.5001 / 255
    assert np.abs(restored[COLOR + 4]).max() < 1e-6, "zero stays zero"

    truth = random.integers(0, 255, (3, 5, 6), dtype=np.uint8)
    mask = random.uniform(size=(5, 6)) < 0.5
    write_pairs(tmp_path / "a.npz", Pairs(packed(inputs)[None], truth[None], mask[None]))
    pairs = read_pairs(tmp_path / "a.npz")
    assert np.array_equal(pairs.inputs[0], packed(inputs))
    assert np.array_equal(pairs.truth[0], truth)
    assert np.array_equal(pairs.masks[0], mask)
    data = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "torn.npz").write_bytes(data[: len(data) // 2])
    with open(tmp_path / "array.npz", "wb") as file:
        np.save(file, truth)
    old = {"inputs": np.zeros((1, 4, 5, 6), np.uint8), "truth": truth[None], "masks": mask[None]}
    np.savez(tmp_path / "old.npz", **old)
    for name, message in (
        ("torn", "is damaged"),
        ("array", "is damaged"),
        ("missing", "does not exist"),
        ("old", "holds pairs of another version"),
    ):
        with pytest.raises(igsr.IgsrError, match=rf"{name}\.npz {message}"):
            read_pairs(tmp_path / f"{name}.npz")
    for at in range(100, len(data) - 100, 7):
        (tmp_path / "flipped.npz").write_bytes(data[:at] + bytes([data[at] ^ 255]) + data[at + 1 :])
        try:
            read_pairs(tmp_path / "flipped.npz")
        except igsr.IgsrError as error:
            assert "flipped.npz" in str(error)


def test_a_photo_is_not_looked_up_in_itself():
    scene = scenes.round_splats([[0.0, 0.0, 0.0]], size=2.0, opacity=3.0)
    scene.scales[:, 2] = np.log(0.01)
    views = []
    for k, x in enumerate((0.0, 0.4)):
        picture = igsr.render(scene, camera(x), backend="cpu").to_uint8()
        views.append(View(f"{k}.png", camera(x), "train", picture))
    pairs = rendered_pairs(scene, views, views, BLACK, "cpu")
    valid = COLOR + BUFFERS + 3
    assert pairs.inputs[0][valid, 16, 16] == 255
    assert pairs.inputs[0][valid + 5].max() == 0, "the only other photo is the other one"
    assert np.array_equal(pairs.truth[1], np.moveaxis(views[1].image, -1, 0))
    assert pairs.masks.all()
    hidden = np.eye(32, dtype=np.bool_)
    masked = [replace(views[0], mask=hidden)]
    assert np.array_equal(rendered_pairs(scene, views, masked, BLACK, "cpu").masks[0], hidden)
    small = replace(camera(0.0), width=16)
    other = View("small.png", small, "train", views[1].image[:, :16])
    with pytest.raises(igsr.IgsrError, match="views to render are of sizes"):
        rendered_pairs(scene, views, [views[0], other], BLACK, "cpu")


OPTIONS = {"steps": 4, "backend": "cpu"}


@pytest.mark.parametrize("recipe", ["sparse", "underfit", "noise", "leave-one-out"])
def test_pairs_of_every_recipe_are_the_same_again_and_not_made_twice(tmp_path, recipe):
    made = scenes.capture(views=5, size=24)
    scenes.write_capture(tmp_path / "ball", made)
    options = {"recipes": [recipe], "views": 1, **OPTIONS}
    rows = make_pairs([tmp_path / "ball"], tmp_path / "a", **options)
    assert len(rows) == (5 if recipe == "leave-one-out" else 1)
    assert make_pairs([tmp_path / "ball"], tmp_path / "b", **options) == rows
    for row in rows:
        first, second = (read_pairs(tmp_path / out / row["pairs"]) for out in "ab")
        assert np.array_equal(first.inputs, second.inputs)
        assert len(first.truth) == row["renders"]
        if recipe == "leave-one-out":
            assert (first.truth[0] == np.moveaxis(made.views[0].image, -1, 0)).all() or (
                row["left_out"] != made.views[0].name
            )
    written = (tmp_path / "a" / rows[0]["pairs"]).stat().st_mtime_ns
    assert make_pairs([tmp_path / "ball"], tmp_path / "a", **options) == rows
    assert (tmp_path / "a" / rows[0]["pairs"]).stat().st_mtime_ns == written


def test_what_is_held_out_is_not_trained_on(tmp_path, monkeypatch):
    split = scenes.capture(views=9, size=24)
    monkeypatch.setattr(pairs, "load_capture", lambda _: split)
    monkeypatch.setattr(pairs, "PAPER_STEPS", 4)
    folder = tmp_path / "ball"
    assert split.test_views
    held = {view.image.tobytes() for view in split.test_views}
    for recipes in (["sparse", "paper"], ["leave-one-out"]):
        rows = make_pairs([folder], tmp_path / "a", recipes=recipes, views=9, **OPTIONS)
        for row in rows:
            truth = read_pairs(tmp_path / "a" / row["pairs"]).truth
            shown = {np.moveaxis(one, 0, -1).tobytes() for one in truth}
            assert not shown & held
            if row["recipe"] == "paper":
                assert row["photos"] == len(split.train_views)
                assert row["renders"] == row["photos"]
    assert len(rows) == len(split.train_views)


def test_another_capture_of_the_same_name_is_not_taken_for_done(tmp_path):
    options = {"recipes": ["sparse"], "views": 1, **OPTIONS}
    rows = []
    for name, seed in (("a", 0), ("b", 1)):
        made = scenes.capture(views=5, size=24, scene=scenes.splats(seed=seed))
        scenes.write_capture(tmp_path / name / "ball", made)
        rows += make_pairs([tmp_path / name / "ball"], tmp_path / "out", **options)
    assert rows[0]["psnr"] != rows[1]["psnr"]
    file = tmp_path / "out" / rows[1]["pairs"]
    whole = file.read_bytes()
    file.write_bytes(whole[:-100])
    with pytest.raises(igsr.IgsrError, match="delete it and make it again"):
        read_pairs(file)
    file.unlink()
    make_pairs([tmp_path / "b" / "ball"], tmp_path / "out", **options)
    assert np.array_equal(read_pairs(file).inputs.shape, (2, CHANNELS, 24, 24))


def test_photos_of_several_sizes_are_refused_before_the_first_fit(tmp_path, monkeypatch):
    made = scenes.capture(views=8, size=24)
    tall = [
        replace(view, camera=replace(view.camera, height=16), image=view.image[:16])
        for view in made.views[:4]
    ]
    scenes.write_capture(tmp_path / "mixed", igsr.Capture(made.path, tall + made.views[4:]))
    monkeypatch.setattr(pairs, "fit_capture", lambda *_, **__: pytest.fail("it is fitted"))
    with pytest.raises(igsr.IgsrError, match="views to render are of sizes"):
        make_pairs([tmp_path / "mixed"], tmp_path / "out", recipes=["noise"], backend="cpu")


@pytest.mark.parametrize("recipe", ["noise", "sparse", "paper"])
def test_after_noise_all_views_are_rendered_from_where_they_are(tmp_path, recipe, monkeypatch):
    monkeypatch.setattr(pairs, "PAPER_STEPS", 4)
    made = scenes.capture(views=6, size=24)
    scenes.write_capture(tmp_path / "ball", made)
    options = {"recipes": [recipe], "views": 9, "all_views": True, **OPTIONS}
    (row,) = make_pairs([tmp_path / "ball"], tmp_path / "out", **options)
    unseen = 6 - row["photos"] if recipe == "sparse" else 6
    assert row["renders"] == unseen + (0 if recipe == "paper" else FITTED_RENDERED)
    shown = read_pairs(tmp_path / "out" / row["pairs"]).truth[:unseen]
    assert len(np.unique(shown, axis=0)) == unseen


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"recipes": ["best"]}, "recipe must be one of sparse, underfit"),
        ({"fits": 0}, "fits must be at least 1, not 0"),
        ({"views": 0}, "views must be at least 1, not 0"),
        ({"steps": 0}, "steps must be at least 1, not 0"),
        ({"seed": -1}, "seed must not be negative, not -1"),
    ],
)
def test_bad_arguments_of_pairs(tmp_path, options, message):
    with pytest.raises(igsr.IgsrError, match=message):
        make_pairs([tmp_path / "a"], tmp_path / "out", **options)
    folders = [tmp_path / "a", tmp_path / "b" / "a"]
    for folder in folders:
        scenes.write_capture(folder, scenes.capture(views=5, size=24))
    with pytest.raises(igsr.IgsrError, match="two captures are called a"):
        make_pairs(folders, tmp_path / "out")


def test_pairs_can_be_imported_first():
    """Studies make pairs too; neither may need the other to be there already."""
    subprocess.run([sys.executable, "-c", "import igsr_lab.denoiser.pairs"], check=True)
