"""Photos loaded at a smaller size: pixels, cameras, masks, tracks; reduced folders of photos."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
import scenes
from capture_files import HEIGHT, WIDTH, assert_refused, photo, save, write_colmap, write_transforms
from made_up_tracks import projected
from PIL import Image

from igsr.capture import Camera, View, load_capture
from igsr.capture.downscaling import (
    area_means,
    halved,
    plane_area_means,
    reduced_size,
    reduced_view,
)
from igsr.capture.photo_folder import read_photos
from igsr.errors import IgsrError

# --- the area filter ------------------------------------------------------------------------------


def coverage(pixels, count):
    """float64 [count, pixels]: the part of each pixel that each of ``count`` equal parts covers."""
    low = np.arange(count)[:, None] * pixels / count
    high = low + pixels / count
    pixel = np.arange(pixels)
    return np.clip(np.minimum(high, pixel + 1) - np.maximum(low, pixel), 0.0, None)


@pytest.mark.parametrize("size", [(24, 16), (16, 16), (3, 2), (1, 1), (48, 1), (1, 32), (48, 32)])
def test_whole_factors_are_block_means(size):
    width, height = size
    pixels = photo(1)
    blocks = pixels.reshape(height, HEIGHT // height, width, WIDTH // width, 3).astype(int)
    area = (HEIGHT // height) * (WIDTH // width)
    exact = (2 * blocks.sum(axis=(1, 3)) + area) // (2 * area)
    np.testing.assert_array_equal(area_means(pixels, width, height)[0], exact)


@pytest.mark.parametrize("size", [(47, 31), (31, 20), (11, 7), (7, 11), (47, 32), (5, 1)])
def test_other_factors_count_parts_of_pixels(size):
    width, height = size
    rows, columns = coverage(HEIGHT, height), coverage(WIDTH, width)
    plane = np.random.default_rng(0).random((HEIGHT, WIDTH))
    exact = rows @ plane @ columns.T / (WIDTH * HEIGHT / (width * height))
    np.testing.assert_allclose(plane_area_means(plane, width, height), exact, atol=1e-12)
    pixels, mask = photo(2, channels=4), photo(3)[..., 0] > 99
    used = rows @ mask @ columns.T
    weight = pixels[..., 3] * mask.astype(np.float64)
    opacity = rows @ weight @ columns.T
    color = np.stack([rows @ (pixels[..., k] * weight) @ columns.T for k in range(3)], axis=-1)
    image, kept = area_means(pixels, width, height, mask)
    assert np.abs(image[..., 3] - opacity / np.maximum(used, 1e-9)).max() < 0.5 + 1e-6
    seen = opacity > 1e-9
    exact_color = color[seen] / opacity[seen][:, None]
    assert np.abs(image[seen][:, :3] - exact_color).max() < 0.5 + 1e-6
    np.testing.assert_array_equal(kept, used > 1e-9)


def test_sizes():
    assert reduced_size(4000, 3000, 1000) == (1000, 750)
    assert reduced_size(3000, 4000, 1000) == (750, 1000)
    assert reduced_size(4000, 3000, 4000) == reduced_size(4000, 3000, 9000) == (4000, 3000)
    assert reduced_size(4000, 3, 100) == (100, 1)
    assert reduced_size(1, 1, 1) == (1, 1)
    assert reduced_size(100, 25, 50) == (50, 13)  # rounds halves up


@pytest.mark.parametrize("size", [0, -3, 2.5, True, "big"])
@pytest.mark.parametrize("load", [load_capture, read_photos])
def test_bad_sizes_are_refused(tmp_path, size, load):
    write_transforms(tmp_path)
    with pytest.raises(IgsrError, match=r"max_size is .*; give the longest side in pixels"):
        load(tmp_path, max_size=size)


# --- views ----------------------------------------------------------------------------------------


def view(image, mask=None):
    camera = scenes.ring_camera(0.3, size=image.shape[0])
    return View("a.png", camera, "train", image.astype(np.uint8), mask)


def test_halved_views_have_mean_pixels_and_the_same_projection():
    image = np.arange(7 * 7 * 3).reshape(7, 7, 3)
    half = halved(view(image))
    assert half.image.shape == (3, 3, 3)  # an odd edge is left out
    assert half.image[1, 2, 0] == round(image[2:4, 4:6, 0].mean() + 1e-9)
    point = np.array([[0.1, -0.2, 0.3]])
    small, full = (projected(v.camera, point) for v in (half, view(image)))
    assert np.allclose(small, full / 2.0)


def test_transparent_and_masked_pixels_of_halved_views_lend_no_color():
    image = np.zeros((4, 4, 4))
    image[0, 0] = (200, 100, 50, 255)
    image[0, 1] = (9, 9, 9, 0)
    assert halved(view(image)).image[0, 0].tolist() == [200, 100, 50, 64]
    mask = np.ones((4, 4), bool)
    mask[:2, :2] = [[True, False], [False, False]]
    mask[2:, 2:] = False
    image[0, 1] = (9, 9, 9, 255)
    half = halved(view(image, mask))
    assert half.image[0, 0].tolist() == [200, 100, 50, 255]
    assert half.mask.tolist() == [[True, True], [True, False]]


def test_a_fit_accepts_odd_photos():
    capture = scenes.capture(views=4, size=24)
    first = capture.views[0]
    K = first.camera.K.copy()
    K[:2] /= 24.0
    pixel = np.full((1, 1, 3), 90, dtype=np.uint8)
    odd = [
        View("one-pixel.png", Camera(first.camera.viewmat, K, 1, 1), "train", pixel),
        reduced_view(replace(first, name="wide.png"), 23, 24),
        replace(capture.views[1], name="black.png", image=np.zeros_like(first.image)),
    ]
    options = {"steps": 10, "max_splats": 200, "backend": "cpu", "start": "random"}
    with pytest.warns(UserWarning, match=r"black\.png: black or fully transparent"):
        splats = scenes.fit(replace(capture, views=capture.views + odd), **options)
    assert splats.finite.all()


# --- captures -------------------------------------------------------------------------------------


def test_a_reduced_capture_projects_to_the_same_places(tmp_path):
    write_transforms(tmp_path)
    whole, small = load_capture(tmp_path), load_capture(tmp_path, max_size=31)
    for before, after in zip(whole.views, small.views, strict=True):
        assert (after.camera.width, after.camera.height) == (31, 21)
        np.testing.assert_array_equal(after.image, area_means(before.image, 31, 21)[0])
        scale = [[31 / WIDTH], [21 / HEIGHT], [1.0]]
        np.testing.assert_allclose(after.camera.K, before.camera.K * scale, atol=1e-9)
        np.testing.assert_array_equal(after.camera.viewmat, before.camera.viewmat)
    for size in (WIDTH, 1000):
        assert load_capture(tmp_path, max_size=size) == whole


def test_masked_and_transparent_pixels_lend_no_color(tmp_path):
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    mask[:, : WIDTH // 2 + 1] = 255
    pixels = np.where(mask[..., None] > 0, np.uint8(200), np.uint8(7)).repeat(3, axis=2)
    save(tmp_path / "mask.png", mask)
    write_transforms(tmp_path, 1, {"mask_path": "mask.png"})
    for image in (pixels, np.concatenate([pixels, mask[..., None]], axis=2)):
        save(tmp_path / "images/0.png", image)
        view = load_capture(tmp_path, max_size=WIDTH // 4).views[0]
        assert view.mask.sum(axis=1).tolist() == [7] * (HEIGHT // 4)  # the 7th by a quarter
        assert (view.image[view.mask][:, :3] == 200).all()


def test_lenses_are_undistorted_at_the_smaller_size(tmp_path):
    write_transforms(tmp_path, 1, k1=0.3, cx=22.0, p1=0.01)
    save(tmp_path / "images/0.png", np.full((HEIGHT, WIDTH, 3), 90, dtype=np.uint8))
    before, after = (load_capture(tmp_path, size).views[0] for size in (None, WIDTH // 2))
    assert (after.image[after.mask] == 90).all()
    seen = area_means(before.image, WIDTH // 2, HEIGHT // 2, before.mask)[1]
    assert (seen != after.mask).mean() < 0.05  # except at the border


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV"])
def test_tracks_scale_per_axis(tmp_path, model):
    write_colmap(tmp_path, model, viewmats=np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (3, 1, 1)))
    whole, small = load_capture(tmp_path).points, load_capture(tmp_path, max_size=31).points
    scale = [31 / WIDTH, 21 / HEIGHT]
    np.testing.assert_allclose(small.tracks.xy, whole.tracks.xy * scale, atol=1e-12)
    np.testing.assert_array_equal(small.xyz, whole.xyz)


# --- photos without cameras -----------------------------------------------------------------------


def test_jpegs_of_any_size_keep_their_places(tmp_path):
    # Decoded at a half or a quarter, the last pixels lie partly outside the photo.
    x, y = np.meshgrid(np.arange(403) + 0.5, np.arange(301) + 0.5)
    ramps = np.stack([x * 255 / 403, y * 255 / 301, 0.0 * x], axis=-1).astype(np.uint8)
    for name in ("a", "b"):
        Image.fromarray(ramps).save(tmp_path / f"{name}.jpg", quality=98, subsampling=0)
    for size in (200, 101, 64, 50, 25):
        image = read_photos(tmp_path, max_size=size)[0].image
        expected, _ = area_means(ramps, *reduced_size(403, 301, size))
        assert image.shape == expected.shape
        difference = image.astype(int) - expected
        assert np.abs(difference).max() <= 3
        assert np.abs(difference.mean(axis=(0, 1))).max() < 0.5


@pytest.mark.parametrize("orientation", range(1, 9))
def test_turned_photos_and_their_masks(tmp_path, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769)[0xA405] = 26
    for name in ("a", "b"):
        Image.fromarray(photo(1)).save(tmp_path / f"{name}.png", exif=exif)
    whole = read_photos(tmp_path)[0]
    mask = np.zeros(whole.image.shape[:2], dtype=np.uint8)
    mask[:10, :20] = 255
    save(tmp_path / "masks/a.png", mask)
    small, plain = read_photos(tmp_path, max_size=24)
    size = reduced_size(whole.image.shape[1], whole.image.shape[0], 24)
    image, kept = area_means(whole.image, *size, mask > 0)
    np.testing.assert_array_equal(small.image, image)
    np.testing.assert_array_equal(small.mask, kept)
    np.testing.assert_array_equal(plain.image, area_means(whole.image, *size)[0])
    assert small.taken == small.full_size == whole.full_size == whole.image.shape[1::-1]
    assert whole.taken is None
    assert plain.focal == pytest.approx(whole.focal * 24 / WIDTH)


def test_photos_of_different_sizes(tmp_path):
    sizes = [(48, 32), (49, 32), (1, 1)]
    for index, size in enumerate(sizes):
        save(tmp_path / f"{index}.png", photo(index, *size))
    halves = [(24, 16), (24, 16), (1, 1)]
    for max_size, expected in ((1000, sizes), (24, halves), (1, [(1, 1)] * 3)):
        photos = read_photos(tmp_path, max_size=max_size)
        assert [photo.image.shape[1::-1] for photo in photos] == expected


# --- folders of reduced photos --------------------------------------------------------------------


def reduced_folder(capture, factor, rounding=0, names="{}.png", first=None):
    """Write ``images_K`` next to a model, with photos of one gray level: K, or from ``first``."""
    width, height = WIDTH // factor + rounding, HEIGHT // factor + rounding
    for index in range(3):
        level = factor if first is None else first + index
        pixels = np.full((height, width, 3), level, dtype=np.uint8)
        save(capture / f"images_{factor}" / names.format(index), pixels)


def test_a_model_uses_the_smallest_photos_that_are_large_enough(tmp_path):
    write_colmap(tmp_path)
    full = load_capture(tmp_path)
    for factor in (2, 4):
        reduced_folder(tmp_path, factor)
    for size, width, factor in ((None, 48, 0), (25, 25, 0), (24, 24, 2), (13, 13, 2), (12, 12, 4)):
        capture = load_capture(tmp_path, max_size=size)
        view = capture.views[0]
        assert view.name == "images/0.png"  # at every size
        assert view.camera.width == width
        assert not factor or (view.image == factor).all()
        scale = np.array([[width / WIDTH], [view.camera.height / HEIGHT], [1.0]])
        np.testing.assert_allclose(view.camera.K, full.views[0].camera.K * scale, atol=1e-12)
        expected = full.points.tracks.xy * scale[:2, 0]
        np.testing.assert_allclose(capture.points.tracks.xy, expected, atol=1e-12)
    view = load_capture(tmp_path / "images_4").views[0]
    assert (view.camera.width, view.image[0, 0, 0]) == (12, 4)
    assert load_capture(tmp_path / "images_4", max_size=6).views[0].camera.width == 6
    assert load_capture(tmp_path / "images") == full


def test_a_model_without_full_photos(tmp_path):
    write_colmap(tmp_path)
    for factor in (2, 4):
        reduced_folder(tmp_path, factor)
    shutil.rmtree(tmp_path / "images")
    assert load_capture(tmp_path).views[0].camera.width == 24
    assert load_capture(tmp_path, max_size=5).views[0].camera.width == 5
    (tmp_path / "images_2/1.png").unlink()
    assert load_capture(tmp_path).views[0].camera.width == 12  # the next complete folder
    (tmp_path / "images_4/1.png").unlink()
    assert_refused(r"images_2/1\.png is missing; put the photo there", load_capture, tmp_path)


def test_rounded_sizes_scale_exactly_and_others_are_refused(tmp_path):
    write_colmap(tmp_path)
    full = load_capture(tmp_path).views[0].camera.K
    for rounding in (0, 1, -1):
        reduced_folder(tmp_path, 4, rounding)
        camera = load_capture(tmp_path / "images_4").views[0].camera
        assert (camera.width, camera.height) == (12 + rounding, 8 + rounding)
        scale = [[camera.width / WIDTH], [camera.height / HEIGHT], [1.0]]
        np.testing.assert_allclose(camera.K, full * scale)
    reduced_folder(tmp_path, 4, 2)
    with pytest.raises(IgsrError, match=r"is 14x10 pixels but .* is 48x32, and images_4 says"):
        load_capture(tmp_path / "images_4")
    save(tmp_path / "images/0.png", photo(0, WIDTH - 1, HEIGHT))
    assert_refused(r"is 47x32 pixels but its camera .* is 48x32; resize", load_capture, tmp_path)


def test_reduced_photos_with_other_names(tmp_path):
    write_colmap(tmp_path)
    reduced_folder(tmp_path, 2, names="{}.jpg")
    assert (load_capture(tmp_path, max_size=24).views[2].image == 2).all()
    # As LLFF numbers them.
    reduced_folder(tmp_path, 4, names="image{:03d}.png", first=60)
    views = load_capture(tmp_path, max_size=12).views
    assert [int(view.image[0, 0, 0]) for view in views] == [60, 61, 62]
    (tmp_path / "images_4/image002.png").unlink()
    assert (load_capture(tmp_path, max_size=12).views[0].image == 2).all()  # of images_2
    assert_refused(r"images_4/0\.png is missing", load_capture, tmp_path / "images_4")


def test_masks_of_reduced_photos(tmp_path):
    write_colmap(tmp_path)
    reduced_folder(tmp_path, 2)
    mask = np.full((HEIGHT, WIDTH), 255, dtype=np.uint8)
    mask[0, 0] = 0
    save(tmp_path / "masks/0.png.png", mask)
    view = load_capture(tmp_path, max_size=24).views[0]
    assert np.argwhere(~view.mask).tolist() == [[0, 0]]
    save(tmp_path / "masks_2/0.png.png", np.full((HEIGHT // 2, WIDTH // 2), 255, dtype=np.uint8))
    view = load_capture(tmp_path, max_size=24).views[0]
    assert view.mask is None or view.mask.all()
    save(tmp_path / "masks_2/0.png.png", np.full((4, 4), 255, dtype=np.uint8))
    assert_refused(r"masks_2/0\.png\.png is 4x4 pixels", load_capture, tmp_path, max_size=24)
