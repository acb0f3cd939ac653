"""The left-half protocol: exposure from the left half, scores of the right half."""

import numpy as np
import pytest

from igsr.evaluation import metrics
from igsr_lab.study.left_half import left_half_scores


def photo_of(height, width):
    smooth = np.random.default_rng(0).uniform(0, 255, size=(height // 4 + 1, width // 4 + 1, 3))
    picture = np.kron(smooth, np.ones((4, 4, 1)))[:height, :width]
    return (picture * 0.6 + 40).astype(np.uint8)


def test_the_exposure_of_the_left_half_corrects_the_right_half():
    photo = photo_of(48, 57)
    mixed = photo @ np.array([[0.7, 0.1, 0.0], [0.0, 0.8, 0.1], [0.1, 0.0, 0.6]]) + 12.0
    render = mixed.astype(np.uint8)
    found = left_half_scores(render, photo)
    assert metrics.psnr(render, photo) < 25
    assert found["lh_psnr"] > 45
    assert found["lh_ssim"] > 0.99
    # The right half does not influence the exposure: its errors remain.
    spoiled = render.copy()
    spoiled[:, 28:] = np.clip(spoiled[:, 28:] + 30.0, 0, 255).astype(np.uint8)
    assert left_half_scores(spoiled, photo)["lh_psnr"] < 20
    exact = np.concatenate([render[:, :28], photo[:, 28:]], axis=1)
    assert left_half_scores(exact, photo)["lh_psnr"] < 20


def test_masked_and_clipped_pixels_are_left_out():
    photo = photo_of(48, 56)
    render = (photo * 0.8).astype(np.uint8)
    mask = np.ones(photo.shape[:2], dtype=bool)
    mask[:20] = False
    spoiled = render.copy()
    spoiled[:20] = 90
    assert left_half_scores(spoiled, photo, mask)["lh_psnr"] > 45
    assert left_half_scores(spoiled, photo)["lh_psnr"] < 40
    clipped = render.copy()
    clipped[:20, :28] = 255
    assert left_half_scores(clipped, photo)["lh_psnr"] > 45
    # Without pixels for the exposure, the render is not corrected.
    mask[:, :28] = False
    plain = metrics.psnr(render[:, 28:], photo[:, 28:], mask[:, 28:].copy())
    assert left_half_scores(render, photo, mask)["lh_psnr"] == pytest.approx(plain)
    mask[:, 28:] = False
    assert left_half_scores(render, photo, mask) == {"lh_psnr": None, "lh_ssim": None}
