"""How photos are resampled for Depth Anything 3."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate

from igsr.cameras.da3 import prediction
from igsr.cameras.da3.prediction import network_input, resampled, resampling_of, resamplings_of
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError


@pytest.mark.parametrize(("size", "wanted"), [(12, 4), (10, 7), (97, 31), (8, 8)])
def test_area_means(size, wanted):
    # A fine comb of samples: the same number in each input pixel, and in each output pixel.
    values = np.random.default_rng(size).random(size)
    samples = np.repeat(values, wanted)
    means = prediction.area_matrix(size, wanted) @ values
    np.testing.assert_allclose(means, samples.reshape(wanted, size).mean(axis=1), atol=1e-12)


@pytest.mark.parametrize(("size", "wanted"), [(5, 14), (30, 42), (42, 30), (9, 9)])
def test_cubic_convolution_is_that_of_torch(size, wanted):
    values = np.random.default_rng(size).random((size, 3))
    image = torch.from_numpy(values.T.reshape(1, 3, size, 1)).expand(-1, -1, -1, 4)
    found = prediction.cubic_matrix(size, wanted) @ values
    expected = interpolate(image, size=(wanted, 4), mode="bicubic")[0, :, :, 1].numpy().T
    np.testing.assert_allclose(found, expected, atol=1e-9)


# By the published code's rules; 7 above a multiple of 14 is rounded up.
@pytest.mark.parametrize(
    ("size", "wanted"),
    [
        ((4000, 3000), (504, 378)),
        ((1080, 1920), (280, 504)),
        ((1208, 680), (504, 280)),
        ((504, 377), (504, 378)),
        ((504, 371), (504, 378)),
        ((97, 61), (504, 322)),
        ((504, 504), (504, 504)),
    ],
)
def test_sizes(size, wanted):
    resampling = resampling_of(*size)
    assert (resampling.width, resampling.height) == wanted


@pytest.mark.parametrize("size", [(300, 211), (61, 97), (40, 126)])
def test_a_spot_is_found_at_its_place(size):
    width, height = size
    image = np.zeros((height, width, 3), dtype=np.uint8)
    x, y = width // 2 + 3, height // 2 - 5
    image[y - 2 : y + 3, x - 2 : x + 3] = 255
    resampling = resampling_of(width, height, 126)
    levels = resampled(image, resampling)[..., 0].astype(float)
    assert levels.shape == (resampling.height, resampling.width)
    rows, columns = (np.arange(n) + 0.5 for n in levels.shape)
    place = np.array([levels.sum(0) @ columns, levels.sum(1) @ rows]) / levels.sum()
    grid = resampling.grid()
    back = place * [grid.scale_x, grid.scale_y] + [grid.offset_x, grid.offset_y]
    np.testing.assert_allclose(back, [x + 0.5, y + 0.5], atol=0.2)


def test_channels_are_normalized():
    image = np.full((28, 28, 3), (10, 100, 200), dtype=np.uint8)
    pixels = network_input(image, resampling_of(28, 28, 28))
    assert pixels.dtype == np.float32
    assert pixels.shape == (3, 28, 28)
    wanted = (np.array([10, 100, 200]) / 255 - prediction.MEAN) / prediction.DEVIATION
    np.testing.assert_allclose(pixels[:, 5, 7], wanted, atol=1e-6)


def test_photos_of_almost_one_size_are_shown_at_one_size():
    def photo(width, height):
        return Photo(f"{width}x{height}", np.zeros((height, width, 3), np.uint8))

    shown = resamplings_of([photo(400, 300), photo(400, 300), photo(400, 290), photo(300, 400)])
    assert [(one.width, one.height) for one in shown] == [(504, 378)] * 3 + [(378, 504)]
    assert shown[2].grid().scale_y == pytest.approx(290 / 378)
    with pytest.raises(IgsrError, match="400x3: a photo of 400x3 pixels is too narrow"):
        resamplings_of([photo(400, 3)])
