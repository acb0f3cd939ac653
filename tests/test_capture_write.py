"""Captures written and read back: cameras, pixels, masks and points are the same."""

from __future__ import annotations

import json
import os
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pycolmap
import pytest
from capture_files import assert_refused, photo, random_viewmats, save
from capture_files import write_colmap as write_with_pycolmap
from PIL import Image

from igsr._internal.atomic_write import atomic_folder
from igsr.capture import Camera, Capture, Points, View, load_capture
from igsr.capture.types import Tracks, intrinsic_matrix
from igsr.capture.write_colmap import quaternion, write_colmap
from igsr.capture.write_transforms import write_transforms
from igsr.errors import IgsrError

WRITERS = {
    "colmap": write_colmap,
    "colmap-text": lambda *arguments: write_colmap(*arguments, text=True),
    "transforms": write_transforms,
}
#: The files of the views of ``made_up``, in their order.
NAMES = ["a/1.png", "a/1.png.png", "out side/2.png", "line_break.png"]


def made_up(confidence=True):
    """Four views of two sizes, with alpha, masks and awkward names."""
    random = np.random.default_rng(0)
    names = ["images/a/1.jpg", "images/a/1.png", "../out side/2.heic", "images/line\nbreak.webp"]
    views = []
    for index, viewmat in enumerate(random_viewmats(4)):
        width, height = (48, 32) if index < 3 else (30, 50)
        focal = random.uniform(20.0, 90.0, 2) if index > 1 else (40.1, 42.3)
        K = intrinsic_matrix(*focal, width / 2 + 0.3, height / 2 - 1 / 3)
        mask = random.uniform(size=(height, width)) < 0.5 if index % 2 else None
        pixels = photo(index, width, height, 4 if index == 2 else 3)
        camera = Camera(viewmat, K, width, height)
        views.append(View(names[index], camera, "train", pixels, mask))
    rgb = random.integers(0, 256, (7, 3)).astype(np.uint8)
    sure = random.uniform(0.1, 50.0, 7) if confidence else None
    points = Points(1e3 * random.normal(size=(7, 3)), rgb, sure)
    return Capture(Path("made-up"), views, points)


def assert_same_confidence(points, expected):
    if expected.confidence is None:
        assert points.confidence is None
    else:
        np.testing.assert_allclose(points.confidence, expected.confidence, 1e-12)


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize("confidence", [False, True])
def test_round_trip(tmp_path, form, confidence):
    capture = made_up(confidence)
    WRITERS[form](capture, tmp_path / "new" / "out")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["out"]
    again = load_capture(tmp_path / "new" / "out")
    read = {view.name: view for view in again.views}
    assert set(read) == {f"images/{name}" for name in NAMES}
    for name, view in zip(NAMES, capture.views, strict=True):
        found = read[f"images/{name}"]
        np.testing.assert_allclose(found.camera.viewmat, view.camera.viewmat, 1e-9, 1e-12)
        np.testing.assert_array_equal(found.camera.K, view.camera.K)
        np.testing.assert_array_equal(found.image, view.image)
        np.testing.assert_array_equal(found.mask, view.mask)
    np.testing.assert_array_equal(again.points.xyz, capture.points.xyz)
    np.testing.assert_array_equal(again.points.rgb, capture.points.rgb)
    assert_same_confidence(again.points, capture.points)
    capture.points = None
    WRITERS[form](capture, tmp_path / "no-points")
    assert load_capture(tmp_path / "no-points").points is None


@pytest.mark.parametrize("form", ["colmap", "colmap-text"])
def test_pycolmap_reads_the_model(tmp_path, form):
    capture = made_up()
    WRITERS[form](capture, tmp_path / "out")
    model = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    assert len(model.images) == 4
    assert len(model.cameras) == 3  # the first two views have the same
    for number, view in enumerate(capture.views, start=1):
        image = model.images[number]
        pose = image.cam_from_world().matrix()
        np.testing.assert_allclose(pose, view.camera.viewmat[:3], 1e-9, 1e-12)
        assert (image.camera.width, image.camera.height) == (view.camera.width, view.camera.height)
        np.testing.assert_array_equal(image.camera.calibration_matrix(), view.camera.K)
    xyz = np.stack([model.points3D[i].xyz for i in range(1, 8)])
    np.testing.assert_array_equal(xyz, capture.points.xyz)


def with_tracks(confidence=True):
    """Points 0 to 4 are seen, point 2 by one view alone; the third view sees none."""
    capture = made_up(confidence)
    names = [capture.views[index].name for index in (3, 0, 1)]
    view = np.array([0, 0, 1, 1, 1, 2, 2, 0, 2])
    point = np.array([4, 0, 1, 0, 2, 3, 1, 3, 4])
    xy = np.random.default_rng(3).uniform(0.0, 30.0, (9, 2))
    capture.points.tracks = Tracks(names, view, point, xy)
    if confidence:
        # Confidences of tracks: their lengths over one plus an error.
        capture.points.confidence[:5] = [2, 2, 1, 2, 2] / (1.0 + np.arange(5) / 3.0)
    return capture


def observations(points, names=None):
    tracks = points.tracks
    seen = zip(tracks.view, points.xyz[tracks.point].tolist(), tracks.xy.tolist(), strict=True)
    named = ((tracks.names[view], xyz, xy) for view, xyz, xy in seen)
    return {(names[name] if names else name, *xyz, *xy) for name, xyz, xy in named}


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("confidence", [False, True])
def test_tracks_survive(tmp_path, text, confidence):
    capture = with_tracks(confidence)
    write_colmap(capture, tmp_path / "out", text=text)
    again = load_capture(tmp_path / "out").points
    read_as = {v.name: f"images/{name}" for v, name in zip(capture.views, NAMES, strict=True)}
    expected = observations(capture.points, read_as)
    assert len(expected) == 9
    assert observations(again) == expected
    assert_same_confidence(again, capture.points)
    model = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    for number, view in enumerate(capture.views, start=1):
        for feature in model.images[number].points2D:
            point = model.points3D[feature.point3D_id]
            assert (read_as[view.name], *point.xyz, *feature.xy) in expected
    elements = [model.points3D[number].track.elements for number in range(1, 8)]
    assert list(map(len, elements)) == [2, 2, 1, 2, 2, 0, 0]
    for number, track in enumerate(elements, start=1):
        for element in track:
            feature = model.images[element.image_id].points2D[element.point2D_idx]
            assert feature.point3D_id == number


def test_tracks_of_other_views_are_left_out(tmp_path):
    capture = with_tracks()
    write_colmap(Capture(capture.path, capture.views[:2], capture.points), tmp_path / "out")
    tracks = load_capture(tmp_path / "out").points.tracks
    assert sorted(tracks.point.tolist()) == [0, 1, 1, 2, 3, 4]


def test_models_of_pycolmap_have_masks_and_no_confidence(tmp_path):
    write_with_pycolmap(tmp_path)
    mask = np.zeros((32, 48), dtype=np.uint8)
    mask[:, :9] = 255
    save(tmp_path / "masks/1.png.png", mask)
    capture = load_capture(tmp_path)
    assert capture.points.confidence is None
    assert capture.views[0].mask is None
    np.testing.assert_array_equal(capture.views[1].mask, mask > 0)


def test_further_masks_have_the_size_of_the_photos(tmp_path):
    trusted = np.array([[True, False, True], [False, False, True]])
    masks = {"trusted": [trusted, None, None, trusted]}
    write_colmap(made_up(), tmp_path / "out", further_masks=masks)
    with Image.open(tmp_path / "out/trusted/a/1.png.png") as image:
        written = np.array(image)
    np.testing.assert_array_equal(written > 0, np.kron(trusted, np.ones((16, 16), dtype=bool)))
    assert len(list((tmp_path / "out/trusted").rglob("*.png"))) == 2
    read = {view.name: view.mask for view in load_capture(tmp_path / "out").views}
    assert read["images/a/1.png"] is None


def test_transforms_keep_the_split(tmp_path):
    write_transforms(made_up().with_holdout(2), tmp_path / "out")
    splits = [view.split for view in load_capture(tmp_path / "out").views]
    assert sorted(splits) == ["test", "test", "train", "train"]
    document = json.loads((tmp_path / "out/transforms.json").read_text())
    assert document["ply_file_path"] == "points.ply"


def test_quaternions_of_all_turns():
    half_turns = [np.diag(signs) for signs in ([1, -1, -1], [-1, 1, -1], [-1, -1, 1], [1, 1, 1])]
    for rotation in [*half_turns, *random_viewmats(50)[:, :3, :3]]:
        w, x, y, z = quaternion(np.asarray(rotation, dtype=np.float64))
        assert w >= 0.0
        back = pycolmap.Rotation3d(np.array([x, y, z, w])).matrix()
        np.testing.assert_allclose(back, rotation, atol=1e-14)


def test_a_folder_is_complete_or_missing(tmp_path, monkeypatch):
    out = tmp_path / "out"
    out.mkdir()  # an empty one is allowed
    write_colmap(made_up(), out)
    assert_refused("out is not empty", write_colmap, made_up(), out)
    before = (out / "sparse/0/points3D.bin").read_bytes()

    full = Mock(side_effect=OSError(28, "No space left on device"))
    with monkeypatch.context() as patch:
        patch.setattr("igsr.capture.write_files.Image.fromarray", full)
        words = "Cannot write .*out: No space left on device"
        assert_refused(words, write_colmap, made_up(), out, replace=True)
    assert (out / "sparse/0/points3D.bin").read_bytes() == before
    capture = made_up()
    capture.points = None
    write_colmap(capture, out, replace=True)
    assert load_capture(out).points is None
    assert os.listdir(tmp_path) == ["out"]
    (tmp_path / "file").write_text("")
    with pytest.raises(IgsrError, match="file: it is a file"), atomic_folder(tmp_path / "file"):
        pass
