"""Models with wrong matches between places that look alike."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
import rooms

from igsr.cameras.colmap.attempts import THRESHOLDS, mapped
from igsr.cameras.colmap.contradictions import (
    contradictions,
    leave_out,
    links,
    links_between_parts,
    parts,
)
from igsr.cameras.colmap.database import list_photos
from igsr.cameras.colmap.estimator import guarded
from igsr.cameras.colmap.features import find_features
from igsr.cameras.colmap.mapping import map_photos
from igsr.cameras.colmap.matching import matched, with_focal_lengths
from igsr.cameras.colmap.result import estimate_of
from igsr.geometry.pose_errors import pose_accuracy


class Image:
    """A photo of a model that looks along +z, with pycolmap's interface."""

    def __init__(self, center, sees):
        self.center = np.array(center)
        self.camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 100.0, 200, 200)
        self.points2D = [
            SimpleNamespace(point3D_id=point, has_point3D=lambda point=point: point >= 0)
            for point in sees
        ]

    def projection_center(self):
        return self.center

    def cam_from_world(self):
        pose = np.hstack([np.eye(3), -self.center[:, None]])
        return SimpleNamespace(matrix=lambda: pose)


def model_of(*images, frames=0):
    """A model of photos 1, 2 ... of 400 points on a wall at z = 4, 20 of them in its middle."""
    random = np.random.default_rng(0)
    xyz = np.c_[random.uniform(-2.0, 2.0, (400, 2)), np.full(400, 4.0)]
    xyz[180:200, :2] *= 0.1
    return SimpleNamespace(
        images=dict(enumerate(images, start=1)),
        points3D={i: SimpleNamespace(xyz=place) for i, place in enumerate(xyz)},
        reg_image_ids=lambda: range(1, len(images) + 1),
        point3D_ids=lambda: range(400),
        num_reg_frames=lambda: frames or len(images),
    )


HALF, OTHER = list(range(200)), list(range(180, 380))


def test_neighboring_photos_must_share_points():
    together = Image((0.0, 0.0, 0.0), HALF), Image((0.3, 0.0, 0.0), OTHER)
    assert contradictions(model_of(*together), {}, {}) == {(1, 2)}
    for sees in (
        range(150, 380),
        [*range(0, 180, 9), *range(200, 380)],  # few points as in other light, but not in one place
        range(200, 380),  # no points, as in photos that were never compared
    ):
        other = Image((0.3, 0.0, 0.0), sees)
        assert contradictions(model_of(together[0], other), {}, {}) == set()
    # Rigs are not checked.
    assert contradictions(model_of(*together, frames=1), {}, {}) == set()
    # Matches count also without points.
    matches = {(1, 2): np.stack([np.arange(50), np.arange(50)], axis=1).astype(np.uint32)}
    assert contradictions(model_of(*together), matches, {}) == set()
    # Masked points need not be shared.
    hidden = np.zeros((200, 200), dtype=np.bool_)
    hidden[80:120, 80:120] = True
    assert contradictions(model_of(*together), {}, {1: hidden, 2: hidden}) == set()


@pytest.mark.parametrize(
    ("center", "sees"),
    [
        ((2.5, 0.0, 0.0), OTHER),  # from another direction
        ((0.0, 0.0, 2.0), OTHER),  # from nearer
        ((0.0, 0.0, 5.0), OTHER),  # the wall is behind
        ((0.3, 0.0, 0.0), []),
    ],
)
def test_other_photos_need_not_share_points(center, sees):
    for seen in (HALF[:90], HALF) if sees else (HALF[:90],):
        model = model_of(Image((0.0, 0.0, 0.0), seen), Image(center, sees))
        assert contradictions(model, {}, {}) == set()


def test_the_weakest_links_are_left_out():
    #   1 = 2 = 3 - 4 = 5, and 6 hangs on 5 alone
    strengths = {(1, 2): 500, (2, 3): 400, (3, 4): 40, (4, 5): 600, (1, 5): 30, (5, 6): 20}
    assert links_between_parts(strengths, set()) == set()
    assert links_between_parts(strengths, {(2, 5)}) == {(3, 4), (1, 5)}
    assert parts(strengths, {(2, 5)}) == {1: 1, 2: 1, 3: 1, 4: 4, 5: 4, 6: 4}
    # Photos with strong links stay together.
    assert links_between_parts({**strengths, (3, 4): 200}, {(2, 5)}) == set()


def show(*progress):
    pass


def matches_of(photos, folder):
    features = folder / "features.db"
    list_photos(photos, features)
    find_features(photos, features, show)
    return matched(len(photos), features, 0, show)


def test_two_rooms_that_look_alike_are_kept_apart(tmp_path, monkeypatch):
    # A part of the walls of room 0 is also in room 1.
    original = rooms.texture

    def texture(seed):
        walls = original(seed)
        if seed >= 10:
            walls[:64, :64] = original(seed - 10)[:64, :64]
        return walls

    monkeypatch.setattr(rooms, "texture", texture)
    cameras = [rooms.camera(angle) for angle in np.linspace(-0.4, 0.4, 5)]
    photos = [*rooms.photos(cameras), *rooms.photos(cameras[1:], seed=1)]
    with guarded(0):
        matches = matches_of(photos, tmp_path)
        across = {pair for pair in links(matches) if pair[0] <= 5 < pair[1]}
        assert across
        wrong = map_photos(9, with_focal_lengths(matches, 0), THRESHOLDS[0], 0, show)
        assert wrong.num_reg_images() > 5
        assert contradictions(wrong, links(matches), {})
        copy = Path(shutil.copyfile(matches, tmp_path / "copy.db"))
        leave_out(copy, across)
        assert links(copy).keys() == links(matches).keys() - across
        found = mapped(len(photos), matches, 0, show)
    assert found.removed_pairs == len(across)
    assert not found.doubtful
    estimate = estimate_of(photos, found)
    assert [camera is not None for camera in estimate.cameras] == [True] * 5 + [False] * 4
    assert pose_accuracy(estimate.cameras[:5], cameras)["rotation"] < 0.5
    assert "match each other, but not the registered photos" in estimate.warnings[1]
    assert "look alike" in estimate.warnings[2]


def test_photos_of_another_season_stay_in_one_model(tmp_path, monkeypatch):
    # They share few points with all other photos, in different places.
    cameras = [rooms.camera(angle) for angle in np.linspace(-0.4, 0.4, 6)]
    photos = rooms.photos(cameras[::2])
    original = rooms.texture
    monkeypatch.setattr(
        rooms, "texture", lambda seed: 0.6 * original(seed) + 0.4 * original(seed + 100)
    )
    photos += rooms.photos(cameras[1::2])
    with guarded(0):
        found = mapped(6, matches_of(photos, tmp_path), 0, show)
    assert found.removed_pairs == 0
    estimate = estimate_of(photos, found)
    accuracy = pose_accuracy(estimate.cameras, [*cameras[::2], *cameras[1::2]])
    assert accuracy["registered"] == 6
    assert accuracy["rotation"] < 0.5
