"""Cameras that COLMAP and the estimator "auto" find in photos of a made-up room."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import rooms
from made_up_tracks import projected
from PIL import Image

import igsr
from igsr.cameras import registry
from igsr.cameras.colmap import Colmap, estimator, features, pairs
from igsr.cameras.colmap.attempts import Mapped
from igsr.cameras.colmap.database import list_photos
from igsr.cameras.colmap.features import find_features
from igsr.cameras.estimate import Estimate
from igsr.capture import Capture, View
from igsr.capture.photo_folder import Photo
from igsr.capture.write_transforms import write_transforms
from igsr.geometry.pose_errors import pose_accuracy
from igsr.geometry.similarity import Similarity, similarity_between

CAMERAS = [rooms.camera(angle) for angle in np.linspace(-0.5, 0.5, 6)]


@pytest.fixture(scope="module")
def photos():
    return rooms.photos(CAMERAS)


@pytest.fixture(scope="module")
def found(photos):
    return Colmap()(photos, seed=3)


def matrices(cameras):
    return [None if c is None else (c.viewmat.tolist(), c.K.tolist()) for c in cameras]


def test_cameras_points_and_tracks_are_right(found):
    accuracy = pose_accuracy(found.cameras, CAMERAS)
    assert accuracy["registered"] == 6
    assert accuracy["RRA@5"] == accuracy["RTA@5"] == 1.0
    assert accuracy["rotation"] < 0.5
    assert accuracy["ATE_relative"] < 0.02
    assert found.warnings == []
    for camera, true in zip(found.cameras, CAMERAS, strict=True):
        assert camera.K[0, 0] == pytest.approx(true.K[0, 0], rel=0.02)
        assert camera.K[:2, 2].tolist() == [120.0, 90.0]
    assert not any(found.lenses), "the photos have no distortion"
    # The points lie on the walls.
    xyz = similarity_between(found.cameras, CAMERAS).apply(found.points.xyz.T).T
    off = [
        np.abs(xyz @ np.array(normal) - offset) / np.linalg.norm(normal)
        for normal, offset, _, _ in rooms.WALLS
    ]
    distance = np.min(off, axis=0)
    assert len(distance) > 200
    assert np.median(distance) < 0.04
    sure = found.points.confidence > np.median(found.points.confidence)
    assert distance[sure].mean() < distance[~sure].mean()
    assert found.points.rgb.std() > 20
    tracks = found.points.tracks
    assert tracks.names == [f"{i}.png" for i in range(6)]
    off = [
        np.linalg.norm(projected(found.cameras[view], found.points.xyz[[point]]) - xy)
        for view, point, xy in zip(tracks.view, tracks.point, tracks.xy, strict=True)
    ]
    assert len(off) > 2 * len(distance)
    assert np.median(off) < 1.0


def test_the_same_seed_gives_the_same_bits_without_output(photos, found, capfd):
    stages = {}

    def progress(stage, done, total):
        stages.setdefault(stage, []).append((done, total))

    again = Colmap()(photos, seed=3, progress=progress)
    assert matrices(again.cameras) == matrices(found.cameras)
    assert list(stages) == ["features", "matching", "mapping"]
    for steps in stages.values():
        assert steps == sorted(steps)
        assert steps[-1][0] == steps[-1][1]
    assert capfd.readouterr() == ("", "")


def test_several_processes_find_the_same_features(photos, found, monkeypatch):
    monkeypatch.setattr(features, "MIN_PARALLEL_PX", 0)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    again = Colmap()(photos, seed=3)
    assert matrices(again.cameras) == matrices(found.cameras)
    np.testing.assert_array_equal(again.points.xyz, found.points.xyz)
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(igsr.IgsrError, match="Finding cameras ended early"):
        Colmap()(photos, seed=3)


def test_of_many_features_the_largest_are_kept(photos, monkeypatch):
    gray = features._gray(photos[0])
    everything, descriptors = features._sift(gray, -1)
    monkeypatch.setattr(features, "MAX_FEATURES", 100)
    largest, kept = features._sift(gray, -1)
    areas = features.feature_areas(everything)
    rows = areas >= np.sort(areas)[-100]
    np.testing.assert_array_equal(largest, everything[rows])
    np.testing.assert_array_equal(kept, descriptors[rows])


def test_photos_with_enough_features_are_not_enlarged(photos, monkeypatch):
    gray = features._gray(photos[0])
    assert features._first_octave(photos) == -1
    enlarged, _ = features._sift(gray, -1)
    monkeypatch.setattr(features, "MIN_ONCE_PX", 0)
    assert features._first_octave(photos) == -1
    monkeypatch.setattr(features, "ENOUGH_FEATURES", 50)
    assert features._first_octave(photos) == 0
    once, _ = features._sift(gray, 0)
    assert 50 <= len(once) < len(enlarged)
    assert features.feature_areas(once).min() > 2.0 * features.feature_areas(enlarged).min()


def test_lens_distortion_is_estimated_and_undone():
    bent = rooms.photos(CAMERAS[1:5], k=-0.12)
    capture = igsr.find_cameras(bent, "colmap")
    assert pose_accuracy([v.camera for v in capture.views], CAMERAS[1:5])["RTA@5"] == 1.0
    for view, true in zip(capture.views, CAMERAS[1:5], strict=True):
        assert view.camera.K[0, 0] == pytest.approx(200.0, rel=0.03)
        straight = rooms.picture(true).astype(float)
        inner = (slice(20, -20), slice(20, -20))
        off = np.abs(view.image.astype(float) - straight)[inner].mean()
        assert off < 0.5 * np.abs(rooms.picture(true, k=-0.12) - straight)[inner].mean()


def test_masked_pixels_have_no_influence_on_photos_of_two_cameras():
    cameras, photos = [], []
    for index, angle in enumerate(np.linspace(-0.5, 0.5, 7)):
        wide = index % 2 == 0
        size = (180, 240) if wide else (240, 180)
        cameras.append(rooms.camera(angle, 150.0 if wide else 200.0, *size))
        pixels = rooms.picture(cameras[-1])
        photos.append(Photo(f"{index}.png", pixels, None, 150.0 if wide else None, f"phone {wide}"))
    mask = np.ones(photos[2].image.shape[:2], dtype=bool)
    mask[:, :60] = False
    hidden = []
    for fill in (0, 255):
        pixels = photos[2].image.copy()
        pixels[~mask] = fill
        hidden.append([*photos[:2], replace(photos[2], image=pixels, mask=mask), *photos[3:]])
    black, white = (Colmap()(some) for some in hidden)
    assert matrices(black.cameras) == matrices(white.cameras)
    accuracy = pose_accuracy(black.cameras, cameras)
    assert accuracy["RRA@5"] == accuracy["RTA@5"] == 1.0
    for camera, true in zip(black.cameras, cameras, strict=True):
        assert camera.K[0, 0] == pytest.approx(true.K[0, 0], rel=0.03)


def test_two_photos_with_a_focal_length_from_exif():
    photos = [replace(p, focal=200.0) for p in rooms.photos(CAMERAS[2:4])]
    found = Colmap()(photos)
    assert pose_accuracy(found.cameras, CAMERAS[2:4])["mAA@30"] > 0.95
    assert found.cameras[0].K[0, 0] == 200.0


def test_photos_of_another_scene_are_named_and_the_others_placed(photos):
    stranger = replace(rooms.photos([CAMERAS[2]], seed=7)[0], name="garden/other.png")
    with pytest.warns(UserWarning, match=r"4 of 5 photos .* garden/other\.png\.$"):
        capture = igsr.find_cameras([*photos[1:3], stranger, *photos[3:5]], "colmap")
    assert [view.name for view in capture.views] == ["1.png", "2.png", "3.png", "4.png"]
    assert capture.train_views == capture.views
    garden = [
        replace(photo, name=f"garden/{photo.name}") for photo in rooms.photos(CAMERAS[2:4], seed=7)
    ]
    two_places = Colmap("sift")([*photos[1:4], *garden])
    assert [camera is not None for camera in two_places.cameras] == [True] * 3 + [False] * 2
    assert "garden/0.png, garden/1.png match each other, but not" in two_places.warnings[1]
    with pytest.raises(igsr.IgsrError, match=r"No cameras found: the 2 photos \(1\.png"):
        igsr.find_cameras([photos[1], stranger], "colmap")
    away = [CAMERAS[2], rooms.camera(np.pi)]  # back to back
    blank = [Photo(f"{i}.png", np.full((60, 80, 3), 200, dtype=np.uint8)) for i in range(3)]
    for unusable in (rooms.photos(away), blank):
        with pytest.raises(igsr.IgsrError, match="too few matches"):
            igsr.find_cameras(unusable, "colmap")
    with pytest.raises(igsr.IgsrError, match=r"at least 2 photos; .*1\.png"):
        igsr.find_cameras(photos[1:2], "colmap")


def test_few_pairs_of_many_photos_are_matched(monkeypatch):
    """200 photos of a walk whose end shows its beginning again."""
    random = np.random.default_rng(0)
    places = random.normal(size=(200, 10, 128)).astype(np.float32)
    places /= np.linalg.norm(places, axis=2, keepdims=True)
    glances = [places[i % 180 : i % 180 + 4].reshape(-1, 128) for i in range(200)]
    glances[77] = np.zeros((0, 128), dtype=np.float32)  # a photo without features
    monkeypatch.setattr(pairs, "largest_features", lambda count, database: glances)
    chosen = pairs.pairs_to_match(200, Path("database"))
    assert len(chosen) < 200 * (pairs.FOLLOWING_PHOTOS + pairs.SIMILAR_PHOTOS) < 200 * 199 // 2
    assert {(i, i + 180) for i in range(20)} <= set(chosen)
    assert {(i, i + 1) for i in range(199)} <= set(chosen)
    assert len(pairs.pairs_to_match(pairs.MAX_EXHAUSTIVE_PHOTOS, Path("database"))) == 60 * 59 // 2
    tiles = pairs.in_tiles(chosen)
    assert sorted(pair for tile in tiles for pair in tile) == chosen
    photos_of_tiles = [len({photo for pair in tile for photo in pair}) for tile in tiles]
    assert max(photos_of_tiles) <= 2 * pairs.TILE_PHOTOS


def test_a_warning_says_how_long_many_photos_take(monkeypatch):
    for step in ("list_photos", "find_features", "matched"):
        monkeypatch.setattr(estimator, step, lambda *arguments, **more: None)
    monkeypatch.setattr(estimator, "mapped", lambda *arguments, **more: Mapped(None, False, 0))
    tiny = [Photo(f"{i}.png", np.zeros((2, 2, 3), dtype=np.uint8)) for i in range(500)]
    with (
        pytest.warns(UserWarning, match=r"COLMAP needs about \d+ minutes for 500 photos"),
        pytest.raises(igsr.IgsrError, match="the 500 photos"),
    ):
        igsr.find_cameras(tiny, "colmap")


def test_similar_photos_are_found_by_their_features(photos, tmp_path):
    stranger = rooms.photos([CAMERAS[2]], seed=7)
    both = [*photos[:3], *stranger]
    database = tmp_path / "database.db"
    list_photos(both, database)
    find_features(both, database, lambda *arguments: None)
    counts = pairs.similarity(pairs.largest_features(4, database))
    assert (counts == counts.T).all()
    assert min(counts[0, 1], counts[1, 2]) >= 2 * pairs.MIN_PRESELECTION_MATCHES
    assert counts[:3, 3].max() < pairs.MIN_PRESELECTION_MATCHES


TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
OTHER_WORLD = Similarity(2.5, TURN, np.array([1.0, -2.0, 3.0]))


class Known:
    """An estimator that knows the cameras of some photos, in another world frame."""

    calls: ClassVar = []  # names and seeds of the estimators that were called

    def __init__(self, name, placed, world=None):
        self.name, self.placed = name, placed
        self.cameras = [world.camera(camera) for camera in CAMERAS] if world else CAMERAS

    def __call__(self, photos, *, seed=0, progress=None):
        Known.calls.append((self.name, seed))
        placed = [self.cameras[i] if i in self.placed else None for i in range(len(photos))]
        nothing = [None] * len(photos)
        return Estimate(placed, None, nothing, nothing, [f"A warning by {self.name}."])


@pytest.fixture
def registered(monkeypatch):
    """Replace the estimators by others of the same names; those not given are not ready."""

    def replace_by(**estimators):
        Known.calls.clear()
        for name in registry.ESTIMATORS:
            known = estimators.get(name)
            entry = registry.Entry(lambda known=known: known, lambda _, known=known: bool(known))
            monkeypatch.setitem(registry.ESTIMATORS, name, entry)

    return replace_by


def test_auto_asks_no_network_if_colmap_places_all(photos, registered):
    registered(colmap=Known("colmap", range(6)), da3=Known("da3", range(6)))
    with pytest.warns(UserWarning, match=r"^A warning by colmap\.$"):
        capture = igsr.find_cameras(photos, seed=4)
    assert Known.calls == [("colmap", 4)]
    assert matrices([view.camera for view in capture.views]) == matrices(CAMERAS)
    np.testing.assert_array_equal(capture.views[1].image, photos[1].image)


def test_auto_adds_a_networks_cameras_for_photos_that_colmap_cannot_place(photos, registered):
    network = Known("dust3r", range(6), OTHER_WORLD)
    registered(colmap=Known("colmap", [0, 1, 2, 4]), dust3r=network)
    with pytest.warns(UserWarning, match=r"Cameras of 3\.png, 5\.png are those that dust3r"):
        capture = igsr.find_cameras(photos, seed=1)
    assert Known.calls == [("colmap", 1), ("dust3r", 1)]
    assert len(capture.views) == 6
    for i, (view, true) in enumerate(zip(capture.views, CAMERAS, strict=True)):
        if i in (0, 1, 2, 4):
            assert matrices([view.camera]) == matrices([true]), "placed cameras stay as they are"
            assert view.pose_evidence is None
        else:
            np.testing.assert_allclose(view.camera.viewmat, true.viewmat, atol=1e-6)
            assert view.pose_evidence.rests_on == "network"


def test_auto_keeps_what_colmap_placed_or_takes_the_network_alone(photos, registered):
    registered(colmap=Known("colmap", [0, 1, 3]))
    with pytest.warns(UserWarning, match="A warning by colmap"):
        capture = igsr.find_cameras(photos)
    assert [view.name for view in capture.views] == ["0.png", "1.png", "3.png"]
    assert Known.calls == [("colmap", 0)]
    # COLMAP places too few.
    registered(colmap=Known("colmap", [0, 1]), da3=Known("da3", range(6), OTHER_WORLD))
    with pytest.warns(UserWarning, match="A warning by da3"):
        capture = igsr.find_cameras(photos)
    assert matrices([view.camera for view in capture.views]) == matrices(
        [OTHER_WORLD.camera(camera) for camera in CAMERAS]
    )


def test_auto_imports_no_torch_if_colmap_places_all(tmp_path):
    for photo in rooms.photos(CAMERAS[1:5]):
        Image.fromarray(photo.image).save(tmp_path / photo.name)
    code = (
        "import sys, igsr; views = igsr.find_cameras(sys.argv[1], matcher='sift').views; "
        "print(len(views), 'torch' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path], capture_output=True, text=True, check=True
    )
    assert done.stdout == "4 False\n"


def test_auto_uses_the_cameras_of_a_capture(photos, registered, tmp_path):
    registered(colmap=Known("colmap", range(6)))
    views = [View(f"{i}.png", CAMERAS[i], "train", photos[i].image) for i in range(2)]
    write_transforms(Capture(tmp_path, views), tmp_path / "given")
    assert len(igsr.find_cameras(tmp_path / "given").views) == 2
    assert Known.calls == []
    with pytest.warns(UserWarning, match="A warning"):
        igsr.find_cameras(tmp_path / "given", "colmap")
    assert Known.calls == [("colmap", 0)]


@pytest.mark.parametrize(
    ("estimator", "options", "message"),
    [
        (
            "colmap",
            {"checkpoint": "weights.pth"},
            "checkpoint is not an option of estimator colmap",
        ),
        ("auto", {"nonsense": 1}, "nonsense is not an option of estimator auto"),
        ("magic", {}, "estimator must be auto, colmap or dust3r or da3, not 'magic'"),
        ("auto", {"seed": -1}, "seed is -1"),
    ],
)
def test_wrong_arguments_are_errors(photos, estimator, options, message):
    with pytest.raises(igsr.IgsrError, match=message):
        igsr.find_cameras(photos[:3], estimator, **options)


def test_a_list_has_files_or_photos_of_different_names(photos, tmp_path):
    Image.fromarray(photos[0].image).save(tmp_path / "a.png")
    with pytest.raises(igsr.IgsrError, match="mixes files and Photo objects"):
        igsr.find_cameras([tmp_path / "a.png", photos[1]])
    with pytest.raises(igsr.IgsrError, match="two photos have the same name"):
        igsr.find_cameras([photos[1], photos[1]])
    with pytest.raises(igsr.IgsrError, match=r"there is only a\.png"):
        igsr.find_cameras([tmp_path / "a.png"])


def test_accuracy_of_known_errors():
    """Three cameras, one turned by 10.5 degrees: two of three pairs are off by that."""
    angle = np.radians(10.5)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    cameras = [CAMERAS[0], CAMERAS[2], replace(CAMERAS[5], viewmat=turn @ CAMERAS[5].viewmat)]
    true = [CAMERAS[0], CAMERAS[2], CAMERAS[5]]
    accuracy = pose_accuracy(cameras, true)
    assert accuracy["RRA@5"] == pytest.approx(1 / 3)
    assert accuracy["RRA@15"] == 1.0
    assert accuracy["rotation"] == pytest.approx(10.5)
    # One pair is right for all of 30 thresholds, two for those from 11 degrees.
    assert accuracy["mAA@30"] == pytest.approx((1 + 2 * 20 / 30) / 3)
    # Scale and frame of the world do not matter.
    world = Similarity(3.0, turn[:3, :3], np.array([1.0, 2.0, 3.0]))
    moved = [world.camera(camera) for camera in true]
    exact = pose_accuracy(moved, true)
    assert exact["mAA@30"] == 1.0
    assert exact["ATE"] < 1e-12
    missing = pose_accuracy([moved[0], None, moved[2]], true)
    assert (missing["registered"], missing["RRA@15"]) == (2, pytest.approx(1 / 3))
    assert pose_accuracy([None, None], true[:2])["ATE"] is None
    with pytest.raises(igsr.IgsrError, match="must be pairs"):
        pose_accuracy(moved, true[:2])
