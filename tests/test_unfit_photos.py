"""Folders that vary: bursts, blurred photos, screenshots, and what all of them do to a split."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import textured_room as room
from PIL import Image, ImageDraw, ImageFilter
from scenes import capture as ball_capture

import igsr
from igsr.capture import Camera, Capture, View
from igsr.capture.photo_checks import check_photos, is_screenshot, split_unfit
from igsr.capture.photo_folder import Photo, load_photos
from igsr.capture.sharpness import blur, blurred_photos
from igsr.capture.types import intrinsic_matrix
from igsr.errors import IgsrError

SIZE = (240, 180)
K = intrinsic_matrix(200.0, 200.0, 120.0, 90.0)


@pytest.fixture(scope="module")
def photos() -> list[Photo]:
    return [
        Photo(f"{index}.jpg", room.photo(viewmat, SIZE, room.pinhole(K), 1), device="phone")
        for index, viewmat in enumerate(room.stands(8))
    ]


def moved(photo: Photo, name: str, pixels: int, noise: float = 2.0) -> Photo:
    """The next of a burst: moved by some pixels, with noise of its own."""
    random = np.random.default_rng(len(name))
    image = np.roll(photo.image, pixels, axis=1) + random.normal(0.0, noise, photo.image.shape)
    return replace(photo, name=name, image=np.clip(image, 0, 255).astype(np.uint8))


def blurred(photo: Photo, name: str, radius: float = 4.0) -> Photo:
    image = Image.fromarray(photo.image).filter(ImageFilter.GaussianBlur(radius))
    return replace(photo, name=name, image=np.asarray(image))


def screenshot(name: str, seed: int = 0) -> Photo:
    """Bars and lines of text on a page, of another kind for each seed."""
    image = Image.new("RGB", SIZE, (250, 250, 252))
    draw = ImageDraw.Draw(image)
    random = np.random.default_rng(seed)
    draw.rectangle((0, 0, SIZE[0], 14), fill=(30, 80, 160))
    for line in range(11):
        x = 10
        while x < SIZE[0] - 30:
            width = int(random.integers(4, 20))
            draw.rectangle((x, 22 + 14 * line, x + width, 29 + 14 * line), fill=(40, 40, 40))
            x += width + 4
    return Photo(name, np.asarray(image))


def test_photos_of_one_scene_stay(photos: list[Photo]) -> None:
    assert split_unfit(photos) == (photos, [])
    # A step to the side is a photo of its own, and so are other devices' photos.
    stepped = [*photos, moved(photos[0], "step.jpg", 5)]
    assert split_unfit(stepped) == (stepped, [])


def test_of_a_burst_the_sharpest_stays(photos: list[Photo]) -> None:
    burst = [blurred(photos[2], "a.jpg", 1.0), moved(photos[2], "b.jpg", 0), *photos]
    kept, sentences = split_unfit(burst)
    best = {photo.name for photo in kept} & {"a.jpg", "b.jpg", "2.jpg"}
    assert len(best) == 1
    assert best != {"a.jpg"}
    assert len(kept) == 8
    assert len(sentences) == 1
    assert "the same view as" in sentences[0]
    # Two phones at one place are two photos: their lenses differ.
    other = replace(burst[1], device="another")
    assert len(split_unfit([*photos, other])[0]) == 9


def test_screenshots_are_named(photos: list[Photo]) -> None:
    kept, sentences = split_unfit([*photos, screenshot("IMG_7.png")])
    assert [photo.name for photo in kept] == [photo.name for photo in photos]
    assert sentences == ["IMG_7.png: left out, a screenshot and no photo."]
    # One that shows a picture is told by its name or its EXIF, among photos.
    game = replace(photos[3], device=None)
    for one in (
        replace(game, name="Screenshot_2024-01-02.png"),
        replace(photos[3], name="3x.jpg", screenshot=True),
    ):
        kept, sentences = split_unfit([*photos[:3], *photos[4:], one])
        assert len(kept) == 7
        assert sentences == [f"{one.name}: left out, a screenshot and no photo."]
    # Where all are, they may be views of a game: they are taken.
    views = [replace(photo, name=f"Screenshot {photo.name}", device=None) for photo in photos]
    assert split_unfit(views) == (views, [])


def test_what_is_no_screenshot(photos: list[Photo]) -> None:
    # An object before white, with a little noise, and a photo with black bars.
    image = np.full((180, 240, 3), 255, dtype=np.uint8)
    image[50:130, 80:160] = photos[0].image[50:130, 80:160]
    random = np.random.default_rng(0)
    noisy = np.clip(image - random.integers(0, 4, image.shape), 0, 255).astype(np.uint8)
    barred = photos[1].image.copy()
    barred[:20] = barred[-20:] = 0
    for pixels in (image, noisy, barred, photos[2].image, np.zeros_like(image)):
        assert not is_screenshot(Photo("a.png", pixels))
    assert is_screenshot(screenshot("a.png"))
    assert not is_screenshot(replace(screenshot("a.png"), device="camera"))


def test_a_folder_of_screenshots_is_an_error(tmp_path: Path, photos: list[Photo]) -> None:
    for index in range(4):
        Image.fromarray(screenshot("", index).image).save(tmp_path / f"{index}.png")
    with pytest.raises(IgsrError, match=r"0 is left .*0\.png, 1\.png, 2\.png and 1 more: .*screen"):
        igsr.estimate_poses(tmp_path, "colmap")
    # One photo among them does not make two.
    Image.fromarray(photos[0].image).save(tmp_path / "photo.png")
    with pytest.raises(IgsrError, match=r"2 photos at least, and 1 is left"):
        igsr.estimate_poses(tmp_path, "colmap")


def test_exif_says_that_it_is_a_screenshot(tmp_path: Path, photos: list[Photo]) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0x9286] = b"ASCII\0\0\0Screenshot"
    Image.fromarray(photos[0].image).save(tmp_path / "a.jpg", exif=exif)
    exif.get_ifd(0x8769)[0x9286] = b"ASCII\0\0\0A screenshot of nothing"
    Image.fromarray(photos[1].image).save(tmp_path / "b.jpg", exif=exif)
    assert [photo.screenshot for photo in load_photos(tmp_path)] == [True, False]


def test_portrait_landscape_heic_and_two_phones(tmp_path: Path, photos: list[Photo]) -> None:
    import pillow_heif

    pillow_heif.register_heif_opener()
    for index, suffix in enumerate((".jpg", ".heic", ".jpg", ".png")):
        exif = Image.Exif()
        exif[0x0110] = ("one", "other")[index % 2]
        exif[0x0112] = 6 if index == 2 and suffix == ".jpg" else 1
        Image.fromarray(photos[index].image).save(tmp_path / f"{index}{suffix}", exif=exif)
    loaded = load_photos(tmp_path)
    assert [photo.image.shape[:2] for photo in loaded] == [(180, 240)] * 2 + [
        (240, 180),
        (180, 240),
    ]
    assert [photo.device for photo in loaded] == ["one", "other", "one", "other"]
    assert len(split_unfit(loaded)[0]) == 4


def test_blur_is_seen_whatever_is_shown(photos: list[Photo]) -> None:
    grainy = [moved(photo, photo.name, 0, 12.0) for photo in photos]
    sharp = [blur(photo.image) for photo in grainy]
    for photo, value in zip(grainy, sharp, strict=True):
        assert blur(blurred(photo, "b", 2.0).image) > value + 0.1
    # A hand that moves blurs along one axis.
    image = grainy[0].image.astype(float)
    smeared = np.mean([np.roll(image, k, axis=1) for k in range(12)], axis=0).astype(np.uint8)
    assert blur(smeared) > sharp[0] + 0.2
    assert blur(np.full((40, 40, 3), 7, np.uint8)) == 1.0
    assert blur(photos[0].image[:5, :5]) == 0.0  # too small to say


def views_of(photos: list[Photo]) -> list[View]:
    camera = Camera(np.eye(4), K, *SIZE)
    return [View(photo.name, camera, "train", photo.image) for photo in photos]


def test_blurred_photos_are_reported_and_not_held_out(photos: list[Photo]) -> None:
    # Noise makes the painted walls as sharp as photos are.
    sharp = [moved(photo, photo.name, 0, 12.0) for photo in photos]
    bad = [
        blurred(photo, photo.name) if index in (0, 3) else photo
        for index, photo in enumerate(sharp)
    ]
    views = views_of(bad)
    assert blurred_photos((v.photo, v.image, v.mask) for v in views) == {"0.jpg", "3.jpg"}
    split = Capture(Path("photos"), views).with_holdout(4)
    assert [view.name for view in split.test_views] == ["1.jpg", "4.jpg"]
    usual = Capture(Path("photos"), views_of(sharp)).with_holdout(4)
    assert [view.name for view in usual.test_views] == ["0.jpg", "4.jpg"]
    with pytest.warns(UserWarning, match=r"0\.jpg, 3\.jpg: blurred; leave"):
        check_photos(views)
    # Where all are alike, none stands out, and one is held out.
    soft = views_of([blurred(photo, photo.name) for photo in sharp])
    assert not blurred_photos((v.photo, v.image, v.mask) for v in soft)


def test_a_good_capture_is_not_talked_about() -> None:
    views = ball_capture().views
    assert not blurred_photos((view.photo, view.image, view.mask) for view in views)
