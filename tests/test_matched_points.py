"""Points from SIFT features are on the surface; there are none without matches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
import torch
from made_up_tracks import projected

from igsr.capture import Camera, Capture, View
from igsr.errors import IgsrError
from igsr.fitting.initialization import matched_points as module
from igsr.fitting.initialization.initial_splats import (
    SPLATS_PER_FEATURE,
    chosen_start,
    initial_splats,
)
from igsr.fitting.initialization.matched_points import matched_points

SIZE = 120
NORMAL = np.array([0.4, 0.2, -1.0]) / np.linalg.norm([0.4, 0.2, -1.0])


def texture(seed=0):
    """Blobs of two sizes, 512 x 512 colors."""
    random = np.random.default_rng(seed)
    picture = np.full((512, 512, 3), 128.0)
    for cells, strength in ((128, 90.0), (32, 60.0)):
        grid = random.uniform(-1.0, 1.0, (cells, cells, 3))
        place = np.arange(512) * cells / 512
        low, fraction = place.astype(int), place % 1.0
        for axis in (0, 1):
            weight = np.expand_dims(fraction, tuple({0, 1, 2} - {axis}))
            ends = np.take(grid, low, axis), np.take(grid, (low + 1) % cells, axis)
            grid = ends[0] * (1.0 - weight) + ends[1] * weight
        picture += strength * grid
    return np.clip(picture, 0, 255)


def photo(angle, seed=0, size=SIZE):
    """A photo of a slanted wall through the origin."""
    camera = scenes.ring_camera(angle, size)
    row, column = np.indices((size, size)) + 0.5
    pixels = np.stack([column, row, np.ones((size, size))], axis=-1)
    rays = pixels @ np.linalg.inv(camera.K).T @ camera.viewmat[:3, :3]
    wall = camera.center - rays * ((camera.center @ NORMAL) / (rays @ NORMAL))[..., None]
    column, row = np.moveaxis(((wall[..., :2] + 2.5) * 100).astype(int) % 512, -1, 0)
    return View(f"{angle}.png", camera, "train", texture(seed)[row, column].astype(np.uint8))


@pytest.fixture(scope="module")
def photos():
    return [photo(angle) for angle in (-0.15, 0.0, 0.15)]


@pytest.fixture(scope="module")
def found(photos):
    return matched_points(photos)


@pytest.mark.parametrize("seed", range(3))
def test_points_are_on_the_surface_with_its_colors(capfd, seed):
    views = [photo(angle, seed) for angle in (-0.15, 0.0, 0.15)]
    xyz, colors = matched_points(views)
    assert len(xyz) == len(colors) > 100
    # A pixel is 0.02 wide there and 20 times as deep.
    assert np.quantile(np.abs(xyz @ NORMAL), 0.9) < 0.05
    column, row = projected(views[1].camera, xyz).astype(int).T
    inside = (np.minimum(column, row) >= 0) & (np.maximum(column, row) < SIZE)
    seen = views[1].image[row[inside], column[inside]] / 255.0
    assert np.abs(seen - colors[inside]).mean() < 0.05
    np.testing.assert_array_equal(matched_points(views)[0], xyz)
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
        return matched_points(hidden)[0]

    masked = points(0, alpha=False)
    assert len(masked) > len(found[0]) / 4
    assert masked[:, 1].max() < 0.0
    np.testing.assert_array_equal(masked, points(1, alpha=False))
    np.testing.assert_array_equal(masked, points(1, alpha=True))


def rolled(view):
    """The view with its camera rotated a quarter about its axis, and the photo unchanged."""
    turn = np.eye(4)
    turn[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    return replace(view, camera=replace(view.camera, viewmat=turn @ view.camera.viewmat))


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda v: [replace(x, image=x.image * 0 + 128) for x in v], id="gray"),
        pytest.param(lambda v: [replace(x, mask=x.image[..., 0] > 255) for x in v], id="masked"),
        pytest.param(lambda v: [v[0], photo(0.15, seed=1)], id="another scene"),
        pytest.param(lambda v: [v[0], v[0]], id="the same place"),
        pytest.param(lambda v: [v[0], rolled(v[2])], id="a wrong pose"),
        pytest.param(lambda v: v[:1], id="one photo"),
    ],
)
def test_photos_without_matches_have_hardly_any_points(photos, change):
    xyz, colors = matched_points(change(photos))
    assert xyz.shape == colors.shape == (len(xyz), 3)
    assert len(xyz) < 5


@pytest.mark.parametrize("alpha", [False, True])
def test_large_photos_are_reduced(photos, found, monkeypatch, alpha):
    monkeypatch.setattr(module, "MAX_SIDE_PX", SIZE)
    large = []
    for view in photos:
        image = view.image.repeat(3, axis=0).repeat(3, axis=1)
        if alpha:
            image = np.dstack([image, np.full(image.shape[:2], 255, dtype=np.uint8)])
        K = view.camera.K * [[3.0], [3.0], [1.0]]
        camera = Camera(view.camera.viewmat, K, 3 * SIZE, 3 * SIZE)
        large.append(View(view.name, camera, "train", image))
    xyz, colors = matched_points(large)
    np.testing.assert_allclose(xyz, found[0], atol=1e-9)
    np.testing.assert_allclose(colors, found[1], atol=1e-9)
    monkeypatch.setattr(module, "MAX_SIDE_PX", 1)
    assert len(matched_points(large)[0]) == 0


def test_holes_in_masks_are_no_features(photos):
    """Filled with one gray level, holes look like blobs."""
    row, column = np.indices((SIZE, SIZE))
    mask = (row % 24 > 6) | (column % 24 > 6)
    xyz, _ = matched_points([replace(view, mask=mask) for view in photos])
    assert len(xyz) > 10
    assert np.quantile(np.abs(xyz @ NORMAL), 0.9) < 0.05


def test_only_consistent_tracks_become_points(photos, monkeypatch):
    xyz = np.random.default_rng(0).uniform(-0.5, 0.5, (6, 3))
    xyz[0] = (0.0, 0.0, -8.0)  # behind the cameras
    pixels = np.stack([projected(view.camera, xyz) for view in photos]).clip(0, SIZE - 1)
    # The cameras stand side by side, so epipolar lines run along the rows.
    pixels[1, 1] += (6.0, 0.0)
    pixels[1, 2] += (0.0, 6.0)  # two photos still determine the point
    each = iter(pixels)
    features = np.eye(6, 128, dtype=np.float32)
    monkeypatch.setattr(module, "_features", lambda view: (next(each), features))
    points, colors = matched_points(photos)
    order = np.linalg.norm(points[:, None] - xyz, axis=2).argmin(axis=1)
    assert sorted(order) == [2, 3, 4, 5]
    np.testing.assert_allclose(points, xyz[order], atol=1e-9)
    column, row = pixels[:, 5].astype(int).T
    seen = [view.image[row[v], column[v]] / 255.0 for v, view in enumerate(photos)]
    np.testing.assert_allclose(colors[order == 5][0], np.mean(seen, axis=0))


@pytest.mark.parametrize("seed", range(3))
def test_a_start_from_features(seed):
    """Photos too far apart for depth maps by stereo."""
    photos = [photo(angle, size=200) for angle in (-0.45, 0.45)]
    found = matched_points(photos)
    capture = Capture(Path("wall"), photos)

    def start(max_splats=10_000, seed=seed, **options):
        splats, name = initial_splats(capture, seed, max_splats, 1, "depths", **options)
        assert name == "depths"
        return splats

    splats = start()
    assert len(splats) == SPLATS_PER_FEATURE * len(found[0])
    xyz = splats.means + splats.origin
    np.testing.assert_allclose(xyz[: len(found[0])], found[0], atol=1e-5)
    # Points between two points of a wall are on the wall, and at different places.
    between = xyz[len(found[0]) :]
    assert np.quantile(np.abs(between @ NORMAL), 0.8) < 0.05
    assert len(np.unique(between.round(4), axis=0)) > 0.95 * len(between)
    assert np.linalg.norm(between[:, None] - found[0], axis=-1).min(axis=1).max() < 0.5
    assert start() == splats
    assert start(seed=seed + 1) != splats
    assert len(start(400)) == 200
    assert len(start(9_000, dense=True)) == 9_000


def test_too_few_features_are_an_error_or_replaced_by_rays():
    """Photos of a few blobs from all around have no features in common."""
    capture = scenes.capture(views=5, size=24)
    assert chosen_start(capture) == "depths"
    assert initial_splats(capture, 0, 200, 0)[1] == "rays"
    message = r"^made-up: depth maps and matches of its photos have only \d+ points"
    with pytest.raises(IgsrError, match=message):
        initial_splats(capture, 0, 200, 0, "depths")


@pytest.mark.parametrize(("exact", "expected"), [(True, "depths"), (False, "rays")])
def test_features_need_exact_poses(exact, expected):
    capture = Capture(Path("wall"), [photo(angle) for angle in (-0.45, 0.45)])
    assert initial_splats(capture, 0, 200, 0, exact_poses=exact)[1] == expected


def test_the_trained_matcher_adds_points_of_photos_from_far_apart(with_aliked, monkeypatch):
    far = [photo(angle, size=300) for angle in (-0.9, 0.0, 0.9)]
    xyz, _ = matched_points(far)
    before = torch.get_num_threads()
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            np.testing.assert_array_equal(matched_points(far)[0], xyz)
    finally:
        torch.set_num_threads(before)
    monkeypatch.setattr(module.aliked, "is_available", lambda: False)
    fewer, _ = matched_points(far)
    assert len(xyz) > 1.3 * len(fewer)
    assert np.quantile(np.abs(xyz @ NORMAL), 0.9) < 0.03
