"""The backdrop: a sphere behind scenes of photographs."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import scenes

import igsr
from igsr.capture import Capture
from igsr.geometry.camera_paths import cameras_around
from igsr.rendering import backdrop
from igsr.rendering.backdrop import wants_backdrop, with_backdrop
from igsr.rendering.scene_model import embedded_model
from igsr.splats import BACKDROP_SPLATS as COUNT
from igsr.splats import subset

BALL = scenes.splats(60, degree=1)
SKY = (51, 128, 204)


@pytest.fixture(autouse=True)
def small_scenes_have_one(monkeypatch):
    monkeypatch.setattr(backdrop, "MIN_SPLATS", 0)


def before_sky(views=6, arc=2.0 * np.pi):
    """Photos of the ball in front of a sky of one color, and over black."""
    made = scenes.capture(views=views, scene=BALL, arc=arc)
    photos = []
    for view in made.views:
        shown = igsr.render(BALL, view.camera, np.array(SKY) / 255.0, "cpu").to_uint8()
        photos.append(replace(view, image=shown))
    return Capture(made.path, photos, made.points), made


@pytest.fixture
def photos():
    return before_sky()[0]


@pytest.fixture
def scene(photos):
    return with_backdrop(BALL, photos.views, "cpu")


def looking_away(camera):
    """A camera at the same place that looks away from the ball, at the backdrop."""
    viewmat = camera.viewmat.copy()
    viewmat[[0, 2]] *= -1.0
    return replace(camera, viewmat=viewmat)


def test_transparent_pixels_determine_the_backdrop(photos, scene):
    assert len(scene) == len(BALL) + COUNT
    assert subset(scene, slice(len(BALL))) == BALL
    for view in photos.views:
        shown = igsr.render(scene, view.camera, backend="cpu")
        assert shown.alpha.min() > 0.985
        assert np.abs(shown.to_uint8().astype(int) - view.image).max() < 12


def test_unseen_directions_have_the_mean_color():
    photos, _ = before_sky(views=2, arc=0.5)
    scene = with_backdrop(BALL, photos.views, "cpu")
    away = igsr.render(scene, looking_away(photos.views[0].camera), backend="cpu")
    np.testing.assert_allclose(away.color.mean(axis=(0, 1)), np.array(SKY) / 255.0, atol=0.1)
    black = igsr.render(BALL, looking_away(photos.views[0].camera), backend="cpu")
    assert black.color.max() == 0.0


def test_opaque_scenes_have_the_photos_colors_behind_them():
    # A wall that fills the picture of a camera: nothing can be seen behind it.
    camera = scenes.ring_camera(0.0)
    image = np.full((camera.height, camera.width, 3), (200, 100, 50), np.uint8)
    view = igsr.View("wall.png", camera, "train", image)
    center = camera.center + 2.0 * camera.viewmat[2, :3]
    color = np.array([200, 100, 50]) / 255.0
    wall = scenes.round_splats([center], size=np.exp(2.0), opacity=9.0, color=color)
    scene = with_backdrop(wall, [view], "cpu")
    behind = igsr.render(scene, looking_away(camera), backend="cpu")
    np.testing.assert_allclose(behind.color.mean(axis=(0, 1)), color, atol=0.02)


def test_no_backdrop_over_black():
    _, before_black = before_sky()
    assert with_backdrop(BALL, before_black.views, "cpu") is BALL


def test_masked_pixels_do_not_count(photos):
    wrong = []
    for view in photos.views:
        image, mask = view.image.copy(), np.ones(view.image.shape[:2], np.bool_)
        image[:8], mask[:8] = (255, 0, 0), False
        wrong.append(replace(view, image=image, mask=mask))
    scene = with_backdrop(BALL, wrong, "cpu")
    shown = igsr.render(scene, photos.views[0].camera, backend="cpu").to_uint8()
    assert np.abs(shown[:8].astype(int) - SKY).max() < 25


def test_no_backdrop_without_finite_splats(photos):
    broken = replace(BALL, means=np.full_like(BALL.means, np.nan))
    assert with_backdrop(broken, photos.views, "cpu") is broken


@pytest.mark.parametrize("name", ["scene.ply", "scene.splat"])
def test_lossless_files_keep_the_backdrop(tmp_path, name, scene):
    scene.save(tmp_path / name)
    read = igsr.Splats.load(tmp_path / name)
    assert read.backdrop_splats == (COUNT if name.endswith(".ply") else 0)
    assert BALL.backdrop_splats == 0
    assert scene.without_backdrop() == BALL
    assert BALL.without_backdrop() is BALL


def test_info_reports_the_backdrop_and_bounds_without_it(tmp_path, igsr_here, photos):
    for name, scene in (("bare", BALL), ("whole", with_backdrop(BALL, photos.views, "cpu"))):
        scene.save(tmp_path / f"{name}.ply")
    bare, whole = (
        json.loads(igsr_here("info", tmp_path / f"{name}.ply", "--json").stdout)
        for name in ("bare", "whole")
    )
    assert (bare["backdrop_splats"], whole["backdrop_splats"]) == (0, COUNT)
    assert bare["highest_corner"] == whole["highest_corner"]


@pytest.mark.parametrize("photographs", [True, False])
def test_removal_of_floaters_ignores_the_backdrop(photographs, photos, scene):
    capture = photos if photographs else None
    cleaned = igsr.remove_floaters(scene, capture, backend="cpu")
    bare = igsr.remove_floaters(BALL, capture, backend="cpu")
    assert cleaned.removed == bare.removed
    assert cleaned.splats == bare.splats.with_backdrop_of(scene)
    assert cleaned.splats.backdrop_splats == COUNT


def test_framing_ignores_the_backdrop(scene):
    for one, other in zip(cameras_around(BALL, 3, 32), cameras_around(scene, 3, 32), strict=True):
        np.testing.assert_array_equal(one.viewmat, other.viewmat)
    assert embedded_model(scene).radius == embedded_model(BALL).radius


def test_compaction_keeps_the_backdrop(photos, scene):
    compact = igsr.compact(scene, 3.0, capture=photos, sh_degree=0, steps=20, backend="cpu").splats
    assert compact.backdrop_splats == COUNT
    assert compact.sh_degree == 0
    away = igsr.render(compact, looking_away(photos.views[0].camera), backend="cpu")
    assert away.alpha.min() > 0.98


def test_no_backdrop_for_few_splats_or_no_extent(monkeypatch, photos):
    still = photos.views[0].camera.center
    at_camera = replace(BALL, means=np.tile(still, (len(BALL), 1)).astype(np.float32))
    same_place = [replace(v, camera=photos.views[0].camera) for v in photos.views]
    assert with_backdrop(at_camera, same_place, "cpu") is at_camera
    monkeypatch.setattr(backdrop, "MIN_SPLATS", len(BALL) + 1)
    assert with_backdrop(BALL, photos.views, "cpu") is BALL


def test_fits_add_a_backdrop_and_continue_without_it(photos):
    options = {"steps": 40, "backend": "cpu", "max_splats": 300, "seed": 3}
    bare, whole = scenes.fit(photos, backdrop=False, **options), scenes.fit(photos, **options)
    assert bare.backdrop_splats == 0
    assert whole.without_backdrop() == bare
    assert whole == with_backdrop(bare, photos.train_views, "cpu")
    continued = scenes.fit(photos, start=whole, **options)
    assert continued == scenes.fit(photos, start=bare, **options)
    assert continued.backdrop_splats == COUNT


def test_no_backdrop_for_cut_out_objects_or_given_backgrounds(photos):
    options = {"steps": 3, "backend": "cpu"}
    assert wants_backdrop(photos.views)
    assert not wants_backdrop(scenes.capture(alpha=True).views)
    masks = []
    for view in photos.views:
        mask = np.ones(view.image.shape[:2], np.bool_)
        mask[:, :15] = False
        masks.append(replace(view, mask=mask))
    assert not wants_backdrop(masks)
    # One photo's, or the edges that undistortion leaves, cut nothing out.
    assert wants_backdrop([masks[0], *photos.views[1:]])
    for capture, more in (
        (scenes.capture(alpha=True), {}),
        (Capture(photos.path, masks), {}),
        (photos, {"background": (0.2, 0.5, 0.8)}),
        (photos, {"backdrop": False}),
    ):
        assert scenes.fit(capture, **options, **more).backdrop_splats == 0


def test_refinement_scores_the_backdrop_and_denoises_without_it(photos, rendered):
    views = [replace(v, split="test" if k == 3 else "train") for k, v in enumerate(photos.views)]
    capture = Capture(photos.path, views)
    refined = igsr.refine(capture, rounds=1, steps=40, backend="cpu")
    assert refined.splats.backdrop_splats == COUNT
    assert rendered
    assert all(model.splats.backdrop_splats == 0 for model in rendered)
    scores = igsr.evaluate(refined.first, capture, backend="cpu")
    assert refined.first_test["psnr"] == pytest.approx(scores["psnr"])
