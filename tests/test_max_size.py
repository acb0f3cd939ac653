"""Photos loaded at a smaller size: pixels, cameras, masks, tracks."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from capture_files import HEIGHT, WIDTH, photo, save, write_colmap, write_json, write_transforms
from PIL import Image

from igsr.capture import Camera, View, load_capture
from igsr.capture.downscaling import area_means, plane_area_means, reduced_size, reduced_view
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
    weight = pixels[..., 3] * mask.astype(np.float64)
    opacity = rows @ weight @ columns.T
    color = np.stack([rows @ (pixels[..., k] * weight) @ columns.T for k in range(3)], axis=-1)
    image, kept = area_means(pixels, width, height, mask)
    assert np.abs(image[..., 3] - opacity / np.maximum(used, 1e-9)).max() < 0.5 + 1e-6
    seen = opacity > 1e-9
    exact_color = color[seen] / opacity[seen][:, None]
    assert np.abs(image[seen][:, :3] - exact_color).max() < 0.5 + 1e-6
    np.testing.assert_array_equal(kept, used > 1e-9)


def test_a_ramp_stays_the_same_ramp() -> None:
    # The mean of a linear function over an area is its value at the middle: centres stay centres.
    plane = np.add.outer(3.0 * (np.arange(HEIGHT) + 0.5), 2.0 * (np.arange(WIDTH) + 0.5))
    width, height = 16, 8
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
        at, then = ((camera.K @ points)[:2] / points[2] for camera in (before.camera, after.camera))
        np.testing.assert_allclose(then, at * scale, atol=1e-9)
        np.testing.assert_array_equal(after.camera.viewmat, before.camera.viewmat)
    for size in (WIDTH, 1000):
        assert load_capture(tmp_path, max_size=size) == whole


def test_jpegs_of_any_size_keep_their_places(tmp_path: Path) -> None:
    # Decoded at a half or a quarter, the last pixels lie partly beyond the photo.
    x, y = np.meshgrid(np.arange(403) + 0.5, np.arange(301) + 0.5)
    ramps = np.stack([x * 255 / 403, y * 255 / 301, 0.0 * x], axis=-1).astype(np.uint8)
    for name in ("a", "b"):
        Image.fromarray(ramps).save(tmp_path / f"{name}.jpg", quality=98, subsampling=0)
    for size in (200, 101, 64, 50, 25):
        image = load_photos(tmp_path, max_size=size)[0].image
        expected, _ = area_means(ramps, *reduced_size(403, 301, size))
        assert image.shape == expected.shape
        difference = image.astype(int) - expected
        assert np.abs(difference).max() <= 3
        assert np.abs(difference.mean(axis=(0, 1))).max() < 0.5


def test_masked_and_transparent_pixels_lend_no_color(tmp_path: Path) -> None:
    document = write_transforms(tmp_path, 1)
    document["frames"][0]["mask_path"] = "mask.png"
    write_json(tmp_path / "transforms.json", document)
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    mask[:, : WIDTH // 2 + 1] = 255
    pixels = np.where(mask[..., None] > 0, np.uint8(200), np.uint8(7)).repeat(3, axis=2)
    save(tmp_path / "mask.png", mask)
    save(tmp_path / "images/0.png", pixels)
    view = load_capture(tmp_path, max_size=WIDTH // 4).views[0]
    assert view.mask is not None
    assert view.mask.sum(axis=1).tolist() == [7] * (HEIGHT // 4)  # the 7th by a quarter
    assert (view.image[view.mask] == 200).all()
    save(tmp_path / "images/0.png", np.concatenate([pixels, mask[..., None]], axis=2))
    view = load_capture(tmp_path, max_size=WIDTH // 4).views[0]
    assert (view.image[view.mask][:, :3] == 200).all()


def test_lenses_are_undone_at_the_smaller_size(tmp_path: Path) -> None:
    write_transforms(tmp_path, k1=0.3, cx=22.0, p1=0.01)
    for index in range(3):
        save(tmp_path / f"images/{index}.png", np.full((HEIGHT, WIDTH, 3), 90, dtype=np.uint8))
    whole, small = load_capture(tmp_path), load_capture(tmp_path, max_size=WIDTH // 2)
    for before, after in zip(whole.views, small.views, strict=True):
        assert before.mask is not None
        assert after.mask is not None
        assert (after.image[after.mask] == 90).all()
        seen = area_means(before.image, WIDTH // 2, HEIGHT // 2, before.mask)[1]
        assert (seen != after.mask).mean() < 0.05  # but for the border


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV"])
def test_tracks_scale_per_axis(tmp_path: Path, model: str) -> None:
    write_colmap(tmp_path, model, viewmats=np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (3, 1, 1)))
    whole, small = load_capture(tmp_path).points, load_capture(tmp_path, max_size=31).points
    assert whole is not None
    assert small is not None
    assert whole.tracks is not None
    assert small.tracks is not None
    scale = [31 / WIDTH, 21 / HEIGHT]
    np.testing.assert_allclose(small.tracks.xy, whole.tracks.xy * scale, atol=1e-12)
    np.testing.assert_array_equal(small.xyz, whole.xyz)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_turned_photos_and_their_masks(tmp_path: Path, orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769)[0xA405] = 26
    for name in ("a", "b"):
        Image.fromarray(photo(1)).save(tmp_path / f"{name}.png", exif=exif)
    whole = load_photos(tmp_path)[0]
    mask = np.zeros(whole.image.shape[:2], dtype=np.uint8)
    mask[:10, :20] = 255
    save(tmp_path / "masks/a.png", mask)
    small, plain = load_photos(tmp_path, max_size=24)
    size = reduced_size(whole.image.shape[1], whole.image.shape[0], 24)
    image, kept = area_means(whole.image, *size, mask > 0)
    np.testing.assert_array_equal(small.image, image)
    np.testing.assert_array_equal(small.mask, kept)
    np.testing.assert_array_equal(plain.image, area_means(whole.image, *size)[0])
    assert small.taken == small.full_size == whole.full_size == whole.image.shape[1::-1]
    assert whole.taken is None
    assert whole.focal is not None
    assert plain.focal == pytest.approx(whole.focal * 24 / WIDTH)


def test_photos_of_different_sizes_and_odd_ones(tmp_path: Path) -> None:
    save(tmp_path / "a.png", photo(1))
    save(tmp_path / "b.png", photo(2, WIDTH + 1, HEIGHT))
    save(tmp_path / "c.png", photo(3, 1, 1))
    save(tmp_path / "d.png", np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8))
    whole = load_photos(tmp_path, max_size=1000)
    assert [one.image.shape[1::-1] for one in whole] == [(48, 32), (49, 32), (1, 1), (48, 32)]
    small = load_photos(tmp_path, max_size=24)
    assert [one.image.shape[1::-1] for one in small] == [(24, 16), (24, 16), (1, 1), (24, 16)]
    assert not small[3].image.any()
    assert {one.image.shape for one in load_photos(tmp_path, max_size=1)} == {(1, 1, 3)}


@pytest.mark.parametrize("size", [0, -3, 2.5, True, "big"])
def test_what_is_no_size(tmp_path: Path, size: object) -> None:
    write_transforms(tmp_path)
    for load in (load_capture, load_photos):
        with pytest.raises(IgsrError, match=r"max_size is .*; give the longest side in pixels"):
            load(tmp_path, max_size=size)


def reduced_folder(
    capture: Path, factor: int, rounding: int = 0, names: str = "{}.png", value: int | None = None
) -> None:
    """Write ``images_K`` beside a model, with photos of one grey each: K, or as given."""
    width, height = WIDTH // factor + rounding, HEIGHT // factor + rounding
    for index in range(3):
        grey = np.full((height, width, 3), factor if value is None else value, dtype=np.uint8)
        save(capture / f"images_{factor}" / names.format(index), grey)


def test_a_model_takes_the_smallest_photos_that_are_large_enough(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    full = load_capture(tmp_path)
    for factor in (2, 4):
        reduced_folder(tmp_path, factor)
    for size, width, factor in ((None, 48, 0), (25, 25, 0), (24, 24, 2), (13, 13, 2), (12, 12, 4)):
        capture = load_capture(tmp_path, max_size=size)
        view = capture.views[0]
        assert view.name == "images/0.png", "photos keep their names at every size"
        assert view.camera.width == width
        if factor:
            assert (view.image == factor).all()
        scale = np.array([[width / WIDTH], [view.camera.height / HEIGHT], [1.0]])
        np.testing.assert_allclose(view.camera.K, full.views[0].camera.K * scale, atol=1e-12)
        assert capture.points is not None
        assert full.points is not None
        assert capture.points.tracks is not None
        assert full.points.tracks is not None
        np.testing.assert_allclose(
            capture.points.tracks.xy, full.points.tracks.xy * scale[:2, 0], atol=1e-12
        )
    view = load_capture(tmp_path / "images_4").views[0]
    assert (view.camera.width, view.image[0, 0, 0]) == (12, 4)
    assert load_capture(tmp_path / "images_4", max_size=6).views[0].camera.width == 6
    assert load_capture(tmp_path / "images") == full


def test_a_model_whose_full_photos_are_missing(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    for factor in (2, 4):
        reduced_folder(tmp_path, factor)
    shutil.rmtree(tmp_path / "images")
    assert load_capture(tmp_path).views[0].camera.width == 24
    assert load_capture(tmp_path, max_size=5).views[0].camera.width == 5
    (tmp_path / "images_2/1.png").unlink()
    assert load_capture(tmp_path).views[0].camera.width == 12, "the next that is complete"
    (tmp_path / "images_4/1.png").unlink()
    with pytest.raises(IgsrError, match=r"images_2/1\.png is missing; put the photo there"):
        load_capture(tmp_path)


@pytest.mark.parametrize("rounding", [0, 1, -1])
def test_rounded_sizes_scale_exactly(tmp_path: Path, rounding: int) -> None:
    write_colmap(tmp_path)
    reduced_folder(tmp_path, 4, rounding)
    camera = load_capture(tmp_path / "images_4").views[0].camera
    full = load_capture(tmp_path).views[0].camera
    assert (camera.width, camera.height) == (12 + rounding, 8 + rounding)
    np.testing.assert_allclose(
        camera.K[0] / full.K[0].clip(1e-9), (12 + rounding) / 48 * (full.K[0] > 0)
    )
    np.testing.assert_allclose(camera.K[1, 1:] / full.K[1, 1:], (8 + rounding) / 32)


def test_photos_that_are_really_of_another_size(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    reduced_folder(tmp_path, 4, 2)
    with pytest.raises(IgsrError, match=r"is 14x10 pixels but .* is 48x32, and images_4 says"):
        load_capture(tmp_path / "images_4")
    save(tmp_path / "images/0.png", photo(0, WIDTH - 1, HEIGHT))
    with pytest.raises(IgsrError, match=r"is 47x32 pixels but its camera .* is 48x32; resize"):
        load_capture(tmp_path)


def test_reduced_photos_of_other_names(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    reduced_folder(tmp_path, 2, names="{}.jpg")
    assert (load_capture(tmp_path, max_size=24).views[2].image == 2).all()
    # As LLFF numbers them anew.
    for index in range(3):
        grey = np.full((HEIGHT // 4, WIDTH // 4, 3), 60 + index, dtype=np.uint8)
        save(tmp_path / f"images_4/image{index:03d}.png", grey)
    views = load_capture(tmp_path, max_size=12).views
    assert [int(view.image[0, 0, 0]) for view in views] == [60, 61, 62]
    (tmp_path / "images_4/image002.png").unlink()
    assert (load_capture(tmp_path, max_size=12).views[0].image == 2).all(), "images_2 is complete"
    with pytest.raises(IgsrError, match=r"images_4/0\.png is missing"):
        load_capture(tmp_path / "images_4")


def test_masks_of_reduced_photos(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    reduced_folder(tmp_path, 2)
    mask = np.full((HEIGHT, WIDTH), 255, dtype=np.uint8)
    mask[0, 0] = 0
    save(tmp_path / "masks/0.png.png", mask)
    view = load_capture(tmp_path, max_size=24).views[0]
    assert view.mask is not None
    assert np.argwhere(~view.mask).tolist() == [[0, 0]]
    save(tmp_path / "masks_2/0.png.png", np.full((HEIGHT // 2, WIDTH // 2), 255, dtype=np.uint8))
    view = load_capture(tmp_path, max_size=24).views[0]
    assert view.mask is None or view.mask.all()
    save(tmp_path / "masks_2/0.png.png", np.full((4, 4), 255, dtype=np.uint8))
    with pytest.raises(IgsrError, match=r"masks_2/0\.png\.png is 4x4 pixels"):
        load_capture(tmp_path, max_size=24)


def test_a_fit_takes_odd_photos_among_good_ones() -> None:
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
    with pytest.warns(UserWarning, match=r"black\.png: black or wholly transparent"):
        splats = scenes.fit(
            replace(capture, views=capture.views + odd),
            steps=10,
            max_splats=200,
            backend="cpu",
            start="random",
        )
    assert splats.finite.all()
