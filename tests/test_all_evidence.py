"""Cameras by an inaccurate network and by features, on photos of a synthetic room."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import rooms
from scenes import perturbed_camera

from igsr._internal.part_usage import Usage
from igsr.cameras import all_evidence
from igsr.cameras.alignment import AlignedPhoto
from igsr.cameras.all_evidence import with_all_evidence
from igsr.cameras.cameras_file import KeptCameras, read_cameras_file, write_cameras_file
from igsr.cameras.colmap import Colmap
from igsr.cameras.colmap.matchers import chosen_matchers
from igsr.cameras.da3.estimator import Da3
from igsr.cameras.da3.prediction import resampling_of
from igsr.cameras.found_cameras import FoundCameras
from igsr.capture.types import PoseEvidence
from igsr.capture.write_transforms import write_cameras
from igsr.errors import IgsrError
from igsr.fitting.pose_priors import pose_priors
from igsr.geometry.pose_errors import pose_accuracy, pose_errors
from igsr.geometry.similarity import similarity_between

COUNT = 5
ANGLES = [0.3 * (i - COUNT / 2) for i in range(COUNT)]


def turned(camera, degrees, moved, seed):
    """A camera with a wrong rotation, center and focal length."""
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= 1.05
    return replace(perturbed_camera(camera, degrees, moved, seed), K=K)


@pytest.fixture(scope="module")
def truth():
    return [rooms.camera(angle) for angle in ANGLES]


@pytest.fixture(scope="module")
def photos(truth):
    return photos_of(truth)


def photos_of(cameras):
    return [replace(photo, device="phone") for photo in rooms.photos(cameras)]


def without_features(photos, index, image=128):
    """The photos; one shows a plain gray or another image."""
    blank = replace(photos[index], image=np.full_like(photos[index].image, image))
    return [*photos[:index], blank, *photos[index + 1 :]]


def check_unchanged(found, start):
    """All cameras are as predicted."""
    assert rests_on(found) == ["network"] * len(start)
    assert all(one is other.camera for one, other in zip(found.cameras, start, strict=True))


def predicted(truth, degrees=3.0, moved=0.2):
    """Predictions of a network: inaccurate cameras, and depths with wrong scales."""
    result = []
    for i, camera in enumerate(truth):
        grid = resampling_of(camera.width, camera.height, 252).grid()
        depth = rooms.depths(camera, grid.photo_pixels()).reshape(grid.height, grid.width)
        depth = (depth * (1.0 + 0.05 * (-1) ** i)).astype(np.float32)
        sure = np.full(depth.shape, 2.0, np.float32)
        result.append(AlignedPhoto(turned(camera, degrees, moved, i), grid, depth, sure))
    return result


@pytest.fixture
def colmap_places_none(monkeypatch):
    """Use the network's cameras as the start, even if COLMAP places all photos."""
    monkeypatch.setattr(all_evidence, "MIN_PLACED", 99)


def together(photos, start, seed=0):
    sure = [None if one is None else np.ones(one.depth.shape, bool) for one in start]
    return with_all_evidence(photos, start, sure, "The network", chosen_matchers("sift"), seed)


def rests_on(found):
    return [one and one.rests_on for one in found.evidence]


def check_depths(found, truth):
    """Depths agree with the cameras, whatever the unit."""
    scale = similarity_between(found.cameras, truth).scale
    for one, camera in zip(found.photos, truth, strict=True):
        exact = rooms.depths(camera, one.grid.photo_pixels()).reshape(one.depth.shape)
        assert np.median(scale * one.depth / exact) == pytest.approx(1.0, abs=0.01)


def test_colmaps_cameras_are_kept_if_it_places_all_photos(truth, photos):
    alone = Colmap()(photos, seed=0)
    found = together(photos, predicted(truth))
    for one, other in zip(found.cameras, alone.cameras, strict=True):
        np.testing.assert_array_equal(one.viewmat, other.viewmat)
        np.testing.assert_array_equal(one.K, other.K)
    assert rests_on(found) == ["features"] * COUNT
    assert found.warnings == alone.warnings
    check_depths(found, truth)


def test_inaccurate_cameras_are_corrected(truth, photos, colmap_places_none):
    start = predicted(truth)
    before = pose_errors([one.camera for one in start], truth)
    assert before["rotation"] > 1.5
    found = together(photos, start)
    assert rests_on(found) == ["features"] * COUNT
    assert found.warnings == []
    after = pose_errors(found.cameras, truth)
    assert after["rotation"] < 0.1
    assert after["center"] < 0.1 * before["center"]
    np.testing.assert_allclose([camera.K[0, 0] for camera in found.cameras], 200.0, rtol=0.01)
    # World and unit are close to the prediction.
    assert similarity_between(found.cameras, truth).scale == pytest.approx(1.0, abs=0.1)
    check_depths(found, truth)
    # Joint fits take pose priors from these tracks.
    tracks = found.points.tracks
    assert np.bincount(tracks.view, minlength=COUNT).min() >= 15


def test_the_same_seed_gives_the_same_bits(truth, photos, colmap_places_none):
    one, again = (together(photos, predicted(truth), 1) for _ in range(2))
    assert one.evidence == again.evidence
    for first, second in zip(one.cameras, again.cameras, strict=True):
        np.testing.assert_array_equal(first.viewmat, second.viewmat)


@pytest.mark.parametrize("fewest", [3, 99])
def test_a_photo_without_matches_keeps_its_prediction(truth, photos, monkeypatch, fewest):
    monkeypatch.setattr(all_evidence, "MIN_PLACED", fewest)
    start = predicted(truth)
    found = together(without_features(photos, 2), start)
    assert rests_on(found) == ["features", "features", "network", "features", "features"]
    (warning,) = found.warnings
    assert warning.startswith(f"Cameras of {photos[2].name} are as The network predicts them, with")
    # All other photos are accurate, and this one is as predicted relative to them.
    others = (0, 1, 3, 4)
    right = [found.cameras[i] for i in others]
    assert pose_errors(right, [truth[i] for i in others])["rotation"] < 0.6
    world = similarity_between([start[i].camera for i in others], right)
    wanted = world.camera(start[2].camera)
    assert pose_errors([*right, found.cameras[2]], [*right, wanted])["rotation"] < 0.5
    # Its deviations come from errors of other predictions.
    known, predicted_only = found.evidence[0], found.evidence[2]
    assert predicted_only.rotation > 10.0 * known.rotation
    assert 0.5 < predicted_only.rotation < 4.0
    assert 0.02 < predicted_only.center / world.scale < 0.4


def test_photos_without_matches_keep_their_predictions(truth, photos):
    random = np.random.default_rng(0)
    images = random.integers(0, 256, (COUNT, *photos[0].image.shape), dtype=np.uint8)
    noise = [replace(photo, image=one) for photo, one in zip(photos, images, strict=True)]
    start = predicted(truth)
    found = together(noise, start)
    check_unchanged(found, start)
    assert found.warnings[0].startswith("Cameras of all photos are as The network predicts them")


def test_a_photo_of_something_else_moves_no_other(truth, photos):
    random = np.random.default_rng(0)
    other = random.integers(0, 256, photos[2].image.shape, dtype=np.uint8)
    start = predicted(truth)
    start[2] = replace(start[2], camera=turned(truth[2], 120.0, 3.0, 9))
    found = together(without_features(photos, 2, other), start)
    assert rests_on(found)[2] == "network"
    others = (0, 1, 3, 4)
    cameras = [found.cameras[i] for i in others]
    assert pose_errors(cameras, [truth[i] for i in others])["rotation"] < 0.6


def test_a_wrong_depth_of_one_photo_moves_no_other(truth, photos, colmap_places_none):
    start = predicted(truth)
    right = pose_errors(together(photos, start).cameras, truth)
    random = np.random.default_rng(5)
    wrong = start[1].depth * np.exp(random.normal(size=start[1].depth.shape))
    start[1] = replace(start[1], depth=(3.0 * wrong).astype(np.float32))
    moved = pose_errors(together(photos, start).cameras, truth)
    assert moved["rotation"] < 2.0 * right["rotation"]
    assert moved["center"] < 2.0 * right["center"]


@pytest.mark.usefixtures("colmap_places_none")
def test_an_adjustment_far_from_the_prediction_is_not_used(truth, photos, monkeypatch):
    monkeypatch.setattr(all_evidence, "MAX_ANGLE", 0.5)
    start = predicted(truth)
    found = together(photos, start)
    check_unchanged(found, start)
    assert found.warnings[0].startswith("Bundle adjustment contradicts the prediction of The")


def test_a_prediction_that_contradicts_features_is_not_used(truth, photos):
    found = together(without_features(photos, 4), predicted(truth, degrees=90.0))
    assert rests_on(found) == ["features"] * 4 + [None]
    assert pose_errors(found.cameras[:4], truth[:4])["rotation"] < 0.2
    assert found.warnings[-1] == (
        "Features place 4 of 5 photos, but not where The network predicts them; the prediction is "
        "not used"
    )


def test_few_features_that_contradict_the_prediction_are_not_used(truth, photos):
    # Features place three photos at one end of the room, the network at another.
    noise = np.random.default_rng(1).integers(0, 256, (3, *photos[0].image.shape), dtype=np.uint8)
    others = [replace(photos[0], name=f"other{i}.png", image=one) for i, one in enumerate(noise)]
    elsewhere = [rooms.camera(2.0 + 1.5 * i) for i in range(3)]
    start = predicted([*elsewhere, *(rooms.camera(0.2 * i) for i in range(3))])
    found = together([*photos[:3], *others], start)
    check_unchanged(found, start)
    assert found.warnings[0].startswith("Features place 3 of 6 photos, but not where")


def test_features_place_a_photo_without_a_prediction(truth, photos):
    start = predicted(truth)
    start[2] = None
    found = together(photos, start)
    assert rests_on(found) == ["features"] * COUNT
    assert found.photos[2] is None


def test_portrait_landscape_and_a_principal_point_off_the_middle(colmap_places_none):
    sizes = [(240, 180), (180, 240)] * COUNT
    cameras = [rooms.camera(ANGLES[i], 200.0, *sizes[i]) for i in range(COUNT)]
    photos = photos_of(cameras)
    found = together(photos, predicted(cameras))
    assert rests_on(found) == ["features"] * COUNT
    assert pose_errors(found.cameras, cameras)["rotation"] < 0.2
    for camera in cameras:
        camera.K[0, 2] += 0.04 * camera.width
    photos = photos_of(cameras)
    start = predicted(cameras)
    for one in start:
        one.camera.K[:2, 2] = one.camera.width / 2, one.camera.height / 2
    found = together(photos, start)
    # The principal point is not estimated, so all cameras are rotated alike; relative to each other
    # they are still better than predicted.
    before = pose_accuracy([one.camera for one in start], cameras)["rotation"]
    assert pose_accuracy(found.cameras, cameras)["rotation"] < 0.3 * before


def test_two_photos(truth, photos):
    start = predicted(truth)[1:3]
    found = together(photos[1:3], start)
    errors = pose_accuracy(found.cameras, truth[1:3])
    assert errors["rotation"] < pose_accuracy([one.camera for one in start], truth[1:3])["rotation"]


class RoughPredictor:
    def __init__(self, truth):
        self.truth = truth

    def most_photos(self, photos):
        return len(photos)

    def __call__(self, photos, seed):
        return predicted(self.truth)


def test_bundle_adjustment_of_the_estimator(truth, photos):
    adjusted = Da3(RoughPredictor(truth))(photos)
    plain = Da3(RoughPredictor(truth), bundle_adjustment=False)(photos)
    errors = [pose_errors(found.cameras, truth)["rotation"] for found in (adjusted, plain)]
    assert errors[0] < 0.1
    assert errors[1] > 1.5
    assert adjusted.warnings == plain.warnings == []
    assert plain.evidence == []
    # Points of depth maps, and points of features with tracks.
    assert adjusted.points.tracks is not None
    assert len(adjusted.points.xyz) > adjusted.points.tracks.point.max() + 1
    # With accurate cameras, photos agree on depths.
    trusted = [np.mean([one.mean() for one in found.trusted]) for found in (adjusted, plain)]
    assert trusted[0] > trusted[1]


def test_evidence_is_kept_and_written(truth, photos, tmp_path):
    shown = without_features(photos, 2)
    found = Da3(RoughPredictor(truth))(shown)
    of_photos = FoundCameras.of(shown, found, {"estimator": "da3"})
    kept = KeptCameras(of_photos, {}, Usage(0.0, 0.0, None))
    write_cameras_file(tmp_path / "cameras.npz", kept)
    again = read_cameras_file(tmp_path / "cameras.npz").found
    assert again.estimate.evidence == found.evidence
    capture = again.capture(tmp_path, shown)
    assert capture.views[2].pose_evidence.rests_on == "network"
    write_cameras(tmp_path / "cameras.json", capture.views)
    frames = json.loads((tmp_path / "cameras.json").read_text())["frames"]
    assert frames[2]["pose_evidence"]["rests_on"] == "network"
    assert frames[0]["pose_evidence"]["rotation"] < frames[2]["pose_evidence"]["rotation"]
    # A joint fit has priors from tracks, or from the evidence of the prediction.
    priors = pose_priors(capture.train_views, capture.points, poses=True, focal="fixed")
    known = [np.diagonal(one)[:3].min() ** -0.5 for one in priors.information]
    assert np.degrees(known[2]) == pytest.approx(found.evidence[2].rotation)
    assert max(known[:2] + known[3:]) < 0.2 * known[2]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (("hope", 0.1, 0.1), "rests_on is 'hope'"),
        (("network", -1.0, 0.1), "the rotation of pose_evidence is -1.0"),
        (("network", 0.1, np.inf), "the center of pose_evidence is inf"),
    ],
)
def test_invalid_evidence(fields, message):
    with pytest.raises(IgsrError, match=message):
        PoseEvidence(*fields)
