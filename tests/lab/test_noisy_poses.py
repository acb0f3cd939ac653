"""Noise on camera poses has the size that it names, and changes photos as it changes cameras."""

from dataclasses import replace

import numpy as np
import pytest
import scenes
from made_up_tracks import projected

from igsr_lab.camera_noise import AFFINE, MATRIX, TURN, Noise, noise_unit, noisy_view


@pytest.fixture(scope="module")
def views():
    return scenes.capture(views=6, size=64, scene=scenes.splats(count=120)).views


@pytest.mark.parametrize("seed", range(3))
def test_noise_has_its_size(views, seed):
    random, camera = np.random.default_rng(seed), views[2].camera
    turned = noisy_view(views[2], Noise(TURN, 2.0), random).camera
    between = turned.viewmat[:3, :3] @ camera.viewmat[:3, :3].T
    assert np.degrees(np.arccos((np.trace(between) - 1.0) / 2.0)) == pytest.approx(2.0, abs=1e-6)
    assert np.allclose(turned.center, camera.center)
    noisy = [noisy_view(views[2], Noise(MATRIX, 0.01), random).camera for _ in range(300)]
    assert np.std([c.center - camera.center for c in noisy]) == pytest.approx(0.01, rel=0.1)
    unchanged = noisy_view(views[2], Noise("clean", 0.0), random).camera.viewmat
    assert unchanged == pytest.approx(camera.viewmat, abs=1e-12)


def test_the_unit_of_noise_is_the_viewing_distance(views):
    unit = noise_unit(views)
    for view in views:
        assert np.linalg.norm(view.camera.center) / 4.03 == pytest.approx(unit, rel=0.05)

    def noise(unit):
        random = np.random.default_rng(3)
        camera = noisy_view(views[0], Noise(MATRIX, 0.01), random, unit).camera
        return camera.viewmat[:3, :3], camera.center - views[0].camera.center

    (rotation, shift), (same_rotation, doubled) = noise(1.0), noise(2.0)
    assert np.array_equal(rotation, same_rotation)
    assert doubled == pytest.approx(2.0 * shift, abs=1e-9)
    assert noise_unit(views[:1]) == 1.0  # one camera has no focus point


@pytest.mark.parametrize("seed", range(3))
def test_affine_noise_is_a_rigid_camera_and_a_shear_of_the_photo(views, seed):
    view = views[2]
    noisy = noisy_view(view, Noise(AFFINE, 0.01), np.random.default_rng(seed))
    affine = np.linalg.inv(view.camera.viewmat)
    affine[:3, :4] += 0.01 * np.random.default_rng(seed).normal(size=(3, 4))
    points = np.random.default_rng(1).normal(scale=0.3, size=(50, 3))
    local = np.linalg.inv(affine) @ np.pad(points, ((0, 0), (0, 1)), constant_values=1.0).T
    exact = (view.camera.K @ local[:3] / local[2]).T
    rigid = projected(noisy.camera, points)
    assert np.allclose(exact[:, 1], rigid[:, 1], atol=1e-9)
    # Rows move as a whole, in proportion to their distance from the principal point.
    shift = exact[:, 0] - rigid[:, 0]
    slope = np.polyfit(rigid[:, 1], shift, 1)
    assert np.allclose(np.polyval(slope, rigid[:, 1]), shift, atol=1e-9)
    assert abs(slope[0]) > 1e-5
    assert noisy.image.shape == view.image.shape
    assert not np.array_equal(noisy.image, view.image)


def test_partly_covered_pixels_of_sheared_photos_keep_their_color(views):
    image = np.zeros((64, 64, 4), np.uint8)
    image[:, 20:40] = (200, 100, 50, 255)
    view = replace(views[2], image=image)
    sheared = noisy_view(view, Noise(AFFINE, 0.01), np.random.default_rng(0)).image
    covered = sheared[..., 3] > 0
    assert (sheared[covered][:, :3] == (200, 100, 50)).all()
    assert (sheared[covered][:, 3] < 255).any()
