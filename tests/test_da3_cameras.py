"""Cameras from and to pose encodings of Depth Anything 3, and from its rays."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import ring_camera

from igsr.errors import IgsrError
from igsr.pose.da3.cameras import cameras_of_rays, decode_pose, encode_pose, normalized_viewmats

HEIGHT, WIDTH = 42, 70
SIZES = [(HEIGHT, WIDTH)]
VIEWMATS = np.stack([ring_camera(0.7 * n, 32).viewmat for n in range(5)])
INTRINSICS = np.stack(
    [[[60.0 + n, 0, WIDTH / 2], [0, 55.0 + 2 * n, HEIGHT / 2], [0, 0, 1]] for n in range(5)]
)


def exact_rays(rows=24, columns=40):
    """Rays of every camera at the pixel centers of a grid, float64 [S, rows, columns, 6]."""
    x, y = np.meshgrid(
        (np.arange(columns) + 0.5) * WIDTH / columns, (np.arange(rows) + 0.5) * HEIGHT / rows
    )
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    rays = []
    for viewmat, K in zip(VIEWMATS, INTRINSICS, strict=True):
        rotation = viewmat[:3, :3].T
        directions = pixels @ np.linalg.inv(K).T @ rotation.T
        center = np.broadcast_to(-rotation @ viewmat[:3, 3], directions.shape)
        rays.append(np.concatenate([directions, center], axis=-1))
    return np.stack(rays)


def max_degrees(one, other):
    products = np.einsum("sij,sij->s", one[:, :, :3], other[:, :3, :3])
    return np.degrees(np.arccos(np.clip((products - 1.0) / 2.0, -1.0, 1.0))).max()


def test_decoding_inverts_encoding():
    encoding = encode_pose(VIEWMATS, INTRINSICS, SIZES * 5)
    assert (encoding[:, 6] >= 0).all()
    np.testing.assert_allclose(encoding[:, 3:7].norm(dim=1), 1.0)
    # A quaternion may have any length and sign.
    scaled = encoding.clone()
    scaled[:, 3:7] *= -7.5
    for one in (encoding, scaled):
        w2c, K = decode_pose(one, HEIGHT, WIDTH)
        np.testing.assert_allclose(w2c, VIEWMATS[:, :3], atol=1e-12)
        np.testing.assert_allclose(K, INTRINSICS, rtol=1e-12)


def test_the_nine_numbers():
    # A camera at (1, 2, 3), rotated by 90 degrees about y; fields of view 90 and 53.13 degrees.
    half = np.sqrt(0.5)
    fields = [np.pi / 2, 2 * np.arctan(0.5)]
    w2c, K = decode_pose([[1, 2, 3, 0, half, 0, half, *fields]], 100, 200)
    # Its z axis is the world's x axis.
    np.testing.assert_allclose(w2c[0, 2, :3], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(w2c[0] @ [1, 2, 3, 1], 0.0, atol=1e-12)
    np.testing.assert_allclose(K[0], [[200, 0, 100], [0, 50, 50], [0, 0, 1]])
    # No field of view is a very long focal length.
    _, K = decode_pose([[0, 0, 0, 0, 0, 0, 1, 0.0, 4.0]], 100, 200)
    np.testing.assert_allclose([K[0, 0, 0], K[0, 1, 1]], [5e5 * 200, 5e5 * 100])


def test_normalized_cameras_are_in_the_frame_of_the_first():
    found = normalized_viewmats(torch.from_numpy(VIEWMATS))
    np.testing.assert_allclose(found[0], np.eye(4), atol=1e-12)
    # The unit is the lower median distance, including the first's own 0.
    centers = np.stack([-v[:3, :3].T @ v[:3, 3] for v in found])
    assert np.sort(np.linalg.norm(centers, axis=1))[2] == pytest.approx(1.0)
    before = VIEWMATS[3] @ np.linalg.inv(VIEWMATS[1])
    after = found[3] @ np.linalg.inv(found[1])
    np.testing.assert_allclose(after[:3, :3], before[:3, :3], atol=1e-12)
    pair = normalized_viewmats(VIEWMATS[:2])
    assert np.linalg.norm(pair[1, :3, 3]) == pytest.approx(
        np.linalg.norm((VIEWMATS[1] @ np.linalg.inv(VIEWMATS[0]))[:3, 3]) / 0.1
    )


@pytest.mark.parametrize("official", [False, True])
def test_exact_rays_give_exact_cameras(official):
    w2c, K = cameras_of_rays(
        exact_rays(), np.full((5, 24, 40), 2.0), HEIGHT, WIDTH, official=official
    )
    np.testing.assert_allclose(w2c, VIEWMATS[:, :3], atol=1e-8)
    np.testing.assert_allclose(K, INTRINSICS, atol=1e-6)


def test_noise_and_outliers_with_low_confidence():
    errors, official_errors = [], []
    for seed in range(8):
        random = np.random.default_rng(seed)
        rays = exact_rays()
        rays[..., :3] += 0.02 * random.normal(size=(*rays.shape[:3], 3))
        wrong = random.random(rays.shape[:3]) < 0.1
        rays[wrong, :3] = random.normal(size=(int(wrong.sum()), 3))
        rays[wrong, :3] *= np.sign(rays[wrong, 2])[:, None]
        weights = np.where(wrong, 1.05, 3.0 + random.random(wrong.shape))
        w2c, K = cameras_of_rays(rays, weights, HEIGHT, WIDTH, seed=seed)
        np.testing.assert_allclose(K, INTRINSICS, rtol=0.03)
        errors.append(max_degrees(w2c, VIEWMATS))
        again, _ = cameras_of_rays(rays, weights, HEIGHT, WIDTH, seed=seed)
        np.testing.assert_array_equal(w2c, again)
        official, _ = cameras_of_rays(rays, weights, HEIGHT, WIDTH, official=True)
        official_errors.append(max_degrees(official, VIEWMATS))
    assert max(errors) < 1.0
    # Some cameras look across the first, for which the published code divides by a z near 0.
    assert np.mean(errors) < 0.6 * np.mean(official_errors)


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_rays_that_fit_no_camera(value):
    with pytest.raises(IgsrError, match="the rays of view 0 fit no camera"):
        cameras_of_rays(np.full((1, 4, 4, 6), value), np.ones((1, 4, 4)), 9, 9)
