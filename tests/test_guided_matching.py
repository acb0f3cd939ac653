"""Guided matching, compared with all distances computed one by one."""

from __future__ import annotations

import numpy as np
import pytest

from igsr.cameras.colmap import guided_matching
from igsr.cameras.colmap.guided_matching import EpipolarLine, Plane, comparable, guided_matches

H = np.array([[0.9, 0.1, 20.0], [-0.1, 1.0, 5.0], [1e-4, 0.0, 1.0]])


def homogeneous(xy):
    return np.hstack([xy, np.ones((len(xy), 1))])


def two_photos(seed=0):
    """Places and descriptors of two photos of 300 points, and their fundamental matrix.

    Ten textures repeat everywhere, so that descriptors alone are ambiguous.
    """
    random = np.random.default_rng(seed)
    points = np.column_stack([random.uniform(-2, 2, (300, 2)), random.uniform(3, 6, 300)])
    K = np.array([[800.0, 0, 500], [0, 800, 400], [0, 0, 1]])
    angle, t = 0.2, np.array([1.0, 0.1, 0.2])
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    F = np.linalg.inv(K).T @ cross @ R @ np.linalg.inv(K)
    places = []
    for seen in (points, points @ R.T + t):
        image = seen @ K.T
        places.append(image[:, :2] / image[:, 2:] + random.normal(0, 0.5, (300, 2)))
    textures = random.exponential(45.0, (10, 128))
    textures *= 512.0 / np.linalg.norm(textures, axis=1, keepdims=True)
    kind = random.integers(0, 10, 300)
    a, b = (
        (textures[kind] + random.normal(0, 4, (300, 128))).clip(0, 255).astype(np.uint8)
        for _ in range(2)
    )
    order = random.permutation(300)
    return places[0], a, places[1][order], b[order], F


def one_by_one(xy, a, other_xy, b, allowed):
    """The definition: each other's nearest by less than 0.8 of the next, if allowed."""
    distance = np.linalg.norm(a[:, None].astype(float) - b[None].astype(float), axis=2)
    distance[~allowed] = np.inf

    def clear(rows):
        nearest, second = np.sort(rows, axis=1)[:, :2].T
        chosen = (nearest < 0.8 * second) & (nearest <= 0.7 * 512.0)
        return np.where(chosen, rows.argmin(axis=1), -1)

    there, back = clear(distance), clear(distance.T)
    return {(i, int(j)) for i, j in enumerate(there) if j >= 0 and back[j] == i}


@pytest.mark.parametrize("rows", [7, 512])
def test_matches_follow_the_definition(rows, monkeypatch):
    monkeypatch.setattr(guided_matching, "BATCH_FEATURES", rows)
    xy, a, other_xy, b, F = two_photos()
    # Features whose nearest one has a better partner.
    noise = np.random.default_rng(4).normal(0, 12, (100, 128))
    xy, a = np.vstack([xy, xy[:100]]), np.vstack([a, (a[:100] + noise).clip(0, 255).astype("u1")])
    lines, others = homogeneous(xy) @ F.T, homogeneous(other_xy) @ F
    off = lines @ homogeneous(other_xy).T
    size = (lines[:, :2] ** 2).sum(1)[:, None] + (others[:, :2] ** 2).sum(1)
    expected = one_by_one(xy, a, other_xy, b, off**2 / size <= 16.0)
    # Fundamental matrices have any scale.
    for scale in (1.0, 1e-12, 1e12):
        constraint = EpipolarLine(scale * F, 4.0)
        found = guided_matches(comparable(xy, a), comparable(other_xy, b), constraint)
        assert found.dtype == np.uint32
        assert {(int(i), int(j)) for i, j in found} == expected
    everywhere = one_by_one(xy, a, other_xy, b, np.ones(off.shape, dtype=bool))
    assert len(expected) > 100 > 10 * len(everywhere)


def test_a_plane_guides_matching():
    """Distances are in the second photo, also for matches from the second to the first."""
    xy, a, _, _, _ = two_photos(1)
    mapped = homogeneous(xy) @ H.T
    mapped = mapped[:, :2] / mapped[:, 2:]
    order = np.random.default_rng(1).permutation(300)
    other_xy = (mapped + np.random.default_rng(2).normal(0, 2.0, xy.shape))[order]
    b = a[order]
    off = np.linalg.norm(mapped[:, None] - other_xy[None], axis=2)
    expected = one_by_one(xy, a, other_xy, b, off <= 4.0)
    found = guided_matches(comparable(xy, a), comparable(other_xy, b), Plane(H, 4.0))
    assert {(int(i), int(j)) for i, j in found} == expected
    assert 150 < len(expected) < 290


def test_distances_are_exact_for_any_descriptors():
    random = np.random.default_rng(3)
    a, b = (random.integers(0, 256, (50, 128)).astype(np.uint8) for _ in range(2))
    a[0], b[0] = 255, 0  # the longest possible distance
    product = comparable(np.zeros((50, 2)), a).left @ comparable(np.zeros((50, 2)), b).right.T
    exact = ((a[:, None].astype(np.int64) - b[None].astype(np.int64)) ** 2).sum(axis=2)
    np.testing.assert_array_equal(-product.astype(np.int64), exact)


def test_no_features_no_matches():
    xy, a, _, _, F = two_photos()
    nothing = comparable(np.zeros((0, 2)), np.zeros((0, 128), dtype=np.uint8))
    some = comparable(xy, a)
    for first, second in ((nothing, some), (some, nothing), (nothing, nothing)):
        assert guided_matches(first, second, EpipolarLine(F, 4.0)).shape == (0, 2)
