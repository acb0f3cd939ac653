"""Bundle adjustment with a prediction as a prior, on synthetic points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import perturbed_camera, ring_camera

from igsr.cameras.colmap.adjustment import deviations
from igsr.cameras.prior_adjustment import (
    Bundle,
    Observations,
    Spread,
    _Problem,
    _stepped,
    adjusted_bundle,
    covariances,
)
from igsr.geometry.pose_errors import pose_accuracy, pose_errors

COUNT = 5
SPREAD = Spread(np.radians(1.5), 0.1)
TRUTH = [ring_camera(0.6 * k + 0.05 * k**2, 640) for k in range(COUNT)]


def scene(shown_by, per_group=30, seed=0):
    """Exact points and observations; each group of points is seen by some cameras."""
    random = np.random.default_rng(seed)
    points = random.normal(scale=0.5, size=(per_group * len(shown_by), 3))
    view, point, xy, depth = [], [], [], []
    for group, cameras in enumerate(shown_by):
        for p in range(group * per_group, (group + 1) * per_group):
            for k in cameras:
                local = TRUTH[k].viewmat[:3, :3] @ points[p] + TRUTH[k].viewmat[:3, 3]
                view.append(k)
                point.append(p)
                xy.append(local[:2] / local[2] * TRUTH[k].K[0, 0] + TRUTH[k].K[:2, 2])
                depth.append(local[2])
    seen = Observations(np.array(view), np.array(point), np.array(xy), np.array(depth))
    lenses = np.zeros(COUNT, dtype=np.int64)
    return Bundle(TRUTH, lenses, points, np.zeros(COUNT)), seen


def predicted(degrees=1.5, moved=0.1):
    return [perturbed_camera(camera, degrees, moved, k) for k, camera in enumerate(TRUTH)]


def started(bundle, cameras, seed=3):
    noise = np.random.default_rng(seed).normal(scale=0.05, size=bundle.points.shape)
    return replace(bundle, cameras=cameras, points=bundle.points + noise)


PAIRS = [(k, k + 1) for k in range(COUNT - 1)]
THREES = [(k, k + 1, k + 2) for k in range(COUNT - 2)]


def test_derivatives_are_those_of_the_cost():
    bundle, seen = scene(THREES, per_group=4)
    depth = seen.depth * np.exp(np.random.default_rng(0).normal(scale=0.1, size=len(seen.depth)))
    depth[::3] = np.nan
    seen = replace(seen, depth=depth)
    cameras = predicted()
    cameras[1] = None
    problem = _Problem(seen, cameras, SPREAD, 2.0, np.array([6.0]))
    bundle = started(bundle, predicted(moved=0.2))
    bundle = replace(bundle, scales=np.linspace(-0.1, 0.1, COUNT))
    equations, prior = problem.linearized(bundle)
    value, errors = equations.value[:, :, :-1], equations.value[:, :, -1]
    slope = prior[:-1, -1].copy()
    np.add.at(slope, equations.column[:, :-1], np.einsum("mrc,mr->mc", value, errors))
    size = equations.width - 1
    nowhere = replace(equations, value=np.zeros_like(equations.value))
    for k in range(size):
        costs = []
        for sign in (1.0, -1.0):
            # A step of 1e-5 along one parameter, with fixed points.
            wanted = np.zeros((size + 1, size + 1))
            wanted[:size, :size] = np.eye(size)
            wanted[k, size] = -sign * 1e-5
            costs.append(problem.cost(_stepped(bundle, nowhere, wanted, 0.0)))
        numeric = (costs[0] - costs[1]) / 2e-5
        assert numeric == pytest.approx(2.0 * slope[k], rel=2e-3, abs=2e-2)


def test_points_in_three_photos_outweigh_the_prediction():
    bundle, seen = scene(THREES)
    wanted = predicted()
    found = adjusted_bundle(started(bundle, wanted), seen, wanted, SPREAD, 1.0)
    before, after = (pose_errors(one, TRUTH) for one in (wanted, found.cameras))
    assert after["rotation"] < 0.1 * before["rotation"]
    assert after["center"] < 0.1 * before["center"]


def test_the_prediction_decides_if_points_are_in_two_photos():
    bundle, seen = scene(PAIRS)
    noise = np.random.default_rng(1).normal(scale=1.0, size=seen.xy.shape)
    seen = replace(seen, xy=seen.xy + noise, depth=np.full(len(seen.depth), np.nan))
    wanted = predicted()
    nothing = [None] * COUNT
    found, free = started(bundle, wanted), started(bundle, wanted)
    for pixels in (20.0, 5.0, 1.0):
        found = adjusted_bundle(found, seen, wanted, SPREAD, pixels)
        free = adjusted_bundle(free, seen, nothing, SPREAD, pixels)
    with_prior, without, before = (
        pose_accuracy(one, TRUTH) for one in (found.cameras, free.cameras, wanted)
    )
    assert with_prior["rotation"] < 0.7 * before["rotation"]
    assert with_prior["ATE"] < before["ATE"]
    assert with_prior["ATE"] < without["ATE"]


def test_depths_decide_too_and_wrong_ones_have_no_influence():
    bundle, seen = scene(PAIRS)
    wanted = predicted(moved=0.3)
    exact = adjusted_bundle(started(bundle, wanted), seen, wanted, SPREAD, 1.0)
    none = replace(seen, depth=np.full(len(seen.depth), np.nan))
    without = adjusted_bundle(started(bundle, wanted), none, wanted, SPREAD, 1.0)
    errors = [pose_errors(one.cameras, TRUTH)["center"] for one in (exact, without)]
    assert errors[0] < 0.8 * errors[1]
    wrong = np.where(seen.view == 2, seen.depth * 3.0, seen.depth)
    wrong = replace(seen, depth=wrong)
    found = adjusted_bundle(started(bundle, wanted), wrong, wanted, SPREAD, 1.0)
    assert pose_errors(found.cameras, TRUTH)["center"] < 2.0 * errors[0]


def test_a_wrong_prediction_has_no_influence():
    bundle, seen = scene(THREES)
    wanted = predicted()
    right = adjusted_bundle(started(bundle, wanted), seen, wanted, SPREAD, 1.0)
    start = started(bundle, list(wanted))
    wanted[2] = perturbed_camera(TRUTH[2], 40.0, 2.0, 9)
    found = adjusted_bundle(start, seen, wanted, SPREAD, 1.0)
    a, b = (pose_errors(one.cameras, TRUTH) for one in (right, found))
    assert b["rotation"] < a["rotation"] + 0.05
    assert b["center"] < a["center"] + 0.01


def test_wrong_matches_have_little_influence():
    bundle, seen = scene(THREES)
    wanted = predicted()
    xy = seen.xy.copy()
    xy[::10] += np.random.default_rng(0).normal(scale=15.0, size=xy[::10].shape)
    found = adjusted_bundle(started(bundle, wanted), replace(seen, xy=xy), wanted, SPREAD, 1.0)
    assert pose_errors(found.cameras, TRUTH)["rotation"] < 0.3


def test_covariances_match_errors():
    bundle, seen = scene(THREES, per_group=20)
    errors, expected = [], []
    for seed in range(6):
        random = np.random.default_rng(seed)
        noisy = replace(seen, xy=seen.xy + random.normal(scale=0.5, size=seen.xy.shape))
        none = replace(noisy, depth=np.full(len(seen.depth), np.nan))
        nothing = [None] * COUNT
        found = adjusted_bundle(bundle, none, nothing, SPREAD, 3.0)
        errors.append(pose_errors(found.cameras, TRUTH)["rotation"])
        expected.append([deviations(one)[0] for one in covariances(found, none, nothing, SPREAD)])
    # Rotations about three axes.
    assert 0.5 < np.mean(errors) / (np.degrees(np.mean(expected)) * np.sqrt(3.0)) < 2.0


def test_a_camera_without_points_has_the_deviations_of_the_prediction():
    bundle, seen = scene([(0, 1, 2), (1, 2, 3)])
    turn, move = np.transpose([deviations(c) for c in covariances(bundle, seen, TRUTH, SPREAD)])
    assert turn[4] > 10.0 * turn[1]
    assert move[4] > 10.0 * move[1]
    assert turn[4] == pytest.approx(SPREAD.rotation, rel=0.3)
    found = adjusted_bundle(bundle, seen, TRUTH, SPREAD, 1.0)
    np.testing.assert_allclose(found.cameras[4].viewmat, TRUTH[4].viewmat, atol=1e-6)
