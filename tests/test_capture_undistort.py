"""Undistortion compared with COLMAP's projection, and its masks."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from capture_files import HEIGHT, MODEL_PARAMS, WIDTH, photo, save, write_colmap

from igsr.capture import load_capture
from igsr.capture.colmap_files import read_cameras
from igsr.capture.read_colmap import intrinsics
from igsr.capture.undistort import Lens, Undistorter
from igsr.errors import IgsrError

K = np.array([[40.0, 0.0, 23.0], [0.0, 42.0, 17.0], [0.0, 0.0, 1.0]])


def colmap_camera(model, scale=1):
    camera = pycolmap.Camera.create_from_model_name(1, model, 40.0, WIDTH, HEIGHT)
    camera.params = MODEL_PARAMS[model]
    camera.rescale(float(scale))
    return camera


def pattern(x, y):
    """A smooth scene at infinity: float64 [..., 3] in 0 .. 255 for the ray (x, y, 1)."""
    # Steep enough (7 gray levels per pixel) that half a pixel of shift would show.
    waves = [np.sin(20.0 * x + 1.0), np.sin(18.0 * y + 2.0), np.sin(14.0 * (x + y))]
    return 127.5 + 120.0 * np.stack(waves, axis=-1)


@pytest.mark.parametrize("model", MODEL_PARAMS)
def test_undistorted_photo_equals_that_of_a_pinhole(model, tmp_path):
    """The photo is drawn through COLMAP's cam_from_img, which igsr never calls."""
    scale = 8
    camera = colmap_camera(model, scale)
    write_colmap(tmp_path, model)
    reconstruction = pycolmap.Reconstruction(tmp_path / "sparse/0")
    reconstruction.cameras[7].rescale(float(scale))
    reconstruction.write_binary(tmp_path / "sparse/0")
    width, height = camera.width, camera.height
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = camera.cam_from_img(np.stack([u.ravel(), v.ravel()], axis=1))
    drawn = pattern(rays[:, 0], rays[:, 1]).reshape(height, width, 3)
    for index in range(3):
        save(tmp_path / f"images/{index}.png", np.rint(drawn).astype(np.uint8))

    view = load_capture(tmp_path).views[0]

    pinhole = view.camera.K
    np.testing.assert_allclose(pinhole, camera.calibration_matrix(), rtol=1e-12)
    expected = pattern((u - pinhole[0, 2]) / pinhole[0, 0], (v - pinhole[1, 2]) / pinhole[1, 1])
    mask = np.ones((height, width), dtype=bool) if view.mask is None else view.mask
    error = np.abs(view.image.astype(float) - expected)[mask]
    assert mask.mean() > 0.5
    assert np.quantile(error, 0.98) < 1.1  # 8-bit rounding twice, and bilinear interpolation
    # The outermost half pixel of the photo is sampled by clamping.
    assert error.max() < 6.0


@pytest.mark.parametrize("model", MODEL_PARAMS)
def test_lens_agrees_with_colmap_to_rounding(model, tmp_path):
    camera = colmap_camera(model)
    x, y = np.random.default_rng(1).uniform(-0.7, 0.7, (2, 500))
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    write_colmap(tmp_path, model)
    pinhole, lens = intrinsics(read_cameras(tmp_path / "sparse/0/cameras.bin")[7])
    xd, yd, valid = lens.distort(x, y)
    assert valid.all()
    actual = np.stack([xd, yd], axis=1) * pinhole[[0, 1], [0, 1]] + pinhole[:2, 2]
    np.testing.assert_allclose(actual, camera.img_from_cam(rays), atol=1e-10)
    np.testing.assert_allclose(camera.cam_from_img(actual), rays[:, :2], atol=1e-6)


def test_a_lens_without_distortion_changes_no_bit():
    undistorter = Undistorter(Lens(), K, WIDTH, HEIGHT)
    assert undistorter.valid.all()
    np.testing.assert_array_equal(undistorter.image(photo(3)), photo(3))


def test_a_fisheye_fills_the_pinhole():
    """A pinhole of the same focal length sees less than the fisheye."""
    assert Undistorter(Lens(fisheye=True), K, WIDTH, HEIGHT).valid.all()
    x, y, valid = Lens(fisheye=True).distort(np.array([1e9, 0.0]), np.array([0.0, 0.0]))
    np.testing.assert_allclose([x, y], [[np.pi / 2, 0.0], [0.0, 0.0]], atol=1e-8)
    assert valid.all()


def test_pixels_outside_the_photo_are_masked_and_black():
    """Pincushion distortion moves the corners out of the photo."""
    undistorter = Undistorter(Lens(radial=(0.3,)), K, WIDTH, HEIGHT)
    out = undistorter.image(np.full((HEIGHT, WIDTH, 3), 200, dtype=np.uint8))
    assert not undistorter.valid[0, 0]
    assert undistorter.valid[HEIGHT // 2, WIDTH // 2]
    np.testing.assert_array_equal(out[..., 0], np.where(undistorter.valid, 200, 0))


FOLDED = [Lens(radial=(-1.5,)), Lens(fisheye=True, radial=(-0.5, 0.0, 0.0, 0.0))]
FOLDED += [Lens(radial=(0.0,), denominator=(-0.9,)), Lens(tangential=(0.0, 0.4))]


@pytest.mark.parametrize("lens", FOLDED)
def test_rays_beyond_the_fold_are_masked(lens):
    """Beyond the fold, two rays share a pixel; only the inner one may be used."""
    r = np.linspace(0.0, 5.0, 2001)
    for angle in np.linspace(0.0, 2.0 * np.pi, 9):
        x, y, valid = lens.distort(r * np.cos(angle), r * np.sin(angle))
        first_out = len(r) if valid.all() else int(np.argmin(valid))
        along = (x * np.cos(angle) + y * np.sin(angle))[:first_out]
        assert first_out > 50
        assert (np.diff(along) > 0.0).all()
    assert not lens.distort(np.array([-5.0, 5.0]), np.zeros(2))[2].all()


def test_transparent_pixels_lend_no_color():
    image = np.zeros((HEIGHT, WIDTH, 4), dtype=np.uint8)
    image[:, : WIDTH // 2] = (200, 100, 50, 255)
    image[:, WIDTH // 2 :] = (0, 255, 0, 0)
    out = Undistorter(Lens(radial=(-0.2,)), K, WIDTH, HEIGHT).image(image)
    assert ((out[..., 3] > 0) & (out[..., 3] < 255)).any()
    assert np.abs(out[out[..., 3] > 8][:, :3].astype(int) - [200, 100, 50]).max() <= 1


def test_pixels_that_mix_masked_ones_are_masked():
    mask = np.ones((HEIGHT, WIDTH), dtype=bool)
    mask[10:20, 30:40] = False
    image = np.where(mask[..., None], 255, 0).astype(np.uint8).repeat(3, axis=2)
    undistorter = Undistorter(Lens(radial=(-0.2,)), K, WIDTH, HEIGHT)
    out = undistorter.mask(mask)
    assert 0 < (~out).sum() < 300
    assert (undistorter.image(image)[out] >= 254).all()


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 7), (7, 1)])
def test_thin_photos(width, height):
    image = photo(0, width, height)
    K = np.array([[5.0, 0.0, width / 2], [0.0, 5.0, height / 2], [0.0, 0.0, 1.0]])
    undistorter = Undistorter(Lens(radial=(-0.01,)), K, width, height)
    middle = height // 2, width // 2
    np.testing.assert_array_equal(undistorter.image(image)[middle], image[middle])


@pytest.mark.parametrize("k1", [-1e300, 1e300])
def test_absurd_coefficients_are_refused(k1):
    K_off = K.copy()
    K_off[0, 2] = 1000.0
    with pytest.raises(IgsrError, match="leaves no pixel"):
        Undistorter(Lens(radial=(k1, 1e300)), K_off, WIDTH, HEIGHT)
