"""Pairs of renders and photos that the denoiser is trained on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

import igsr
from igsr.capture import View
from igsr.denoiser.inputs import BUFFERS, CHANNELS, COLOR
from igsr.evaluation.scores import BLACK
from igsr_lab.denoiser import pairs
from igsr_lab.denoiser.pair_files import (
    OFFSET,
    SCALE,
    Pairs,
    packed,
    read_pairs,
    rendered_pairs,
    write_pairs,
)
from igsr_lab.denoiser.pairs import FITTED_RENDERED, make_pairs


@pytest.fixture
def stored(tmp_path):
    """Arrays of pairs, their file, and the folder."""
    random = np.random.default_rng(0)
    inputs = random.uniform(-1, 2, (CHANNELS, 5, 6)).astype(np.float32)
    narrow = SCALE < 0.01
    inputs[narrow] = np.clip(inputs[narrow], 0, 1)
    inputs[COLOR + 4] = 0.0
    truth = random.integers(0, 255, (3, 5, 6), dtype=np.uint8)
    mask = random.uniform(size=(5, 6)) < 0.5
    write_pairs(tmp_path / "a.npz", Pairs(packed(inputs)[None], truth[None], mask[None]))
    return inputs, truth, mask, tmp_path


def test_eight_bits_keep_the_inputs(stored):
    inputs, truth, mask, folder = stored
    narrow = SCALE < 0.01
    restored = packed(inputs) * SCALE[:, None, None] + OFFSET[:, None, None]
    assert np.abs(restored - inputs)[narrow].max() <= 0.5001 / 255
    assert np.abs(restored - inputs).max() <= 1.5001 / 255
    assert np.abs(restored[COLOR + 4]).max() < 1e-6, "zero stays zero"
    pairs = read_pairs(folder / "a.npz")
    assert np.array_equal(pairs.inputs[0], packed(inputs))
    assert np.array_equal(pairs.truth[0], truth)
    assert np.array_equal(pairs.masks[0], mask)


def test_damaged_files_of_pairs_are_errors(stored):
    _, truth, mask, folder = stored
    data = (folder / "a.npz").read_bytes()
    (folder / "torn.npz").write_bytes(data[: len(data) // 2])
    with open(folder / "array.npz", "wb") as file:
        np.save(file, truth)
    old = {"inputs": np.zeros((1, 4, 5, 6), np.uint8), "truth": truth[None], "masks": mask[None]}
    np.savez(folder / "old.npz", **old)
    for name, message in (
        ("torn", "is damaged"),
        ("array", "is damaged"),
        ("missing", "does not exist"),
        ("old", "holds pairs of another version"),
    ):
        with pytest.raises(igsr.IgsrError, match=rf"{name}\.npz {message}"):
            read_pairs(folder / f"{name}.npz")
    for at in range(100, len(data) - 100, 7):
        (folder / "flipped.npz").write_bytes(data[:at] + bytes([data[at] ^ 255]) + data[at + 1 :])
        try:
            read_pairs(folder / "flipped.npz")
        except igsr.IgsrError as error:
            assert "flipped.npz" in str(error)


def test_a_photo_is_not_warped_to_itself():
    scene = scenes.splats(200)
    views = []
    for k, angle in enumerate((0.0, 0.1)):
        camera = scenes.ring_camera(angle, size=32)
        picture = igsr.render(scene, camera, backend="cpu").to_uint8()
        views.append(View(f"{k}.png", camera, "train", picture))
    pairs = rendered_pairs(scene, views, views, BLACK, "cpu")
    valid = COLOR + BUFFERS + 3
    assert pairs.inputs[0][valid, 16, 16] == 255
    assert pairs.inputs[0][valid + 5].max() == 0, "the only other photo is the other one"
    assert np.array_equal(pairs.truth[1], np.moveaxis(views[1].image, -1, 0))
    assert pairs.masks.all()
    hidden = np.eye(32, dtype=np.bool_)
    masked = [replace(views[0], mask=hidden)]
    assert np.array_equal(rendered_pairs(scene, views, masked, BLACK, "cpu").masks[0], hidden)
    small = replace(views[0].camera, width=16)
    other = View("small.png", small, "train", views[1].image[:, :16])
    with pytest.raises(igsr.IgsrError, match="views to render are of sizes"):
        rendered_pairs(scene, views, [views[0], other], BLACK, "cpu")


@pytest.mark.parametrize("recipe", ["sparse", "underfit", "noise", "leave-one-out"])
def test_pairs_of_every_recipe_are_deterministic_and_made_once(tmp_path, recipe):
    made = scenes.capture(views=5, size=24)
    scenes.write_capture(tmp_path / "ball", made)
    options = {"recipes": [recipe], "steps": 4, "views": 1, "backend": "cpu"}
    rows = make_pairs([tmp_path / "ball"], tmp_path / "a", **options)
    again = make_pairs([tmp_path / "ball"], tmp_path / "b", **options)
    assert len(rows) == (5 if recipe == "leave-one-out" else 1)
    assert rows == again
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


def test_held_out_photos_are_not_trained_on(tmp_path, monkeypatch):
    split = scenes.capture(views=9, size=24)
    monkeypatch.setattr(pairs, "load_capture", lambda _: split)
    monkeypatch.setattr(pairs, "PAPER_STEPS", 4)
    folder = tmp_path / "ball"
    assert split.test_views
    held = {view.image.tobytes() for view in split.test_views}
    options = {"steps": 4, "views": 9, "backend": "cpu"}
    for recipes in (["sparse", "paper"], ["leave-one-out"]):
        rows = make_pairs([folder], tmp_path / "a", recipes=recipes, **options)
        for row in rows:
            truth = read_pairs(tmp_path / "a" / row["pairs"]).truth
            shown = {np.moveaxis(one, 0, -1).tobytes() for one in truth}
            assert not shown & held
            if row["recipe"] == "paper":
                assert row["photos"] == len(split.train_views)
                assert row["renders"] == row["photos"]
    assert len(rows) == len(split.train_views)


def test_another_capture_of_the_same_name_is_made_again(tmp_path):
    options = {"recipes": ["sparse"], "steps": 4, "views": 1, "backend": "cpu"}
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


def test_photos_of_several_sizes_are_an_error_before_the_first_fit(tmp_path, monkeypatch):
    made = scenes.capture(views=8, size=24)
    tall = [
        replace(view, camera=replace(view.camera, height=16), image=view.image[:16])
        for view in made.views[:4]
    ]
    scenes.write_capture(tmp_path / "mixed", igsr.Capture(made.path, tall + made.views[4:]))
    monkeypatch.setattr(pairs, "fit_capture", lambda *_, **__: pytest.fail("it was fitted"))
    with pytest.raises(igsr.IgsrError, match="views to render are of sizes"):
        make_pairs([tmp_path / "mixed"], tmp_path / "out", recipes=["noise"], backend="cpu")


@pytest.mark.parametrize("recipe", ["noise", "sparse", "paper"])
def test_after_noise_all_views_are_rendered_from_their_own_cameras(tmp_path, recipe, monkeypatch):
    monkeypatch.setattr(pairs, "PAPER_STEPS", 4)
    made = scenes.capture(views=6, size=24)
    scenes.write_capture(tmp_path / "ball", made)
    options = {"recipes": [recipe], "steps": 4, "views": 9, "backend": "cpu", "all_views": True}
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
