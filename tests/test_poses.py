"""Cameras that are not exact: alignment, refinement, fitting them with the splats."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import scenes
from typer.testing import CliRunner

import igsr
from igsr.capture import Capture
from igsr.cli import app
from igsr.evaluation.scores import BLACK
from igsr.fitting.pose_refinement import refine_cameras
from igsr.geometry.camera_noise import Noise, noise_unit, noisy_view
from igsr.geometry.pose_errors import pose_errors
from igsr.geometry.similarity import Similarity, similarity_between
from igsr_lab.study.noisy_poses import CLEAN


def turn(degrees, axis=(0.3, 1.0, -0.2)):
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def turned(view, degrees, axis=(0.3, 1.0, -0.2)):
    viewmat = view.camera.viewmat.copy()
    viewmat[:3] = turn(degrees, axis) @ viewmat[:3]
    return replace(view, camera=replace(view.camera, viewmat=viewmat))


def cameras(made):
    return [view.camera for view in made.views]


@pytest.fixture(scope="module")
def scene():
    return scenes.splats(count=120)


@pytest.fixture(scope="module")
def made(scene):
    return scenes.capture(views=12, size=64, scene=scene)


def wrong(made, degrees=1.0):
    """The capture with its train cameras turned, each about another axis."""
    random = np.random.default_rng(5)
    views = [
        turned(view, degrees, random.normal(size=3)) if view.split == "train" else view
        for view in made.views
    ]
    return Capture(made.path, views)


def test_a_similarity_is_found_and_leaves_no_error(made):
    there = Similarity(1.7, turn(40.0), np.array([3.0, -1.0, 0.5]))
    moved = [there.camera(camera) for camera in cameras(made)]
    found = similarity_between(cameras(made), moved)
    assert found.scale == pytest.approx(1.7, rel=1e-12)
    assert np.allclose(found.rotation, there.rotation, atol=1e-12)
    assert np.allclose(found.translation, there.translation, atol=1e-12)
    errors = pose_errors(moved, cameras(made))
    assert errors["rotation"] < 1e-6
    assert errors["centre"] < 1e-9


def test_pose_errors_are_in_degrees_and_the_true_world(made):
    there = Similarity(2.0, turn(10.0), np.zeros(3))
    # Opposite turns cancel in the alignment and stay as errors.
    both = [
        turned(view, 1.5 if k % 2 else -1.5, (0.0, 1.0, 0.0)).camera
        for k, view in enumerate(made.views)
    ]
    errors = pose_errors([there.camera(camera) for camera in both], cameras(made))
    assert errors["rotation"] == pytest.approx(1.5, abs=0.01)
    assert errors["centre"] < 0.01


def test_one_camera_and_cameras_at_one_place_have_no_scale(made):
    one = made.views[1].camera
    found = similarity_between([one], [Similarity(1.0, turn(30.0), np.ones(3)).camera(one)])
    assert found.scale == 1.0
    assert np.allclose(found.rotation, turn(30.0))
    assert similarity_between([one, one], [one, one]).scale == 1.0
    place, random = np.array([1.3, 2.7, -0.4]), np.random.default_rng(2)
    here = []
    for _ in range(5):
        viewmat = np.eye(4)
        viewmat[:3, :3] = turn(random.uniform(0.0, 170.0), random.normal(size=3))
        viewmat[:3, 3] = -viewmat[:3, :3] @ place
        here.append(replace(one, viewmat=viewmat))
    views = [replace(made.views[1], camera=camera) for camera in here]
    slightly = [turned(view, 0.1, random.normal(size=3)).camera for view in views]
    assert similarity_between(here, slightly).scale == 1.0
    assert pose_errors(slightly, here)["rotation"] < 0.15
    with pytest.raises(igsr.IgsrError, match="1 and 2"):
        similarity_between([one], [one, one])


def test_refining_finds_a_photos_camera_and_leaves_the_splats(made, scene):
    before = scene.means.copy()
    start = [turned(view, 1.0) for view in made.test_views]
    found = refine_cameras(scene, start, BLACK, steps=80, backend="cpu")
    for view, guess, result in zip(made.test_views, start, found, strict=True):
        off = np.linalg.norm(guess.camera.viewmat - view.camera.viewmat)
        left = np.linalg.norm(result.camera.viewmat - view.camera.viewmat)
        assert left < 0.1 * off, f"{view.name}: {off:.4f} became {left:.4f}"
        assert np.array_equal(result.camera.K, view.camera.K)
    assert np.array_equal(scene.means, before)
    assert refine_cameras(scene, [], BLACK) == []
    with pytest.raises(igsr.IgsrError, match="steps"):
        refine_cameras(scene, start, BLACK, steps=0)


def test_joint_poses_undo_much_of_what_is_wrong():
    # Colours that do not change with the view: the fit has SH 0, and cameras would make up for it.
    scene = scenes.splats(count=300, degree=0)
    made = scenes.capture(views=16, size=128, alpha=True, scene=scene)
    given = wrong(made)
    options = {"steps": 900, "backend": "cpu", "max_splats": 1500, "sh_degree": 0}
    splats, fitted = scenes.fit_with_cameras(given, poses="joint", **options)
    train = [view.camera for view in made.train_views]
    before = pose_errors([view.camera for view in given.train_views], train)
    after = pose_errors([view.camera for view in fitted.train_views], train)
    assert after["rotation"] < before["rotation"], (before, after)
    assert [view.name for view in fitted.views] == [view.name for view in made.views]
    for view, same in zip(fitted.test_views, made.test_views, strict=True):
        assert view is same
    # As a whole they stay where they were given.
    drift = similarity_between(
        [view.camera for view in given.train_views], [view.camera for view in fitted.train_views]
    )
    assert drift.scale == pytest.approx(1.0, abs=1e-3)
    assert np.allclose(drift.rotation, np.eye(3), atol=3e-3)
    fixed = scenes.fit(given, **options)
    scores = [
        igsr.evaluate(model, Capture(made.path, views), background=BLACK, backend="cpu")["psnr"]
        for model, views in [
            (splats, refine_cameras(splats, made.test_views, BLACK, backend="cpu")),
            (fixed, refine_cameras(fixed, made.test_views, BLACK, backend="cpu")),
        ]
    ]
    assert scores[0] > scores[1] + 1.0, scores


def test_a_shared_focal_length_is_found(made):
    views = [
        replace(
            view,
            camera=replace(
                view.camera, K=view.camera.K * [[1.06, 1.0, 1.0], [1.0, 1.06, 1.0], [1, 1, 1]]
            ),
        )
        for view in made.views
    ]
    given = Capture(made.path, views)
    _, fitted = scenes.fit_with_cameras(
        given, steps=900, backend="cpu", max_splats=600, focal="shared"
    )
    focal = [view.camera.K[0, 0] for view in fitted.train_views]
    assert len(set(focal)) == 1
    true = made.views[0].camera.K[0, 0]
    assert abs(focal[0] / true - 1.0) < 0.03, "6 % too long at the start"
    found, given = fitted.train_views[0].camera.viewmat, views[1].camera.viewmat
    assert np.allclose(found, given, rtol=0.0, atol=1e-12)


def test_a_resumed_joint_fit_ends_with_the_same_bits(made, tmp_path):
    options = {
        "steps": 300,
        "backend": "cpu",
        "max_splats": 300,
        "poses": "joint",
        "focal": "per-camera",
    }
    whole, cameras_whole = scenes.fit_with_cameras(wrong(made), **options)
    checkpoint = tmp_path / "checkpoint.npz"

    def stop(now):
        return now.step < 130

    scenes.fit(wrong(made), checkpoint=checkpoint, progress=stop, **options)
    part, cameras_part = scenes.fit_with_cameras(
        wrong(made), checkpoint=checkpoint, resume=True, **options
    )
    assert np.array_equal(whole.means, part.means)
    for a, b in zip(cameras_whole.views, cameras_part.views, strict=True):
        assert np.array_equal(a.camera.viewmat, b.camera.viewmat)
        assert np.array_equal(a.camera.K, b.camera.K)
    with pytest.raises(igsr.IgsrError, match=r"was made with poses"):
        scenes.fit(wrong(made), checkpoint=checkpoint, resume=True, **(options | {"poses": "fixed"}))


def test_a_fit_stopped_while_cameras_are_looked_for_keeps_its_checkpoint(tmp_path):
    made = scenes.capture(views=8, size=128)
    checkpoint = tmp_path / "checkpoint.npz"
    options = {"steps": 60, "backend": "cpu", "max_splats": 200, "poses": "joint"}
    steps = []

    def stop_once(now):
        steps.append(now.step)
        return len(steps) > 1

    first, _ = scenes.fit_with_cameras(made, checkpoint=checkpoint, progress=stop_once, **options)
    assert steps == [0], "nothing runs on"
    resumed = scenes.fit(made, checkpoint=checkpoint, resume=True, **options)
    assert not np.array_equal(first.means, resumed.means)
    again = []
    scenes.fit(made, checkpoint=checkpoint, resume=True, progress=again.append, **options)
    assert [(now.step, now.splats) for now in again] == [(60, len(resumed))], "it was complete"


def test_one_photo_keeps_its_camera():
    made = scenes.capture(views=2, size=128)
    with pytest.warns(UserWarning, match="photo"):
        _, fitted = scenes.fit_with_cameras(made, steps=20, max_splats=200, poses="joint")
    (view,) = fitted.train_views
    assert np.allclose(view.camera.viewmat, made.train_views[0].camera.viewmat, atol=1e-9)


def test_warnings_point_to_who_called():
    made = scenes.capture(views=2, size=32)
    for function in (igsr.fit, igsr.fit_with_cameras):
        with pytest.warns(UserWarning, match="photo") as caught:
            function(made, steps=1, max_splats=50, backend="cpu")
        assert caught[0].filename == __file__


def test_a_damaged_camera_state_is_refused(made, tmp_path):
    options = {"steps": 40, "backend": "cpu", "max_splats": 300, "poses": "joint"}
    checkpoint = tmp_path / "checkpoint.npz"
    scenes.fit(made, checkpoint=checkpoint, **options)
    with np.load(checkpoint) as archive:
        good = dict(archive)
    for name, change in [
        ("camera_viewmats", lambda a: 2.0 * a),
        ("camera_first", lambda a: a[:-1]),
        ("camera_gradients", lambda a: a * np.nan),
        ("camera_distances", lambda a: -a),
        ("rough_cameras", lambda a: a[:, :-1]),
        ("rough_cameras", lambda a: 2.0 * a),
    ]:
        np.savez(checkpoint, **good | {name: change(good[name])})
        with pytest.raises(igsr.IgsrError, match="checkpoint"):
            scenes.fit(made, checkpoint=checkpoint, resume=True, **options)


@pytest.mark.parametrize(("name", "value"), [("poses", "free"), ("focal", "one"), ("poses", 3)])
def test_unknown_choices_are_named(made, name, value):
    with pytest.raises(igsr.IgsrError, match=f"{name} must be one of"):
        scenes.fit(made, steps=1, **{name: value})


def test_the_command_writes_cameras_that_load_again(made, tmp_path):
    scenes.write_capture(tmp_path / "photos", wrong(made))
    out = tmp_path / "out"
    arguments = ["fit", str(tmp_path / "photos"), "--out", str(out), "--holdout", "4", "--json"]
    options = ["--poses", "joint", "--steps", "150", "--max-splats", "300", "--backend", "cpu"]
    result = CliRunner().invoke(app, arguments + options)
    assert result.exit_code == 0, result.output
    report = json.loads((out / "report.json").read_text())
    assert report["poses"] == "joint"
    assert report["refined"]["psnr"] >= report["psnr"] - 0.1
    frames = json.loads((out / "cameras.json").read_text())
    names = {frame["file_path"] for frame in frames["frames"]}
    assert len(names) == 9
    (tmp_path / "photos/transforms.json").write_text(json.dumps(frames))
    again = igsr.load_capture(tmp_path / "photos")
    assert {view.name for view in again.views} == names
    given = {view.name: view.camera for view in wrong(made).views}
    moved = [np.abs(v.camera.viewmat - given[v.name].viewmat).max() for v in again.views]
    assert 1e-4 < max(moved) < 0.1


def points_seen(camera, points):
    local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    return local @ camera.K.T / local[:, 2:]


def test_noise_has_the_size_that_it_says(made):
    random = np.random.default_rng(0)
    view = made.views[2]
    true = view.camera.viewmat
    noisy = noisy_view(view, Noise("turn", 2.0), random)
    between = noisy.camera.viewmat[:3, :3] @ true[:3, :3].T
    angle = np.degrees(np.arccos((np.trace(between) - 1.0) / 2.0))
    assert angle == pytest.approx(2.0, abs=1e-6)
    assert np.allclose(noisy.camera.centre, view.camera.centre)
    moves = [
        noisy_view(view, Noise("matrix", 0.01), random).camera.centre - view.camera.centre
        for _ in range(300)
    ]
    assert np.std(moves) == pytest.approx(0.01, rel=0.1)
    assert noisy_view(view, CLEAN, random).camera.viewmat == pytest.approx(true, abs=1e-12)


def test_noise_on_positions_goes_by_how_far_cameras_stand_from_what_they_see():
    views = scenes.capture(views=6, size=16).views
    unit = noise_unit(views)
    for view in views:
        distance = np.linalg.norm(view.camera.centre)
        assert distance / 4.03 == pytest.approx(unit, rel=0.05), "they look at the origin"

    def moved(unit):
        random = np.random.default_rng(3)
        noisy = noisy_view(views[0], Noise("matrix", 0.01), random, unit)
        return noisy.camera.viewmat[:3, :3], noisy.camera.centre - views[0].camera.centre

    (turned, offset), (as_turned, doubled) = moved(1.0), moved(2.0)
    assert np.array_equal(turned, as_turned)
    assert doubled == pytest.approx(2.0 * offset, abs=1e-9)
    assert noise_unit(views[:1]) == 1.0, "one camera does not say how far it looks"


def test_affine_noise_is_the_same_picture_with_a_shear(made):
    """Points that the noisy affine camera sees are where the sheared rigid one has them."""
    view = made.views[2]
    noisy = noisy_view(view, Noise("raw-affine", 0.01), np.random.default_rng(4))
    affine = np.linalg.inv(view.camera.viewmat)
    affine[:3, :4] += 0.01 * np.random.default_rng(4).normal(size=(3, 4))
    points = np.random.default_rng(1).normal(scale=0.3, size=(50, 3))
    local = np.linalg.inv(affine) @ np.concatenate([points, np.ones((50, 1))], axis=1).T
    exact = (view.camera.K @ local[:3] / local[2]).T
    rigid = points_seen(noisy.camera, points)
    assert np.allclose(exact[:, 1], rigid[:, 1], atol=1e-9)
    # Rows are moved as a whole, in proportion to their distance from the principal point.
    slope = np.polyfit(rigid[:, 1], exact[:, 0] - rigid[:, 0], 1)
    assert np.allclose(np.polyval(slope, rigid[:, 1]), exact[:, 0] - rigid[:, 0], atol=1e-9)
    assert abs(slope[0]) > 1e-4
    assert noisy.image.shape == view.image.shape
    assert not np.array_equal(noisy.image, view.image)


def test_the_photo_is_sheared_by_what_the_camera_is_not():
    from igsr.geometry.camera_noise import _rows_shifted

    image = np.zeros((3, 6, 4), np.uint8)
    image[:, 2] = (200, 100, 50, 255)
    moved = _rows_shifted(image, np.array([0.0, 1.0, -0.5]))
    assert moved[0, 2].tolist() == [200, 100, 50, 255]
    assert moved[1, 1].tolist() == [200, 100, 50, 255]
    # Half covered pixels keep their colour.
    assert moved[2, 2].tolist() == [200, 100, 50, 128]
    assert moved[2, 3].tolist() == [200, 100, 50, 128]
