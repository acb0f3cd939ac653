"""Photos that are left out or reported: screenshots, bursts, blur, and unsuitable cameras."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
import textured_room as room
from capture_files import assert_refused
from PIL import Image, ImageDraw, ImageFilter

import igsr
from igsr.capture import Camera, Capture, View
from igsr.capture.photo_checks import check_photos, is_screenshot, split_unfit
from igsr.capture.photo_folder import Photo, read_photos
from igsr.capture.sharpness import blur, blurred_photos
from igsr.capture.types import intrinsic_matrix

SIZE = (240, 180)
K = intrinsic_matrix(200.0, 200.0, 120.0, 90.0)


@pytest.fixture(scope="module")
def photos():
    return [
        Photo(f"{index}.jpg", room.photo(viewmat, SIZE, room.pinhole(K), 1), device="phone")
        for index, viewmat in enumerate(room.stands(8))
    ]


def moved(photo, name, pixels, noise=2.0):
    """The next photo of a burst: moved by some pixels, with its own noise."""
    random = np.random.default_rng(len(name))
    image = np.roll(photo.image, pixels, axis=1) + random.normal(0.0, noise, photo.image.shape)
    return replace(photo, name=name, image=np.clip(image, 0, 255).astype(np.uint8))


def blurred(photo, name, radius=4.0):
    image = Image.fromarray(photo.image).filter(ImageFilter.GaussianBlur(radius))
    return replace(photo, name=name, image=np.asarray(image))


def screenshot(name, seed=0):
    """Bars and lines of text on a page, different for each seed."""
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


# --- before cameras are found -------------------------------------------------------------------


def test_photos_of_one_scene_are_kept(photos):
    # A step to the side is another photo.
    for kept in (photos, [*photos, moved(photos[0], "step.jpg", 5)]):
        assert split_unfit(kept) == (kept, [])


def test_the_sharpest_photo_of_a_burst_is_kept(photos):
    burst = [blurred(photos[2], "a.jpg", 1.0), moved(photos[2], "b.jpg", 0), *photos]
    kept, (sentence,) = split_unfit(burst)
    best = {photo.name for photo in kept} & {"a.jpg", "b.jpg", "2.jpg"}
    assert best in ({"b.jpg"}, {"2.jpg"})
    assert len(kept) == 8
    assert "the same view as" in sentence
    # Photos of two phones from one place are kept: their lenses differ.
    assert len(split_unfit([*photos, replace(burst[1], device="another")])[0]) == 9


def test_screenshots_are_left_out(photos):
    game = replace(photos[3], device=None)
    # By its look, by its name, and by its EXIF.
    for shot in (
        screenshot("IMG_7.png"),
        replace(game, name="Screenshot_2024-01-02.png"),
        replace(photos[3], name="3x.jpg", screenshot=True),
    ):
        kept, sentences = split_unfit([*photos[:3], shot, *photos[4:]])
        assert kept == [*photos[:3], *photos[4:]]
        assert sentences == [f"{shot.name}: left out, a screenshot and no photo."]
    # A whole folder of them may show views of a game.
    views = [replace(photo, name=f"Screenshot {photo.name}", device=None) for photo in photos]
    assert split_unfit(views) == (views, [])


def test_other_pictures_are_no_screenshots(photos):
    on_white = np.full((180, 240, 3), 255, dtype=np.uint8)
    on_white[50:130, 80:160] = photos[0].image[50:130, 80:160]
    random = np.random.default_rng(0)
    noisy = np.clip(on_white - random.integers(0, 4, on_white.shape), 0, 255).astype(np.uint8)
    barred = photos[1].image.copy()
    barred[:20] = barred[-20:] = 0
    for pixels in (on_white, noisy, barred, photos[2].image, np.zeros_like(barred)):
        assert not is_screenshot(Photo("a.png", pixels))
    assert is_screenshot(screenshot("a.png"))
    assert not is_screenshot(replace(screenshot("a.png"), device="camera"))


def test_a_folder_of_screenshots_is_an_error(tmp_path, photos):
    for index in range(4):
        Image.fromarray(screenshot("", index).image).save(tmp_path / f"{index}.png")
    words = r"only 0 can be used: 0\.png, 1\.png, 2\.png, 3\.png: .*screen"
    assert_refused(words, igsr.find_cameras, tmp_path)
    Image.fromarray(photos[0].image).save(tmp_path / "photo.png")
    assert_refused("at least 2 photos, but only 1 can be used", igsr.find_cameras, tmp_path)


def test_exif_of_a_screenshot(tmp_path, photos):
    exif = Image.Exif()
    for index, comment in enumerate((b"Screenshot", b"A screenshot of nothing")):
        exif.get_ifd(0x8769)[0x9286] = b"ASCII\0\0\0" + comment
        Image.fromarray(photos[index].image).save(tmp_path / f"{index}.jpg", exif=exif)
    assert [photo.screenshot for photo in read_photos(tmp_path)] == [True, False]


# --- blur ---------------------------------------------------------------------------------------


def test_blur_is_measured_for_any_content(photos):
    grainy = [moved(photo, photo.name, 0, 12.0) for photo in photos]
    for photo in grainy:
        assert blur(blurred(photo, "b", 2.0).image) > blur(photo.image) + 0.1
    # A moving hand blurs along one axis.
    image = grainy[0].image.astype(float)
    smeared = np.mean([np.roll(image, k, axis=1) for k in range(12)], axis=0).astype(np.uint8)
    assert blur(smeared) > blur(grainy[0].image) + 0.2
    assert blur(np.full((40, 40, 3), 7, np.uint8)) == 1.0
    assert blur(photos[0].image[:5, :5]) == 0.0  # too small


def views_of(photos):
    camera = Camera(np.eye(4), K, *SIZE)
    return [View(photo.name, camera, "train", photo.image) for photo in photos]


def blurred_views(views):
    return blurred_photos((view.photo, view.image, view.mask) for view in views)


def test_blurred_photos_are_reported_and_not_held_out(photos):
    # Noise makes the painted walls as sharp as photos are.
    sharp = [moved(photo, photo.name, 0, 12.0) for photo in photos]
    mixed = [blurred(p, p.name) if index in (0, 3) else p for index, p in enumerate(sharp)]
    views = views_of(mixed)
    assert blurred_views(views) == {"0.jpg", "3.jpg"}
    for photos_here, held_out in ((mixed, ["1.jpg", "4.jpg"]), (sharp, ["0.jpg", "4.jpg"])):
        split = Capture(Path("photos"), views_of(photos_here)).with_holdout(4)
        assert [view.name for view in split.test_views] == held_out
    with pytest.warns(UserWarning, match=r"0\.jpg, 3\.jpg: blurred; leave"):
        check_photos(views)
    # If all photos are equally blurred, none is reported.
    assert not blurred_views(views_of([blurred(photo, photo.name) for photo in sharp]))
    assert not blurred_views(scenes.capture().views)


# --- before a fit -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def views():
    return scenes.capture(views=6, size=24).views


def turned_away(view, index):
    """The same photo from a camera that looks away from all others."""
    angle = 2.0 * np.pi * index / 3.0
    c, s = np.cos(angle), np.sin(angle)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]
    viewmat[:3, 3] = [0.0, 0.0, -1.0]  # its center lies one unit along its own axis
    return replace(view, camera=Camera(viewmat, view.camera.K, 24, 24), name=f"{index}.png")


def test_good_photos_are_not_reported(views):
    apart = [turned_away(views[k], k) for k in range(3)]
    K = views[2].camera.K * [[1.5], [1.5], [1.0]]
    zoomed = replace(views[2], camera=replace(views[2].camera, K=K), name="zoomed.png")
    outline = np.zeros((24, 24, 4), np.uint8)  # of a black object
    outline[8:, :, 3] = 255
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for good in (views, views[:2], [*views, zoomed], [*apart, *views]):
            check_photos(good)
        check_photos([replace(view, image=outline) for view in views])


def test_a_fit_of_one_photo_works(views):
    with pytest.warns(UserWarning, match="one photo only"):
        splats = scenes.fit(Capture("one", views[1:2]), steps=20, backend="cpu", max_splats=200)
    assert np.isfinite(splats.means).all()


def test_unsuitable_photos_are_reported(views):
    at_one_place = [replace(view, camera=views[0].camera) for view in views]
    apart = [turned_away(views[k], k) for k in range(3)]
    black = replace(views[0], image=np.zeros((24, 24, 3), np.uint8))
    for photos, words in (
        (at_one_place, "All cameras are at one place"),
        ([*views, replace(views[2], name="a.png")], r"02\.png, a\.png have the same camera"),
        (apart, "No two photos see anything in common"),
        ([black, *views[1:]], "black or fully transparent; leave"),
    ):
        with pytest.warns(UserWarning, match=words):
            check_photos(photos)


def test_empty_photos_are_refused(views):
    black, transparent = np.zeros((24, 24, 3), np.uint8), np.zeros((24, 24, 4), np.uint8)
    transparent[..., :3] = 255
    opaque = np.dstack([black, np.full((24, 24), 255, np.uint8)])
    for image in (black, transparent, opaque):
        photos = [replace(view, image=image) for view in views]
        assert_refused("Every photo is black or fully transparent", check_photos, photos)
    hidden = replace(views[1], mask=np.zeros((24, 24), bool))
    assert_refused(r"01\.png: its mask leaves no pixel", check_photos, [hidden, *views])
