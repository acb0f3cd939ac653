"""Photos loaded at a smaller size: pixels, cameras, masks, tracks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from capture_files import HEIGHT, WIDTH, photo, save, write_colmap, write_json, write_transforms
from PIL import Image

from igsr.capture import load_capture
from igsr.capture.downscaling import area_means, plane_area_means, reduced_size
from igsr.capture.photo_folder import load_photos
from igsr.errors import IgsrError


def coverage(pixels: int, count: int) -> np.ndarray:
    """float64 [count, pixels]: the part of each pixel that each of ``count`` equal parts covers."""
    low = np.arange(count)[:, None] * pixels / count
    high = low + pixels / count
    pixel = np.arange(pixels)
    return np.clip(np.minimum(high, pixel + 1) - np.maximum(low, pixel), 0.0, None)


@pytest.mark.parametrize("size", [(24, 16), (16, 16), (3, 2), (1, 1), (48, 1), (1, 32), (48, 32)])
def test_whole_factors_are_block_means(size: tuple[int, int]) -> None:
    width, height = size
    pixels = photo(1)
    blocks = pixels.reshape(height, HEIGHT // height, width, WIDTH // width, 3).astype(int)
    area = (HEIGHT // height) * (WIDTH // width)
    exact = (2 * blocks.sum(axis=(1, 3)) + area) // (2 * area)
    np.testing.assert_array_equal(area_means(pixels, width, height)[0], exact)


@pytest.mark.parametrize("size", [(47, 31), (31, 20), (11, 7), (7, 11), (47, 32), (5, 1)])
def test_other_factors_count_parts_of_pixels(size: tuple[int, int]) -> None:
    width, height = size
    rows, columns = coverage(HEIGHT, height), coverage(WIDTH, width)
    area = WIDTH * HEIGHT / (width * height)
    plane = np.random.default_rng(0).random((HEIGHT, WIDTH))
    exact = rows @ plane @ columns.T / area
    np.testing.assert_allclose(plane_area_means(plane, width, height), exact, atol=1e-12)
    pixels, mask = photo(2, channels=4), photo(3)[..., 0] > 99
    used = rows @ mask @ columns.T
    opacity = rows @ (pixels[..., 3] * mask) @ columns.T
    color = np.einsum("ij,jkc,lk->ilc", rows, pixels[..., :3] * (pixels[..., 3:] * mask[..., None]), columns)
    image, kept = area_means(pixels, width, height, mask)
    assert np.abs(image[..., 3] - opacity / np.maximum(used, 1e-9)).max() < 0.5 + 1e-6
    assert np.abs(image[..., :3] - color / np.maximum(opacity, 1e-9)[..., None]).max() < 0.5 + 1e-6
    np.testing.assert_array_equal(kept, used > 1e-9)


def test_a_ramp_stays_the_same_ramp() -> None:
    # The mean of a linear function over an area is its value at the middle: pixel centres are kept.
    plane = np.add.outer(3.0 * (np.arange(HEIGHT) + 0.5), 2.0 * (np.arange(WIDTH) + 0.5))
    width, height = 31, 21
    y, x = (np.arange(height) + 0.5) * HEIGHT / height, (np.arange(width) + 0.5) * WIDTH / width
    small = plane_area_means(plane, width, height)
    np.testing.assert_allclose(small, np.add.outer(3.0 * y, 2.0 * x), atol=1e-9)


def test_sizes() -> None:
    assert reduced_size(4000, 3000, 1000) == (1000, 750)
    assert reduced_size(3000, 4000, 1000) == (750, 1000)
    assert reduced_size(4000, 3000, 4000) == reduced_size(4000, 3000, 9000) == (4000, 3000)
    assert reduced_size(4000, 3, 100) == (100, 1)
    assert reduced_size(1, 1, 1) == (1, 1)
    assert reduced_size(100, 25, 50) == (50, 13)  # halves go up


def test_a_capture_projects_to_the_same_places(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    whole, small = load_capture(tmp_path), load_capture(tmp_path, max_size=31)
    for before, after in zip(whole.views, small.views, strict=True):
        assert (after.camera.width, after.camera.height) == (31, 21)
        assert after.image.shape == (21, 31, 3)
        np.testing.assert_array_equal(after.image, area_means(before.image, 31, 21)[0])
        points = np.random.default_rng(0).normal(size=(3, 50)) + [[0.0], [0.0], [4.0]]
        scale = np.array([[31 / WIDTH], [21 / HEIGHT]])
        for camera in (before.camera, after.camera):
            camera.__dict__["pixels"] = (camera.K @ points)[:2] / points[2]
        np.testing.assert_allclose(
            after.camera.__dict__["pixels"], before.camera.__dict__["pixels"] * scale, atol=1e-9
        )
        np.testing.assert_array_equal(after.camera.viewmat, before.camera.viewmat)
    for size in (WIDTH, 1000):
        assert load_capture(tmp_path, max_size=size) == whole
