"""Photos at half their size."""

from __future__ import annotations

import numpy as np
import scenes

from igsr.capture import View
from igsr.capture.downscaling import halved


def view(image, mask=None):
    camera = scenes.ring_camera(0.3, size=image.shape[0])
    return View("a.png", camera, "train", image.astype(np.uint8), mask)


def test_pixels_are_averages_and_the_camera_sees_the_same():
    image = np.arange(6 * 6 * 3).reshape(6, 6, 3)
    half = halved(view(image))
    assert half.image.shape == (3, 3, 3)
    assert half.image[1, 2, 0] == round(image[2:4, 4:6, 0].mean() + 1e-9)
    point = np.array([0.1, -0.2, 0.3])

    def pixel(camera):
        local = camera.viewmat[:3, :3] @ point + camera.viewmat[:3, 3]
        return (camera.K @ local / local[2])[:2]

    assert np.allclose(pixel(half.camera), pixel(view(image).camera) / 2.0)


def test_transparent_and_masked_pixels_lend_no_color():
    image = np.zeros((4, 4, 4))
    image[0, 0] = (200, 100, 50, 255)
    image[0, 1] = (9, 9, 9, 0)
    half = halved(view(image))
    assert half.image[0, 0].tolist() == [200, 100, 50, 64]
    mask = np.ones((4, 4), bool)
    mask[:2, :2] = [[True, False], [False, False]]
    mask[2:, 2:] = False
    image[0, 1] = (9, 9, 9, 255)
    half = halved(view(image, mask))
    assert half.image[0, 0].tolist() == [200, 100, 50, 255]
    assert half.mask.tolist() == [[True, True], [True, False]]


def test_an_odd_edge_is_left_out():
    half = halved(view(np.full((5, 5, 3), 7)))
    assert half.image.shape == (2, 2, 3)
    assert (half.camera.width, half.camera.height) == (2, 2)
