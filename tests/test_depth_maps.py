"""Depth maps by stereo, and their points, are on the visible surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from igsr import _core
from igsr.capture import Camera, View
from igsr.fitting.initialization.depth_maps import (
    MAX_DEPTH,
    MAX_DEPTH_MAPS,
    MIN_DEPTH,
    depth_maps,
    depth_points,
    have_neighbors,
)

SIZE, FOCAL, DEPTH = 64, 80.0, 4.0
#: The wall moves by 8 pixels from photo to photo, and its texture is not interpolated.
TOLERANCE = 0.15


def wall(count=3, is_plain=lambda x: np.zeros(x.shape, dtype=bool), baseline=0.4, seed=0):
    """Photos side by side of a wall at z = 4 with a random texture, with gray parts."""
    texture = np.random.default_rng(seed).integers(0, 256, (40, 200, 3))
    views = []
    for i in range(count):
        center = baseline * (i - (count - 1) / 2)
        viewmat = np.eye(4)
        viewmat[0, 3] = -center
        K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
        offset = (np.arange(SIZE) + 0.5 - SIZE / 2) / FOCAL * DEPTH
        y, x = np.meshgrid(offset, offset + center, indexing="ij")
        colors = texture[((y + 2.0) * 7).astype(int) % 40, ((x + 10.0) * 7).astype(int) % 200]
        image = np.where(is_plain(x)[..., None], 128, colors).astype(np.uint8)
        views.append(View(f"{i}.png", Camera(viewmat, K, SIZE, SIZE), "train", image))
    return views


#: The photos' axes are parallel, so their focus point is unknown without points.
KNOWN = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3)) + np.array([0.0, 0.0, DEPTH])


def points(views, count=400, seed=0):
    return depth_points(views, KNOWN, count, np.random.default_rng(seed))


def fraction_on_wall(xyz):
    return np.mean(np.abs(xyz[:, 2] - DEPTH) < TOLERANCE)


@pytest.mark.parametrize("seed", range(3))
def test_points_are_on_the_surface_with_its_colors(seed):
    views = wall(seed=seed)
    xyz, colors = points(views)
    assert xyz.shape == colors.shape == (400, 3)
    assert fraction_on_wall(xyz) > 0.95
    np.testing.assert_array_equal(xyz, points(views)[0])
    column, row = np.floor(FOCAL * xyz[:, :2] / xyz[:, 2:] + SIZE / 2).astype(int).T
    seen = views[1].image[row.clip(0, SIZE - 1), column.clip(0, SIZE - 1)] / 255.0
    assert np.abs(seen - colors).mean() < 0.15


def test_plain_surfaces_have_few_points():
    xyz, _ = points(wall(is_plain=lambda x: x < 0.0))
    assert np.mean(xyz[:, 0] < -0.3) < 0.1


def test_masked_pixels_have_no_points_and_do_not_matter():
    def masked(seed):
        views = wall()
        random = np.random.default_rng(seed)
        for view in views:
            view.mask = np.zeros((SIZE, SIZE), dtype=bool)
            view.mask[:32] = True
            view.image[32:] = random.integers(0, 256, (SIZE - 32, SIZE, 3))
        return points(views)[0]

    xyz = masked(0)
    assert fraction_on_wall(xyz) > 0.95
    assert xyz[:, 1].max() <= 1e-9
    np.testing.assert_array_equal(xyz, masked(1))


def test_photos_have_neighbors_within_an_angle():
    angles = (0.0, 0.6, 1.2, 2.4)
    ring = [replace(wall(1)[0], camera=scenes.ring_camera(angle, SIZE)) for angle in angles]
    target = np.zeros(3)
    assert have_neighbors(ring[:3], target)
    assert not have_neighbors(ring, target)
    assert not have_neighbors(ring[:1], target)
    assert not have_neighbors(ring[:3], target, 30.0)


def back_to_back():
    first, second = wall(2)
    camera = replace(second.camera, viewmat=np.diag([-1.0, 1.0, -1.0, 1.0]))
    return [first, replace(second, camera=camera)]


@pytest.mark.parametrize("views", [wall(1), back_to_back()])
def test_photos_without_a_neighbor_give_no_points(views):
    xyz, colors = points(views)
    assert xyz.shape == colors.shape == (0, 3)


def test_depth_maps_have_depth_normals_and_confidence_where_confirmed():
    for depth_map in depth_maps(wall(), KNOWN):
        is_known = depth_map.depth > 0.0
        assert is_known.mean() > 0.3
        assert np.median(np.abs(depth_map.depth[is_known] / DEPTH - 1.0)) < 0.01
        lengths = np.linalg.norm(depth_map.normal, axis=2)
        np.testing.assert_allclose(lengths, is_known, atol=1e-5)
        assert np.median(depth_map.normal[is_known], axis=0)[2] < -0.9
        np.testing.assert_array_equal(depth_map.confidence > 0.0, is_known)
        assert depth_map.confidence.max() <= 1.0


def test_known_points_are_seeds_and_narrow_the_range_of_depths(monkeypatch):
    known = KNOWN - np.array([0.0, 0.0, DEPTH])
    cameras = [scenes.ring_camera(angle, SIZE, DEPTH) for angle in (0.0, 0.2, 0.4)]
    views = [replace(wall(1)[0], camera=camera) for camera in cameras]
    given = []
    monkeypatch.setattr(_core, "depth_maps", lambda *arguments: given.append(arguments[-1]) or [])

    def depth_range(known):
        with pytest.raises(ValueError, match="zip"):  # no maps are returned
            depth_maps(views, known)
        _, others, (near, far), seeds = given[-1][0]
        assert sorted(others) == [1, 2]
        return 1.0 / near, 1.0 / far, seeds

    nearest, farthest, seeds = depth_range(known)
    assert nearest < DEPTH - 1.0 < DEPTH + 1.0 < farthest
    assert farthest / nearest < 0.5 * MAX_DEPTH / MIN_DEPTH
    assert seeds.shape == (len(known), 3)
    np.testing.assert_allclose(1.0 / seeds[:, 2], known[:, 2] + DEPTH, rtol=1e-5)
    # Of a flat scene, the range begins near its points; of a deep one, farther in front of them.
    corners = np.indices((5, 5)).reshape(2, -1).T / 2.0 - 1.0
    for behind, fraction in ((0.0, 0.9), (1.0, 1 / (1 + 1.5 * 0.2)), (40.0, 0.6)):
        depths = np.where(np.arange(25) < 5, DEPTH, DEPTH + behind)
        points = np.column_stack([corners * 0.05, depths - DEPTH])
        assert depth_range(points)[0] == pytest.approx(fraction * DEPTH, rel=0.01)
    # Too few points do not count.
    assert depth_range(known[:5])[:2] == depth_range(None)[:2]
    assert depth_range(None)[:2] == pytest.approx((MIN_DEPTH * DEPTH, MAX_DEPTH * DEPTH), rel=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_points_need_a_second_depth_map_that_agrees(seed):
    views = wall()
    noise = np.random.default_rng(seed).integers(0, 256, (SIZE, SIZE, 3)).astype(np.uint8)
    strange = [views[0], replace(views[1], image=noise)]
    assert len(points(strange)[0]) < 0.05 * SIZE * SIZE
    assert len(points(views[:2], count=SIZE * SIZE)[0]) > 0.3 * SIZE * SIZE


def test_of_many_photos_some_have_depth_maps():
    views = wall(MAX_DEPTH_MAPS + 6, baseline=0.05)
    names = [depth_map.view.name for depth_map in depth_maps(views, KNOWN)]
    assert len(names) == MAX_DEPTH_MAPS
    assert (names[0], names[-1]) == (views[0].name, views[-1].name)
