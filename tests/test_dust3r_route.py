"""DUSt3R from photos to an estimate, with exact pointmaps instead of the network."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from dust3r_networks import SMALL, hashed_network
from PIL import Image
from scenes import ring_camera, splats

from igsr.cameras import depth_maps, registry
from igsr.cameras.alignment import AlignedPhoto, PairPrediction
from igsr.cameras.cameras_file import read_cameras_file
from igsr.cameras.dust3r.estimator import Dust3r, with_dense_depth
from igsr.cameras.dust3r.prediction import DenseGrid, DenseMap, DustPredictor
from igsr.cameras.grid import Grid
from igsr.capture import Camera
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError
from igsr.geometry.pose_errors import pose_errors
from igsr.geometry.similarity import similarity_between
from igsr.rendering.renders import render

COUNT, SIZE, STEP = 4, 48, 2
#: A photo's grid leaves out its border, as cropping to patches does.
GRID = Grid(SIZE // STEP - 2, SIZE // STEP - 4, STEP, STEP, 4.0, 2.0)

#: PSNR in dB of held-out photos with exact cameras; cameras rotated by a pixel do not reach it.
GOOD = 27.0


class Scene:
    """Photos of a ball of splats with a background, and the depth of every pixel."""

    def __init__(self, count=COUNT, degree=1):
        ball = splats(count=300, seed=3, degree=degree)
        self.cameras = [ring_camera(0.25 * i, SIZE) for i in range(count)]
        self.photos, self.worlds, self.seen = [], [], []
        for i, camera in enumerate(self.cameras):
            picture = render(ball, camera, backend="cpu")
            self.photos.append(Photo(f"{i}.png", picture.to_uint8(), None, None, "phone"))
            column, row = GRID.photo_pixels().astype(int).T
            depth = picture.expected_depth[row, column].astype(np.float64)
            seen = picture.alpha[row, column] > 0.9
            depth[~seen] = 8.0
            rays = (GRID.photo_pixels() - camera.K[[0, 1], 2]) / camera.K[[0, 1], [0, 1]]
            local = np.pad(rays, ((0, 0), (0, 1)), constant_values=1.0) * depth[:, None]
            self.worlds.append((local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3])
            self.seen.append(seen)

    def predictor(self, photos, pairs, progress=None):
        """Exact pointmaps of the photos by their names, each pair with a different scale."""
        index = [int(photo.name.removesuffix(".png")) for photo in photos]
        predictions = []
        for done, (first, second) in enumerate(pairs):
            viewmat, maps = self.cameras[index[first]].viewmat, []
            for photo in (first, second):
                local = self.worlds[index[photo]] @ viewmat[:3, :3].T + viewmat[:3, 3]
                points = (0.5 + 0.1 * first) * local
                confidence = np.where(self.seen[index[photo]], 6.0 + index[photo], 1.02)
                maps.append(points.reshape(GRID.height, GRID.width, 3).astype(np.float32))
                maps.append(confidence.reshape(GRID.height, GRID.width).astype(np.float32))
            predictions.append(PairPrediction(first, second, *maps))
            if progress is not None:
                progress("pairs", done + 1, len(pairs))
        return [GRID] * len(photos), predictions

    def changed(self, change):
        """The predictor with a function that changes each prediction in place."""

        def predictor(photos, pairs, progress=None):
            grids, predictions = self.predictor(photos, pairs)
            for prediction in predictions:
                change(prediction)
            return grids, predictions

        return predictor


@pytest.fixture(scope="module")
def scene():
    return Scene()


@pytest.fixture(scope="module")
def estimate(scene):
    return Dust3r(scene.predictor)(scene.photos)


def test_cameras_are_right(scene, estimate):
    errors = pose_errors(estimate.cameras, scene.cameras)
    assert errors["rotation"] < 0.01
    assert errors["center"] < 1e-3
    for camera, truth in zip(estimate.cameras, scene.cameras, strict=True):
        np.testing.assert_allclose(camera.K, truth.K, rtol=1e-3)
        assert (camera.width, camera.height) == (SIZE, SIZE)
    assert estimate.warnings == []


def test_photos_in_fit_and_scores_out(tmp_path, monkeypatch, igsr_here):
    # Colors are independent of the view, so that errors come from cameras and places.
    scene = Scene(count=6, degree=0)
    photos, out = tmp_path / "photos", tmp_path / "out"
    photos.mkdir()
    for photo in scene.photos:
        Image.fromarray(photo.image).save(photos / photo.name)
    entry = registry.Entry(lambda: Dust3r(scene.predictor), lambda options: True)
    monkeypatch.setitem(registry.ESTIMATORS, "dust3r", entry)
    result = igsr_here(
        "fit", photos, "--out", out, "--holdout", "3", "--steps", "400",
        "--max-splats", "1500", "--sh-degree", "0", "--backend", "cpu", "--json",
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    report = json.loads((out / "report.json").read_text())
    found = read_cameras_file(out / "cameras.npz").found.estimate
    assert pose_errors(found.cameras, scene.cameras)["rotation"] < 0.01
    assert len(found.points.xyz) > 500
    # The fit starts from the predicted depths.
    assert all(depth is not None for depth in found.depths)
    assert report["start"] == "depths"
    assert report["psnr"] > GOOD
    assert report["refined"]["psnr"] > GOOD


def test_points_lie_on_the_scene_with_its_colors(scene, estimate):
    points = estimate.points
    xyz = similarity_between(estimate.cameras, scene.cameras).apply(points.xyz.T).T
    truth = np.concatenate([w[s] for w, s in zip(scene.worlds, scene.seen, strict=True)])
    nearest = np.linalg.norm(xyz[:, None] - truth[None], axis=2)
    assert nearest.min(axis=1).max() < 1e-2
    assert len(xyz) > 0.5 * len(truth)
    assert points.confidence.min() > depth_maps.MIN_CONFIDENCE
    column, row = GRID.photo_pixels().astype(int).T
    colors = np.concatenate(
        [
            photo.image[row[seen], column[seen]]
            for photo, seen in zip(scene.photos, scene.seen, strict=True)
        ]
    )
    # Points of two photos may coincide.
    assert (points.rgb == colors[nearest.argmin(axis=1)]).mean() > 0.99


def test_depths_and_trusted_masks(scene, estimate):
    scale = similarity_between(estimate.cameras, scene.cameras).scale
    for i, (depth, trusted) in enumerate(zip(estimate.depths, estimate.trusted, strict=True)):
        viewmat = scene.cameras[i].viewmat
        truth = (scene.worlds[i] @ viewmat[2, :3] + viewmat[2, 3]).reshape(depth.shape)
        assert depth.dtype == np.float32
        assert trusted.dtype == bool
        assert trusted.shape == depth.shape == (GRID.height, GRID.width)
        np.testing.assert_allclose(scale * depth[trusted], truth[trusted], rtol=1e-3)
        assert not trusted[~scene.seen[i].reshape(depth.shape)].any()
        assert 0 < trusted.sum() < trusted.size


def test_masked_pixels_are_not_trusted(scene, estimate):
    mask = np.ones((SIZE, SIZE), dtype=bool)
    mask[:, SIZE // 2 :] = False
    photos = [Photo(p.name, p.image, mask, None, None) for p in scene.photos]
    masked = Dust3r(scene.predictor)(photos).trusted
    left = GRID.photo_pixels()[:, 0].reshape(GRID.height, GRID.width) < SIZE // 2
    for now, before in zip(masked, estimate.trusted, strict=True):
        np.testing.assert_array_equal(now, before & left)


def test_progress_and_pairs(scene):
    told = []
    Dust3r(scene.predictor, graph="oneref-1")(
        scene.photos, progress=lambda stage, done, of: told.append((stage, done, of))
    )
    assert [of for stage, _, of in told if stage == "pairs"] == [2 * (COUNT - 1)] * (2 * COUNT - 2)
    assert told[-1][0] == "alignment"
    assert told[-1][1] == told[-1][2]


def test_the_same_seed_gives_the_same_bits(scene, estimate):
    before = [photo.image.copy() for photo in scene.photos]
    again = Dust3r(scene.predictor)(scene.photos)
    assert all(map(np.array_equal, before, (photo.image for photo in scene.photos)))
    np.testing.assert_array_equal(again.points.xyz, estimate.points.xyz)
    for one, two in zip(again.cameras, estimate.cameras, strict=True):
        np.testing.assert_array_equal(one.viewmat, two.viewmat)


def test_known_cameras_are_kept_and_define_intrinsics(scene):
    known = {f"{i}.png": scene.cameras[i] for i in (0, 3)}
    found = Dust3r(scene.predictor, cameras=known)(scene.photos)
    for i, (camera, truth) in enumerate(zip(found.cameras, scene.cameras, strict=True)):
        np.testing.assert_array_equal(camera.K, truth.K)
        np.testing.assert_allclose(camera.center, truth.center, atol=1e-2)
        if i in (0, 3):
            np.testing.assert_array_equal(camera.viewmat, truth.viewmat)


def test_focal_lengths_per_device(scene):
    zoomed = [Photo(p.name, p.image, None, None, "12"[i > 1]) for i, p in enumerate(scene.photos)]

    def enlarge(prediction):
        """Depths 10 % too large for two photos, as for another focal length."""
        if prediction.first > 1:
            prediction.first_points[..., 2] *= 1.1
            prediction.second_points[..., 2] *= 1.1

    predictor = scene.changed(enlarge)
    cameras = Dust3r(predictor)(zoomed).cameras
    focals = [camera.K[0, 0] for camera in cameras]
    assert len(set(focals[:2])) == len(set(focals[2:])) == 1
    assert focals[3] > 1.03 * focals[0]
    shared = Dust3r(predictor)(scene.photos).cameras
    assert len({camera.K[0, 0] for camera in shared}) == 1


def test_points_are_bounded(scene, monkeypatch):
    monkeypatch.setattr(depth_maps, "MAX_POINTS", 50)
    points = Dust3r(scene.predictor)(scene.photos).points
    assert len(points.xyz) == len(points.rgb) == len(points.confidence) == 50
    assert len(np.unique(points.confidence)) > 1  # of more than one photo


def test_dense_depths_keep_the_edges_of_the_pointmap(scene):
    # A predictor that kept every pixel of a step, and every second of them to align.
    fine = Grid(20, 24, 2.0, 2.0, 0.0, 0.0)
    coarse = Grid(10, 12, 4.0, 4.0, -1.0, -1.0)
    depth = np.where(np.arange(24) < 11, 2.0, 5.0) * np.ones((20, 1))
    confidence = np.full((20, 24), 4.0, np.float32)
    confidence[3, 3] = 1.0
    rows, columns = range(0, 20, 2), range(0, 24, 2)
    dense = DenseMap(depth.astype(np.float32), confidence, fine, rows, columns)
    camera = Camera(np.eye(4), np.array([[50.0, 0, 24], [0, 50, 20], [0, 0, 1]]), 48, 40)
    aligned = (3.0 * depth[np.ix_(rows, columns)]).astype(np.float32)
    aligned[4, 4] = np.nan
    sure = np.full((10, 12), 6.0, np.float32)
    photo = with_dense_depth(AlignedPhoto(camera, coarse, aligned, sure), dense)
    expected = 3.0 * depth
    expected[3, 3] = np.nan
    expected[8, 8] = np.nan
    np.testing.assert_allclose(photo.depth, expected, rtol=1e-6)
    assert photo.grid is fine
    assert photo.confidence[3, 3] == 1.0
    assert photo.confidence[0, 0] == 6.0


def test_a_predictor_that_keeps_dense_maps_gives_dense_depths(scene):
    def predictor(photos, pairs, progress=None):
        grids, predictions = scene.predictor(photos, pairs)
        whole = Grid(2 * GRID.height, 2 * GRID.width, 1.0, 1.0, 4.0, 2.0)
        samples = range(0, whole.height, 2), range(0, whole.width, 2)
        dense = []
        for i, grid in enumerate(grids):
            kept = next(p for p in predictions if p.first == i)
            maps = (kept.first_points[..., 2], kept.first_confidence)
            maps = [np.kron(one, np.ones((2, 2), np.float32)) for one in maps]
            dense.append(DenseGrid(**vars(grid), dense=DenseMap(*maps, whole, *samples)))
        return dense, predictions

    found = Dust3r(predictor)(scene.photos)
    assert found.depths[0].shape == found.trusted[0].shape == (2 * GRID.height, 2 * GRID.width)
    assert found.trusted[0].any()


def test_the_network_fits_into_the_route(scene):
    # Its predictions are meaningless, so only their form is tested.
    network = DustPredictor(hashed_network(SMALL))
    try:
        found = Dust3r(network)(scene.photos[:3])
    except IgsrError as error:
        assert "no overlap between any two photos" in str(error)
        return
    for camera, depth, trusted in zip(found.cameras, found.depths, found.trusted, strict=True):
        if camera is not None:
            assert np.isfinite(camera.viewmat).all()
            assert depth.shape == trusted.shape == (48, 64)


def test_photos_of_another_thing_are_named(scene):
    def doubt(prediction):
        if 3 in (prediction.first, prediction.second):
            prediction.first_confidence[:] = prediction.second_confidence[:] = 1.1

    predictor = scene.changed(doubt)
    found = Dust3r(predictor)(scene.photos)
    assert found.cameras[3] is found.depths[3] is found.trusted[3] is None
    assert [("3.png" in sentence) for sentence in found.warnings] == [True]
    assert pose_errors(found.cameras[:3], scene.cameras[:3])["rotation"] < 0.01
    # Known cameras of unaligned photos are kept only if another one was aligned.
    both = {f"{i}.png": scene.cameras[i] for i in (0, 3)}
    assert Dust3r(predictor, cameras=both)(scene.photos).cameras[3] is scene.cameras[3]
    assert Dust3r(predictor, cameras={"3.png": scene.cameras[3]})(scene.photos).cameras[3] is None


def test_invalid_input(scene):
    def doubt(prediction):
        prediction.first_confidence[:] = prediction.second_confidence[:] = 1.0

    camera = scene.cameras[0]
    small = replace(camera, width=24)
    for options, count, message in (
        ({"predictor": scene.changed(doubt)}, 2, "no overlap between any two photos"),
        ({}, 1, "at least two photos"),
        ({"graph": "star"}, 4, "pair graph 'star' is unknown"),
        ({"cameras": {"9.png": camera}}, 4, "cameras has '9.png', but no photo has this name"),
        ({"cameras": {"0.png": small}}, 4, "has 24 x 48 pixels, but the photo has 48 x 48"),
        ({"predictor": None, "checkpoint": "/nowhere/at_all.pth"}, 4, "nowhere"),
    ):
        with pytest.raises(IgsrError, match=message):
            Dust3r(**{"predictor": scene.predictor, **options})(scene.photos[:count])
