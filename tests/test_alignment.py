"""Global alignment: exact pointmaps, noise, fixed cameras, and unusable predictions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pointmaps import CONFIDENCE, PointmapScene, all_pairs

from igsr.cameras.alignment import AlignedPhoto, align
from igsr.cameras.alignment import predictions as predictions_module
from igsr.cameras.alignment.camera_solvers import searched_focal, weiszfeld_focal
from igsr.cameras.alignment.initial_alignment import components, spanning_tree, start
from igsr.cameras.alignment.objective import Objective
from igsr.cameras.alignment.predictions import observe, overlapping_edges
from igsr.cameras.depth_maps import trusted_pixels
from igsr.cameras.grid import Grid
from igsr.errors import IgsrError
from igsr.geometry.pose_errors import pose_errors
from igsr.geometry.similarity import Similarity, similarity_between, similarity_of_points


def depth_noise(part, seed=0):
    """Errors of depth, smooth and per pixel, each ``part`` in relative root mean square."""
    random = np.random.default_rng(seed)

    def spoil(points, confidence, first, photo):
        height, width = confidence.shape
        blocks = random.normal(size=(-(-height // 8), -(-width // 8)))
        smooth = np.kron(blocks, np.ones((8, 8)))[:height, :width]
        error = part * (smooth + random.normal(size=confidence.shape))
        return points * np.exp(error)[..., None], confidence

    return spoil


def cameras_of(alignment):
    return [photo.camera for photo in alignment.photos if photo is not None]


def assert_exact(alignment, scene, photos=None, degrees=1e-3, center=1e-4, focal=1e-3):
    photos = range(len(scene.cameras)) if photos is None else photos
    truth = [scene.cameras[i] for i in photos]
    found = [alignment.photos[i].camera for i in photos]
    errors = pose_errors(found, truth)
    assert errors["rotation"] < degrees
    assert errors["center"] < center
    for camera, true_camera in zip(found, truth, strict=True):
        np.testing.assert_allclose(camera.K, true_camera.K, rtol=focal, atol=1e-9)
        assert (camera.width, camera.height) == (true_camera.width, true_camera.height)


# --- exact predictions


def mixed_scene():
    """Photos of two cameras of different focal lengths and sizes, some of them upright."""
    return PointmapScene(6, sizes=((96, 128), (128, 96), (80, 112)), focals=(1.2, 1.2, 0.9))


def by_size(i):
    return i % 3 == 2


@pytest.mark.parametrize("steps", [0, 20])
def test_exact_pointmaps_give_exact_cameras_and_depths(steps):
    scene = mixed_scene()
    predictions = scene.predictions()
    alignment = align(predictions, scene.photos(group=by_size), steps=steps)
    for used, given in zip(predictions, scene.predictions(), strict=True):
        np.testing.assert_array_equal(used.first_points, given.first_points)
    assert alignment.loss <= alignment.start_loss < 1e-5
    assert_exact(alignment, scene)
    assert alignment.warnings == []
    assert sorted(alignment.pairs) == all_pairs(6)
    # The world is the camera frame of a photo.
    nearest = min(np.abs(photo.camera.viewmat - np.eye(4)).max() for photo in alignment.photos)
    assert nearest < 1e-12
    world = similarity_between(cameras_of(alignment), scene.cameras)
    for photo, grid, truth in zip(alignment.photos, scene.grids, scene.worlds, strict=True):
        assert photo.depth.shape == photo.confidence.shape == (grid.height, grid.width)
        assert photo.depth.dtype == photo.confidence.dtype == np.float32
        np.testing.assert_array_equal(photo.confidence, CONFIDENCE)
        xyz, index = photo.world_points()
        assert len(index) == photo.depth.size
        np.testing.assert_allclose(world.apply(xyz.T).T, truth, atol=1e-3)


def test_two_photos_and_pairs_in_one_direction():
    scene = PointmapScene(2, arc=0.4)
    assert_exact(align(scene.predictions(), scene.photos(), steps=20), scene)
    scene = PointmapScene(4)
    pairs = [(0, 1), (2, 1), (3, 2), (0, 3)]
    assert_exact(align(scene.predictions(pairs), scene.photos(), steps=0), scene)


def test_a_photo_that_is_never_first_has_its_focal_length_searched():
    # It is alone in its group. 21 values are tried, and the optimizer refines the best.
    scene = PointmapScene(4)
    pairs = [(i, j) for i, j in all_pairs(4) if i != 2]
    photos = scene.photos(group=lambda i: i == 2)
    begun = align(scene.predictions(pairs), photos, steps=0).photos[2].camera
    found = align(scene.predictions(pairs), photos, steps=150).photos[2].camera
    true_focal = scene.cameras[2].K[0, 0]
    assert abs(begun.K[0, 0] / true_focal - 1) < 0.1
    assert abs(found.K[0, 0] / true_focal - 1) < 0.01
    # Three points are too few.
    few = np.eye(3)
    assert searched_focal(few, few[:, :2], np.full(3, 5.0), (96, 128), seed=0) is None


def mirrored(points, confidence, first, photo):
    """The points of photos 2 and 3 are behind them."""
    return (-points if first >= 2 else points), confidence


@pytest.mark.parametrize(
    ("spoil", "group", "groups"),
    [
        (depth_noise(0.05), lambda i: None, 1),
        (depth_noise(0.05), lambda i: i, 4),
        (mirrored, lambda i: i >= 2, 2),
    ],
)
def test_photos_of_one_group_share_their_focal_length(spoil, group, groups):
    scene = PointmapScene(4)
    found = align(scene.predictions(spoil=spoil), scene.photos(group=group), steps=3)
    focals = [camera.K[0, 0] for camera in cameras_of(found)]
    assert (len(focals), len(set(focals))) == (4, groups)


def test_fifty_photos_in_a_sliding_window():
    scene = PointmapScene(50, arc=6.0, sizes=((64, 96),))
    pairs = [(i, j) for i, j in all_pairs(50) if abs(i - j) <= 2]
    alignment = align(scene.predictions(pairs), scene.photos(), steps=1)
    # Rounding errors accumulate along 49 edges.
    assert_exact(alignment, scene, degrees=0.02, center=1e-3)


def test_thinned_grids_give_every_depth(monkeypatch):
    monkeypatch.setattr(predictions_module, "MAX_POINTS", 3_000)
    scene = PointmapScene(4)
    edges = overlapping_edges(scene.predictions())
    assert len(observe(edges, scene.photos()).photos[0].pixels) < 200
    alignment = align(scene.predictions(), scene.photos(), steps=0)
    assert_exact(alignment, scene)
    assert np.isfinite(alignment.photos[0].depth).all()
    assert alignment.photos[0].depth.shape == (23, 30)


# --- noise


def test_noise_is_averaged():
    scene = PointmapScene(6)
    predictions = scene.predictions(spoil=depth_noise(0.05))
    begun = align(predictions, scene.photos(), steps=0)
    found = align(predictions, scene.photos())
    assert found.start_loss == begun.loss == begun.start_loss
    assert found.loss < found.start_loss
    assert_exact(found, scene, degrees=0.3, center=0.05, focal=5e-3)
    before, after = (pose_errors(cameras_of(a), scene.cameras) for a in (begun, found))
    assert after["rotation"] < 0.5 * before["rotation"]
    assert after["center"] < 0.5 * before["center"]


def test_a_confident_half_of_the_pixels_suffices():
    scene = PointmapScene(5)
    random = np.random.default_rng(1)

    def spoil(points, confidence, first, photo):
        wrong = random.random(confidence.shape) < 0.5
        shift = random.normal(size=points.shape) + [1.0, 0.0, 3.0]
        points = np.where(wrong[..., None], points + shift, points)
        return points, np.where(wrong, 1.05, confidence)

    predictions = scene.predictions(spoil=spoil)
    assert_exact(align(predictions, scene.photos(), steps=0), scene, degrees=0.05, center=5e-3)
    assert_exact(align(predictions, scene.photos(), steps=60), scene, degrees=0.02, center=2e-3)


def test_the_order_of_photos_does_not_matter():
    scene = PointmapScene(5)
    predictions = scene.predictions(spoil=depth_noise(0.02))
    straight = cameras_of(align(predictions, scene.photos(), steps=150))
    order = np.array([3, 0, 4, 2, 1])
    place = np.argsort(order)
    shuffled = [
        replace(p, first=int(place[p.first]), second=int(place[p.second])) for p in predictions
    ]
    photos = scene.photos()
    other = cameras_of(align(shuffled[::-1], [photos[i] for i in order], steps=150))
    errors = pose_errors([other[i] for i in place], straight)
    assert errors["rotation"] < 5e-3
    assert errors["center"] < 1e-3
    np.testing.assert_allclose(other[0].K[0, 0], straight[0].K[0, 0], rtol=1e-3)


# --- fixed cameras


@pytest.mark.parametrize("fixed", [[1], [0, 3], [1, 2, 4], [0, 1, 2, 3, 4]])
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_fixed_poses_define_the_world(fixed, noise):
    scene = PointmapScene(5)
    photos = scene.photos(viewmat=lambda i: scene.cameras[i].viewmat if i in fixed else None)
    alignment = align(scene.predictions(spoil=depth_noise(noise)), photos, steps=60)
    # Noise of 2 % at 5 units is averaged over hundreds of pixels.
    bound = 0.2 if noise else 1e-4
    for i, (camera, truth) in enumerate(zip(cameras_of(alignment), scene.cameras, strict=True)):
        if i in fixed:
            np.testing.assert_array_equal(camera.viewmat, truth.viewmat)
        np.testing.assert_allclose(camera.viewmat[:3, :3], truth.viewmat[:3, :3], atol=0.1 * bound)
        if len(fixed) > 1:
            np.testing.assert_allclose(camera.center, truth.center, atol=bound)
    if len(fixed) > 1:
        depth = scene.points(0, 0)[..., 2]
        assert np.median(np.abs(alignment.photos[0].depth / depth - 1)) < (0.05 if noise else 1e-4)


def test_fixed_poses_far_from_the_origin():
    scene = PointmapScene(4)
    away = Similarity(3.0, np.eye(3), np.array([1e6, -2e6, 5e5]))
    moved = [away.camera(camera) for camera in scene.cameras]
    photos = scene.photos(viewmat=lambda i: moved[i].viewmat if i < 2 else None)
    alignment = align(scene.predictions(), photos, steps=20)
    for found, truth in zip(cameras_of(alignment), moved, strict=True):
        np.testing.assert_allclose(found.center, truth.center, atol=1e-3)


def test_fixed_poses_at_one_place_do_not_fix_the_scale():
    scene = PointmapScene(4)
    photos = scene.photos(viewmat=lambda i: scene.cameras[0].viewmat if i == 0 else None)
    twin = replace(photos[0], name="twin.jpg")
    pairs = [p for p in scene.predictions() if p.first != 3 and p.second != 3]
    # Photo 3 is a copy of photo 0.
    doubled = [replace(p, first=3) for p in pairs if p.first == 0]
    alignment = align(pairs + doubled, [*photos[:3], twin], steps=20)
    assert_exact(alignment, scene, photos=range(3))


def test_fixed_intrinsics_are_kept():
    scene = mixed_scene()
    given = scene.cameras[1].K * [[1.01, 1.0, 1.0], [1.0, 0.99, 1.02], [1.0, 1.0, 1.0]]
    photos = scene.photos(group=by_size, intrinsics=lambda i: given if i == 1 else None)
    alignment = align(scene.predictions(), photos, steps=5)
    np.testing.assert_array_equal(alignment.photos[1].camera.K, given)
    focals = [photo.camera.K[0, 0] for photo in alignment.photos]
    assert focals[0] == focals[3] != focals[1]


# --- unusable predictions


def test_pixels_that_are_not_finite_are_ignored():
    scene = PointmapScene(4)

    def spoil(points, confidence, first, photo):
        points = points.copy()
        points[:6] = np.nan
        points[6:8] = np.inf
        points[8:9] = 1e30
        confidence = confidence.copy()
        confidence[9:10], confidence[10:11], confidence[11:12] = np.nan, np.inf, -3.0
        return points, confidence

    with np.errstate(over="ignore"):
        predictions = scene.predictions(spoil=spoil)
    alignment = align(predictions, scene.photos(), steps=10)
    assert_exact(alignment, scene)
    for photo in alignment.photos:
        assert np.isnan(photo.depth[:12]).all()
        assert np.isfinite(photo.depth[12:]).all()
        assert (photo.confidence[:12] == 1.0).all()


RANDOM = np.random.default_rng(2)
USELESS = {
    "garbage": lambda points, sure: (RANDOM.normal(size=points.shape), np.full_like(sure, 1.1)),
    "nothing": lambda points, sure: (points, np.ones_like(sure)),
    "one point": lambda points, sure: (np.full_like(points, 2.0), sure),
    "one line": lambda points, sure: (points[..., :1] * [1.0, 2.0, 3.0], sure),
    "not finite": lambda points, sure: (np.full_like(points, np.nan), sure),
}


@pytest.mark.parametrize("useless", USELESS.values(), ids=USELESS)
def test_a_photo_without_overlap_is_named(useless):
    scene = PointmapScene(5)

    def spoil(points, confidence, first, photo):
        return useless(points, confidence) if 3 in (first, photo) else (points, confidence)

    alignment = align(scene.predictions(spoil=spoil), scene.photos(), steps=5)
    assert alignment.photos[3] is None
    assert len(alignment.warnings) == 1
    assert "3.jpg" in alignment.warnings[0]
    assert_exact(alignment, scene, photos=[0, 1, 2, 4])


def test_of_two_groups_the_one_with_fixed_poses_or_more_photos_is_placed():
    scene = PointmapScene(5)
    pairs = [(i, j) for i, j in all_pairs(5) if (i < 2) == (j < 2)]
    alignment = align(scene.predictions(pairs), scene.photos(), steps=5)
    assert [photo is None for photo in alignment.photos] == [True, True, False, False, False]
    assert ["0.jpg" in alignment.warnings[0], "1.jpg" in alignment.warnings[1]] == [True, True]
    assert_exact(alignment, scene, photos=[2, 3, 4])
    photos = scene.photos(viewmat=lambda i: scene.cameras[i].viewmat if i == 1 else None)
    alignment = align(scene.predictions(pairs), photos, steps=5)
    assert [photo is None for photo in alignment.photos] == [False, False, True, True, True]


def test_no_overlap_at_all():
    scene = PointmapScene(3)
    useless = [USELESS[kind] for kind in ("nothing", "not finite", "one point")]
    unusable = [scene.predictions(spoil=lambda *maps, f=f: f(*maps[:2])) for f in useless]
    for predictions in ([], *unusable):
        with pytest.raises(IgsrError, match="no overlap between any two photos"):
            align(predictions, scene.photos())


# --- parts


def test_the_gradient_is_that_of_the_loss():
    scene = PointmapScene(3, sizes=((64, 96),))
    photos = scene.photos(viewmat=lambda i: scene.cameras[i].viewmat if i == 0 else None)
    observations = observe(overlapping_edges(scene.predictions(spoil=depth_noise(0.05))), photos)
    placement, depths = start(observations, photos, seed=0)
    objective = Objective(observations, placement, depths, photos)
    random = np.random.default_rng(0)
    # The norm is not differentiable at the initial distances of nearly zero.
    for parameter in objective.parameters:
        parameter.data += 0.05 * parameter.new_tensor(random.normal(size=parameter.shape))
    objective.loss()
    gradients = [parameter.grad.clone() for parameter in objective.parameters]
    for parameter, gradient in zip(objective.parameters, gradients, strict=True):
        direction = gradient.sign() * gradient.new_tensor(random.random(gradient.shape))
        expected = float((gradient * direction).sum())
        losses = []
        for step in (1e-3, -1e-3):
            parameter.data += step * direction
            losses.append(objective.loss())
            parameter.data -= step * direction
        assert expected > 0.0
        assert abs((losses[0] - losses[1]) / 2e-3 / expected - 1) < 2e-3
    assert (objective.turns.grad[0] == 0).all()


def test_similarity_with_a_third_of_the_points_wrong():
    random = np.random.default_rng(3)
    q, r = np.linalg.qr(random.normal(size=(3, 3)))
    rotation = q * np.sign(np.diag(r))
    rotation *= np.sign(np.linalg.det(rotation))
    truth = Similarity(2.5, rotation, np.array([1.0, -2.0, 7.0]))
    points = random.normal(size=(3, 300))
    others = truth.apply(points)
    others[:, :100] += random.normal(size=(3, 100)) + 2.0
    found = similarity_of_points(points, others, np.ones(300))
    assert abs(found.scale / truth.scale - 1) < 1e-3
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-3)
    line = np.outer([1.0, 2.0, 3.0], random.normal(size=300))
    assert similarity_of_points(line, truth.apply(line), np.ones(300)) is None
    assert similarity_of_points(points, others, np.zeros(300)) is None


def test_weiszfeld_focal():
    random = np.random.default_rng(4)
    offsets = random.uniform(-200, 200, size=(500, 2))
    depth = random.uniform(1, 9, size=500)
    points = np.vstack([offsets.T / 321.0, np.ones(500)]) * depth
    points[:, :150] += random.normal(size=(3, 150))
    points[2, 400] = 0.0
    points[2, 401] = -5.0
    assert abs(weiszfeld_focal(points, offsets, np.ones(500)) / 321.0 - 1) < 1e-3
    assert weiszfeld_focal(points, -offsets, np.ones(500)) is None
    assert weiszfeld_focal(points, offsets, np.zeros(500)) is None
    assert weiszfeld_focal(-points, offsets, np.ones(500)) is None


def test_spanning_tree_takes_the_strongest_edges():
    edges = np.array([(0, 1), (1, 0), (1, 2), (2, 0), (3, 2)])
    scores = np.array([2.0, 5.0, 1.0, 4.0, 3.0])
    assert spanning_tree(edges, scores) == [(1, True), (3, False), (4, False)]
    assert components(5, [(0, 1), (3, 4), (1, 2)]) == [[0, 1, 2], [3, 4]]


# --- trusted pixels


def photos_of_a_wall():
    grid, maps = Grid(24, 32, 4.0, 4.0, 0.0, 0.0), np.ones((2, 24, 32), np.float32)
    cameras = PointmapScene(2, arc=0.2).cameras
    return [AlignedPhoto(camera, grid, 5.0 * maps[0], 9.0 * maps[1]) for camera in cameras]


def test_a_less_confident_pixel_in_front_of_a_surface_is_not_trusted():
    photos = photos_of_a_wall()
    assert all(mask.all() for mask in trusted_pixels(photos, [(0, 1)]))
    photos[0].depth[12, 16] = 2.5
    photos[0].confidence[12, 16] = 8.0
    first, second = trusted_pixels(photos, [(0, 1)])
    assert not first[12, 16]
    assert first.sum() == first.size - 1
    assert second.all()
    assert all(mask.all() for mask in trusted_pixels(photos, []))
    photos[0].confidence[12, 16] = 10.0
    assert trusted_pixels(photos, [(0, 1)])[0].all()


def test_trusted_pixels_do_not_depend_on_the_order_of_photos():
    scene = PointmapScene(4)
    random = np.random.default_rng(7)
    predictions = scene.predictions(spoil=depth_noise(0.1))
    photos = align(predictions, scene.photos(), steps=0).photos
    for photo in photos:
        photo.confidence[:] = random.uniform(2, 9, size=photo.confidence.shape)
    pairs, order = all_pairs(4), [2, 0, 3, 1]
    straight = trusted_pixels(photos, pairs)
    shuffled = trusted_pixels([photos[i] for i in order], pairs)
    assert 0 < sum(mask.sum() for mask in straight) < sum(mask.size for mask in straight)
    for place, i in enumerate(order):
        np.testing.assert_array_equal(shuffled[place], straight[i])


def test_low_confidence_and_unknown_depth_are_not_trusted():
    photos = photos_of_a_wall()
    photos[0].confidence[0, 0] = 3.0
    photos[0].depth[0, 1] = np.nan
    first, missing = trusted_pixels([photos[0], None], [(0, 1)])
    assert missing is None
    assert not first[0, 0]
    assert not first[0, 1]
    assert first.sum() == first.size - 2


# --- grids


def test_pixels_of_a_grid():
    grid = Grid(2, 3, 4.0, 5.0, 1.0, -2.0)
    expected = [[x, y] for y in (0.5, 5.5) for x in (3.0, 7.0, 11.0)]
    np.testing.assert_array_equal(grid.photo_pixels(), expected)
    # Every second of five columns and four rows.
    thinned = Grid(4, 5, 1.0, 1.0, 0.0, 0.0).photo_pixels(2)
    np.testing.assert_array_equal(np.unique(thinned[:, 0]), [0.5, 2.5, 4.5])
    np.testing.assert_array_equal(np.unique(thinned[:, 1]), [0.5, 2.5])
    assert len(Grid(1, 2, 1.0, 1.0, 0.0, 0.0).photo_pixels(9)) == 1
