"""Cameras by a network that is off and by features, on photos of a made-up room."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import rooms

from igsr.capture import Camera
from igsr.capture.types import PoseEvidence
from igsr.capture.write_transforms import write_cameras
from igsr.errors import IgsrError
from igsr.fitting.pose_priors import pose_priors
from igsr.geometry.pose_errors import pose_accuracy, pose_errors
from igsr.geometry.similarity import similarity_between
from igsr.pose import FoundCameras, all_evidence, read_found
from igsr.pose.alignment import AlignedPhoto
from igsr.pose.all_evidence import with_all_evidence
from igsr.pose.colmap import Colmap
from igsr.pose.da3.estimator import Da3
from igsr.pose.da3.preprocessing import resampling_of
from igsr.pose.find_cameras import chosen_estimator
from igsr.pose.registry import ESTIMATORS

COUNT = 5


def depths(camera, pixels):
    """Depths [P] of the room's walls at pixels [P, 2] of a camera."""
    slopes = (pixels - camera.K[[0, 1], 2]) / camera.K[[0, 1], [0, 1]]
    rays = np.pad(slopes, ((0, 0), (0, 1)), constant_values=1.0) @ camera.viewmat[:3, :3]
    nearest = np.full(len(rays), np.inf)
    for normal, offset, _, _ in rooms.WALLS:
        with np.errstate(divide="ignore"):
            distance = (offset - camera.center @ normal) / (rays @ np.array(normal))
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
    centre = camera.center + moved * random.normal(size=3) / np.sqrt(3)
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


@pytest.fixture
def colmap_places_none(monkeypatch):
    """What COLMAP's mapper places counts as too little: the network's cameras are the start."""
    monkeypatch.setattr(all_evidence, "FEWEST_PLACED", 99)


def together(photos, start, seed=0):
    sure = [None if one is None else np.ones(one.depth.shape, bool) for one in start]
    return with_all_evidence(photos, start, sure, "The network", None, seed)


def rests_on(found):
    return [one and one.rests_on for one in found.evidence]


def check_depths(found, truth):
    """Depths agree with the cameras, whatever the unit."""
    scale = similarity_between(found.cameras, truth).scale
    for one, camera in zip(found.photos, truth, strict=True):
        exact = depths(camera, one.grid.photo_pixels()).reshape(one.depth.shape)
        assert np.median(scale * one.depth / exact) == pytest.approx(1.0, abs=0.01)


def test_where_colmap_places_all_photos_its_cameras_stand(truth, photos):
    alone = Colmap()(photos, seed=0)
    found = together(photos, predicted(truth))
    for one, other in zip(found.cameras, alone.cameras, strict=True):
        np.testing.assert_array_equal(one.viewmat, other.viewmat)
        np.testing.assert_array_equal(one.K, other.K)
    assert rests_on(found) == ["features"] * COUNT
    assert found.warnings == alone.warnings
    check_depths(found, truth)


def test_cameras_that_are_off_by_degrees_become_right(truth, photos, colmap_places_none):
    start = predicted(truth)
    before = pose_errors([one.camera for one in start], truth)
    assert before["rotation"] > 1.5
    found = together(photos, start)
    assert rests_on(found) == ["features"] * COUNT
    assert found.warnings == []
    after = pose_errors(found.cameras, truth)
    assert after["rotation"] < 0.1
    assert after["centre"] < 0.1 * before["centre"]
    np.testing.assert_allclose([camera.K[0, 0] for camera in found.cameras], 200.0, rtol=0.01)
    # World and unit are near those of the prediction.
    assert similarity_between(found.cameras, truth).scale == pytest.approx(1.0, abs=0.1)
    check_depths(found, truth)
    # Joint fits take their pose priors from these.
    tracks = found.points.tracks
    assert np.bincount(tracks.view, minlength=COUNT).min() >= 15


def test_the_same_seed_gives_the_same_bits(truth, photos, colmap_places_none):
    one, again = (together(photos, predicted(truth), 1) for _ in range(2))
    assert one.evidence == again.evidence
    for first, second in zip(one.cameras, again.cameras, strict=True):
        np.testing.assert_array_equal(first.viewmat, second.viewmat)


@pytest.mark.parametrize("fewest", [3, 99])
def test_a_photo_without_matches_keeps_its_prediction(truth, photos, monkeypatch, fewest):
    monkeypatch.setattr(all_evidence, "FEWEST_PLACED", fewest)
    blank = replace(photos[2], image=np.full_like(photos[2].image, 128))
    shown = [*photos[:2], blank, *photos[3:]]
    start = predicted(truth)
    found = together(shown, start)
    assert rests_on(found) == ["features", "features", "network", "features", "features"]
    (told,) = found.warnings
    assert told.startswith(f"Cameras of {blank.name} are as The network predicts them, about")
    # The others are right, and this one is where the prediction has it among them.
    others = (0, 1, 3, 4)
    right = [found.cameras[i] for i in others]
    assert pose_errors(right, [truth[i] for i in others])["rotation"] < 0.6
    world = similarity_between([start[i].camera for i in others], right)
    wanted = world.camera(start[2].camera)
    assert pose_errors([*right, found.cameras[2]], [*right, wanted])["rotation"] < 0.5
    # How far off it is, the others tell: their predictions are off as far.
    sure, unsure = found.evidence[0], found.evidence[2]
    assert unsure.rotation > 10.0 * sure.rotation
    assert 0.5 < unsure.rotation < 4.0
    assert 0.02 < unsure.center / world.scale < 0.4


def test_photos_that_share_nothing_are_left_alone(truth, photos):
    random = np.random.default_rng(0)
    noise = [
        replace(photo, image=random.integers(0, 256, photo.image.shape, dtype=np.uint8))
        for photo in photos
    ]
    start = predicted(truth)
    found = together(noise, start)
    assert rests_on(found) == ["network"] * COUNT
    assert all(one is other.camera for one, other in zip(found.cameras, start, strict=True))
    assert found.warnings[0].startswith("Cameras of all photos are as The network predicts them")


def test_a_photo_of_something_else_moves_no_other(truth, photos):
    random = np.random.default_rng(0)
    other = random.integers(0, 256, photos[2].image.shape, dtype=np.uint8)
    shown = [*photos[:2], replace(photos[2], image=other), *photos[3:]]
    start = predicted(truth)
    start[2] = replace(start[2], camera=turned(truth[2], 120.0, 3.0, 9))
    found = together(shown, start)
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
    assert moved["centre"] < 2.0 * right["centre"]


def test_an_adjustment_that_leads_far_away_is_not_taken(
    truth, photos, monkeypatch, colmap_places_none
):
    monkeypatch.setattr(all_evidence, "FARTHEST", 0.5)
    start = predicted(truth)
    found = together(photos, start)
    assert rests_on(found) == ["network"] * COUNT
    assert found.warnings[0].startswith("Bundle adjustment led too far from what The network")
    assert all(one is other.camera for one, other in zip(found.cameras, start, strict=True))


def test_a_prediction_that_contradicts_features_is_left_out(truth, photos):
    blank = replace(photos[4], image=np.full_like(photos[4].image, 128))
    start = predicted(truth, degrees=90.0)
    found = together([*photos[:4], blank], start)
    assert rests_on(found) == ["features"] * 4 + [None]
    assert pose_errors(found.cameras[:4], truth[:4])["rotation"] < 0.2
    assert found.warnings[-1] == (
        "Features place 4 of 5 photos where The network does not predict them; the prediction is "
        "left out"
    )


def test_features_of_few_photos_that_contradict_the_prediction_are_left_out(truth, photos):
    # Three photos of one end of the room among others of another: what is alike is another place.
    noise = np.random.default_rng(1).integers(0, 256, (4, *photos[0].image.shape), dtype=np.uint8)
    others = [replace(photos[0], name=f"other{i}.png", image=one) for i, one in enumerate(noise)]
    elsewhere = [rooms.camera(2.0 + 1.5 * i) for i in range(3)]
    start = predicted([*elsewhere, *(rooms.camera(0.2 * i) for i in range(4))])
    found = together([*photos[:3], *others], start)
    assert rests_on(found) == ["network"] * 7
    assert all(one is other.camera for one, other in zip(found.cameras, start, strict=True))
    assert found.warnings[0].startswith("Features place 3 of 7 photos where The network does not")


def test_what_the_network_places_nowhere_has_the_features_of_others(truth, photos):
    start = predicted(truth)
    start[2] = None
    found = together(photos, start)
    assert rests_on(found) == ["features"] * COUNT
    assert found.photos[2] is None


def test_portrait_landscape_and_a_principal_point_off_the_middle(colmap_places_none):
    cameras = [rooms.camera(0.3 * (i - COUNT / 2)) for i in range(COUNT)]
    for i in (1, 3):
        high = rooms.camera(0.3 * (i - COUNT / 2), width=180, height=240)
        cameras[i] = high
    photos = [replace(photo, device="phone") for photo in rooms.photos(cameras)]
    found = together(photos, predicted(cameras))
    assert rests_on(found) == ["features"] * COUNT
    assert pose_errors(found.cameras, cameras)["rotation"] < 0.2
    for camera in cameras:
        camera.K[0, 2] += 0.04 * camera.width  # less than a seventieth of a turn
    photos = [replace(photo, device="phone") for photo in rooms.photos(cameras)]
    start = [
        replace(one, camera=replace(one.camera, K=_centred(one.camera)))
        for one in predicted(cameras)
    ]
    found = together(photos, start)
    # The principal point is not looked for. What features say is turned as much as it is off, and
    # relative to each other the cameras are still better than predicted.
    before = pose_accuracy([one.camera for one in start], cameras)["rotation"]
    assert pose_accuracy(found.cameras, cameras)["rotation"] < 0.3 * before


def _centred(camera):
    K = camera.K.copy()
    K[:2, 2] = camera.width / 2, camera.height / 2
    return K


def test_two_photos(truth, photos):
    start = predicted(truth)[1:3]
    found = together(photos[1:3], start)
    errors = pose_accuracy(found.cameras, truth[1:3])
    assert errors["rotation"] < pose_accuracy([one.camera for one in start], truth[1:3])["rotation"]


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
    assert plain.evidence == []
    # Points of depths, and points of features with their tracks.
    assert adjusted.points.tracks is not None
    assert len(adjusted.points.xyz) > adjusted.points.tracks.point.max() + 1
    # Where cameras are right, photos agree on depths.
    trusted = [np.mean([one.mean() for one in found.trusted]) for found in (adjusted, plain)]
    assert trusted[0] > trusted[1]


def test_what_cameras_rest_on_is_kept_and_written(truth, photos, tmp_path):
    blank = replace(photos[2], image=np.full_like(photos[2].image, 128))
    shown = [*photos[:2], blank, *photos[3:]]
    found = Da3(RoughPredictor(truth))(shown)
    kept = FoundCameras.of(shown, found, {"estimator": "da3"})
    (tmp_path / "found.npz").write_bytes(kept.to_bytes())
    again = read_found(tmp_path / "found.npz")
    assert again.estimate.evidence == found.evidence
    capture = again.capture(tmp_path, shown)
    assert capture.views[2].pose_evidence.rests_on == "network"
    write_cameras(tmp_path / "cameras.json", capture.views)
    frames = json.loads((tmp_path / "cameras.json").read_text())["frames"]
    assert frames[2]["pose_evidence"]["rests_on"] == "network"
    assert frames[0]["pose_evidence"]["rotation"] < frames[2]["pose_evidence"]["rotation"]
    # A joint fit holds the one by its tracks, the other by what is known of the prediction.
    priors = pose_priors(capture.train_views, capture.points, poses=True, focal="fixed")
    known = [np.diagonal(one)[:3].min() ** -0.5 for one in priors.information]
    assert np.degrees(known[2]) == pytest.approx(found.evidence[2].rotation)
    assert max(known[:2] + known[3:]) < 0.2 * known[2]


def test_auto_takes_the_network_whose_weights_are_there(monkeypatch):
    for name, there in (("dust3r", True), ("da3", True), ("colmap", True)):
        entry = replace(ESTIMATORS[name], ready=lambda options, there=there: there)
        monkeypatch.setitem(ESTIMATORS, name, entry)
    assert chosen_estimator("auto", {}) == "dust3r"
    assert chosen_estimator("auto", {"matcher": "sift"}) == "da3"  # which DUSt3R does not know
    for name in ("dust3r", "da3"):
        gone = replace(ESTIMATORS[name], ready=lambda options: False)
        monkeypatch.setitem(ESTIMATORS, name, gone)
        left = "da3" if name == "dust3r" else "colmap"
        assert chosen_estimator("auto", {}) == left
    with pytest.raises(IgsrError, match="graph is no option of colmap"):
        chosen_estimator("auto", {"graph": "complete"})


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (("hope", 0.1, 0.1), "rests_on is 'hope'"),
        (("network", -1.0, 0.1), "the rotation of pose_evidence is -1.0"),
        (("network", 0.1, np.inf), "the center of pose_evidence is inf"),
    ],
)
def test_evidence_that_is_none(fields, message):
    with pytest.raises(IgsrError, match=message):
        PoseEvidence(*fields)
