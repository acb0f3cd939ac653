"""Cameras are checked when they are made; captures split and measure themselves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from capture_files import random_viewmats

from igsr.capture import Camera, Capture, Points, View
from igsr.capture.types import Tracks
from igsr.errors import IgsrError

K = np.array([[40.0, 0.0, 23.0], [0.0, 42.0, 17.0], [0.0, 0.0, 1.0]])


def changed(matrix: np.ndarray, row: int, column: int, value: float) -> np.ndarray:
    matrix = matrix.copy()
    matrix[row, column] = value
    return matrix


def capture(names: list[str], centers: np.ndarray | None = None) -> Capture:
    views = []
    for index, name in enumerate(names):
        viewmat = np.eye(4)
        if centers is not None:
            viewmat[:3, 3] = -centers[index]
        image = np.zeros((2, 3, 3), dtype=np.uint8)
        views.append(View(name, Camera(viewmat, K, 3, 2), "train", image))
    return Capture(Path("capture"), views)


def test_camera_keeps_what_it_is_given_and_knows_its_center() -> None:
    viewmat = random_viewmats(1)[0]
    camera = Camera(viewmat, K, 48, 32)
    np.testing.assert_allclose(camera.viewmat, viewmat, atol=1e-14)
    np.testing.assert_array_equal(camera.K, K)
    np.testing.assert_allclose(viewmat @ np.append(camera.center, 1.0), [0, 0, 0, 1], atol=1e-12)


def test_rounded_rotation_becomes_exact() -> None:
    viewmat = np.round(random_viewmats(1)[0], 4)
    rotation = Camera(viewmat, K, 48, 32).viewmat[:3, :3]
    assert np.abs(viewmat[:3, :3] @ viewmat[:3, :3].T - np.eye(3)).max() > 1e-6
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rotation, viewmat[:3, :3], atol=2e-4)


@pytest.mark.parametrize(
    ("viewmat", "words"),
    [
        (np.eye(3), "shape"),
        (changed(np.eye(4), 0, 3, np.nan), "NaN"),
        (changed(np.eye(4), 1, 1, np.inf), "infinite"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "divide its 3x3 block by the uniform scale 2"),
        (changed(np.eye(4), 0, 1, 0.1), "not rigid"),
        (np.diag([0.0, 0.0, 0.0, 1.0]), "not rigid"),
        (np.diag([1e200, 1.0, 1.0, 1.0]), "not rigid"),
        (np.diag([-1.0, 1.0, 1.0, 1.0]), "reflection"),
        (changed(np.eye(4), 3, 0, 0.5), r"\[0, 0, 0, 1\]"),
        ("no matrix", "numbers"),
    ],
)
def test_bad_viewmat_is_named(viewmat: np.ndarray, words: str) -> None:
    with pytest.raises(IgsrError, match=f"viewmat.*{words}"):
        Camera(viewmat, K, 48, 32)


@pytest.mark.parametrize(
    ("intrinsics", "words"),
    [
        (np.eye(4), "K has shape"),
        (changed(K, 0, 0, 0.0), "fx is 0 pixels.*singular"),
        (changed(K, 1, 1, -3.0), "fy is -3 pixels.*singular"),
        (changed(K, 0, 0, np.nan), "fx is nan"),
        (changed(K, 0, 2, np.inf), "cx is inf"),
        (changed(K, 0, 1, 0.5), "skew"),
        (changed(K, 2, 2, 2.0), "K is not of the form"),
        ([[1.0], [2.0, 3.0]], "K is not a matrix"),
    ],
)
def test_bad_intrinsics_are_named(intrinsics: np.ndarray, words: str) -> None:
    with pytest.raises(IgsrError, match=words):
        Camera(np.eye(4), intrinsics, 48, 32)


@pytest.mark.parametrize("width", [0, -1, 2.5, True, "48"])
def test_bad_width_is_named(width: object) -> None:
    with pytest.raises(IgsrError, match="width is"):
        Camera(np.eye(4), K, width, 32)  # type: ignore[arg-type]


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
def test_pixels_that_do_not_fit_the_camera_are_named(
    image: object, mask: object, words: str
) -> None:
    with pytest.raises(IgsrError, match=rf"a\.png: its {words}"):
        View("a.png", Camera(np.eye(4), K, 3, 2), "train", image, mask)  # type: ignore[arg-type]


def test_holdout_goes_by_name_and_keeps_the_order() -> None:
    names = [f"{index:02d}.png" for index in (9, 3, 8, 0, 1, 2, 4, 5, 6, 7)]
    whole = capture(names)
    split = whole.with_holdout(4)
    assert [view.name for view in split.views] == names
    assert sorted(view.name for view in split.test_views) == ["00.png", "04.png", "08.png"]
    assert len(split.train_views) == 7
    assert split.views[0].image is whole.views[0].image
    assert not whole.test_views


@pytest.mark.parametrize("every", [0, 1, -8, 2.5, True])
def test_bad_holdout_is_named(every: object) -> None:
    with pytest.raises(IgsrError, match="holdout is"):
        capture(["a", "b"]).with_holdout(every)  # type: ignore[arg-type]


def test_holdout_of_one_view_is_refused() -> None:
    with pytest.raises(IgsrError, match="one photo only"):
        capture(["a"]).with_holdout(8)


def test_extent_is_that_of_the_training_cameras() -> None:
    centers = np.array([[0.0, 0, 0], [2.0, 0, 0], [100.0, 0, 0]])
    whole = capture(["a", "b", "c"], centers)
    whole.views[2].split = "test"
    np.testing.assert_allclose(whole.scene_center, [1.0, 0.0, 0.0])
    assert whole.scene_extent == pytest.approx(1.1)


def test_extent_of_one_spot_does_not_vanish() -> None:
    assert capture(["a", "b"], np.ones((2, 3))).scene_extent == 1.0


@pytest.mark.parametrize(
    ("confidence", "words"),
    [
        ([1.0, 2.0], r"shape \[2\]; give \[3\]"),
        ([[1.0], [2.0], [3.0]], "shape"),
        ([1.0, 0.0, 2.0], "not positive and finite"),
        ([1.0, np.nan, 2.0], "not positive and finite"),
        ([1.0, np.inf, 2.0], "not positive and finite"),
        (["high", "low", "low"], "not a list of numbers"),
    ],
)
def test_bad_confidences_are_refused(confidence: object, words: str) -> None:
    with pytest.raises(IgsrError, match=f"^confidence .*{words}"):
        Points(np.zeros((3, 3)), np.zeros((3, 3), dtype=np.uint8), confidence)  # type: ignore[arg-type]


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
def test_tracks_belong_to_names_and_points(
    view: list[int], point: list[int], xy: list[list[float]], words: str
) -> None:
    gray = np.zeros((3, 3), dtype=np.uint8)
    arrays = np.array(view), np.array(point), np.array(xy)
    with pytest.raises(IgsrError, match=words):
        Points(np.zeros((3, 3)), gray, tracks=Tracks(["a", "b"], *arrays))


def test_a_background_is_a_color_behind_a_picture_without_alpha() -> None:
    view = capture(["a.png"]).views[0]
    assert replace(view, background=(0.0, 0.5, 1.0)).background == (0.0, 0.5, 1.0)
    for background in ((0.0, 0.5), (0.0, 0.5, 1.5), (0.0, np.nan, 1.0)):
        with pytest.raises(IgsrError, match=r"a.png: its background must be three numbers in \[0"):
            replace(view, background=background)
    with pytest.raises(IgsrError, match=r"a.png: only an image without alpha has a background"):
        replace(view, image=np.zeros((2, 3, 4), np.uint8), background=(1.0, 1.0, 1.0))
