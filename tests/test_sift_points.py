"""Points from features that several photos have: on the surface, or none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes

import igsr.fitting.initialization.sift_points
from igsr.capture import Camera, Capture, View
from igsr.errors import IgsrError
from igsr.fitting.initialization.initial_splats import (
    SPLATS_PER_FEATURE,
    chosen_start,
    initial_splats,
)
from igsr.fitting.initialization.sift_points import (
    _features,
    _matches,
    _off_epipolar,
    _tracks,
    _triangulated,
    sift_points,
)

SIZE = 120
NORMAL = np.array([0.4, 0.2, -1.0]) / np.linalg.norm([0.4, 0.2, -1.0])


def texture(seed=0):
    """Blobs of two sizes, 512 x 512 colours."""
    random = np.random.default_rng(seed)
    picture = np.zeros((512, 512, 3))
    for cells, strength in ((128, 90.0), (32, 60.0)):
        grid = random.uniform(-1.0, 1.0, (cells, cells, 3))
        at = np.arange(512) * cells / 512
        low, part = at.astype(int), at % 1.0
        for axis in (0, 1):
            weight = np.expand_dims(part, tuple({0, 1, 2} - {axis}))
            grid = (
                np.take(grid, low, axis) * (1.0 - weight)
                + np.take(grid, (low + 1) % cells, axis) * weight
            )
        picture += strength * grid
    return np.clip(picture + 128.0, 0, 255)


def photo(angle, seed=0):
    """A photo of a slanted wall through the origin."""
    camera = scenes.ring_camera(angle, SIZE)
    row, column = np.indices((SIZE, SIZE)) + 0.5
    local = np.stack(
        [
            (column - camera.K[0, 2]) / camera.K[0, 0],
            (row - camera.K[1, 2]) / camera.K[1, 1],
            np.ones((SIZE, SIZE)),
        ],
        axis=-1,
    )
    rays = local @ camera.viewmat[:3, :3]
    wall = camera.center - rays * ((camera.center @ NORMAL) / (rays @ NORMAL))[..., None]
    at = ((wall[..., :2] + 2.5) * 100).astype(int) % 512
    image = texture(seed)[at[..., 1], at[..., 0]].astype(np.uint8)
    return View(f"{angle}.png", camera, "train", image)


@pytest.fixture(scope="module")
def photos():
    return [photo(angle) for angle in (-0.15, 0.0, 0.15)]


@pytest.fixture(scope="module")
def found(photos):
    return sift_points(photos)


def test_points_lie_on_the_surface_with_its_colours(photos, found, capfd):
    xyz, colors = found
    assert len(xyz) == len(colors) > 100
    # A pixel is 0.02 wide there and 20 times as deep.
    assert np.quantile(np.abs(xyz @ NORMAL), 0.9) < 0.05
    camera = photos[1].camera
    local = xyz @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    column, row = (local[:, :2] / local[:, 2:] * 1.5 * SIZE + SIZE / 2).astype(int).T
    inside = (np.minimum(column, row) >= 0) & (np.maximum(column, row) < SIZE)
    seen = photos[1].image[row[inside], column[inside]] / 255.0
    assert np.abs(seen - colors[inside]).mean() < 0.05
    again, _ = sift_points(photos)
    np.testing.assert_array_equal(again, xyz)
    assert capfd.readouterr() == ("", "")


def test_hidden_pixels_have_no_points_and_do_not_matter(photos, found):
    shown = np.zeros((SIZE, SIZE), dtype=bool)
    shown[: SIZE // 2] = True

    def points(seed, alpha):
        hidden = []
        for view in photos:
            noise = np.random.default_rng(seed).integers(0, 256, view.image.shape)
            image = np.where(shown[..., None], view.image, noise).astype(np.uint8)
            if alpha:
                image = np.dstack([image, np.where(shown, 255, 0).astype(np.uint8)])
            hidden.append(replace(view, image=image, mask=None if alpha else shown))
        return sift_points(hidden)[0]

    masked = points(0, alpha=False)
    assert len(masked) > len(found[0]) / 4
    assert masked[:, 1].max() < 0.0
    np.testing.assert_array_equal(masked, points(1, alpha=False))
    np.testing.assert_array_equal(masked, points(1, alpha=True))


def turned(view):
    """The view with its camera a quarter turned about its axis, the photo not."""
    turn = np.eye(4)
    turn[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    return replace(view, camera=replace(view.camera, viewmat=turn @ view.camera.viewmat))


def nothing(photos):
    grey = [replace(view, image=np.full_like(view.image, 128)) for view in photos]
    hidden = [replace(view, mask=np.zeros((SIZE, SIZE), dtype=bool)) for view in photos]
    other = [photos[0], photo(0.15, seed=1)]
    same_place = [photos[0], photos[0]]
    wrong_pose = [photos[0], turned(photos[2])]
    return [grey, hidden, other, same_place, wrong_pose, photos[:1]]


@pytest.mark.parametrize("case", range(6))
def test_photos_that_tell_nothing_have_no_points(photos, case):
    xyz, colors = sift_points(nothing(photos)[case])
    assert xyz.shape == colors.shape
    assert xyz.shape[1] == 3
    assert len(xyz) < 5


@pytest.mark.parametrize("alpha", [False, True])
def test_large_photos_are_reduced(photos, found, monkeypatch, alpha):
    monkeypatch.setattr(igsr.fitting.initialization.sift_points, "LONGEST", SIZE)
    large = []
    for view in photos:
        image = view.image.repeat(3, axis=0).repeat(3, axis=1)
        if alpha:
            image = np.dstack([image, np.full(image.shape[:2], 255, dtype=np.uint8)])
        K = view.camera.K * [[3.0], [3.0], [1.0]]
        camera = Camera(view.camera.viewmat, K, 3 * SIZE, 3 * SIZE)
        large.append(View(view.name, camera, "train", image))
    xyz, colors = sift_points(large)
    np.testing.assert_allclose(xyz, found[0], atol=1e-9)
    np.testing.assert_allclose(colors, found[1], atol=1e-9)
    monkeypatch.setattr(igsr.fitting.initialization.sift_points, "LONGEST", 1)
    assert len(sift_points(large)[0]) == 0


def test_hidden_holes_are_no_features(photos):
    """Filled with one grey, holes in a mask look like blobs."""
    row, column = np.indices((SIZE, SIZE))
    mask = (row % 24 > 6) | (column % 24 > 6)
    pixels, descriptors = _features(replace(photos[0], mask=mask))
    assert len(pixels) == len(descriptors) > 50
    assert mask[pixels[:, 1].astype(int), pixels[:, 0].astype(int)].all()


def projected(photos, xyz):
    """Pixels [V, P, 2] of points that all photos see."""
    pixels = []
    for view in photos:
        local = xyz @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]
        pixels.append(local[:, :2] / local[:, 2:] * 1.5 * SIZE + SIZE / 2)
    return np.stack(pixels)


def test_matches_off_the_epipolar_line_are_found(photos):
    a, _, b = projected(photos, np.random.default_rng(0).uniform(-1, 1, (20, 3)))
    off = _off_epipolar(photos[0], a, photos[2], b)
    assert off.max() < 1e-6
    # Cameras side by side: the lines run nearly along the rows.
    off = _off_epipolar(photos[0], a, photos[2], b + [0.0, 3.0])
    np.testing.assert_allclose(off, 3.0, atol=0.1)
    off = _off_epipolar(photos[0], a, photos[2], b + [3.0, 0.0])
    assert off.max() < 0.6
    features = [_features(view) for view in photos]
    right = _matches(photos[0], features[0], photos[2], features[2])
    wrong = _matches(photos[0], features[0], turned(photos[2]), features[2])
    assert len(right) > 50 > 4 * len(wrong)


def test_only_tracks_that_fit_become_points(photos):
    xyz = np.random.default_rng(0).uniform(-0.5, 0.5, (5, 3))
    pixels = projected(photos, xyz)
    pixels[1, 2] += 6.0
    views, tracks = np.repeat(np.arange(3), 5), np.tile(np.arange(5), 3)
    found, colors = _triangulated(photos, views, pixels.reshape(-1, 2), tracks)
    np.testing.assert_allclose(found, xyz[[0, 1, 3, 4]], atol=1e-9)
    column, row = pixels[..., 0].astype(int), pixels[..., 1].astype(int)
    seen = [photos[v].image[row[v, 4], column[v, 4]] / 255.0 for v in range(3)]
    np.testing.assert_allclose(colors[3], np.mean(seen, axis=0))
    # Seen from behind, the same rays meet at the back of the cameras.
    behind = projected(photos, np.array([[0.0, 0.0, -8.0]])).clip(0, SIZE - 1)
    assert len(_triangulated(photos, np.arange(3), behind[:, 0], np.zeros(3, int))[0]) == 0


def test_tracks_join_matches_across_photos():
    pairs = np.array([[0, 4], [4, 7], [1, 5], [3, 7]])
    assert _tracks(pairs, 8).tolist() == [0, 1, 2, 0, 0, 1, 6, 0]
    assert _tracks(pairs[:0], 2).tolist() == [0, 1]


def test_a_start_from_features(photos, found):
    capture = Capture(Path("wall"), photos)
    splats, made_from = initial_splats(capture, 0, 10_000, 1, "sift")
    assert made_from == "sift"
    assert len(splats) == SPLATS_PER_FEATURE * len(found[0])
    places = splats.means + splats.origin
    np.testing.assert_allclose(places[: len(found[0])], found[0], atol=1e-5)
    # What is between points of a wall is on the wall, and not all at one place.
    between = places[len(found[0]) :]
    assert np.quantile(np.abs(between @ NORMAL), 0.8) < 0.05
    assert len(np.unique(between.round(4), axis=0)) > 0.95 * len(between)
    assert np.linalg.norm(between[:, None] - found[0], axis=-1).min(axis=1).max() < 0.5
    again, _ = initial_splats(capture, 0, 10_000, 1, "sift")
    np.testing.assert_array_equal(again.means, splats.means)
    other, _ = initial_splats(capture, 1, 10_000, 1, "sift")
    assert not np.array_equal(other.means, splats.means)
    assert len(initial_splats(capture, 0, 50, 1, "sift")[0]) == 50
    assert len(initial_splats(capture, 0, 9_000, 1, "sift", dense=True)[0]) == 9_000


def test_too_few_features_are_one_sentence_or_rays():
    """Photos of a few blobs from all around have no features in common."""
    capture = scenes.capture(views=5, size=24)
    assert chosen_start(capture) == "sift"
    _, made_from = initial_splats(capture, 0, 200, 0)
    assert made_from == "rays"
    wide = [photo(angle) for angle in (-0.36, 0.36)]
    for exact, expected in ((True, "sift"), (False, "rays")):
        made = initial_splats(Capture(Path("wall"), wide), 0, 200, 0, exact_poses=exact)
        assert made[1] == expected
    sentence = (
        r"^made-up: only \d+ points could be triangulated from features of its photos, too few to "
        r"start from; use start rays or random\.$"
    )
    with pytest.raises(IgsrError, match=sentence):
        initial_splats(capture, 0, 200, 0, "sift")
