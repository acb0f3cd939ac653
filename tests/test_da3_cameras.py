"""Cameras from and to pose encodings of Depth Anything 3."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import ring_camera

from igsr.cameras.da3.cameras import decode_pose, encode_pose, normalized_viewmats

HEIGHT, WIDTH = 42, 70
SIZES = [(HEIGHT, WIDTH)]
VIEWMATS = np.stack([ring_camera(0.7 * n, 32).viewmat for n in range(5)])
INTRINSICS = np.stack(
    [[[60.0 + n, 0, WIDTH / 2], [0, 55.0 + 2 * n, HEIGHT / 2], [0, 0, 1]] for n in range(5)]
)


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
