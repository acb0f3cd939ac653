"""Cameras that are not exact: alignment, refinement, and fits that optimize them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
import scenes

import igsr
from igsr.capture import Capture
from igsr.evaluation.scores import BLACK
from igsr.fitting import fit_capture, refine_cameras
from igsr.geometry.pose_errors import pose_errors
from igsr.geometry.similarity import Similarity, similarity_between

JOINT = {"backend": "cpu", "max_splats": 300, "poses": "joint"}


def turn(degrees, axis=(0.3, 1.0, -0.2)):
    axis = np.asarray(axis) / np.linalg.norm(axis)
    return pycolmap.Rotation3d(np.radians(degrees) * axis).matrix()


def turned(view, degrees, axis=(0.3, 1.0, -0.2)):
    viewmat = view.camera.viewmat.copy()
    viewmat[:3] = turn(degrees, axis) @ viewmat[:3]
    return replace(view, camera=replace(view.camera, viewmat=viewmat))


def cameras(views):
    return [view.camera for view in views]


@pytest.fixture(scope="module")
def scene():
    return scenes.splats(count=120)


@pytest.fixture(scope="module")
def exact(scene):
    return scenes.capture(views=12, size=64, scene=scene)


def with_errors(capture, degrees=1.0, seed=5):
    """The capture with its train cameras turned, each about a random axis."""
    random = np.random.default_rng(seed)
    views = [
        turned(view, degrees, random.normal(size=3)) if view.split == "train" else view
        for view in capture.views
    ]
    return Capture(capture.path, views)


def test_similarity_is_found_exactly(exact):
    true = Similarity(1.7, turn(40.0), np.array([3.0, -1.0, 0.5]))
    moved = [true.camera(camera) for camera in cameras(exact.views)]
    found = similarity_between(cameras(exact.views), moved)
    assert found.scale == pytest.approx(1.7, rel=1e-12)
    assert np.allclose(found.rotation, true.rotation, atol=1e-12)
    assert np.allclose(found.translation, true.translation, atol=1e-12)
    errors = pose_errors(moved, cameras(exact.views))
    assert errors["rotation"] < 1e-6
    assert errors["center"] < 1e-9


def test_pose_errors_are_in_degrees_after_alignment(exact):
    similarity = Similarity(2.0, turn(10.0), np.zeros(3))
    # Opposite turns cancel in the alignment and stay as errors.
    wrong = [
        turned(view, 1.5 if k % 2 else -1.5, (0.0, 1.0, 0.0)).camera
        for k, view in enumerate(exact.views)
    ]
    errors = pose_errors([similarity.camera(camera) for camera in wrong], cameras(exact.views))
    assert errors["rotation"] == pytest.approx(1.5, abs=0.01)
    assert errors["center"] < 0.01


def test_cameras_at_one_place_have_no_scale(exact):
    view = exact.views[1]
    camera = view.camera
    found = similarity_between([camera], [Similarity(1.0, turn(30.0), np.ones(3)).camera(camera)])
    assert found.scale == 1.0
    assert np.allclose(found.rotation, turn(30.0))
    assert similarity_between([camera, camera], [camera, camera]).scale == 1.0
    place, random = np.array([1.3, 2.7, -0.4]), np.random.default_rng(2)
    views = []
    for _ in range(5):
        viewmat = np.eye(4)
        viewmat[:3, :3] = turn(random.uniform(0.0, 170.0), random.normal(size=3))
        viewmat[:3, 3] = -viewmat[:3, :3] @ place
        views.append(replace(view, camera=replace(camera, viewmat=viewmat)))
    near = [turned(view, 0.1, random.normal(size=3)).camera for view in views]
    assert similarity_between(cameras(views), near).scale == 1.0
    assert pose_errors(near, cameras(views))["rotation"] < 0.15
    with pytest.raises(igsr.IgsrError, match="1 and 2"):
        similarity_between([camera], [camera, camera])


def test_refine_cameras_finds_poses_and_leaves_the_splats(exact, scene):
    means = scene.means.copy()
    start = [turned(view, 1.0) for view in exact.test_views]
    found = refine_cameras(scene, start, BLACK, steps=80, backend="cpu")
    for view, guess, result in zip(exact.test_views, start, found, strict=True):
        before, after = (
            np.linalg.norm(other.camera.viewmat - view.camera.viewmat) for other in (guess, result)
        )
        assert after < 0.1 * before, view.name
        assert np.array_equal(result.camera.K, view.camera.K)
    assert np.array_equal(scene.means, means)
    assert refine_cameras(scene, [], BLACK) == []
    with pytest.raises(igsr.IgsrError, match="steps"):
        refine_cameras(scene, start, BLACK, steps=0)


def test_joint_fits_correct_poses():
    # Without view-dependent colors, which would compensate for wrong cameras.
    scene = scenes.splats(count=300, degree=0)
    exact = scenes.capture(views=16, size=128, alpha=True, scene=scene)
    options = {"steps": 900, "backend": "cpu", "max_splats": 1500, "sh_degree": 0}
    gains, before, after = [], [], []
    for seed in range(3):
        given = with_errors(exact, seed=seed)
        joint, fitted = scenes.fit_with_cameras(given, poses="joint", **options)
        fixed = scenes.fit(given, **options)
        true, start, found = (cameras(c.train_views) for c in (exact, given, fitted))
        before.append(pose_errors(start, true)["rotation"])
        after.append(pose_errors(found, true)["rotation"])
        assert [view.name for view in fitted.views] == [view.name for view in exact.views]
        assert fitted.test_views == given.test_views
        # The mean pose stays.
        drift = similarity_between(start, found)
        assert drift.scale == pytest.approx(1.0, abs=1e-3)
        assert np.allclose(drift.rotation, np.eye(3), atol=3e-3)
        psnr = []
        for splats in (joint, fixed):
            views = refine_cameras(splats, exact.test_views, BLACK, backend="cpu")
            seen = replace(exact, views=views)
            psnr.append(igsr.evaluate(splats, seen, background=BLACK, backend="cpu").psnr)
        gains.append(psnr[0] - psnr[1])
    assert np.mean(after) < np.mean(before), (before, after)
    assert np.mean(gains) > 1.0, gains


def test_a_shared_focal_length_is_found(exact):
    factors = [[1.06, 1.0, 1.0], [1.0, 1.06, 1.0], [1, 1, 1]]
    views = [
        replace(view, camera=replace(view.camera, K=view.camera.K * factors))
        for view in exact.views
    ]
    given = Capture(exact.path, views)
    options = {"steps": 900, "backend": "cpu", "max_splats": 600, "focal": "shared"}
    _, fitted = scenes.fit_with_cameras(given, **options)
    (focal,) = {view.camera.K[0, 0] for view in fitted.train_views}
    assert focal == pytest.approx(exact.views[0].camera.K[0, 0], rel=0.03)
    for view, start in zip(fitted.train_views, given.train_views, strict=True):
        assert np.allclose(view.camera.viewmat, start.camera.viewmat, rtol=0.0, atol=1e-12)


def test_a_fit_that_ends_among_rough_cameras_has_no_checkpoint(tmp_path):
    capture, path, events = scenes.capture(views=8, size=128), tmp_path / "a.npz", []

    def stop(event):
        events.append(event)
        raise scenes.Stop

    options = JOINT | {"steps": 60, "checkpoint": path}
    with pytest.raises(scenes.Stop):
        fit_capture(capture, report=stop, **options)
    assert [event.done for event in events] == [0]
    with pytest.raises(igsr.IgsrError, match="There is no checkpoint"):
        fit_capture(capture, resume=True, **options)


def test_rough_cameras_are_in_the_first_checkpoint(tmp_path):
    capture, path = scenes.capture(views=8, size=128), tmp_path / "a.npz"
    whole, cameras_of_whole = scenes.fit_with_cameras(capture, steps=60, **JOINT)

    def stop(event):
        if path.exists():
            raise scenes.Stop

    options = JOINT | {"steps": 60, "checkpoint": path}
    with pytest.raises(scenes.Stop):
        fit_capture(capture, report=stop, **options)
    resumed = fit_capture(capture, resume=True, **options)
    assert resumed.splats == whole
    assert resumed.capture == cameras_of_whole
    events = []
    again = fit_capture(capture, resume=True, report=events.append, **options)
    assert again.splats == whole
    assert not events, "the fit was finished"
    assert np.isnan(again.loss)


def test_one_photo_keeps_its_camera():
    capture = scenes.capture(views=2, size=128)
    with pytest.warns(UserWarning, match="photo"):
        _, fitted = scenes.fit_with_cameras(capture, steps=20, max_splats=200, poses="joint")
    (view,) = fitted.train_views
    assert np.allclose(view.camera.viewmat, capture.train_views[0].camera.viewmat, atol=1e-9)


@pytest.mark.parametrize("function", [igsr.fit, fit_capture])
def test_warnings_point_to_the_caller(function):
    capture = scenes.capture(views=2, size=32)
    with pytest.warns(UserWarning, match="photo") as caught:
        function(capture, steps=1, max_splats=50, backend="cpu")
    assert caught[0].filename == __file__


def test_damaged_camera_states_are_refused(exact, tmp_path):
    options = JOINT | {"steps": 40, "checkpoint": tmp_path / "checkpoint.npz"}
    fit_capture(exact, **options)
    with np.load(options["checkpoint"]) as archive:
        good = dict(archive)
    for name, change in [
        ("camera_viewmats", lambda a: 2.0 * a),
        ("camera_first", lambda a: a[:-1]),
        ("camera_gradients", lambda a: a * np.nan),
        ("camera_distances", lambda a: -a),
        ("rough_cameras", lambda a: a[:, :-1]),
        ("rough_cameras", lambda a: 2.0 * a),
    ]:
        np.savez(options["checkpoint"], **good | {name: change(good[name])})
        with pytest.raises(igsr.IgsrError, match="checkpoint"):
            fit_capture(exact, resume=True, **options)


def test_fit_writes_optimized_cameras_that_load_again(exact, tmp_path):
    given, out = with_errors(exact), tmp_path / "out"
    photos = scenes.write_capture(tmp_path / "photos", given)
    result = igsr.fit(photos, out=out, holdout=4, steps=150, **JOINT)
    assert result.report["poses"] == "joint"
    assert result.report["refined"]["psnr"] >= result.report["psnr"] - 0.1
    frames = json.loads((out / "cameras.json").read_text())
    (photos / "transforms.json").write_text(json.dumps(frames))
    again = igsr.load_capture(photos)
    assert [view.name for view in again.views] == [view.name for view in result.capture.train_views]
    start = {view.name: view.camera.viewmat for view in given.views}
    moves = [np.abs(view.camera.viewmat - start[view.name]).max() for view in again.views]
    assert 1e-4 < max(moves) < 0.1
