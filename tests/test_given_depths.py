"""Fits with given depths start from them and stay near them, if they are right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rooms
import scenes

import igsr
from igsr._internal.part_usage import Usage
from igsr.cameras.cameras_file import KeptCameras, read_cameras_file, write_cameras_file
from igsr.cameras.estimate import Estimate
from igsr.cameras.found_cameras import FoundCameras
from igsr.cameras.grid import Grid
from igsr.capture import Capture, Points, View
from igsr.capture.photo_folder import Photo
from igsr.capture.types import Tracks
from igsr.fitting.depth_checks import with_consistent_depths, with_scaled_depths
from igsr.fitting.initialization.given_depths import given_points, have_depths
from igsr.fitting.initialization.initial_splats import chosen_start, initial_splats
from igsr.rendering.renders import render


def room(angles, held_out, width=96, height=72):
    """Photos of the textured room with exact depths, and held-out photos without depths."""
    views = []
    for k, angle in enumerate(angles):
        camera = rooms.camera(angle, 80.0, width, height)
        test = k in held_out
        depth = None if test else rooms.depth(camera)
        split = "test" if test else "train"
        views.append(View(f"{k}.png", camera, split, rooms.picture(camera), depth=depth))
    return Capture(Path("room"), views)


def with_views(capture, change):
    """The capture with ``change(index, view)`` applied to its train views."""
    views = enumerate(capture.views)
    changed = [change(k, view) if view.split == "train" else view for k, view in views]
    return replace(capture, views=changed)


def with_factors(capture, factors):
    """The capture with the depths of some views multiplied; None removes them."""

    def change(k, view):
        factor = factors.get(k, 1.0)
        depth = None if factor is None else view.depth * np.float32(factor)
        return replace(view, depth=depth)

    return with_views(capture, change)


def without_depths(capture):
    return with_factors(capture, dict.fromkeys(range(len(capture.views))))


def off_walls(xyz):
    """Distances of points to the nearest wall."""
    normals, offsets = (np.array([wall[k] for wall in rooms.WALLS]) for k in (0, 1))
    lengths = np.linalg.norm(normals, axis=1)
    return np.abs((xyz @ normals.T - offsets) / lengths).min(axis=1)


@pytest.fixture(scope="module")
def made():
    return room(np.linspace(-0.5, 0.5, 6), (1, 4))


def test_points_of_exact_depths_are_on_the_walls(made):
    for view in made.train_views:
        world, colors, confidence = given_points([view], 500, np.random.default_rng(0))
        assert off_walls(world).max() < 1e-5
        assert len(world) == len(colors) == 500
        assert confidence is None


def test_a_fit_starts_from_depths_if_half_of_the_photos_have_them(made):
    splats, start = initial_splats(made, 0, 2000, 0)
    assert chosen_start(made) == start == "depths"
    assert len(splats) == 1000  # density control adds the rest
    assert off_walls(splats.means + splats.origin).max() < 1e-3
    # The train photos are 0, 2, 3 and 5.
    assert have_depths(with_factors(made, {0: None, 2: None}).train_views)
    assert not have_depths(with_factors(made, {0: None, 2: None, 3: None}).train_views)


def test_masked_transparent_and_uncertain_pixels_have_no_points(made):
    def spoiled(k, view):
        depth = view.depth.copy()
        depth[:, :40] = 0.01
        mask = np.ones(depth.shape, bool)
        mask[:, :20] = False
        confidence = np.ones(depth.shape, np.float32)
        confidence[:, 20:30] = 0.0
        alpha = np.full((*depth.shape, 1), 255, np.uint8)
        alpha[:, 30:40] = 254
        image = np.concatenate([view.image, alpha], -1)
        return replace(view, depth=depth, mask=mask, depth_confidence=confidence, image=image)

    views = with_views(made, spoiled).train_views
    world, _, confidence = given_points(views, 3000, np.random.default_rng(0))
    assert len(world) == 3000
    assert off_walls(world).max() < 1e-5
    assert (confidence == 1.0).all()


def test_points_of_a_wrong_depth_map_are_left_out(made):
    wrong = with_factors(made, {2: 0.5})
    world, *_ = given_points(wrong.train_views, 4000, np.random.default_rng(0))
    # All points of three photos; of the fourth, only points that no photo contradicts.
    assert np.mean(off_walls(world) > 0.1) < 0.06
    whole, *_ = given_points(made.train_views, 4000, np.random.default_rng(0))
    assert len(whole) == 4000


OPTIONS = {"steps": 300, "backend": "cpu", "max_splats": 1500, "sh_degree": 0}


def fit(capture, **options):
    return scenes.fit(capture, **{**OPTIONS, **options})


def psnr(splats, capture):
    return igsr.evaluate(splats, capture, backend="cpu").psnr


def test_depths_improve_held_out_photos_even_if_one_is_wrong():
    # Too far apart for features and patches.
    capture = room(np.linspace(-1.2, 1.2, 5), (1, 3))
    captures = without_depths(capture), capture, with_factors(capture, {0: 1.5})
    without, given, one_wrong = (psnr(fit(photos), capture) for photos in captures)
    assert given > without + 1.0
    assert one_wrong > without + 0.5


def test_the_depth_loss_brings_renders_closer_to_depths(made):
    def error(splats):
        errors = []
        for view in made.train_views:
            drawn = render(splats, view.camera, (0.0, 0.0, 0.0), backend="cpu")
            opaque = drawn.alpha > 0.9
            errors.append(np.abs(drawn.expected_depth / view.depth - 1.0)[opaque].mean())
        return np.mean(errors)

    start, _ = initial_splats(made, 0, 1500, 0, "rays")
    loose, near = (error(fit(made, start=start, depth_weight=weight)) for weight in (0.0, 1.0))
    assert near < 0.7 * loose


def test_a_weight_of_0_uses_no_depths(made):
    options = {"steps": 40, "depth_weight": 0.0}
    assert fit(made, **options) == fit(without_depths(made), **options)


def test_cpu_and_gpu_fit_alike(made):
    cpu, gpu = (psnr(fit(made, steps=60, backend=name), made) for name in ("cpu", "gpu"))
    assert cpu == pytest.approx(gpu, abs=0.1)


# ---- depths in the unit of the cameras -----------------------------------------------------------


def points_of(capture, per_photo=60):
    """Points on the walls, each seen by one photo with depths."""
    random = np.random.default_rng(4)
    numbers = [k for k, view in enumerate(capture.views) if view.depth is not None]
    xyz, xy = [], []
    for camera in (capture.views[k].camera for k in numbers):
        pixels = random.uniform(2.0, [camera.width - 2, camera.height - 2], (per_photo, 2))
        rays = np.pad(pixels, ((0, 0), (0, 1)), constant_values=1.0) @ np.linalg.inv(camera.K).T
        local = rays * rooms.depths(camera, pixels)[:, None]
        xyz.append((local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3])
        xy.append(pixels)
    names = [view.name for view in capture.views]
    seen_by = np.repeat(numbers, per_photo)
    tracks = Tracks(names, seen_by, np.arange(len(seen_by)), np.concatenate(xy))
    return Points(np.concatenate(xyz), np.full((len(seen_by), 3), 128, np.uint8), None, tracks)


def test_depths_of_each_photo_are_scaled_to_the_points(made):
    points = points_of(made)
    scaled = with_factors(made, {0: 0.001, 2: 250.0, 3: 0.2, 5: 3.0})
    for view, truth in zip(with_scaled_depths(scaled.views, points), made.views, strict=True):
        if truth.depth is None:
            assert view.depth is None
        else:
            assert view.depth == pytest.approx(truth.depth, rel=0.02)
    # They are unchanged without tracks, or with few.
    for few in (None, replace(points, tracks=None), points_of(made, 10)):
        same = with_scaled_depths(scaled.views, few)
        assert all(a is b for a, b in zip(same, scaled.views, strict=True))


def test_depths_of_something_else_are_left_out(made):
    noise = np.random.default_rng(0).uniform(0.1, 9.0, made.views[2].depth.shape)
    spoiled = with_views(
        made, lambda k, v: replace(v, depth=noise.astype(np.float32)) if k == 2 else v
    )
    with pytest.warns(UserWarning, match=r"The depth of 2\.png does not fit the points"):
        views = with_scaled_depths(spoiled.views, points_of(made))
    assert [view.depth is None for view in views] == [False, True, True, False, True, False]


def test_a_fit_scales_depths_and_leaves_out_wrong_ones(made):
    points = points_of(made)
    scaled = with_factors(made, dict.fromkeys(range(6), 0.1))
    fits = [fit(replace(scaled, points=points), steps=30)]
    with pytest.warns(UserWarning, match="contradicts"):
        fits.append(fit(with_factors(made, {2: 1.6}), steps=30))
    for splats in fits:
        assert np.median(off_walls(splats.means + splats.origin)) < 0.1


def depths_left_out(capture):
    """Numbers of the train photos without depth."""
    views = with_consistent_depths(capture.views)
    return [k for k, view in enumerate(views) if view.split == "train" and view.depth is None]


@pytest.mark.parametrize("factor", [0.6, 1.3, 2.0])
def test_depths_that_other_photos_contradict_are_not_used(made, factor):
    with pytest.warns(UserWarning, match=r"The depth of 2\.png contradicts the other"):
        assert depths_left_out(with_factors(made, {2: factor})) == [2]


def test_depths_without_a_majority_against_them_are_kept(made):
    assert depths_left_out(made) == []
    # Two photos that disagree: either may be right.
    assert depths_left_out(with_factors(made, {2: 2.0, 3: None, 5: None})) == [3, 5]
    # A common factor contradicts nothing.
    assert depths_left_out(with_factors(made, dict.fromkeys(range(6), 1.5))) == []
    # Photos without depths, and none at all.
    none = without_depths(made)
    assert all(a is b for a, b in zip(with_consistent_depths(none.views), none.views, strict=True))
    assert with_consistent_depths([]) == []


def test_hidden_surfaces_are_no_contradiction():
    # Photos of both sides of a wall: each sees the points of the far side behind its surface.
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    behind[2, 3] = 6.0  # 6 units away, looking back
    K = np.array([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]])
    # Walls at z = 2 and z = 4 of the first camera.
    image, depth = np.zeros((30, 40, 3), np.uint8), np.full((30, 40), 2.0, "f4")
    views = []
    for k, viewmat in enumerate([np.eye(4), np.eye(4), behind, behind]):
        camera = igsr.Camera(viewmat + np.diag([0.1 * k], 3), K, 40, 30)
        views.append(View(f"{k}.png", camera, "train", image, depth=depth))
    assert all(a is b for a, b in zip(with_consistent_depths(views), views, strict=True))


# ---- depths of networks --------------------------------------------------------------------------


def written_and_read(found, folder):
    """Found cameras from a cameras file."""
    write_cameras_file(folder / "cameras.npz", KeptCameras(found, {}, Usage(0.0, 0.0, None)))
    return read_cameras_file(folder / "cameras.npz").found


@pytest.fixture
def photos(made):
    return [Photo(view.name, view.image, None, None, "phone") for view in made.views]


def test_trusted_depths_of_an_estimator_are_kept_with_the_photos(made, photos, tmp_path):
    grid = Grid(34, 44, 2.0, 2.0, 6.0, 2.0)
    column, row = grid.photo_pixels().astype(int).T
    depths = [rooms.depth(view.camera)[row, column].reshape(34, 44) for view in made.views]
    depths[1] = np.full((34, 44), np.nan, np.float32)
    sure = [np.ones((34, 44), bool) for _ in depths]
    sure[2][:20] = False
    nothing = [None] * len(photos)
    cameras, grids = [view.camera for view in made.views], [*[grid] * 5, None]
    estimate = Estimate(cameras, None, [*depths[:5], None], [*sure[:5], None], [], grids=grids)
    found = FoundCameras.of(photos, estimate, {"estimator": "stand-in"})
    for cameras_of_room in (found, written_and_read(found, tmp_path)):
        capture = cameras_of_room.capture(Path("room"), photos)
        assert [k for k in range(6) if capture.views[k].depth is None] == [1, 5]
        for k in (0, 2, 3, 4):
            depth, truth = capture.views[k].depth, rooms.depth(made.views[k].camera)
            known = depth > 0.0
            # Within a pixel of the grid; the border outside the grid is unknown.
            assert not known[:, :6].any()
            assert not known[:2].any()
            assert np.median(np.abs(depth[known] / truth[known] - 1.0)) < 0.01
            rows = 14 if k == 2 else 34
            assert known.mean() == pytest.approx(rows * 44 * 4 / known.size, rel=0.05)
    old = FoundCameras.of(photos, replace(estimate, depths=nothing, trusted=nothing, grids=[]), {})
    assert all(view.depth is None for view in old.capture(Path("room"), photos).views)


def test_damaged_kept_depths_are_refused(made, photos, tmp_path):
    cameras, nothing = [view.camera for view in made.views], [None] * len(photos)
    for bad in (np.full((3, 4), np.nan, np.float32), np.ones((3, 4)), np.ones(7, np.float32)):
        estimate = Estimate(cameras, None, list(nothing), nothing, [])
        found = FoundCameras.of(photos, estimate, {})
        found.estimate.depths[0] = bad
        with pytest.raises(igsr.IgsrError, match="delete it to find the cameras again"):
            written_and_read(found, tmp_path)
