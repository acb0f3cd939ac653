"""COLMAP models that pycolmap wrote, whole and damaged."""

from __future__ import annotations

import random

import numpy as np
import pycolmap
import pytest
from capture_files import (
    HEIGHT,
    MODEL_PARAMS,
    WIDTH,
    assert_damage_is_refused,
    assert_refused,
    photo,
    random_viewmats,
    save,
    write_colmap,
)

from igsr.capture import load_capture
from igsr.errors import IgsrError

FILES = ("cameras", "images", "points3D")
KINDS = pytest.mark.parametrize("text", [False, True])


def assert_like_colmap(capture, reconstruction):
    images = {f"images/{image.name}": image for image in reconstruction.images.values()}
    assert [view.name for view in capture.views] == sorted(images)
    for view in capture.views:
        expected = images[view.name].cam_from_world().matrix()
        np.testing.assert_allclose(view.camera.viewmat[:3], expected, atol=1e-12)
        camera = images[view.name].camera
        np.testing.assert_allclose(view.camera.K, camera.calibration_matrix(), rtol=1e-15)
        assert (view.camera.width, view.camera.height) == (camera.width, camera.height)
        assert view.image.shape == (camera.height, camera.width, 3)
        assert view.split == "train"
    # The file has the points in the order of a hash table.
    points = sorted(reconstruction.points3D.values(), key=lambda point: point.xyz[0])
    order = np.argsort(capture.points.xyz[:, 0])
    np.testing.assert_array_equal(capture.points.xyz[order], [point.xyz for point in points])
    np.testing.assert_array_equal(capture.points.rgb[order], [point.color for point in points])


@KINDS
@pytest.mark.parametrize("model", MODEL_PARAMS)
def test_reads_models_of_colmap(model, text, tmp_path):
    reconstruction = write_colmap(tmp_path, model, text=text)
    assert_like_colmap(load_capture(tmp_path), reconstruction)


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "."])
def test_places_of_the_model(place, tmp_path):
    reconstruction = write_colmap(tmp_path, place=place)
    capture = load_capture(tmp_path)
    assert_like_colmap(capture, reconstruction)
    for index, view in enumerate(capture.views):  # a pinhole changes no pixel
        np.testing.assert_array_equal(view.image, photo(index))
        assert view.mask is None


@KINDS
def test_tracks_equal_those_of_colmap(text, tmp_path):
    reconstruction = write_colmap(tmp_path, "PINHOLE", text=text)
    points = load_capture(tmp_path).points
    tracks = points.tracks
    assert tracks.names == ["images/0.png", "images/1.png", "images/2.png"]
    rows = zip(tracks.view.tolist(), points.xyz[tracks.point].tolist(), tracks.xy, strict=True)
    expected = {
        (f"images/{image.name}", *reconstruction.points3D[p.point3D_id].xyz, *p.xy)
        for image in reconstruction.images.values()
        for p in image.points2D
        if p.has_point3D()
    }
    assert len(expected) == 6
    assert {(f"images/{view}.png", *xyz, *xy) for view, xyz, xy in rows} == expected


@pytest.mark.parametrize("model", MODEL_PARAMS)
def test_undistorted_tracks_keep_their_reprojection_errors(model, tmp_path):
    viewmats = np.tile(np.eye(4), (3, 1, 1))
    viewmats[:, 0, 3] = [-0.2, 0.0, 0.3]
    viewmats[:, 2, 3] = 5.0  # the points lie at z = -2
    reconstruction = write_colmap(tmp_path, model, viewmats=viewmats)
    error = np.array([0.25, -0.5])
    for image in reconstruction.images.values():
        for feature in image.points2D:
            if feature.has_point3D():
                xyz = reconstruction.points3D[feature.point3D_id].xyz
                feature.xy = image.camera.img_from_cam(image.cam_from_world() * xyz) + error
    reconstruction.write_binary(tmp_path / "sparse/0")
    capture = load_capture(tmp_path)
    tracks = capture.points.tracks
    assert len(tracks.view) == 6
    for view, point, xy in zip(tracks.view, tracks.point, tracks.xy, strict=True):
        camera = capture.views[view].camera
        local = camera.viewmat[:3] @ [*capture.points.xyz[point], 1.0]
        np.testing.assert_allclose(xy - (camera.K @ local)[:2] / local[2], error, atol=1e-9)


def test_features_of_removed_points_are_ignored(tmp_path):
    write_text_model(tmp_path, point="7 0 0 1 10 20 30 0.5 1 2")
    images = tmp_path / "sparse/0/images.txt"
    images.write_text("1 1 0 0 0 0 0 0 1 0.png\n1 2 -1 3 4 99 5.5 6.5 7\n")
    points = load_capture(tmp_path).points
    assert points.tracks.xy.tolist() == [[5.5, 6.5]]
    assert points.tracks.point.tolist() == [0]
    assert points.confidence == pytest.approx([1 / 1.5])
    images.write_text("1 1 0 0 0 0 0 0 1 0.png\n1 2 -1 3 4 99\n")
    assert load_capture(tmp_path).points.tracks is None


def test_bad_features_are_named(tmp_path):
    write_text_model(tmp_path, point="7 0 0 1 10 20 30 0.5 1 0")
    malformed = "1 2", "1 2 7 3", "1 two 7", "1 2 7.5", "1 2 99999999999999999999"
    words = dict.fromkeys(malformed, r"images\.txt, line 2 is not of the form X Y POINT3D_ID")
    words["1 nan 7"] = r"images\.txt: 0\.png sees a point at no finite place"
    for features in words:
        (tmp_path / "sparse/0/images.txt").write_text(f"1 1 0 0 0 0 0 0 1 0.png\n{features}\n")
        assert_refused(words[features], load_capture, tmp_path)


def test_poses_in_a_rig_are_products(tmp_path):
    """COLMAP stores the poses of rig and sensor; the view's pose is their product."""
    write_colmap(tmp_path)
    first, second = random_viewmats(2, seed=5)
    poses = [pycolmap.Rigid3d(pycolmap.Rotation3d(v[:3, :3]), v[:3, 3]) for v in (first, second)]
    sensors = [pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number) for number in (1, 2)]
    reconstruction = pycolmap.Reconstruction()
    rig, frame = pycolmap.Rig(rig_id=1), pycolmap.Frame(frame_id=1, rig_id=1)
    rig.add_ref_sensor(sensors[0])
    rig.add_sensor(sensors[1], poses[1])
    frame.rig_from_world = poses[0]
    for number, sensor in enumerate(sensors, start=1):
        camera = pycolmap.Camera.create_from_model_name(number, "PINHOLE", 40.0, WIDTH, HEIGHT)
        reconstruction.add_camera(camera)
        frame.add_data_id(pycolmap.data_t(sensor, number))
    reconstruction.add_rig(rig)
    reconstruction.add_frame(frame)
    for number in (1, 2):
        image = pycolmap.Image(name=f"{number}.png", camera_id=number, image_id=number)
        image.frame_id = 1
        reconstruction.add_image(image)
    reconstruction.register_frame(1)
    reconstruction.write_binary(tmp_path / "sparse/0")
    views = load_capture(tmp_path).views
    np.testing.assert_allclose(views[0].camera.viewmat, first, atol=1e-12)
    np.testing.assert_allclose(views[1].camera.viewmat, second @ first, atol=1e-12)


@KINDS
@pytest.mark.parametrize("model", ["FOV", "RAD_TAN_THIN_PRISM_FISHEYE", "EUCM"])
def test_unsupported_models_are_named(model, text, tmp_path):
    write_colmap(tmp_path, model, text=text)
    with pytest.raises(IgsrError, match=f"camera 7: the model {model} is not supported"):
        load_capture(tmp_path)


def test_unknown_model_number_is_named(tmp_path):
    write_colmap(tmp_path)
    path = tmp_path / "sparse/0/cameras.bin"
    data = bytearray(path.read_bytes())
    data[12:16] = (99).to_bytes(4, "little")
    path.write_bytes(data)
    assert_refused(r"cameras\.bin: camera 7 has the model number 99", load_capture, tmp_path)


def test_missing_files(tmp_path):
    write_colmap(tmp_path)
    (tmp_path / "sparse/0/points3D.bin").unlink()
    assert load_capture(tmp_path).points is None
    photo_path = tmp_path / "images/1.png"
    save(photo_path, photo(0, WIDTH // 2, HEIGHT // 2))
    assert_refused(r"1\.png is 24x16 pixels but its camera .* is 48x32", load_capture, tmp_path)
    photo_path.unlink()
    assert_refused(r"camera for 1\.png but .*images/1\.png is missing", load_capture, tmp_path)
    (tmp_path / "sparse/0/images.bin").write_bytes(bytes(8))
    assert_refused(r"images\.bin lists no images", load_capture, tmp_path)
    (tmp_path / "sparse/0/images.bin").unlink()
    assert_refused(r"images\.bin is missing", load_capture, tmp_path)


@pytest.mark.parametrize("file", FILES)
def test_files_of_wrong_length_are_refused(file, tmp_path):
    """pycolmap reads some of these as zeros and crashes on others."""
    write_colmap(tmp_path, "OPENCV")
    path = tmp_path / f"sparse/0/{file}.bin"
    data = path.read_bytes()
    for length in range(len(data)):
        path.write_bytes(data[:length])
        assert_refused(rf"{file}\.bin is (truncated or )?corrupt", load_capture, tmp_path)
    path.write_bytes(data + b"x")
    assert_refused(rf"{file}\.bin is corrupt: 1 bytes follow", load_capture, tmp_path)
    # Nothing is allocated for a huge number of entries.
    path.write_bytes(b"\xff" * 8 + data[8:])
    assert_refused(rf"{file}\.bin is truncated or corrupt", load_capture, tmp_path)


@KINDS
@pytest.mark.parametrize("file", FILES)
def test_random_damage_is_read_or_refused(file, text, tmp_path):
    write_colmap(tmp_path, "OPENCV", text=text)
    path = tmp_path / f"sparse/0/{file}.{'txt' if text else 'bin'}"
    rng = random.Random(file)
    for choices in (None, b"\0\xff -9"):
        assert assert_damage_is_refused(path, lambda: load_capture(tmp_path), rng, 75, choices) > 0
        write_colmap(tmp_path, "OPENCV", text=text)


def write_text_model(folder, **lines):
    """A hand-written model of one camera and one image, with single lines replaced."""
    write_colmap(folder, text=True)
    cameras = lines.get("camera", f"1 PINHOLE {WIDTH} {HEIGHT} 40 40 24 16")
    image = lines.get("image", "1 1 0 0 0 0 0 0 1 0.png")
    point = lines.get("point", "1 0 0 1 10 20 30 0.5")
    (folder / "sparse/0/cameras.txt").write_text(f"# comment\n{cameras}\n")
    (folder / "sparse/0/images.txt").write_text(f"# comment\n{image}\n\n", encoding="latin-1")
    (folder / "sparse/0/points3D.txt").write_text(f"{point}\n")


def test_hand_written_text_model(tmp_path):
    write_text_model(tmp_path, image="1 1 0 0 0 0 0 0 1 left side/a b.png")
    save(tmp_path / "images/left side/a b.png", photo())
    capture = load_capture(tmp_path)
    assert [view.name for view in capture.views] == ["images/left side/a b.png"]
    np.testing.assert_array_equal(capture.views[0].camera.viewmat, np.eye(4))
    np.testing.assert_array_equal(capture.points.rgb, [[10, 20, 30]])


@pytest.mark.parametrize(
    ("line", "text", "words"),
    [
        ("camera", "1 PINHOLE 48 32 0 40 24 16", r"cameras\.txt, camera 1: .*fx is 0"),
        ("camera", "1 PINHOLE 48 32 40 -40 24 16", r"cameras\.txt, camera 1: .*fy is -40"),
        ("camera", "1 PINHOLE 48 32 nan 40 24 16", r"camera 1: .*not finite"),
        ("camera", "1 PINHOLE 48 32 40 40 24", "PINHOLE has 4 parameters, not 3"),
        ("camera", "1 PINHOLE 48", r"cameras\.txt, line 2 is not of the form"),
        ("camera", "1 PINHOLE 0 32 40 40 24 16", "width is 0"),
        ("camera", "1 PINHOLE 99999999999 99999999999 40 40 24 16", "0.png is 48x32 pixels but"),
        ("camera", "1 RADIAL 48 32 40 24 16 1e9 1e300", r"images/0\.png.*leaves no pixel"),
        ("image", "1 1 0 0 0 0 0 0 9 0.png", "camera 9, which cameras.txt does not have"),
        ("image", "1 0 0 0 0 0 0 0 1 0.png", r"images\.txt: the pose of 0\.png .* zero quat"),
        ("image", "1 nan 0 0 0 0 0 0 1 0.png", r"the pose of 0\.png has a NaN"),
        ("image", "1 1 0 0 0 0 inf 0 1 0.png", r"the pose of 0\.png has a NaN or infinite"),
        ("image", "1 1 0 0 0 0 0 0 1", r"images\.txt, line 2 is not of the form"),
        ("image", "1 1 0 0 0 0 0 0 1 0.png\n\n2 1 0 0 0 0 0 1 1 0.png", "two cameras for .*0.png"),
        ("image", "1 1 0 0 0 0 0 0 1 ../../../../etc", "etc is missing"),
        ("image", "1 1 0 0 0 0 0 0 1 " + "a" * 5000, "is missing"),
        ("image", "1 1 0 0 0 0 0 0 1 a\0b", "is missing"),
        ("image", "1 1 0 0 0 0 0 0 1 \xff.png", r"images\.txt is corrupt or not in UTF-8"),
        ("point", "1 0 0 nan 10 20 30 0.5", r"points3D\.txt has a point that is not finite"),
        ("point", "1 0 0 1 10 20 300 0.5", r"points3D\.txt, line 1 is not of the form"),
        ("point", "1 0 0", r"points3D\.txt, line 1 is not of the form"),
    ],
)
def test_bad_text_is_named(line, text, words, tmp_path):
    write_text_model(tmp_path, **{line: text})
    assert_refused(words, load_capture, tmp_path)
