"""What tracks say about cameras, and joint fits that it is a prior for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from made_up_tracks import projected, tracked

import igsr
from igsr.capture import Capture, View
from igsr.fitting.pose_priors import LEAST_ERROR, LEFT_OPEN, pose_priors
from igsr.geometry.pose_errors import pose_errors

COUNT = 4
XYZ = np.random.default_rng(1).normal(scale=0.4, size=(30, 3))
BLANK = np.zeros((64, 64, 3), np.uint8)
#: Some are off their axis, so that no two parameters do the same by chance.
VIEWS = [
    View(f"{k}.png", scenes.ring_camera(0.5 * k + 0.03 * k**2, 64), "train", BLANK)
    for k in range(COUNT)
]


def cross(v):
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def moved(view, turn, move, log_focal=0.0):
    """The view with its camera turned about and moved along its own axes, as fits do."""
    angle = np.linalg.norm(turn)
    axis = cross(turn) / max(angle, 1e-300)
    rotation = np.eye(3) + np.sin(angle) * axis + (1.0 - np.cos(angle)) * axis @ axis
    viewmat = view.camera.viewmat.copy()
    viewmat[:3] = rotation @ viewmat[:3]
    viewmat[:3, 3] += move
    K = view.camera.K.copy()
    K[[0, 1], [0, 1]] *= np.exp(log_focal)
    return replace(view, camera=replace(view.camera, viewmat=viewmat, K=K))


def by_hand(views, points, poses, focal):
    """Covariance [N, N] of all camera parameters, by differences and pseudo-inverses of all."""
    tracks, count = points.tracks, len(views)
    focals = {"fixed": 0, "shared": 1, "per-camera": count}[focal]

    def errors(cameras, shifts):
        changed = [
            moved(
                view,
                *(cameras[: 6 * count].reshape(count, 2, 3)[k] if poses else np.zeros((2, 3))),
                0.0 if not focals else cameras[len(cameras) - focals :][k if focals > 1 else 0],
            )
            for k, view in enumerate(views)
        ]
        xyz = points.xyz + shifts.reshape(-1, 3)
        seen = np.stack([projected(view.camera, xyz) for view in changed])
        return (seen[tracks.view, tracks.point] - tracks.xy).ravel()

    size = 6 * count * poses + focals
    zeros = np.zeros(size), np.zeros(points.xyz.size)
    steps = [(1e-5 * np.eye(size), 0), (1e-5 * np.eye(points.xyz.size), 1)]
    of_camera, of_point = (
        np.stack(
            [
                (
                    errors(*(s if i == which else zeros[i] for i in range(2)))
                    - errors(*(-s if i == which else zeros[i] for i in range(2)))
                )
                / 2e-5
                for s in each
            ],
            axis=1,
        )
        for each, which in steps
    )
    error = errors(*zeros)
    rest = np.eye(len(error)) - of_point @ np.linalg.pinv(of_point, rcond=1e-9)
    normal = of_camera.T @ rest @ of_camera
    scale = np.sqrt(np.diagonal(of_camera.T @ rest @ of_camera))
    inverse = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-8) / np.outer(scale, scale)
    step = -inverse @ of_camera.T @ rest @ error
    left = np.sum((rest @ (error + of_camera @ step)) ** 2)
    freedom = len(error) - len(zeros[1]) - size
    variance = LEFT_OPEN**2 * max(left / freedom, LEAST_ERROR**2)
    return inverse * variance + np.outer(step, step)


@pytest.mark.parametrize(
    ("poses", "focal"),
    [
        (True, "fixed"),
        (True, "shared"),
        (True, "per-camera"),
        (False, "shared"),
        (False, "per-camera"),
    ],
)
def test_it_is_what_bundle_adjustment_reports(poses, focal):
    points = tracked(VIEWS, XYZ, noise=0.7, miss=0.3)
    given = [moved(view, 1e-3 * np.ones(3), 1e-3 * np.ones(3)) for view in VIEWS[:1]] + VIEWS[1:]
    found = pose_priors(given, points, poses=poses, focal=focal)
    expected = by_hand(given, points, poses, focal)
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


def test_cameras_that_their_tracks_have_elsewhere_are_free_to_go_there():
    points = tracked(VIEWS, XYZ, noise=0.05)
    turn, move = np.array([0.01, -0.005, 0.008]), np.array([0.015, 0.01, -0.025])
    given = [*VIEWS[:2], moved(VIEWS[2], turn, move), VIEWS[3]]
    way = np.concatenate([-turn, -move])
    surely, there = (
        np.sqrt(way @ pose_priors(views, points, poses=True, focal="fixed").information[2] @ way)
        for views in (VIEWS, given)
    )
    # In standard deviations. It is still some, as a part of the way counts as that of all cameras.
    assert surely > 100.0
    assert there < 0.2 * surely


def test_only_what_the_views_see_counts():
    points = tracked(VIEWS, XYZ, noise=0.5)
    assert pose_priors(VIEWS, None, poses=True, focal="fixed") is None
    bare = igsr.Points(points.xyz, points.rgb)
    assert pose_priors(VIEWS, bare, poses=True, focal="fixed") is None
    strangers = [replace(view, name=f"other/{view.name}") for view in VIEWS]
    assert pose_priors(strangers, points, poses=True, focal="fixed") is None
    assert pose_priors(VIEWS[:1], points, poses=True, focal="fixed") is None
    # Held-out photos' tracks say nothing: here they are wrong.
    wrong = tracked(VIEWS, XYZ, noise=0.5)
    wrong.tracks.xy[wrong.tracks.view == 3] += 50.0
    one, two = (pose_priors(VIEWS[:3], p, poses=True, focal="fixed") for p in (points, wrong))
    np.testing.assert_array_equal(one.information, two.information)
    # A camera that sees two points, and one that sees none, are not held; the others are.
    few = (points.tracks.view < 2) | ((points.tracks.view == 2) & (points.tracks.point < 2))
    tracks = points.tracks
    points.tracks = replace(
        tracks, view=tracks.view[few], point=tracks.point[few], xy=tracks.xy[few]
    )
    held = pose_priors(VIEWS, points, poses=True, focal="fixed")
    assert held.information.any(axis=(1, 2)).tolist() == [True, True, False, False]
    assert np.isfinite(held.information).all()


@pytest.fixture(scope="module")
def made():
    scene = scenes.splats(count=120)
    return scenes.capture(views=12, size=64, scene=scene), scene.means.astype(np.float64)


OPTIONS = {"steps": 250, "backend": "cpu", "max_splats": 400, "poses": "joint", "start": "random"}


def test_exact_cameras_with_tracks_stay_where_a_fit_would_move_them(made):
    capture, means = made
    true = [view.camera for view in capture.train_views]
    points = tracked(capture.train_views, means)
    errors = []
    for given in (Capture(capture.path, capture.views, points), capture):
        _, fitted = scenes.fit_with_cameras(given, **OPTIONS)
        errors.append(pose_errors([view.camera for view in fitted.train_views], true)["rotation"])
    held, free = errors
    assert held < 0.1 * free, errors


def test_a_held_fit_resumes_with_its_own_tracks_alone(made, tmp_path):
    capture, means = made
    given = Capture(capture.path, capture.views, tracked(capture.train_views, means, noise=0.3))
    checkpoint = tmp_path / "checkpoint.npz"
    options = OPTIONS | {"steps": 90, "focal": "shared"}
    whole, cameras_whole = scenes.fit_with_cameras(given, **options)
    scenes.fit(given, checkpoint=checkpoint, progress=lambda now: now.step < 40, **options)
    part, cameras_part = scenes.fit_with_cameras(given, checkpoint=checkpoint, resume=True, **options)
    np.testing.assert_array_equal(whole.means, part.means)
    for a, b in zip(cameras_whole.views, cameras_part.views, strict=True):
        np.testing.assert_array_equal(a.camera.viewmat, b.camera.viewmat)
        np.testing.assert_array_equal(a.camera.K, b.camera.K)
    with pytest.raises(igsr.IgsrError, match="other photos, masks, cameras, tracks"):
        scenes.fit(capture, checkpoint=checkpoint, resume=True, **options)


def least_ratio(found, expected, rows):
    """The least factor by which information about any direction of the cameras has changed."""
    ratios = []
    for k in rows:
        half = np.linalg.cholesky(expected.information[k])
        inverse = np.linalg.inv(half)
        ratios.append(np.linalg.eigvalsh(inverse @ found.information[k] @ inverse.T).min())
    return min(ratios)


@pytest.mark.parametrize("focal", ["fixed", "shared", "per-camera"])
def test_two_cameras_are_held(focal):
    found = pose_priors(VIEWS[:2], tracked(VIEWS[:2], XYZ, noise=0.5), poses=True, focal=focal)
    for information in found.information:
        assert np.linalg.eigvalsh(information).min() > 0.0


@pytest.mark.parametrize("seen", [0, 1, 2])
def test_a_camera_without_tracks_loosens_no_other(seen):
    points = tracked(VIEWS, XYZ, noise=0.5)
    expected = pose_priors(VIEWS, points, poses=True, focal="fixed")
    more = [*VIEWS, replace(VIEWS[0], name="more.png", camera=scenes.ring_camera(-0.4, 64))]
    tracks = points.tracks
    place = projected(more[-1].camera, XYZ[:seen])
    points = replace(
        points,
        tracks=replace(
            tracks,
            names=[*tracks.names, "more.png"],
            view=np.append(tracks.view, np.full(seen, COUNT)),
            point=np.append(tracks.point, np.arange(seen)),
            xy=np.concatenate([tracks.xy, place]),
        ),
    )
    found = pose_priors(more, points, poses=True, focal="fixed")
    assert not found.information[COUNT].any()
    assert least_ratio(found, expected, range(COUNT)) > 0.9


def test_what_no_camera_can_have_seen_changes_little():
    points = tracked(VIEWS, XYZ, noise=0.5)
    expected = pose_priors(VIEWS, points, poses=True, focal="fixed")
    for wrong in (1e200, 1e6):
        xyz = XYZ.copy()
        xyz[3] = wrong
        found = pose_priors(VIEWS, replace(points, xyz=xyz), poses=True, focal="fixed")
        assert least_ratio(found, expected, range(COUNT)) > 0.5
    for wrong in (1e300, 100.0):
        xy = points.tracks.xy.copy()
        xy[5] += wrong
        off = replace(points, tracks=replace(points.tracks, xy=xy))
        found = pose_priors(VIEWS, off, poses=True, focal="fixed")
        assert least_ratio(found, expected, range(COUNT)) > 0.5
