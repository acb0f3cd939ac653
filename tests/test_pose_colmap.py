"""Cameras found by COLMAP in photos of a made-up room, and by whatever ``auto`` chooses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rooms
from made_up_tracks import projected
from PIL import Image

import igsr
from igsr import pose
from igsr.capture import Camera, Capture, View
from igsr.capture.photo_folder import Photo
from igsr.capture.write_transforms import write_transforms
from igsr.geometry.pose_errors import pose_accuracy
from igsr.pose import registry
from igsr.pose.colmap import Colmap, estimator, pairs
from igsr.pose.colmap.attempts import Mapped
from igsr.pose.colmap.database import list_photos
from igsr.pose.colmap.features import find_features
from igsr.pose.estimate import Estimate

CAMERAS = [rooms.camera(angle) for angle in np.linspace(-0.5, 0.5, 6)]


@pytest.fixture(scope="module")
def photos() -> list[Photo]:
    return rooms.photos(CAMERAS)


@pytest.fixture(scope="module")
def found(photos: list[Photo]) -> Estimate:
    return Colmap()(photos, seed=3)


def matrices(cameras: list[Camera | None]) -> list[object]:
    return [None if c is None else (c.viewmat.tolist(), c.K.tolist()) for c in cameras]


def test_cameras_and_points_are_right(found: Estimate) -> None:
    accuracy = pose_accuracy(found.cameras, CAMERAS)
    assert accuracy["registered"] == 6
    assert accuracy["RRA@5"] == accuracy["RTA@5"] == 1.0
    assert accuracy["rotation"] < 0.5
    assert accuracy["ATE_relative"] < 0.02
    assert found.warnings == []
    for camera, true in zip(found.cameras, CAMERAS, strict=True):
        assert camera.K[0, 0] == pytest.approx(true.K[0, 0], rel=0.02)
        assert camera.K[:2, 2].tolist() == [120.0, 90.0]
    assert not any(found.lenses)  # there is no distortion, and none is made up
    # In the true world, the points lie on the walls.
    to_true = igsr.geometry.similarity.similarity_between(found.cameras, CAMERAS)
    xyz = to_true.scale * found.points.xyz @ to_true.rotation.T + to_true.translation
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
    assert np.median(off) < 1.0  # pixels


def test_same_seed_same_bits_and_nothing_said(
    photos: list[Photo], found: Estimate, capfd: pytest.CaptureFixture[str]
) -> None:
    stages: dict[str, list[tuple[int, int]]] = {}

    def progress(stage: str, done: int, total: int) -> None:
        stages.setdefault(stage, []).append((done, total))

    again = Colmap()(photos, seed=3, progress=progress)
    assert matrices(again.cameras) == matrices(found.cameras)
    np.testing.assert_array_equal(again.points.xyz, found.points.xyz)
    assert list(stages) == ["features", "matching", "mapping"]
    for steps in stages.values():
        assert steps == sorted(steps)
        assert steps[-1][0] == steps[-1][1]
    assert capfd.readouterr() == ("", "")


def test_distortion_is_found_and_undone() -> None:
    bent = rooms.photos(CAMERAS[1:5], k=-0.12)
    capture = igsr.find_cameras(bent, "colmap")
    assert pose_accuracy([v.camera for v in capture.views], CAMERAS[1:5])["RTA@5"] == 1.0
    for view, true in zip(capture.views, CAMERAS[1:5], strict=True):
        assert view.camera.K[0, 0] == pytest.approx(200.0, rel=0.03)
        straight = rooms.picture(true).astype(float)
        inner = (slice(20, -20), slice(20, -20))
        off = np.abs(view.image.astype(float) - straight)[inner].mean()
        assert off < 0.5 * np.abs(rooms.picture(true, k=-0.12) - straight)[inner].mean()


def test_cameras_of_two_kinds_and_a_mask_that_hides() -> None:
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


def test_two_photos_with_a_focal_length_from_exif() -> None:
    photos = [replace(p, focal=200.0) for p in rooms.photos(CAMERAS[2:4])]
    found = Colmap()(photos)
    assert pose_accuracy(found.cameras, CAMERAS[2:4])["mAA@30"] > 0.95
    assert found.cameras[0].K[0, 0] == 200.0


def test_what_shows_something_else_is_named_and_the_rest_kept(photos: list[Photo]) -> None:
    stranger = replace(rooms.photos([CAMERAS[2]], seed=7)[0], name="garden/other.png")
    with pytest.warns(UserWarning, match=r"4 of 5 photos .* garden/other\.png\.$"):
        capture = igsr.find_cameras([*photos[1:3], stranger, *photos[3:5]], "colmap")
    assert [view.name for view in capture.views] == ["1.png", "2.png", "3.png", "4.png"]
    assert capture.train_views == capture.views
    with pytest.raises(igsr.IgsrError, match=r"No cameras found: the 2 photos \(1\.png"):
        igsr.find_cameras([photos[1], stranger], "colmap")
    away = [CAMERAS[2], rooms.camera(np.pi)]  # back to back: no common view
    with pytest.raises(igsr.IgsrError, match="too few matches"):
        igsr.find_cameras(rooms.photos(away), "colmap")
    blank = [Photo(f"{i}.png", np.full((60, 80, 3), 200, dtype=np.uint8)) for i in range(3)]
    with pytest.raises(igsr.IgsrError, match="too few matches"):
        igsr.find_cameras(blank, "colmap")
    with pytest.raises(
        igsr.IgsrError, match=r"two photos at least|from 2 photos at least; .*1\.png"
    ):
        igsr.find_cameras(photos[1:2], "colmap")


def test_of_many_photos_few_pairs_are_matched(monkeypatch: pytest.MonkeyPatch) -> None:
    """A walk round a block of 200 photos, whose end sees its beginning again."""
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
    assert max(len({photo for pair in tile for photo in pair}) for tile in tiles) <= 2 * pairs.TILE


def test_of_many_photos_the_time_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    for step in ("list_photos", "find_features"):
        monkeypatch.setattr(estimator, step, lambda *arguments: None)
    monkeypatch.setattr(estimator, "matched", lambda *arguments: None)
    monkeypatch.setattr(estimator, "mapped", lambda *arguments, **more: Mapped(None, False, 0))
    tiny = [Photo(f"{i}.png", np.zeros((2, 2, 3), dtype=np.uint8)) for i in range(500)]
    with (
        pytest.warns(UserWarning, match=r"COLMAP needs about \d+ minutes for 500 photos"),
        pytest.raises(igsr.IgsrError, match="the 500 photos"),
    ):
        igsr.find_cameras(tiny, "colmap")


def test_photos_that_look_alike_are_found_in_the_database(photos: list[Photo], tmp_path: Path):
    stranger = rooms.photos([CAMERAS[2]], seed=7)
    both = [*photos[:3], *stranger]
    database = tmp_path / "database.db"
    list_photos(both, database)
    find_features(both, tmp_path, database, lambda *arguments: None)
    counts = pairs.similarity(pairs.largest_features(4, database))
    assert (counts == counts.T).all()
    assert min(counts[0, 1], counts[1, 2]) >= 2 * pairs.LEAST_SIMILAR
    assert counts[:3, 3].max() < pairs.LEAST_SIMILAR


def make_estimator(calls: list[dict[str, object]], name: str) -> object:
    def make(checkpoint: object = None) -> object:
        def run(photos, *, seed=0, progress=None):
            calls.append({"name": name, "checkpoint": checkpoint, "seed": seed})
            nothing = [None] * len(photos)
            return Estimate(list(CAMERAS[: len(photos)]), None, nothing, nothing, ["A warning."])

        return run

    return make


def test_auto_takes_given_cameras_then_a_checkpoint_then_colmap(
    photos: list[Photo], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[dict[str, object]] = []
    entry = registry.Entry(make_estimator(calls, "dust3r"), lambda options: "checkpoint" in options)
    monkeypatch.setitem(registry.ESTIMATORS, "dust3r", entry)
    plain = registry.Entry(lambda: make_estimator(calls, "colmap")(), lambda options: True)
    monkeypatch.setitem(registry.ESTIMATORS, "colmap", plain)
    with pytest.warns(UserWarning, match=r"^A warning\.$"):
        capture = igsr.find_cameras(photos[:3], seed=4)
    assert calls == [{"name": "colmap", "checkpoint": None, "seed": 4}]
    np.testing.assert_array_equal(capture.views[1].image, photos[1].image)
    assert capture.views[1].camera is CAMERAS[1]
    name, _ = pose.estimate(photos[:3], checkpoint="weights.pth")
    assert name == "dust3r"
    assert calls[1] == {"name": "dust3r", "checkpoint": "weights.pth", "seed": 0}
    with pytest.raises(igsr.IgsrError, match="checkpoint is no option of colmap"):
        pose.estimate(photos[:3], "colmap", checkpoint="weights.pth")
    with pytest.raises(igsr.IgsrError, match="estimator must be auto, dust3r or da3 or colmap"):
        pose.estimate(photos[:3], "magic")
    with pytest.raises(igsr.IgsrError, match="seed is -1"):
        pose.estimate(photos[:3], seed=-1)
    views = [View(f"{i}.png", CAMERAS[i], "train", photos[i].image) for i in range(2)]
    write_transforms(Capture(tmp_path, views), tmp_path / "given")
    assert len(igsr.find_cameras(tmp_path / "given").views) == 2
    assert len(calls) == 2  # the cameras that are there are taken
    with pytest.warns(UserWarning, match="A warning"):
        igsr.find_cameras(tmp_path / "given", "colmap")
    assert len(calls) == 3  # or found anew where an estimator is named


def test_files_and_photos_in_a_list(photos: list[Photo], tmp_path: Path) -> None:
    Image.fromarray(photos[0].image).save(tmp_path / "a.png")
    with pytest.raises(igsr.IgsrError, match="mixes files and Photo objects"):
        igsr.find_cameras([tmp_path / "a.png", photos[1]])
    with pytest.raises(igsr.IgsrError, match="two photos of one name"):
        igsr.find_cameras([photos[1], photos[1]])
    with pytest.raises(igsr.IgsrError, match=r"there is only a\.png"):
        igsr.find_cameras([tmp_path / "a.png"])


def test_accuracy_by_hand() -> None:
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
    # A world of another scale and frame changes nothing.
    pose_of_world = igsr.geometry.similarity.Similarity(
        3.0, turn[:3, :3], np.array([1.0, 2.0, 3.0])
    )
    moved = [pose_of_world.camera(camera) for camera in true]
    exact = pose_accuracy(moved, true)
    assert exact["mAA@30"] == 1.0
    assert exact["ATE"] < 1e-12
    missing = pose_accuracy([moved[0], None, moved[2]], true)
    assert (missing["registered"], missing["RRA@15"]) == (2, pytest.approx(1 / 3))
    assert pose_accuracy([None, None], true[:2])["ATE"] is None
    with pytest.raises(igsr.IgsrError, match="must be pairs"):
        pose_accuracy(moved, true[:2])
