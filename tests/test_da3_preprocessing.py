"""What Depth Anything 3 is shown of photos, and the way back to their pixels."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate

from igsr.errors import IgsrError
from igsr.pose.da3.preprocessing import (
    DEVIATION,
    MEAN,
    area_matrix,
    cubic_matrix,
    grey_levels,
    network_inputs,
    resampling_of,
)


@pytest.mark.parametrize(("size", "wanted"), [(12, 4), (10, 7), (97, 31), (8, 8)])
def test_areas_are_means_of_what_a_pixel_covers(size, wanted):
    # A fine comb of samples: as many to each old pixel, as many to each new one.
    values = np.random.default_rng(size).random(size)
    samples = np.repeat(values, wanted)
    np.testing.assert_allclose(
        area_matrix(size, wanted) @ values, samples.reshape(wanted, size).mean(axis=1), atol=1e-12
    )


@pytest.mark.parametrize(("size", "wanted"), [(5, 14), (30, 42), (42, 30), (9, 9)])
def test_cubic_convolution_is_torchs_which_has_the_same_constant(size, wanted):
    values = np.random.default_rng(size).random((size, 3))
    image = torch.from_numpy(values.T.reshape(1, 3, size, 1)).expand(-1, -1, -1, 4)
    wanted_values = interpolate(image, size=(wanted, 4), mode="bicubic")[0, :, :, 1].numpy().T
    np.testing.assert_allclose(cubic_matrix(size, wanted) @ values, wanted_values, atol=1e-9)


# From the published code's rules, worked out by hand.
SIZES = {
    (4000, 3000): ((504, 378), (504, 378), (672, 504), (672, 504)),
    (1080, 1920): ((280, 504), (280, 504), (504, 896), (504, 896)),
    (1208, 680): ((504, 280), (504, 280), (896, 504), (882, 504)),
    # 7 over a multiple of 14 goes up.
    (504, 377): ((504, 378), (504, 364), (672, 504), (672, 504)),
    (97, 61): ((504, 322), (504, 308), (798, 504), (798, 504)),
    (504, 504): ((504, 504), (504, 504), (504, 504), (504, 504)),
}


@pytest.mark.parametrize("size", SIZES)
def test_sizes(size):
    methods = ("upper_bound_resize", "upper_bound_crop", "lower_bound_resize", "lower_bound_crop")
    for method, wanted in zip(methods, SIZES[size], strict=True):
        resampling = resampling_of(*size, 504, method)
        assert (resampling.width, resampling.height) == wanted, method
    assert resampling_of(504, 371).height == 378


@pytest.mark.parametrize("method", ["upper_bound_resize", "lower_bound_crop"])
@pytest.mark.parametrize("size", [(300, 211), (61, 97), (40, 126)])
def test_a_spot_is_found_again_at_its_place(method, size):
    width, height = size
    image = np.zeros((height, width, 3), dtype=np.uint8)
    x, y = width // 2 + 3, height // 2 - 5
    image[y - 2 : y + 3, x - 2 : x + 3] = 255
    resampling = resampling_of(width, height, 126, method)
    levels = grey_levels(image, resampling)[..., 0].astype(float)
    assert levels.shape == (resampling.height, resampling.width)
    rows, columns = (np.arange(n) + 0.5 for n in levels.shape)
    found = np.array([levels.sum(0) @ columns, levels.sum(1) @ rows]) / levels.sum()
    grid = resampling.grid()
    back = found * [grid.scale_x, grid.scale_y] + [grid.offset_x, grid.offset_y]
    np.testing.assert_allclose(back, [x + 0.5, y + 0.5], atol=0.2)
    # Intrinsics go the same way: a pixel on the axis of a camera stays there.
    K = resampling.intrinsics(np.array([[99.0, 0, x + 0.5], [0, 98.0, y + 0.5], [0, 0, 1]]))
    np.testing.assert_allclose(K[:2, 2], found, atol=0.2)


def test_pixels_are_normalised_channel_by_channel():
    image = np.full((28, 28, 3), (10, 100, 200), dtype=np.uint8)
    pixels, K = network_inputs([image], 28)
    assert pixels.dtype == np.float32
    assert pixels.shape == (1, 3, 28, 28)
    assert K is None
    wanted = (np.array([10, 100, 200]) / 255 - MEAN) / DEVIATION
    np.testing.assert_allclose(pixels[0, :, 5, 7], wanted, atol=1e-6)


def test_photos_of_several_sizes_are_cut_about_the_middle_to_one():
    wide = np.zeros((56, 84, 3), dtype=np.uint8)
    wide[:, 14:70] = 255
    high = np.zeros((84, 56, 3), dtype=np.uint8)
    high[14:70] = 255
    K = np.array([[50.0, 0, 42], [0, 50.0, 28], [0, 0, 1]])
    pixels, intrinsics = network_inputs([wide, high], 84, "upper_bound_resize", [K, K])
    assert pixels.shape == (2, 3, 56, 56)
    assert (pixels > 0).all()
    np.testing.assert_allclose(intrinsics[:, :2, 2], [[28, 28], [42, 14]])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([],), "images is empty"),
        (([np.zeros((9, 9, 4), np.uint8)],), r"image 0 is uint8 \[9, 9, 4\]"),
        (([np.zeros((9, 9, 3))],), "image 0 is float64"),
        (([np.zeros((9, 9, 3), np.uint8)], 500.0), "resolution is 500.0"),
        (([np.zeros((9, 9, 3), np.uint8)], 13), "resolution is 13"),
        (([np.zeros((9, 9, 3), np.uint8)], 504, "middle"), "method is 'middle'"),
        (([np.zeros((5, 900, 3), np.uint8)],), "900x5 pixels is too narrow"),
        (([np.zeros((9, 9, 3), np.uint8)], 28, "upper_bound_crop", []), "intrinsics are 0"),
    ],
)
def test_photos_that_cannot_be_shown(arguments, message):
    with pytest.raises(IgsrError, match=message):
        network_inputs(*arguments)
