"""What the denoiser looks at: buffers, photos warped to a render, network channels, pairs."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import scenes

import igsr
from igsr.capture import Camera, View
from igsr.denoiser import (
    Buffers,
    Source,
    Warped,
    photo_sources,
    photo_support,
    render_buffers,
    warp_photos,
    warping,
)
from igsr.denoiser.inputs import BUFFERS, CHANNELS, COLOR, PHOTOS, network_inputs
from igsr.denoiser.warping import MAX_SOURCES
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


def camera(x=0.0, size=32, focal=40.0):
    """Looks along +z from (x, 0, -4)."""
    viewmat = np.eye(4)
    viewmat[:3, 3] = [-x, 0.0, 4.0]
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    return Camera(viewmat, K, size, size)


def splats(means, scales, opacity=0.95, quats=(1.0, 0.0, 0.0, 0.0)):
    means = np.asarray(means, np.float32)
    n = len(means)
    return igsr.Splats(
        means=means,
        quats=np.tile(np.asarray(quats, np.float32), (n, 1)),
        scales=np.log(np.broadcast_to(np.asarray(scales, np.float32), (n, 3))),
        opacities=np.full(n, np.log(opacity / (1 - opacity)), np.float32),
        sh=np.full((n, 1, 3), 0.5, np.float32),
    )


def test_buffers_are_what_is_known_of_a_flat_splat():
    flat = splats([[0.0, 0.0, 0.0]], [2.0, 2.0, 0.01])
    empty = np.zeros((32, 32, 3), np.uint8)
    photos = [View(f"{x}.png", camera(x), "train", empty) for x in (0.0, 0.5, 50.0)]
    seen = photo_support(flat, photos, "cpu")
    assert seen.tolist() == [2.0], "the third photo looks past it"
    masked = replace(photos[0], mask=np.zeros((32, 32), np.bool_))
    assert photo_support(flat, [masked, *photos[1:]], "cpu").tolist() == [1.0]
    buffers = render_buffers(flat, camera(), seen, (1.0, 1.0, 1.0), "cpu")
    drawn = igsr.render(flat, camera(), (1.0, 1.0, 1.0), "cpu")
    assert np.array_equal(buffers.color, drawn.color)
    assert np.array_equal(buffers.alpha, drawn.alpha)
    middle = (16, 16)
    assert buffers.depth[middle] == pytest.approx(4.0, rel=1e-5)
    assert buffers.depth_deviation[middle] == pytest.approx(0.0, abs=1e-3)
    assert np.allclose(buffers.normal[middle], [0.0, 0.0, -1.0], atol=1e-5)
    size = np.exp(np.log([2.0, 2.0, 0.01]).mean()) * 40.0 / 4.0
    assert buffers.footprint[middle] == pytest.approx(np.log2(size), rel=1e-4)
    assert buffers.support[middle] == pytest.approx(2.0, rel=1e-4)
    assert all(
        np.isfinite(array).all() for name, array in vars(buffers).items() if name != "camera"
    )


def test_depth_deviates_where_two_surfaces_are_blended():
    two = splats([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]], [3.0, 3.0, 0.01], opacity=0.5)
    buffers = render_buffers(two, camera(), np.ones(2, np.float32), backend="cpu")
    a, b = 0.5, 0.25
    mean = (a * 4.0 + b * 6.0) / (a + b)
    deviation = np.sqrt((a * (4.0 - mean) ** 2 + b * (6.0 - mean) ** 2) / (a + b))
    assert buffers.depth[16, 16] == pytest.approx(mean, rel=1e-3)
    assert buffers.depth_deviation[16, 16] == pytest.approx(deviation / mean, rel=2e-3)


def test_nothing_drawn_is_zero_everywhere():
    behind = splats([[0.0, 0.0, -9.0], [0.0, 0.0, -4.0]], 0.1)
    buffers = render_buffers(behind, camera(), np.ones(2, np.float32), backend="cpu")
    for name in ("color", "alpha", "depth", "depth_deviation", "normal", "footprint", "support"):
        assert not getattr(buffers, name).any(), name
    assert np.isfinite(network_inputs(buffers, warped_of(buffers, []))).all()


def test_buffers_of_other_shapes_are_refused():
    color = np.zeros((4, 5, 3), np.float32)
    with pytest.raises(igsr.IgsrError, match=r"^color must be \[H, W, 3\], not \[4, 5\]$"):
        Buffers(color=color[..., 0])
    with pytest.raises(igsr.IgsrError, match=r"^alpha must be \[4, 5\] as color, not \[5, 4\]$"):
        Buffers(color=color, alpha=np.zeros((5, 4), np.float32))
    with pytest.raises(igsr.IgsrError, match="camera is of a 32x32 picture, color is 5x4"):
        Buffers(color=color, camera=camera())


def plane_photo(at, z=0.0):
    """What a camera sees of the plane z, painted by a smooth function of x and y."""
    columns, rows = np.meshgrid(np.arange(at.width) + 0.5, np.arange(at.height) + 0.5)
    depth = z + 4.0
    x = (columns - at.K[0, 2]) / at.K[0, 0] * depth + at.centre[0]
    y = (rows - at.K[1, 2]) / at.K[1, 1] * depth
    color = np.stack([np.sin(2 * x), np.cos(3 * y), np.sin(x + y)], -1) * 0.4 + 0.5
    return color.astype(np.float32), np.full((at.height, at.width), depth, np.float32)


def source(x, z=0.0):
    color, depth = plane_photo(camera(x), z)
    return Source(camera(x), color, np.ones(depth.shape, np.bool_), depth)


def warped_of(buffers, sources, keep=PHOTOS):
    return warp_photos(buffers.camera, buffers.depth, buffers.alpha, sources, keep)


def test_photos_are_looked_up_at_the_surface_nearest_direction_first():
    truth, depth = plane_photo(camera())
    buffers = Buffers(truth, np.ones_like(depth), depth, camera=camera())
    warped = warped_of(buffers, [source(0.8), source(-0.3), source(0.5)])
    # The camera at -0.3 is nearest and sees all but a strip at one side.
    inner = warped.valid[0] & warped.valid[1]
    assert inner[:, 8:28].all()
    assert np.abs(warped.color[0] - truth)[:, 8:28].max() < 0.01
    assert np.allclose(warped.angle[0][16, 16], np.arctan(0.3 / 4.0), atol=2e-2)
    assert (warped.angle[0] <= warped.angle[1]).all()
    assert not warped.valid[0][:, :1].any() or not warped.valid[1][:, :1].any()


def test_hidden_masked_and_missing_photos_are_not_valid():
    truth, depth = plane_photo(camera())
    buffers = Buffers(truth, np.ones_like(depth), depth, camera=camera())
    hidden = source(0.1)
    hidden.depth[:, :16] = 2.0  # something stands before the left half
    warped = warped_of(buffers, [hidden])
    assert not warped.valid[0][:, :14].any()
    assert warped.valid[0][:, 18:30].all()
    assert not warped.valid[1].any(), "there is one photo only"
    assert not warped.color[1].any()
    masked = source(0.1)
    masked.usable[:] = False
    assert not warped_of(buffers, [masked]).valid.any()
    assert not warped_of(buffers, []).valid.any()
    transparent = Buffers(truth, np.zeros_like(depth), depth, camera=camera())
    assert not warped_of(transparent, [source(0.1)]).valid.any(), "there is no surface"


def test_of_many_photos_those_that_look_from_nearest_are_looked_up():
    truth, depth = plane_photo(camera())
    buffers = Buffers(truth, np.ones_like(depth), depth, camera=camera())
    near = [source(x) for x in np.linspace(-0.4, 0.4, MAX_SOURCES)]
    far = [source(x) for x in (-1.2, 1.2, 1.5)]
    few, many = warped_of(buffers, near, 3), warped_of(buffers, [far[0], *near, *far[1:]], 3)
    assert few.valid[0].any()
    for name in ("color", "valid", "angle"):
        assert np.array_equal(getattr(few, name), getattr(many, name))


def nothing_warped(height, width):
    empty = np.zeros((PHOTOS, height, width), np.float32)
    return Warped(np.zeros((*empty.shape, 3), np.float32), empty > 0, empty + np.float32(np.pi))


def test_what_is_lacking_or_not_finite_is_zero_in_the_channels():
    color = np.full((6, 7, 3), np.nan, np.float32)
    color[0, 0] = [0.25, 7.0, -1.0]
    inputs = network_inputs(Buffers(color), nothing_warped(6, 7))
    assert inputs.shape == (CHANNELS, 6, 7)
    assert inputs[:COLOR, 0, 0].tolist() == [0.25, 1.0, 0.0]
    assert not inputs[:COLOR, 1:].any()
    assert not inputs[COLOR:].any()


def test_the_background_is_a_choice_where_there_is_one():
    color = np.full((8, 8, 3), 0.9, np.float32)
    at = COLOR + BUFFERS + PHOTOS * 5
    behind = np.array([0.2, 0.4, 0.6], np.float32)
    inputs = network_inputs(Buffers(color, background=behind), nothing_warped(8, 8))
    assert np.allclose(inputs[at : at + 5, 0, 0], [0.2, 0.4, 0.6, 1.0, 0.0])
    assert np.ptp(inputs[at:], axis=(1, 2)).max() == 0.0, "the same everywhere"
    assert not network_inputs(Buffers(color), nothing_warped(8, 8))[at:].any()
    with pytest.raises(igsr.IgsrError, match=r"background must be \[3\], not \[2\]"):
        Buffers(color, background=behind[:2])


def test_renders_know_the_background_that_photos_with_alpha_have():
    scene, view = scenes.splats(40), scenes.ring_camera(0.0, size=24)
    seen = np.ones(40, np.float32)
    white = render_buffers(scene, view, seen, (1.0, 1.0, 1.0), "cpu")
    none = render_buffers(scene, view, seen, backend="cpu")
    assert white.background.tolist() == [1.0, 1.0, 1.0]
    assert none.background is None
    gap = (1.0 - none.alpha)[..., None]
    assert np.allclose(white.color, none.color + gap, atol=1e-5), "none is drawn over black"


def test_depth_is_relative_so_that_units_do_not_matter():
    color, depth = plane_photo(camera())
    depth = depth + np.linspace(0, 1, 32, dtype=np.float32)[:, None]
    alpha = np.ones_like(depth)
    near = network_inputs(Buffers(color, alpha, depth), nothing_warped(32, 32))
    far = network_inputs(Buffers(color, alpha, 1000.0 * depth), nothing_warped(32, 32))
    assert np.allclose(near, far, atol=1e-5)
    assert near[COLOR + 1].std() > 0.01


def test_eight_bits_keep_what_counts(tmp_path):
    random = np.random.default_rng(0)
    inputs = random.uniform(-1, 2, (CHANNELS, 5, 6)).astype(np.float32)
    narrow = SCALE < 0.01
    inputs[narrow] = np.clip(inputs[narrow], 0, 1)
    inputs[COLOR + 4] = 0.0
    restored = packed(inputs) * SCALE[:, None, None] + OFFSET[:, None, None]
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
    with pytest.raises(igsr.IgsrError, match=r"torn\.npz is damaged"):
        read_pairs(tmp_path / "torn.npz")
    with open(tmp_path / "array.npz", "wb") as file:
        np.save(file, truth)
    with pytest.raises(igsr.IgsrError, match=r"array\.npz is damaged"):
        read_pairs(tmp_path / "array.npz")
    for at in range(100, len(data) - 100, 7):
        (tmp_path / "flipped.npz").write_bytes(data[:at] + bytes([data[at] ^ 255]) + data[at + 1 :])
        try:
            read_pairs(tmp_path / "flipped.npz")
        except igsr.IgsrError as error:
            assert "flipped.npz" in str(error)
    with pytest.raises(igsr.IgsrError, match=r"missing\.npz does not exist"):
        read_pairs(tmp_path / "missing.npz")
    old = {"inputs": np.zeros((1, 4, 5, 6), np.uint8), "truth": truth[None], "masks": mask[None]}
    np.savez(tmp_path / "old.npz", **old)
    with pytest.raises(igsr.IgsrError, match=r"old\.npz holds pairs of another version"):
        read_pairs(tmp_path / "old.npz")


def test_a_photo_is_not_looked_up_in_itself():
    scene = splats([[0.0, 0.0, 0.0]], [2.0, 2.0, 0.01])
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


@pytest.mark.parametrize("recipe", ["sparse", "underfit", "noise", "leave-one-out"])
def test_pairs_of_every_recipe_are_the_same_again_and_not_made_twice(tmp_path, recipe):
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


def test_what_is_held_out_is_not_trained_on(tmp_path, monkeypatch):
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


def test_another_capture_of_the_same_name_is_not_taken_for_done(tmp_path):
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


def test_pairs_can_be_imported_first():
    """Studies make pairs too; neither may need the other to be there already."""
    subprocess.run([sys.executable, "-c", "import igsr_lab.denoiser.pairs"], check=True)


def test_a_large_picture_is_looked_up_in_bands_of_rows(monkeypatch):
    scene = scenes.splats(60)
    photos = scenes.capture(views=6, size=40, scene=scene).views
    sources = photo_sources(scene, photos, BLACK, "cpu")
    view = scenes.ring_camera(0.1, 40)
    buffers = render_buffers(scene, view, photo_support(scene, photos, "cpu"), backend="cpu")
    whole = warp_photos(view, buffers.depth, buffers.alpha, sources, PHOTOS)
    monkeypatch.setattr(warping, "BAND_PIXELS", 7 * 40)
    bands = warp_photos(view, buffers.depth, buffers.alpha, sources, PHOTOS)
    assert whole.valid.any()
    for name in ("color", "valid", "angle"):
        assert np.array_equal(getattr(whole, name), getattr(bands, name))


def test_no_splats_are_an_empty_picture():
    none = splats(np.zeros((0, 3)), 0.1)
    photos = scenes.capture(views=2, size=32).views
    buffers = render_buffers(none, camera(), photo_support(none, photos, "cpu"), backend="cpu")
    assert not buffers.color.any()
    picture, confidence = igsr.denoise(buffers, photo_sources(none, photos, BLACK, "cpu"))
    assert np.isfinite(picture).all()
    assert np.isfinite(confidence).all()


def test_one_far_pixel_leaves_the_depth_of_the_others():
    depth = np.full((8, 8), 2.0, np.float32)
    depth[0, 0] = 1e5
    depth[0, 1] = 0.0
    depth[3, 3] = 4.0
    nothing = Warped(np.zeros((0, 8, 8, 3)), np.zeros((0, 8, 8), bool), np.zeros((0, 8, 8)))
    buffers = Buffers(color=np.zeros((8, 8, 3), np.float32), depth=depth)
    channel = network_inputs(buffers, nothing)[4]
    assert channel[3, 3] == pytest.approx(1.0)
    assert channel[3, 4] == 0.0
    assert channel[0, 1] == 0.0


def test_a_picture_in_bytes_is_refused_as_colour():
    with pytest.raises(igsr.IgsrError, match="color must be of floats"):
        Buffers(color=np.zeros((8, 8, 3), np.uint8))
