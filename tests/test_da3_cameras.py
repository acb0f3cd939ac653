"""Cameras from pose encodings of Depth Anything 3."""

from __future__ import annotations

import numpy as np

from igsr.cameras.da3.cameras import decode_pose


def test_the_nine_numbers():
    # A camera at (1, 2, 3), rotated by 90 degrees about y; fields of view 90 and 53.13 degrees.
    half = np.sqrt(0.5)
    fields = [np.pi / 2, 2 * np.arctan(0.5)]
    # A quaternion may have any length and sign.
    w2c, K = decode_pose([[1, 2, 3, 0, -7 * half, 0, -7 * half, *fields]], 100, 200)
    # Its z axis is the world's x axis.
    np.testing.assert_allclose(w2c[0, 2, :3], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(w2c[0] @ [1, 2, 3, 1], 0.0, atol=1e-12)
    np.testing.assert_allclose(K[0], [[200, 0, 100], [0, 50, 50], [0, 0, 1]])
    # No field of view is a very long focal length.
    _, K = decode_pose([[0, 0, 0, 0, 0, 0, 1, 0.0, 4.0]], 100, 200)
    np.testing.assert_allclose([K[0, 0, 0], K[0, 1, 1]], [5e5 * 200, 5e5 * 100])
