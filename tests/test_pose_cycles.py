"""Focal lengths by cycles of photos around an object, and matches of its look-alike sides."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
import scenes
from made_up_tracks import projected

from igsr.cameras.colmap.attempts import mapped
from igsr.cameras.colmap.contradictions import links
from igsr.cameras.colmap.cycles import consistent_databases, cycle_errors
from igsr.cameras.colmap.database import list_photos, photo_file
from igsr.cameras.colmap.estimator import guarded
from igsr.cameras.colmap.matching import with_focal_lengths
from igsr.cameras.colmap.result import estimate_of
from igsr.capture.photo_folder import Photo
from igsr.geometry.pose_errors import pose_accuracy

COUNT, SIZE = 8, 400
CAMERAS = [scenes.ring_camera(2.0 * np.pi * i / COUNT, SIZE) for i in range(COUNT)]
FOCAL = CAMERAS[0].K[0, 0] / SIZE
#: Photos whose matches are of two sides that look alike, 180 degrees apart.
ALIKE = (0, 3)


@pytest.fixture
def database(tmp_path):
    """Matches of neighbors around an object, a few of them also in the next photo."""
    random = np.random.default_rng(0)
    photos = [Photo(f"{i}.png", np.zeros((SIZE, SIZE, 3), np.uint8)) for i in range(COUNT)]
    keypoints = [[] for _ in photos]
    matches = {}

    def add(photo, xyz):
        pixels = projected(CAMERAS[photo], xyz) + random.normal(scale=0.3, size=(len(xyz), 2))
        first = sum(map(len, keypoints[photo]))
        keypoints[photo].append(pixels)
        return first + np.arange(len(xyz))

    def match(a, b, of_a, of_b):
        pair = (a, b) if a < b else (b, a)
        rows = np.stack([of_a, of_b] if a < b else [of_b, of_a], axis=1)
        matches.setdefault(pair, []).append(rows)

    for i in range(COUNT):
        xyz = random.normal(scale=0.4, size=(120, 3))
        j, k = (i + 1) % COUNT, (i + 2) % COUNT
        of_i, of_j, of_k = add(i, xyz), add(j, xyz), add(k, xyz[:8])
        match(i, j, of_i, of_j)
        match(j, k, of_j[:8], of_k)
    turned = random.normal(scale=0.4, size=(60, 3))
    match(*ALIKE, add(ALIKE[0], turned), add(ALIKE[1], turned * [-1.0, 1.0, -1.0]))
    path = tmp_path / "matched.db"
    list_photos(photos, path)
    with pycolmap.Database.open(path) as opened:
        for i, pixels in enumerate(keypoints):
            opened.write_keypoints(i + 1, np.concatenate(pixels).astype(np.float32))
        for (a, b), rows in matches.items():
            opened.write_matches(a + 1, b + 1, np.concatenate(rows).astype(np.uint32))
    listing = tmp_path / "pairs.txt"
    listing.write_text("".join(f"{photo_file(a)} {photo_file(b)}\n" for a, b in matches))
    with guarded(0):
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = 0
        pycolmap.verify_matches(path, listing, options)
    return path, photos


def turn(angle):
    """The rotation [3, 3] about the vertical axis, degrees."""
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])


def test_errors_of_cycles():
    ring = {(0, 1): (turn(120), 9), (1, 2): (turn(120), 8), (0, 2): (turn(-120), 7)}
    assert cycle_errors(ring) == pytest.approx({(0, 1): 0, (1, 2): 0, (0, 2): 0}, abs=1e-5)
    ring[0, 2] = (turn(-100), 7)
    ring[3, 4] = (turn(30), 5)  # of another scene
    assert cycle_errors(ring)[0, 2] == pytest.approx(20.0)
    assert cycle_errors(ring)[3, 4] == pytest.approx(0.0, abs=1e-5)
    ring[0, 2] = (turn(-100), 10)  # the weakest pair is off
    assert cycle_errors(ring)[1, 2] == pytest.approx(20.0)
    assert cycle_errors({}) == {}


def test_the_focal_length_is_found_and_alike_sides_are_left_out(database):
    path, _ = database
    verified = links(path)
    alike = tuple(i + 1 for i in ALIKE)
    assert alike in verified
    with guarded(0):
        best = next(consistent_databases(with_focal_lengths(path, 0)))
    with pycolmap.Database.open(best) as opened:
        (camera,) = opened.read_all_cameras()
    assert camera.params[0] / SIZE == pytest.approx(FOCAL, rel=0.05)
    assert links(best).keys() == verified.keys() - {alike}


def test_photos_around_an_object_are_placed(database):
    path, photos = database
    with guarded(0):
        found = mapped(COUNT, path, 0, lambda *_: None, sift=False)
    accuracy = pose_accuracy(estimate_of(photos, found).cameras, CAMERAS)
    assert accuracy["registered"] == COUNT
    assert accuracy["rotation"] < 1.0


def test_photos_without_cycles_have_no_copies(database):
    path, _ = database
    with pycolmap.Database.open(path) as opened:
        for a, b in links(path):
            if b - a != 1:
                opened.delete_two_view_geometry(a, b)
    with guarded(0):
        assert list(consistent_databases(with_focal_lengths(path, 0))) == []
