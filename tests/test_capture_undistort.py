"""Undistortion against COLMAP's own projection, and its masks."""

from __future__ import annotations

from pathlib import Path

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


def colmap_camera(model: str, scale: int = 1) -> pycolmap.Camera:
    camera = pycolmap.Camera.create_from_model_name(1, model, 40.0, WIDTH, HEIGHT)
    camera.params = MODEL_PARAMS[model]
    camera.rescale(float(scale))
    return camera


def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth scene at infinity: float64 [..., 3] in 0 .. 255 for the ray (x, y, 1)."""
    # Steep enough (7 gray levels per pixel) that half a pixel of shift would show.
    waves = [np.sin(20.0 * x + 1.0), np.sin(18.0 * y + 2.0), np.sin(14.0 * (x + y))]
    return 127.5 + 120.0 * np.stack(waves, axis=-1)


def pixel_centers(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    return np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)


@pytest.mark.parametrize("model", MODEL_PARAMS)
def test_undistorted_photo_shows_what_a_pinhole_would(model: str, tmp_path: Path) -> None:
    """The photo is drawn through COLMAP's cam_from_img, which igsr never calls."""
    scale = 8
    camera = colmap_camera(model, scale)
    write_colmap(tmp_path, model)
    reconstruction = pycolmap.Reconstruction(tmp_path / "sparse/0")
    reconstruction.cameras[7].rescale(float(scale))
    reconstruction.write_binary(tmp_path / "sparse/0")
    width, height = camera.width, camera.height
    u, v = pixel_centers(width, height)
    rays = camera.cam_from_img(np.stack([u.ravel(), v.ravel()], axis=1))
    drawn = pattern(rays[:, 0], rays[:, 1]).reshape(height, width, 3)
    for index in range(3):
        save(tmp_path / f"images/{index}.png", np.rint(drawn).astype(np.uint8))

    view = load_capture(tmp_path).views[0]

    pinhole = view.camera.K
    np.testing.assert_allclose(pinhole, camera.calibration_matrix(), rtol=1e-12)
    expected = pattern((u - pinhole[0, 2]) / pinhole[0, 0], (v - pinhole[1, 2]) / pinhole[1, 1])
    mask = np.ones((height, width), dtype=bool) if view.mask is None else view.mask
    # The outermost half pixel of the photo is sampled by clamping, so it may lag by half a pixel.
    error = np.abs(view.image.astype(float) - expected)[mask]
    assert mask.mean() > 0.5
    assert np.quantile(error, 0.98) < 1.1  # 8-bit rounding twice, and bilinear interpolation
    assert error.max() < 6.0


@pytest.mark.parametrize("model", MODEL_PARAMS)
def test_lens_agrees_with_colmap_to_rounding(model: str, tmp_path: Path) -> None:
    camera = colmap_camera(model)
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-0.7, 0.7, (2, 500))
    expected = camera.img_from_cam(np.stack([x, y, np.ones_like(x)], axis=1))
    write_colmap(tmp_path, model)
    lens, pinhole = loaded_lens(tmp_path)
    xd, yd, valid = lens.distort(x, y)
    assert valid.all()
    actual = np.stack([pinhole[0, 0] * xd + pinhole[0, 2], pinhole[1, 1] * yd + pinhole[1, 2]], 1)
    np.testing.assert_allclose(actual, expected, atol=1e-10)
    np.testing.assert_allclose(camera.cam_from_img(actual), np.stack([x, y], axis=1), atol=1e-6)


def loaded_lens(folder: Path) -> tuple[Lens, np.ndarray]:
    K, lens = intrinsics(read_cameras(folder / "sparse/0/cameras.bin")[7])
    return lens, K


def test_straight_lens_changes_no_bit() -> None:
    image = photo(3)
    undistorter = Undistorter(Lens(), K, WIDTH, HEIGHT)
    assert undistorter.valid.all()
    np.testing.assert_array_equal(undistorter.image(image), image)


def test_fisheye_middle_is_kept_and_corners_reach_outward() -> None:
    """A pinhole of the same focal length sees less than the fisheye, so every pixel is filled."""
    undistorter = Undistorter(Lens(fisheye=True), K, WIDTH, HEIGHT)
    assert undistorter.valid.all()
    x, y, valid = Lens(fisheye=True).distort(np.array([1e9, 0.0]), np.array([0.0, 0.0]))
    np.testing.assert_allclose([x, y], [[np.pi / 2, 0.0], [0.0, 0.0]], atol=1e-8)
    assert valid.all()


def test_pixels_the_photo_does_not_cover_are_masked_and_black() -> None:
    """Pincushion distortion pushes the corners out of the photo."""
    undistorter = Undistorter(Lens(radial=(0.3,)), K, WIDTH, HEIGHT)
    image = np.full((HEIGHT, WIDTH, 3), 200, dtype=np.uint8)
    out = undistorter.image(image)
    assert not undistorter.valid[0, 0]
    assert undistorter.valid[HEIGHT // 2, WIDTH // 2]
    assert (out[undistorter.valid] == 200).all()
    assert (out[~undistorter.valid] == 0).all()


@pytest.mark.parametrize(
    "lens",
    [
        Lens(radial=(-1.5,)),
        Lens(fisheye=True, radial=(-0.5, 0.0, 0.0, 0.0)),
        Lens(radial=(0.0,), denominator=(-0.9,)),
        Lens(tangential=(0.0, 0.4)),
    ],
)
def test_rays_beyond_the_fold_are_masked(lens: Lens) -> None:
    """Where the model turns back, two rays share a pixel; only the inner one may be used."""
    r = np.linspace(0.0, 5.0, 2001)
    for angle in np.linspace(0.0, 2.0 * np.pi, 9):
        x, y, valid = lens.distort(r * np.cos(angle), r * np.sin(angle))
        first_out = len(r) if valid.all() else int(np.argmin(valid))
        along = (x * np.cos(angle) + y * np.sin(angle))[:first_out]
        assert first_out > 50
        assert (np.diff(along) > 0.0).all()
    assert not lens.distort(np.array([-5.0, 5.0]), np.zeros(2))[2].all()


def test_no_color_bleeds_from_transparent_pixels() -> None:
    image = np.zeros((HEIGHT, WIDTH, 4), dtype=np.uint8)
    image[:, : WIDTH // 2] = (200, 100, 50, 255)
    image[:, WIDTH // 2 :] = (0, 255, 0, 0)
    out = Undistorter(Lens(radial=(-0.2,)), K, WIDTH, HEIGHT).image(image)
    partly = (out[..., 3] > 0) & (out[..., 3] < 255)
    assert partly.any()
    assert np.abs(out[out[..., 3] > 8][:, :3].astype(int) - [200, 100, 50]).max() <= 1


def test_mask_travels_with_the_photo() -> None:
    """A pixel that mixes a masked one in is masked."""
    mask = np.ones((HEIGHT, WIDTH), dtype=bool)
    mask[10:20, 30:40] = False
    image = np.where(mask[..., None], 255, 0).astype(np.uint8).repeat(3, axis=2)
    undistorter = Undistorter(Lens(radial=(-0.2,)), K, WIDTH, HEIGHT)
    out = undistorter.mask(mask)
    assert 0 < (~out).sum() < 300
    assert (undistorter.image(image)[out] >= 254).all()


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 7), (7, 1)])
def test_thin_photos(width: int, height: int) -> None:
    image = photo(0, width, height)
    K = np.array([[5.0, 0.0, width / 2], [0.0, 5.0, height / 2], [0.0, 0.0, 1.0]])
    undistorter = Undistorter(Lens(radial=(-0.01,)), K, width, height)
    middle = height // 2, width // 2
    np.testing.assert_array_equal(undistorter.image(image)[middle], image[middle])


@pytest.mark.parametrize("k1", [-1e300, 1e300])
def test_absurd_coefficients_are_refused_or_masked(k1: float) -> None:
    K_off = K.copy()
    K_off[0, 2] = 1000.0
    with pytest.raises(IgsrError, match="leaves no pixel"):
        Undistorter(Lens(radial=(k1, 1e300)), K_off, WIDTH, HEIGHT)
