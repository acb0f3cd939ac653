"""Checks of cameras, views and points; splits and sizes of captures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from capture_files import assert_refused, random_viewmats

from igsr.capture import Camera, Capture, Points, PseudoView, View
from igsr.capture.types import Tracks
from igsr.errors import IgsrError

K = np.array([[40.0, 0.0, 23.0], [0.0, 42.0, 17.0], [0.0, 0.0, 1.0]])


def changed(matrix, row, column, value):
    matrix = matrix.copy()
    matrix[row, column] = value
    return matrix


def capture(names, centers=None):
    views = []
    for index, name in enumerate(names):
        viewmat = np.eye(4)
        viewmat[:3, 3] = 0.0 if centers is None else -centers[index]
        image = np.full((2, 3, 3), index, dtype=np.uint8)
        views.append(View(name, Camera(viewmat, K, 3, 2), "train", image))
    return Capture(Path("capture"), views)


def test_camera_keeps_its_fields_and_has_a_center():
    viewmat = random_viewmats(1)[0]
    camera = Camera(viewmat, K, 48, 32)
    np.testing.assert_allclose(camera.viewmat, viewmat, atol=1e-14)
    np.testing.assert_array_equal(camera.K, K)
    np.testing.assert_allclose(viewmat @ np.append(camera.center, 1.0), [0, 0, 0, 1], atol=1e-12)
    # A rounded rotation becomes exact.
    rounded = np.round(viewmat, 4)
    rotation = Camera(rounded, K, 48, 32).viewmat[:3, :3]
    assert np.abs(rounded[:3, :3] @ rounded[:3, :3].T - np.eye(3)).max() > 1e-6
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rotation, rounded[:3, :3], atol=2e-4)


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("viewmat", np.eye(3), "viewmat has shape"),
        ("viewmat", changed(np.eye(4), 0, 3, np.nan), "viewmat .*NaN"),
        ("viewmat", changed(np.eye(4), 1, 1, np.inf), "viewmat .*infinite"),
        ("viewmat", np.diag([2.0, 2.0, 2.0, 1.0]), "divide its 3x3 block by the uniform scale 2"),
        ("viewmat", changed(np.eye(4), 0, 1, 0.1), "viewmat is not rigid"),
        ("viewmat", np.diag([0.0, 0.0, 0.0, 1.0]), "viewmat is not rigid"),
        ("viewmat", np.diag([1e200, 1.0, 1.0, 1.0]), "viewmat is not rigid"),
        ("viewmat", np.diag([-1.0, 1.0, 1.0, 1.0]), "viewmat is a reflection"),
        ("viewmat", changed(np.eye(4), 3, 0, 0.5), r"viewmat .*\[0, 0, 0, 1\]"),
        ("viewmat", "no matrix", "viewmat is not a matrix of numbers"),
        ("K", np.eye(4), "K has shape"),
        ("K", changed(K, 0, 0, 0.0), "fx is 0 pixels.*singular"),
        ("K", changed(K, 1, 1, -3.0), "fy is -3 pixels.*singular"),
        ("K", changed(K, 0, 0, np.nan), "fx is nan"),
        ("K", changed(K, 0, 2, np.inf), "cx is inf"),
        ("K", changed(K, 0, 1, 0.5), "skew"),
        ("K", changed(K, 2, 2, 2.0), "K is not of the form"),
        ("K", [[1.0], [2.0, 3.0]], "K is not a matrix of numbers"),
        *(("width", width, "width is") for width in (0, -1, 2.5, True, "48")),
    ],
)
def test_bad_cameras_are_refused(field, value, words):
    with pytest.raises(IgsrError, match=words):
        Camera(**{"viewmat": np.eye(4), "K": K, "width": 48, "height": 32, field: value})


@pytest.mark.parametrize(
    ("image", "mask", "words"),
    [
        (np.zeros((3, 2, 3), dtype=np.uint8), None, "image is uint8"),
        (np.zeros((2, 3), dtype=np.uint8), None, "image is uint8"),
        (np.zeros((2, 3, 3), dtype=np.float32), None, "image is float32"),
        ([[0, 0, 0]], None, "image is a list"),
        (np.zeros((2, 3, 4), dtype=np.uint8), np.ones((2, 3), dtype=np.uint8), "mask is uint8"),
        (np.zeros((2, 3, 4), dtype=np.uint8), np.ones((2, 2), dtype=bool), "mask is bool"),
    ],
)
def test_pixels_must_match_the_camera(image, mask, words):
    with pytest.raises(IgsrError, match=rf"a\.png: its {words}"):
        View("a.png", Camera(np.eye(4), K, 3, 2), "train", image, mask)


def test_a_background_is_a_color_behind_an_image_without_alpha():
    camera = Camera(np.eye(4), np.eye(3), 3, 2)

    def view(background, channels=3):
        image = np.zeros((2, 3, channels), np.uint8)
        weights = np.ones((2, 3), np.float32)
        return PseudoView("a.png", camera, "train", image, weights=weights, background=background)

    assert view((0.0, 0.5, 1.0)).background == (0.0, 0.5, 1.0)
    for background in ((0.0, 0.5), (0.0, 0.5, 1.5), (0.0, np.nan, 1.0)):
        assert_refused(r"a.png: its background must be three numbers in \[0", view, background)
    with pytest.raises(IgsrError, match=r"a.png: only an image without alpha has a background"):
        view((1.0, 1.0, 1.0), channels=4)


def test_holdout_is_by_name_and_keeps_the_order():
    names = [f"{index:02d}.png" for index in (9, 3, 8, 0, 1, 2, 4, 5, 6, 7)]
    whole = capture(names)
    split = whole.with_holdout(4)
    assert [view.name for view in split.views] == names
    assert sorted(view.name for view in split.test_views) == ["00.png", "04.png", "08.png"]
    assert len(split.train_views) == 7
    assert split.views[0].image is whole.views[0].image
    assert not whole.test_views
    for every in (0, 1, -8, 2.5, True):
        assert_refused("holdout is", whole.with_holdout, every)
    with pytest.raises(IgsrError, match="one photo only"):
        capture(["a"]).with_holdout(8)


def test_copies_of_a_photo_are_held_out_together():
    whole = capture([f"{index}.png" for index in range(6)])
    views = [
        replace(view, image=whole.views[0].image) if view.name == "5.png" else view
        for view in whole.views
    ]
    split = Capture(whole.path, views).with_holdout(4)
    assert [view.name for view in split.test_views] == ["0.png", "4.png", "5.png"]


def test_extent_of_the_training_cameras():
    whole = capture(["a", "b", "c"], np.array([[0.0, 0, 0], [2.0, 0, 0], [100.0, 0, 0]]))
    whole.views[2].split = "test"
    np.testing.assert_allclose(whole.scene_center, [1.0, 0.0, 0.0])
    assert whole.scene_extent == pytest.approx(1.1)
    assert capture(["a", "b"], np.ones((2, 3))).scene_extent == 1.0


@pytest.mark.parametrize(
    ("confidence", "words"),
    [
        ([1.0, 2.0], r"shape \[2\]; give \[3\]"),
        ([[1.0], [2.0], [3.0]], "shape"),
        *(([1.0, bad, 2.0], "not positive and finite") for bad in (0.0, np.nan, np.inf)),
        (["high", "low", "low"], "not a list of numbers"),
    ],
)
def test_bad_confidences_are_refused(confidence, words):
    with pytest.raises(IgsrError, match=f"^confidence .*{words}"):
        Points(np.zeros((3, 3)), np.zeros((3, 3), dtype=np.uint8), confidence)


@pytest.mark.parametrize(
    ("view", "point", "xy", "words"),
    [
        ([0, 1], [0], [[1.0, 2.0]] * 2, "lists of one length"),
        ([0], [0], [[1.0]], "two finite numbers"),
        ([0], [0], [[1.0, np.inf]], "two finite numbers"),
        ([2], [0], [[1.0, 2.0]], "index without a name"),
        ([-1], [0], [[1.0, 2.0]], "index without a name"),
        ([0], [3], [[1.0, 2.0]], "index without a point"),
        ([0], [-1], [[1.0, 2.0]], "index without a point"),
    ],
)
def test_bad_tracks_are_refused(view, point, xy, words):
    arrays, gray = map(np.array, (view, point, xy)), np.zeros((3, 3), dtype=np.uint8)
    with pytest.raises(IgsrError, match=words):
        Points(np.zeros((3, 3)), gray, tracks=Tracks(["a", "b"], *arrays))
