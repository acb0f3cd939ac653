"""Bundle adjustment from cameras that are roughly right, on photos of a made-up room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import rooms

from igsr.capture import Camera
from igsr.geometry.pose_errors import pose_errors
from igsr.geometry.similarity import similarity_between
from igsr.pose.alignment import AlignedPhoto
from igsr.pose.da3.estimator import Da3
from igsr.pose.da3.preprocessing import resampling_of

COUNT = 5


def depths(camera, pixels):
    """Depths [P] of the room's walls at pixels [P, 2] of a camera."""
    slopes = (pixels - camera.K[[0, 1], 2]) / camera.K[[0, 1], [0, 1]]
    rays = np.pad(slopes, ((0, 0), (0, 1)), constant_values=1.0) @ camera.viewmat[:3, :3]
    nearest = np.full(len(rays), np.inf)
    for normal, offset, _, _ in rooms.WALLS:
        with np.errstate(divide="ignore"):
            distance = (offset - camera.centre @ normal) / (rays @ np.array(normal))
        nearest = np.where((distance > 0) & (distance < nearest), distance, nearest)
    return nearest


def turned(camera, degrees, moved, seed):
    """A camera with a wrong rotation, place and focal length."""
    random = np.random.default_rng(seed)
    axis = random.normal(size=3)
    x, y, z = np.radians(degrees) * axis / np.linalg.norm(axis)
    rotation = np.linalg.qr(np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))[0]
    rotation *= np.sign(np.diag(rotation))
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation @ camera.viewmat[:3, :3]
    centre = camera.centre + moved * random.normal(size=3) / np.sqrt(3)
    viewmat[:3, 3] = -viewmat[:3, :3] @ centre
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= 1.05
    return Camera(viewmat, K, camera.width, camera.height)


@pytest.fixture(scope="module")
def truth():
    return [rooms.camera(0.3 * (i - COUNT / 2)) for i in range(COUNT)]


@pytest.fixture(scope="module")
def photos(truth):
    return [replace(photo, device="phone") for photo in rooms.photos(truth)]


def predicted(truth, degrees=3.0, moved=0.2):
    """What a network might say: cameras that are off, and depths each at a wrong scale."""
    result = []
    for i, camera in enumerate(truth):
        grid = resampling_of(camera.width, camera.height, 252).grid()
        depth = depths(camera, grid.photo_pixels()).reshape(grid.height, grid.width)
        depth = (depth * (1.0 + 0.05 * (-1) ** i)).astype(np.float32)
        sure = np.full(depth.shape, 2.0, np.float32)  # as sure of the one as of the other
        result.append(AlignedPhoto(turned(camera, degrees, moved, i), grid, depth, sure))
    return result


def test_cameras_that_are_off_by_degrees_become_right(truth, photos):
    start = predicted(truth)
    before = pose_errors([one.camera for one in start], truth)
    assert before["rotation"] > 1.5
    found, adjusted, why = with_adjusted_cameras(photos, start, 0)
    assert (adjusted, why) == (list(range(COUNT)), "")
    cameras = [one.camera for one in found]
    after = pose_errors(cameras, truth)
    assert after["rotation"] < 0.1
    assert after["centre"] < 0.02 < 0.3 * before["centre"] + 0.02
    focals = [camera.K[0, 0] for camera in cameras]
    np.testing.assert_allclose(focals, 200.0, rtol=0.01)
    # World and unit are near those of the prediction, and depths agree with the cameras.
    scale = similarity_between(cameras, truth).scale
    assert scale == pytest.approx(1.0, abs=0.1)
    for one, camera in zip(found, truth, strict=True):
        exact = depths(camera, one.grid.photo_pixels()).reshape(one.depth.shape)
        assert np.median(scale * one.depth / exact) == pytest.approx(1.0, abs=0.01)


def test_the_same_seed_gives_the_same_bits(truth, photos):
    one, again = (with_adjusted_cameras(photos, predicted(truth), 1)[0] for _ in range(2))
    for first, second in zip(one, again, strict=True):
        np.testing.assert_array_equal(first.camera.viewmat, second.camera.viewmat)


def test_a_photo_without_matches_keeps_its_prediction(truth, photos):
    blank = replace(photos[2], image=np.full_like(photos[2].image, 128))
    start = predicted(truth)
    start[4] = None
    shown = [*photos[:2], blank, *photos[3:]]
    found, adjusted, why = with_adjusted_cameras(shown, start, 0)
    assert (adjusted, why) == ([0, 1, 3], "")
    assert found[2] is start[2]
    assert found[4] is None
    cameras = [found[i].camera for i in (0, 1, 3)]
    assert pose_errors(cameras, [truth[i] for i in (0, 1, 3)])["rotation"] < 0.6


def test_photos_that_share_nothing_are_left_alone(truth, photos):
    random = np.random.default_rng(0)
    noise = [
        replace(photo, image=random.integers(0, 256, photo.image.shape, dtype=np.uint8))
        for photo in photos
    ]
    start = predicted(truth)
    found, adjusted, why = with_adjusted_cameras(noise, start, 0)
    assert (adjusted, why) == ([], "the photos share too few features")
    assert all(one is other for one, other in zip(found, start, strict=True))
    told = Da3(RoughPredictor(truth))(noise).warnings
    assert told[-1].startswith("Cameras are as Depth Anything 3 predicts them")
    assert told[-1].endswith("the photos share too few features")


def test_an_adjustment_that_leads_far_away_is_not_taken(truth, photos, monkeypatch):
    monkeypatch.setattr(bundle_adjustment, "FARTHEST", 0.5)
    start = predicted(truth)
    found, adjusted, why = with_adjusted_cameras(photos, start, 0)
    assert (adjusted, why) == ([], "it led too far from the prediction")
    assert found == start


class RoughPredictor:
    """A network that is off."""

    def __init__(self, truth):
        self.truth = truth

    def most_photos(self, photos):
        return len(photos)

    def __call__(self, photos, cameras, seed):
        return predicted(self.truth)


def test_the_estimator_adjusts_unless_told_not_to(truth, photos):
    adjusted = Da3(RoughPredictor(truth))(photos)
    plain = Da3(RoughPredictor(truth), bundle_adjustment=False)(photos)
    errors = [pose_errors(found.cameras, truth)["rotation"] for found in (adjusted, plain)]
    assert errors[0] < 0.1
    assert errors[1] > 1.5
    assert adjusted.warnings == plain.warnings == []
    blank = replace(photos[2], image=np.full_like(photos[2].image, 128))
    (told,) = Da3(RoughPredictor(truth))([*photos[:2], blank, *photos[3:]]).warnings
    assert told.startswith(f"Cameras of {blank.name} are as Depth Anything 3 predicts them")
    # Where cameras are right, photos agree on depths.
    trusted = [np.mean([one.mean() for one in found.trusted]) for found in (adjusted, plain)]
    assert trusted[0] > trusted[1]
