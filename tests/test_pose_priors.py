"""Pose priors from tracks, and joint fits that they hold."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pycolmap
import pytest
import scenes
from made_up_tracks import projected, tracked

import igsr
from igsr.capture import Capture, View
from igsr.capture.types import Tracks
from igsr.fitting.pose_priors import DEVIATION_FACTOR, MIN_ERROR_PX, pose_priors
from igsr.geometry.pose_errors import pose_errors

COUNT = 4
XYZ = np.random.default_rng(1).normal(scale=0.4, size=(30, 3))
BLANK = np.zeros((64, 64, 3), np.uint8)
#: Uneven angles, so that no two parameters have the same effect by chance.
VIEWS = [
    View(f"{k}.png", scenes.ring_camera(0.5 * k + 0.03 * k**2, 64), "train", BLANK)
    for k in range(COUNT)
]


def moved(view, turn, move, log_focal=0.0):
    """The view with its camera rotated about and moved along its own axes, as fits do."""
    viewmat = view.camera.viewmat.copy()
    viewmat[:3] = pycolmap.Rotation3d(turn).matrix() @ viewmat[:3]
    viewmat[:3, 3] += move
    K = view.camera.K.copy()
    K[[0, 1], [0, 1]] *= np.exp(log_focal)
    return replace(view, camera=replace(view.camera, viewmat=viewmat, K=K))


def expected_covariance(views, points, poses, focal):
    """Covariance [N, N] of all camera parameters, by finite differences and pseudo-inverses."""
    tracks, count = points.tracks, len(views)
    focals = {"fixed": 0, "shared": 1, "per-camera": count}[focal]
    size = 6 * count * poses + focals

    def errors(parameters):
        cameras, shifts = parameters[:size], parameters[size:]
        moves = cameras[: 6 * count * poses].reshape(-1, 2, 3) if poses else np.zeros((count, 2, 3))
        logs = np.resize(cameras[size - focals :], count) if focals else np.zeros(count)
        changed = [moved(view, *moves[k], logs[k]) for k, view in enumerate(views)]
        xyz = points.xyz + shifts.reshape(-1, 3)
        seen = np.stack([projected(view.camera, xyz) for view in changed])
        return (seen[tracks.view, tracks.point] - tracks.xy).ravel()

    step = 1e-5
    columns = [
        (errors(change) - errors(-change)) / (2.0 * step)
        for change in step * np.eye(size + points.xyz.size)
    ]
    by_camera, by_point = np.stack(columns[:size], axis=1), np.stack(columns[size:], axis=1)
    error = errors(np.zeros(len(columns)))
    rest = np.eye(len(error)) - by_point @ np.linalg.pinv(by_point, rcond=1e-9)
    normal = by_camera.T @ rest @ by_camera
    unit = np.sqrt(np.diagonal(normal))
    scale = np.outer(unit, unit)
    inverse = np.linalg.pinv(normal / scale, rcond=1e-8) / scale
    move = -inverse @ by_camera.T @ rest @ error
    left = np.sum((rest @ (error + by_camera @ move)) ** 2)
    variance = DEVIATION_FACTOR**2 * max(left / (len(error) - len(columns)), MIN_ERROR_PX**2)
    return inverse * variance + np.outer(move, move)


@pytest.mark.parametrize(
    ("focal", "poses"), [("fixed", True), *product(("shared", "per-camera"), (True, False))]
)
def test_priors_are_those_of_bundle_adjustment(poses, focal):
    points = tracked(VIEWS, XYZ, noise=0.7, miss=0.3)
    given = [moved(view, 1e-3 * np.ones(3), 1e-3 * np.ones(3)) for view in VIEWS[:1]] + VIEWS[1:]
    found = pose_priors(given, points, poses=poses, focal=focal)
    expected = expected_covariance(given, points, poses, focal)
    for k in range(COUNT):
        if poses:
            rows = slice(6 * k, 6 * k + 6)
            inverse = np.linalg.inv(expected[rows, rows])
            unit = np.sqrt(np.diagonal(inverse))
            off = (found.information[k] - inverse) / np.outer(unit, unit)
            assert np.abs(off).max() < 1e-3
        else:
            assert not found.information[k].any()
    if focal == "fixed":
        assert not found.focal_information.any()
    else:
        variance = np.diagonal(expected)[-1 if focal == "shared" else slice(-COUNT, None)]
        np.testing.assert_allclose(found.focal_information, 1.0 / variance, rtol=1e-3)


def test_cameras_are_free_to_move_where_their_tracks_place_them():
    points = tracked(VIEWS, XYZ, noise=0.05)
    turn, move = np.array([0.01, -0.005, 0.008]), np.array([0.015, 0.01, -0.025])
    given = [*VIEWS[:2], moved(VIEWS[2], turn, move), VIEWS[3]]
    way = np.concatenate([-turn, -move])
    fixed, free = (
        np.sqrt(way @ pose_priors(views, points, poses=True, focal="fixed").information[2] @ way)
        for views in (VIEWS, given)
    )
    # In standard deviations.
    assert fixed > 100.0
    assert free < 0.2 * fixed


def test_only_points_that_the_views_see_count():
    points = tracked(VIEWS, XYZ, noise=0.5)
    bare = igsr.Points(points.xyz, points.rgb)
    strangers = [replace(view, name=f"other/{view.name}") for view in VIEWS]
    for views, given in ((VIEWS, None), (VIEWS, bare), (strangers, points), (VIEWS[:1], points)):
        assert pose_priors(views, given, poses=True, focal="fixed") is None
    # Tracks of held-out photos are ignored.
    wrong = tracked(VIEWS, XYZ, noise=0.5)
    wrong.tracks.xy[wrong.tracks.view == 3] += 50.0
    one, two = (pose_priors(VIEWS[:3], p, poses=True, focal="fixed") for p in (points, wrong))
    np.testing.assert_array_equal(one.information, two.information)
    # Cameras that see at most two points are free; cameras with more points are held.
    few = (points.tracks.view < 2) | ((points.tracks.view == 2) & (points.tracks.point < 2))
    kept = (array[few] for array in (points.tracks.view, points.tracks.point, points.tracks.xy))
    points.tracks = Tracks(points.tracks.names, *kept)
    held = pose_priors(VIEWS, points, poses=True, focal="fixed")
    assert held.information.any(axis=(1, 2)).tolist() == [True, True, False, False]
    assert np.isfinite(held.information).all()


def test_tracks_hold_exact_cameras_that_a_fit_would_move():
    scene = scenes.splats(count=120)
    capture = scenes.capture(views=12, size=64, scene=scene)
    points = tracked(capture.train_views, scene.means.astype(np.float64))
    true = [view.camera for view in capture.train_views]
    options = {"steps": 250, "backend": "cpu", "max_splats": 400, "start": "random"}
    errors = []
    for given in (Capture(capture.path, capture.views, points), capture):
        _, fitted = scenes.fit_with_cameras(given, poses="joint", **options)
        errors.append(pose_errors([view.camera for view in fitted.train_views], true)["rotation"])
    held, free = errors
    assert held < 0.1 * free


def least_ratio(found, expected):
    """Smallest factor by which the information about any direction of the cameras changed."""
    inverse = np.linalg.inv(np.linalg.cholesky(expected.information))
    whitened = inverse @ found.information[:COUNT] @ inverse.swapaxes(1, 2)
    return np.linalg.eigvalsh(whitened).min()


@pytest.mark.parametrize("focal", ["fixed", "shared", "per-camera"])
def test_two_cameras_are_held(focal):
    found = pose_priors(VIEWS[:2], tracked(VIEWS[:2], XYZ, noise=0.5), poses=True, focal=focal)
    for information in found.information:
        assert np.linalg.eigvalsh(information).min() > 0.0


@pytest.mark.parametrize("seen", [0, 1, 2])
def test_a_camera_without_tracks_does_not_loosen_others(seen):
    points = tracked(VIEWS, XYZ, noise=0.5)
    expected = pose_priors(VIEWS, points, poses=True, focal="fixed")
    more = [*VIEWS, replace(VIEWS[0], name="more.png", camera=scenes.ring_camera(-0.4, 64))]
    tracks = points.tracks
    place = projected(more[-1].camera, XYZ[:seen])
    tracks = Tracks(
        [*tracks.names, "more.png"],
        np.append(tracks.view, np.full(seen, COUNT)),
        np.append(tracks.point, np.arange(seen)),
        np.concatenate([tracks.xy, place]),
    )
    found = pose_priors(more, replace(points, tracks=tracks), poses=True, focal="fixed")
    assert not found.information[COUNT].any()
    assert least_ratio(found, expected) > 0.9


def test_outliers_change_little():
    points = tracked(VIEWS, XYZ, noise=0.5)
    expected = pose_priors(VIEWS, points, poses=True, focal="fixed")
    for wrong in (1e200, 1e6):
        xyz = XYZ.copy()
        xyz[3] = wrong
        found = pose_priors(VIEWS, replace(points, xyz=xyz), poses=True, focal="fixed")
        assert least_ratio(found, expected) > 0.5
    for wrong in (1e300, 100.0):
        xy = points.tracks.xy.copy()
        xy[5] += wrong
        off = replace(points, tracks=replace(points.tracks, xy=xy))
        found = pose_priors(VIEWS, off, poses=True, focal="fixed")
        assert least_ratio(found, expected) > 0.5
