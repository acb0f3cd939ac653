"""Metrics against independent computations, with masks and small pictures."""

import math

import numpy as np
import pytest
import torch
from torchmetrics.functional import image as torch_metrics

from igsr.evaluation import metrics


def picture(seed=0, height=40, width=52):
    random = np.random.default_rng(seed)
    smooth = random.uniform(0, 255, size=(height // 4 + 1, width // 4 + 1, 3))
    image = np.kron(smooth, np.ones((4, 4, 1)))[:height, :width]
    return image.astype(np.uint8)


def noisy(image, amount=20, seed=1):
    noise = np.random.default_rng(seed).integers(-amount, amount + 1, image.shape)
    return np.clip(image.astype(int) + noise, 0, 255).astype(np.uint8)


def batch(image):
    return torch.from_numpy(image).permute(2, 0, 1)[None].to(torch.float64) / 255


def test_psnr_is_the_textbook_formula():
    photo = np.full((8, 9, 3), 100, dtype=np.uint8)
    render = photo.copy()
    render[..., 0] += 10
    mse = (10 / 255) ** 2 / 3
    assert metrics.psnr(render, photo) == pytest.approx(-10 * math.log10(mse), abs=1e-12)


def test_equal_pictures_score_perfectly():
    photo = picture(height=200, width=180)
    scores = metrics.score(photo, photo)
    assert scores["psnr"] == metrics.PSNR_CAP
    assert scores["ssim"] == pytest.approx(1.0, abs=1e-12)
    assert scores["ms_ssim"] == pytest.approx(1.0, abs=1e-6)
    assert scores["flip"] == 0.0


def test_ssim_matches_torchmetrics_inside_the_border():
    photo = picture()
    render = noisy(photo)
    inner = np.zeros(photo.shape[:2], dtype=bool)
    inner[10:-10, 10:-10] = True
    # The masked score sees black outside the mask.
    surrounded = [np.where(inner[..., None], image, 0) for image in (render, photo)]
    options = {"sigma": 1.5, "kernel_size": 11, "return_full_image": True}
    _, full = torch_metrics.structural_similarity_index_measure(
        *map(batch, surrounded), data_range=1.0, **options
    )
    expected = full[0].mean(dim=0).numpy()[inner].mean()
    assert metrics.ssim(render, photo, inner) == pytest.approx(expected, abs=1e-9)


def test_worse_pictures_score_worse_on_every_metric():
    photo = picture(height=176, width=180)
    mild, strong = (metrics.score(noisy(photo, amount), photo) for amount in (8, 40))
    for name in ("psnr", "ssim", "ms_ssim"):
        assert mild[name] > strong[name]
    assert mild["flip"] < strong["flip"]


def test_masked_out_pixels_do_not_count():
    photo = picture(height=180, width=180)
    render = noisy(photo)
    mask = np.ones(photo.shape[:2], dtype=bool)
    mask[:, 90:] = False
    spoiled = render.copy()
    spoiled[:, 90:] = 255 - spoiled[:, 90:]
    assert metrics.score(spoiled, photo, mask) == metrics.score(render, photo, mask)
    assert metrics.psnr(spoiled, photo) < metrics.psnr(spoiled, photo, mask) - 5


@pytest.mark.parametrize(
    ("size", "amount"), [((176, 176), 25), ((200, 331), 5), ((189, 257), 120), ((400, 300), 60)]
)
def test_ms_ssim_matches_torchmetrics(size, amount):
    photo = picture(amount, *size)
    for render in (noisy(photo, amount), picture(99, *size), 255 - photo):
        expected = torch_metrics.multiscale_structural_similarity_index_measure(
            batch(render).float(), batch(photo).float(), data_range=1.0, normalize="relu"
        )
        assert metrics.ms_ssim(render, photo) == pytest.approx(float(expected), abs=1e-5)


def test_ms_ssim_needs_176_pixels():
    small, large = picture(height=175, width=300), picture(height=176, width=300)
    assert metrics.ms_ssim(small, small) is None
    assert metrics.ms_ssim(large, large) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("render", "photo", "mask", "name"),
    [
        (picture().astype(np.float32), picture(), None, "render"),
        (picture(), picture()[..., :2], None, "photo"),
        (picture()[1:], picture(), None, "render"),
        (picture(), picture(), np.ones((3, 3), dtype=bool), "mask"),
        (picture(), picture(), np.ones((40, 52)), "mask"),
        (picture(), picture(), np.zeros((40, 52), dtype=bool), "mask"),
    ],
)
def test_unusable_pictures_are_named(render, photo, mask, name):
    with pytest.raises(ValueError, match=name):
        metrics.score(render, photo, mask)


def test_color_correction_removes_exposure_and_tone():
    photo = np.clip(picture(height=48, width=56).astype(float) * 0.6 + 40, 0, 255).astype(np.uint8)
    brighter = np.clip(photo.astype(float) * [0.7, 0.8, 0.9] + [20, 0, 10], 0, 255).astype(np.uint8)
    curve = (255 * (photo / 255) ** 1.3).astype(np.uint8)
    for render in (brighter, curve):
        assert metrics.psnr(render, photo) < 26
        assert metrics.psnr(metrics.color_corrected(render, photo), photo) > 38
    # Other errors stay.
    scores = metrics.score(noisy(photo, 40), photo)
    assert scores["cc_psnr"] < scores["psnr"] + 1.5
    assert scores["cc_ssim"] < scores["ssim"] + 0.1


def test_color_correction_ignores_masked_and_clipped_pixels():
    photo = np.clip(picture(height=48, width=56).astype(float) * 0.6 + 40, 0, 255).astype(np.uint8)
    render = (photo * 0.8).astype(np.uint8)
    mask = np.ones(photo.shape[:2], dtype=bool)
    mask[:, :20] = False
    spoiled = photo.copy()
    spoiled[:, :20] = 255 - spoiled[:, :20]
    score = metrics.score(render, spoiled, mask)
    assert score["cc_psnr"] > 38
    white = np.full_like(photo, 255)
    assert (metrics.color_corrected(white, photo) == white).all(), "nothing to fit a map to"
    white_patch = render.copy()
    white_patch[:10, :10] = 255
    inner = np.zeros(photo.shape[:2], dtype=bool)
    inner[12:, 12:] = True
    mended = metrics.color_corrected(white_patch, photo)
    assert metrics.psnr(mended, photo, inner) > 38
