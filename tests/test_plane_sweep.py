"""Points of a start without points: on the surface where photos tell, anywhere else last."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from igsr.capture import Camera, View
from igsr.fitting.initialization import plane_sweep
from igsr.fitting.initialization.plane_sweep import (
    FARTHEST,
    MOST_SWEPT,
    _depth_range,
    can_sweep,
    depth_maps,
    swept_points,
)

SIZE, FOCAL, DEPTH = 64, 80.0, 4.0
#: The wall moves by 8 pixels from photo to photo, and photos are compared at whole pixels.
NEAR = 0.3
TARGET = np.array([0.0, 0.0, DEPTH])


def views(count=3, flat=lambda x: np.zeros(x.shape, dtype=bool), baseline=0.4):
    """Photos of a wall at z = 4 with a random texture, but for a grey part."""
    texture = np.random.default_rng(0).integers(0, 256, (40, 200, 3))
    made = []
    for i in range(count):
        center = baseline * (i - (count - 1) / 2)
        viewmat = np.eye(4)
        viewmat[0, 3] = -center
        K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
        at = (np.arange(SIZE) + 0.5 - SIZE / 2) / FOCAL * DEPTH
        y, x = np.meshgrid(at, at + center, indexing="ij")
        cells = texture[((y + 2.0) * 10).astype(int) % 40, ((x + 10.0) * 10).astype(int) % 200]
        image = np.where(flat(x)[..., None], 128, cells).astype(np.uint8)
        made.append(View(f"{i}.png", Camera(viewmat, K, SIZE, SIZE), "train", image))
    return made


#: The photos' axes are parallel: what they look at is known from points.
KNOWN = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3)) + TARGET


def points(photos, count=400, seed=0):
    return swept_points(photos, KNOWN, count, np.random.default_rng(seed))


def test_points_lie_on_the_surface_with_its_colours():
    photos = views()
    xyz, colors = points(photos)
    assert xyz.shape == colors.shape == (400, 3)
    assert np.mean(np.abs(xyz[:, 2] - DEPTH) < NEAR) > 0.95
    again, _ = points(photos)
    np.testing.assert_array_equal(xyz, again)
    pixel = np.floor(FOCAL * xyz[:, :2] / xyz[:, 2:] + SIZE / 2).astype(int).clip(0, SIZE - 1)
    seen = photos[1].image[pixel[:, 1], pixel[:, 0]] / 255.0
    assert np.abs(seen - colors).mean() < 0.15


def test_points_avoid_what_photos_cannot_tell():
    xyz, _ = points(views(flat=lambda x: x < 0.0))
    assert np.mean(xyz[:, 0] < -0.3) < 0.1


def test_masked_pixels_have_no_points_and_do_not_matter():
    def masked(seed):
        photos = views()
        noise = np.random.default_rng(seed)
        for view in photos:
            view.mask = np.zeros((SIZE, SIZE), dtype=bool)
            view.mask[:32] = True
            view.image[32:] = noise.integers(0, 256, (SIZE - 32, SIZE, 3))
        return points(photos)[0]

    xyz = masked(0)
    assert np.mean(np.abs(xyz[:, 2] - DEPTH) < NEAR) > 0.95
    assert xyz[:, 1].max() <= 1e-9
    np.testing.assert_array_equal(xyz, masked(1))


def test_photos_are_swept_that_have_a_near_neighbour():
    ring = [replace(views(1)[0], camera=scenes.ring_camera(a, SIZE)) for a in (0.0, 0.6, 1.2, 2.4)]
    center = np.zeros(3)
    assert can_sweep(ring[:3], center)
    assert not can_sweep(ring, center)
    assert not can_sweep(ring[:1], center)
    assert not can_sweep(ring[:3], center, 30.0)


def back_to_back():
    photos = views(2)
    turned = replace(photos[1].camera, viewmat=np.diag([-1.0, 1.0, -1.0, 1.0]))
    return [photos[0], replace(photos[1], camera=turned)]


@pytest.mark.parametrize("photos", [views(1), back_to_back()])
def test_photos_that_tell_nothing_give_no_points(photos):
    xyz, colors = points(photos)
    assert xyz.shape == colors.shape == (0, 3)


def test_known_points_tell_the_range_of_depths():
    photo = views()[0]
    nearest, farthest = _depth_range(photo, TARGET, KNOWN)
    assert nearest < DEPTH - 1.0 < DEPTH + 1.0 < farthest
    assert farthest / nearest < 0.5 * FARTHEST / plane_sweep.NEAREST
    without = plane_sweep.NEAREST * DEPTH, FARTHEST * DEPTH
    assert _depth_range(photo, np.array([photo.camera.center[0], 0, DEPTH]), None) == without
    assert _depth_range(photo, np.array([photo.camera.center[0], 0, DEPTH]), KNOWN[:5]) == without


def test_points_need_a_second_depth_map_that_agrees():
    """Of a photo whose neighbour shows another scene, little is believed: what agrees by chance."""
    photos = views()
    noise = np.random.default_rng(5).integers(0, 256, (SIZE, SIZE, 3)).astype(np.uint8)
    strange = [photos[0], replace(photos[1], image=noise)]
    assert len(points(strange)[0]) < 0.05 * SIZE * SIZE
    assert len(points(photos[:2], count=SIZE * SIZE)[0]) > 0.3 * SIZE * SIZE


def test_of_many_photos_some_are_swept():
    photos = views(MOST_SWEPT + 6, baseline=0.05)
    maps = depth_maps(photos, KNOWN)
    assert len(maps) == MOST_SWEPT
    names = [one.view.name for one in maps]
    assert names[0] == photos[0].name
    assert names[-1] == photos[-1].name
