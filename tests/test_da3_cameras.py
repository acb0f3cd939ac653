"""Cameras from and to Depth Anything 3's nine numbers, and from its rays."""

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


def intrinsics(cx=0.5, cy=0.5):
    return np.stack(
        [
            [[60.0 + n, 0, cx * WIDTH], [0, 55.0 + 2 * n, cy * HEIGHT], [0, 0, 1]]
            for n in range(len(VIEWMATS))
        ]
    )


def made_up_rays(K, rows=24, columns=40):
    """Rays of every camera at the pixel centres of a grid, float64 [S, rows, columns, 6]."""
    x, y = np.meshgrid(
        (np.arange(columns) + 0.5) * WIDTH / columns, (np.arange(rows) + 0.5) * HEIGHT / rows
    )
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    rays = []
    for viewmat, one in zip(VIEWMATS, K, strict=True):
        rotation = viewmat[:3, :3].T
        directions = pixels @ np.linalg.inv(one).T @ rotation.T
        centre = np.broadcast_to(-rotation @ viewmat[:3, 3], directions.shape)
        rays.append(np.concatenate([directions, centre], axis=-1))
    return np.stack(rays)


def degrees(one, other):
    products = np.einsum("sij,sij->s", one[:, :, :3], other[:, :3, :3])
    return np.degrees(np.arccos(np.clip((products - 1.0) / 2.0, -1.0, 1.0))).max()


def test_encoded_cameras_are_decoded_again():
    K = intrinsics()
    encoding = encode_pose(VIEWMATS, K, SIZES * 5)
    assert (encoding[:, 6] >= 0).all()
    np.testing.assert_allclose(encoding[:, 3:7].norm(dim=1), 1.0)
    found, found_K = decode_pose(encoding, HEIGHT, WIDTH)
    np.testing.assert_allclose(found, VIEWMATS[:, :3], atol=1e-12)
    np.testing.assert_allclose(found_K, K, rtol=1e-12)


def test_a_quaternion_may_have_any_length_and_sign():
    encoding = encode_pose(VIEWMATS, intrinsics(), SIZES * 5)
    other = encoding.clone()
    other[:, 3:7] *= -7.5
    found = [decode_pose(one, 9, 9)[0] for one in (encoding, other)]
    np.testing.assert_allclose(*found, atol=1e-12)


def test_what_the_nine_numbers_mean():
    # A camera at (1, 2, 3) turned by a quarter about y; fields of view of 90 and 53.13 degrees.
    half = np.sqrt(0.5)
    fields = [np.pi / 2, 2 * np.arctan(0.5)]
    found, K = decode_pose([[1, 2, 3, 0, half, 0, half, *fields]], 100, 200)
    # Its z axis is the world's x axis.
    np.testing.assert_allclose(found[0, 2, :3], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(found[0] @ [1, 2, 3, 1], 0.0, atol=1e-12)
    np.testing.assert_allclose(K[0], [[200, 0, 100], [0, 50, 50], [0, 0, 1]])


def test_a_field_of_view_of_nothing_is_a_very_long_focal_length():
    _, K = decode_pose([[0, 0, 0, 0, 0, 0, 1, 0.0, 4.0]], 100, 200)
    np.testing.assert_allclose([K[0, 0, 0], K[0, 1, 1]], [5e5 * 200, 5e5 * 100])


def test_given_cameras_in_the_frame_of_the_first():
    found = normalized_viewmats(torch.from_numpy(VIEWMATS))
    np.testing.assert_allclose(found[0], np.eye(4), atol=1e-12)
    # Relative poses stay; the unit is the lower median distance, the first's own 0 among them.
    centres = np.stack([-v[:3, :3].T @ v[:3, 3] for v in found])
    distances = np.linalg.norm(centres, axis=1)
    assert np.sort(distances)[2] == pytest.approx(1.0)
    given = VIEWMATS[3] @ np.linalg.inv(VIEWMATS[1])
    relative = found[3] @ np.linalg.inv(found[1])
    np.testing.assert_allclose(relative[:3, :3], given[:3, :3], atol=1e-12)
    pair = normalized_viewmats(VIEWMATS[:2])
    assert np.linalg.norm(pair[1, :3, 3]) == pytest.approx(
        np.linalg.norm((VIEWMATS[1] @ np.linalg.inv(VIEWMATS[0]))[:3, 3]) / 0.1
    )


def test_exact_rays_give_exact_cameras():
    K = intrinsics()
    for decomposition in ("centred", "free", "official"):
        found, found_K = cameras_of_rays(
            made_up_rays(K), np.full((5, 24, 40), 2.0), HEIGHT, WIDTH, decomposition=decomposition
        )
        np.testing.assert_allclose(found, VIEWMATS[:, :3], atol=1e-8)
        np.testing.assert_allclose(found_K, K, atol=1e-6)


def test_only_the_free_decomposition_knows_a_principal_point_off_the_centre():
    K = intrinsics(cx=0.6, cy=0.45)
    weights = np.full((5, 24, 40), 2.0)
    free, free_K = cameras_of_rays(made_up_rays(K), weights, HEIGHT, WIDTH, decomposition="free")
    assert degrees(free, VIEWMATS) < 1e-4
    np.testing.assert_allclose(free_K, K, atol=1e-6)
    for decomposition in ("centred", "official"):
        found, _ = cameras_of_rays(
            made_up_rays(K), weights, HEIGHT, WIDTH, decomposition=decomposition
        )
        assert degrees(found, VIEWMATS) > 3.0


def test_noise_and_outliers_of_little_confidence():
    random = np.random.default_rng(3)
    rays = made_up_rays(intrinsics())
    rays[..., :3] += 0.02 * random.normal(size=(*rays.shape[:3], 3))
    wrong = random.random(rays.shape[:3]) < 0.1
    rays[wrong, :3] = random.normal(size=(int(wrong.sum()), 3))
    rays[wrong, :3] *= np.sign(rays[wrong, 2])[:, None]
    weights = np.where(wrong, 1.05, 3.0 + random.random(wrong.shape))
    centred, K = cameras_of_rays(rays, weights, HEIGHT, WIDTH)
    free, _ = cameras_of_rays(rays, weights, HEIGHT, WIDTH, decomposition="free")
    assert degrees(centred, VIEWMATS) < 0.3
    # Where the principal point is in the middle, knowing so is worth much.
    assert degrees(centred, VIEWMATS) < degrees(free, VIEWMATS)
    np.testing.assert_allclose(K, intrinsics(), rtol=0.02)
    # Some cameras look across the first, where the published way divides by little.
    official, _ = cameras_of_rays(rays, weights, HEIGHT, WIDTH, decomposition="official")
    assert degrees(official, VIEWMATS) > 1.5 * degrees(centred, VIEWMATS)


def test_samples_come_from_the_seed_alone():
    random = np.random.default_rng(0)
    rays = made_up_rays(intrinsics())
    rays[..., :3] += 0.1 * random.normal(size=(*rays.shape[:3], 3))
    weights = 1.0 + random.random(rays.shape[:3])
    torch.manual_seed(1)
    one = cameras_of_rays(rays, weights, HEIGHT, WIDTH, seed=4)
    torch.manual_seed(2)
    np.testing.assert_array_equal(one[0], cameras_of_rays(rays, weights, HEIGHT, WIDTH, seed=4)[0])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: decode_pose(np.zeros((2, 8)), 9, 9),
            r"encoding has shape \[2, 8\]; give \[S, 9\]",
        ),
        (
            lambda: cameras_of_rays(np.zeros((1, 4, 4, 5)), np.ones((1, 4, 4)), 9, 9),
            r"rays has shape \[1, 4, 4, 5\]",
        ),
        (
            lambda: cameras_of_rays(np.zeros((1, 4, 4, 6)), np.ones((1, 4, 3)), 9, 9),
            "confidence has shape",
        ),
        (
            lambda: cameras_of_rays(
                np.zeros((1, 4, 4, 6)), np.ones((1, 4, 4)), 9, 9, decomposition="best"
            ),
            "decomposition is 'best'",
        ),
        (
            lambda: cameras_of_rays(np.zeros((1, 4, 4, 6)), np.ones((1, 4, 4)), 9, 9),
            "the rays of view 0 fit no camera",
        ),
        (
            lambda: cameras_of_rays(np.full((1, 4, 4, 6), np.nan), np.ones((1, 4, 4)), 9, 9),
            "the rays of view 0 fit no camera",
        ),
    ],
)
def test_what_cannot_be_used(call, message):
    with pytest.raises(IgsrError, match=message):
        call()
