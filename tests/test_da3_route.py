"""Depth Anything 3 from photos to an estimate, with exact predictions and with the network."""

from __future__ import annotations

import hashlib
import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from da3_networks import hashed_network
from safetensors.torch import save_file
from scenes import ring_camera

from igsr._internal.part_usage import Usage
from igsr.cameras import CameraSettings
from igsr.cameras.alignment import AlignedPhoto
from igsr.cameras.cameras_file import KeptCameras, read_cameras_file, write_cameras_file
from igsr.cameras.da3 import prediction
from igsr.cameras.da3.backbone import BASE
from igsr.cameras.da3.checkpoint import SIZES
from igsr.cameras.da3.estimator import Da3, with_shared_focals
from igsr.cameras.da3.passes import joined_passes, passes_of
from igsr.cameras.da3.prediction import Da3Predictor, memory_of_pass, resampling_of
from igsr.cameras.depth_maps import trusted_depths
from igsr.cameras.find import estimate
from igsr.cameras.found_cameras import FoundCameras
from igsr.capture import Camera
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError
from igsr.geometry.pose_errors import pose_errors
from igsr.geometry.similarity import Similarity, similarity_between

SIZE = 64


def spheres(camera, pixels):
    """Depths [P] of a ball inside a hollow one, as a camera sees them at pixels [P, 2]."""
    K, rotation = camera.K, camera.viewmat[:3, :3]
    local = np.pad((pixels - K[[0, 1], 2]) / K[[0, 1], [0, 1]], ((0, 0), (0, 1)), constant_values=1)
    rays, center = local @ rotation, camera.center
    a, b = (rays * rays).sum(1), rays @ center

    def hit(radius, sign):
        inside = b * b - a * (center @ center - radius**2)
        return np.where(inside > 0, (-b + sign * np.sqrt(np.maximum(inside, 0))) / a, np.nan)

    ball, shell = hit(1.0, -1), hit(9.0, 1)
    return np.where(np.isfinite(ball), ball, shell)


def scene(count, width=SIZE, height=SIZE, step=0.25):
    """Cameras on a ring, and photos of noise."""
    random = np.random.default_rng(count)
    cameras, photos = [], []
    for i in range(count):
        camera = ring_camera(step * i, SIZE)
        K = camera.K.copy()
        K[:2, 2] = width / 2, height / 2
        cameras.append(Camera(camera.viewmat, K, width, height))
        image = random.integers(0, 256, (height, width, 3), dtype=np.uint8)
        photos.append(Photo(f"{i:02}.png", image, device="phone"))
    return cameras, photos


class ExactPredictor:
    """Predicts exact depths and cameras, every pass in another world and unit."""

    def __init__(self, cameras, photos, most=99):
        self.cameras = {photo.name: camera for photo, camera in zip(photos, cameras, strict=True)}
        self.most = most
        self.shown = []

    def most_photos(self, photos):
        return self.most

    def __call__(self, photos, seed):
        self.shown.append([photo.name for photo in photos])
        random = np.random.default_rng(len(self.shown))
        rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
        rotation *= np.sign(np.linalg.det(rotation))
        world = Similarity(random.uniform(0.1, 5.0), rotation, random.normal(size=3))
        return [self.aligned(photo, world) for photo in photos]

    def aligned(self, photo, world):
        camera = self.cameras[photo.name]
        grid = resampling_of(camera.width, camera.height, 56).grid()
        depth = spheres(camera, grid.photo_pixels()).reshape(grid.height, grid.width)
        sure = np.where(depth < 5.0, 3.0, 1.5) + 0.01 * np.arange(depth.size).reshape(depth.shape)
        exact = AlignedPhoto(camera, grid, depth.astype(np.float32), sure.astype(np.float32))
        return exact.mapped(world)


def exact_scene(count, *size, most=99, **more):
    cameras, photos = scene(count, *size, **more)
    return cameras, photos, ExactPredictor(cameras, photos, most)


def unadjusted(*arguments, **more):
    """The estimator without bundle adjustment, since photos of noise have no matches."""
    return Da3(*arguments, bundle_adjustment=False, **more)


def check_cameras(found, wanted, degrees=0.01):
    errors = pose_errors(found, wanted)
    assert errors["rotation"] < degrees
    assert errors["center"] < 1e-3
    for camera, truth in zip(found, wanted, strict=True):
        np.testing.assert_allclose(camera.K, truth.K, rtol=1e-6)


@pytest.mark.parametrize(("count", "size"), [(2, (64, 64)), (5, (80, 60)), (5, (60, 80))])
def test_cameras_depths_and_points_of_one_pass(count, size):
    cameras, photos, predictor = exact_scene(count, *size)
    found = unadjusted(predictor)(photos)
    check_cameras(found.cameras, cameras)
    assert found.warnings == []
    xyz = similarity_between(found.cameras, cameras).apply(found.points.xyz.T)
    radius = np.linalg.norm(xyz, axis=0)
    # All points lie on one of two spheres.
    assert np.minimum(np.abs(radius - 1.0), np.abs(radius - 9.0)).max() < 1e-3
    assert (radius < 1.01).mean() > 0.1
    for depth, trusted in zip(found.depths, found.trusted, strict=True):
        assert depth.shape == trusted.shape
        assert depth.dtype == np.float32
        assert trusted.mean() > 0.1


def test_several_passes_are_joined_in_one_world():
    cameras, photos, predictor = exact_scene(33, most=12, step=0.18)
    calls = []
    found = unadjusted(predictor)(photos, progress=lambda *call: calls.append(call))
    assert len(predictor.shown) > 2
    assert max(len(shown) for shown in predictor.shown) <= 12
    check_cameras(found.cameras, cameras)
    world = similarity_between(found.cameras, cameras)
    pixels = resampling_of(SIZE, SIZE, 56).grid().photo_pixels()
    depths = [float(np.nanmedian(depth)) * world.scale for depth in found.depths]
    truth = [np.median(spheres(camera, pixels)) for camera in cameras]
    np.testing.assert_allclose(depths, truth, rtol=1e-4)
    total = sum(len(shown) for shown in predictor.shown)
    assert calls[-1] == ("passes", total, total)


@pytest.mark.parametrize(("count", "most"), [(33, 32), (33, 12), (200, 32), (5, 4), (7, 2), (9, 3)])
def test_every_photo_is_in_a_pass_and_all_passes_overlap(count, most):
    plan = passes_of(count, most)
    assert set(itertools.chain(*plan)) == set(range(count))
    assert all(len(part) <= most and part == sorted(set(part)) for part in plan)
    seen = set(plan[0])
    for part in plan[1:]:
        assert len(seen & set(part)) >= max(1, most // 4)
        assert set(part) - seen
        seen |= set(part)
    assert passes_of(32, 32) == [list(range(32))]


def test_wrong_pixels_of_shared_photos_have_no_influence():
    cameras, photos, predictor = exact_scene(6)
    one = dict(enumerate(predictor(photos[:4], 0)))
    two = dict(enumerate(predictor(photos[2:], 0), start=2))
    depth = two[2].depth.copy()
    depth[:20] *= 3.0  # a third of one shared photo of two
    two[2] = replace(two[2], depth=depth)
    world, lost = joined_passes([one, two])
    assert lost == []
    check_cameras([world[i].camera for i in range(6)], cameras, degrees=0.1)


def test_a_pass_without_confident_shared_pixels_is_not_registered():
    _, photos, predictor = exact_scene(6, most=4)
    exact = predictor.aligned

    def unsure(photo, world):
        one = exact(photo, world)
        if len(predictor.shown) > 1:
            one = replace(one, confidence=np.ones_like(one.confidence))
        return one

    predictor.aligned = unsure
    found = unadjusted(predictor)(photos)
    missing = [photo.name for photo, one in zip(photos, found.cameras, strict=True) if one is None]
    assert missing
    assert set(missing) == set(predictor.shown[1]) - set(predictor.shown[0])
    assert found.warnings[0].startswith(f"Not registered: {', '.join(missing)}. Their pass shares")


def test_an_invalid_camera_is_not_registered():
    _, photos, predictor = exact_scene(4)
    exact = predictor.aligned
    predictor.aligned = lambda photo, world: None if photo.name == "01.png" else exact(photo, world)
    found = unadjusted(predictor)(photos)
    assert [one is None for one in found.cameras] == [False, True, False, False]
    assert "Not registered: 01.png. Depth Anything 3 predicts no valid camera" in found.warnings[0]


def test_cameras_at_one_place_give_a_warning():
    cameras, photos = scene(3)
    for camera in cameras[1:]:
        camera.viewmat[:3, 3] = -camera.viewmat[:3, :3] @ cameras[0].center
    found = unadjusted(ExactPredictor(cameras, photos))(photos)
    assert found.warnings[0].startswith("All photos seem to be taken from one place")


def test_one_camera_has_one_focal_length():
    cameras, photos = scene(4)
    photos[3] = replace(photos[3], device="other")
    for camera, factor in zip(cameras, (1.0, 1.1, 0.9, 1.3), strict=True):
        camera.K[[0, 1], [0, 1]] *= factor * np.array([1.02, 1.0 / 1.02])
    found = unadjusted(ExactPredictor(cameras, photos))(photos)
    wanted = ring_camera(0.0, SIZE).K[0, 0]
    focals = [camera.K[[0, 1], [0, 1]] for camera in found.cameras]
    np.testing.assert_allclose(focals, wanted * np.array([[1], [1], [1], [1.3]]) * np.ones(2))
    assert with_shared_focals(photos[:1], [None]) == [None]


def test_a_depth_of_a_single_photo_is_not_trusted():
    _, photos, predictor = exact_scene(6)
    exact = predictor(photos, 0)
    before = trusted_depths(exact)
    wrong = exact[2].depth.copy()
    wrong[20:30, 20:40] *= 0.7
    after = trusted_depths([*exact[:2], replace(exact[2], depth=wrong), *exact[3:]])
    assert before[2][20:30, 20:40].mean() > 0.2
    assert after[2][20:30, 20:40].mean() < 0.02
    # The pixels at a step in depth are not trusted.
    steps = np.abs(np.diff(exact[0].depth, axis=1)) > 0.05 * exact[0].depth[:, 1:]
    assert steps.any()
    assert not ((before[0][:, 1:] | before[0][:, :-1]) & steps).any()


def test_masked_and_transparent_pixels_have_no_confidence():
    _, photos = scene(2)
    image = np.dstack([photos[0].image, np.full((SIZE, SIZE), 255, np.uint8)])
    image[:, :32, 3] = 0
    mask = np.ones((SIZE, SIZE), dtype=bool)
    mask[:16] = False
    given = [replace(photos[0], image=image, mask=mask), photos[1]]
    first, second = Da3Predictor(hashed_network())(given, 0)
    assert (first.confidence[:, : first.confidence.shape[1] // 2] == 1.0).all()
    assert (first.confidence[: first.confidence.shape[0] // 4] == 1.0).all()
    assert (first.confidence[-3:, -3:] > 1.0).all()
    assert (second.confidence > 1.0).all()


@pytest.fixture
def small_photos(monkeypatch):
    """Portrait and landscape photos, resampled to few pixels so that the network is fast."""
    usual = prediction.resampling_of
    monkeypatch.setattr(prediction, "resampling_of", lambda w, h: usual(w, h, 70))
    _, photos = scene(3, 64, 40)
    high = replace(photos[2], image=np.ascontiguousarray(photos[2].image.swapaxes(0, 1)))
    return [*photos[:2], high]


def test_the_network_on_portrait_and_landscape_photos(small_photos):
    estimator = unadjusted(Da3Predictor(hashed_network()))
    one, again = estimator(small_photos, seed=1), estimator(small_photos, seed=1)
    placed = [i for i, camera in enumerate(one.cameras) if camera is not None]
    for i in placed:
        camera, depth, other = one.cameras[i], one.depths[i], again.cameras[i]
        height, width = small_photos[i].image.shape[:2]
        assert (camera.width, camera.height) == (width, height)
        np.testing.assert_allclose(camera.K[:2, 2], [width / 2, height / 2])
        assert (depth.shape[0] > depth.shape[1]) == (height > width)
        np.testing.assert_array_equal(camera.viewmat, other.viewmat)


def test_a_named_checkpoint(small_photos, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "none"))
    monkeypatch.delenv("IGSR_DA3", raising=False)
    with pytest.raises(IgsrError, match="igsr weights fetch da3-base"):
        estimate(small_photos, CameraSettings("da3"), print)
    network = hashed_network()
    monkeypatch.setitem(SIZES, "da3-small", network.config)
    weights = {f"model.{key}": value for key, value in network.state_dict().items()}
    save_file(weights, tmp_path / "model.safetensors")
    (tmp_path / "config.json").write_text('{"model_name": "da3-small"}')
    monkeypatch.setattr(prediction, "MIN_FOCAL", 0.0)
    monkeypatch.setattr(prediction, "MAX_FOCAL", np.inf)
    settings = CameraSettings("da3", {"checkpoint": tmp_path})
    found = estimate(small_photos, settings, lambda event: None)
    assert all(camera is not None for camera in found.cameras)
    content = (tmp_path / "model.safetensors").read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    assert found.weights == {"name": "da3-small", "license": "Apache-2.0", "sha256": digest}
    # The license is kept with the cameras.
    of_photos = FoundCameras.of(small_photos, found, {"estimator": "da3"})
    kept = KeptCameras(of_photos, {}, Usage(0.0, 0.0, None))
    write_cameras_file(tmp_path / "cameras.npz", kept)
    again = read_cameras_file(tmp_path / "cameras.npz").found
    assert again.estimate.weights == found.weights


def test_predictions_that_are_not_finite(small_photos):
    network = hashed_network()
    network.cam_dec.fc_t.bias.data.fill_(torch.nan)
    with pytest.raises(IgsrError, match=r"predictions for 00\.png are not finite"):
        unadjusted(Da3Predictor(network))(small_photos)


def test_passes_are_as_large_as_memory_allows(monkeypatch):
    predictor, photos = Da3Predictor(hashed_network()), scene(4, 640, 480)[1]
    assert predictor.most_photos(photos) == prediction.MAX_PHOTOS_ON_CPU
    pixels = 504 * 378
    for wanted in (31, 7, 2):
        free = memory_of_pass(predictor.network.config, wanted, pixels) / prediction.USABLE_MEMORY
        monkeypatch.setattr(prediction, "available_memory", lambda free=free: free + 1)
        assert predictor.most_photos(photos) == wanted
    monkeypatch.setattr(prediction, "available_memory", lambda: free - 10)
    message = r"needs \d.\d GB for two photos, but only \d.\d GB are free"
    with pytest.raises(IgsrError, match=message):
        predictor.most_photos(photos)
    assert memory_of_pass(BASE, 16, pixels) < 6e9
