"""transforms.json in its three styles, whole and damaged."""

from __future__ import annotations

import json
import math
import random

import numpy as np
import pytest
from capture_files import (
    HEIGHT,
    MODEL_PARAMS,
    WIDTH,
    assert_damage_is_refused,
    assert_refused,
    opengl_pose,
    photo,
    random_viewmats,
    save,
    write_colmap,
    write_json,
    write_transforms,
)

from igsr.capture import load_capture
from igsr.errors import IgsrError

ANGLE = 0.7


def write_blender(folder):
    """A NeRF Synthetic scene of three train and two test views; returns its viewmats."""
    viewmats = random_viewmats(5)
    for split, numbers in (("train", (0, 1, 2)), ("test", (3, 4))):
        frames = []
        for index, number in enumerate(numbers):
            save(folder / f"{split}/r_{index}.png", photo(number, channels=4))
            pose = opengl_pose(viewmats[number])
            frame = {"file_path": f"./{split}/r_{index}", "rotation": 0.1}
            frames.append(frame | {"transform_matrix": pose})
        write_json(folder / f"transforms_{split}.json", {"camera_angle_x": ANGLE, "frames": frames})
    return viewmats


def test_blender_scene(tmp_path):
    viewmats = write_blender(tmp_path)
    write_json(tmp_path / "transforms_val.json", "never read")
    capture = load_capture(tmp_path)
    names = [*(f"train/r_{index}.png" for index in range(3)), "test/r_0.png", "test/r_1.png"]
    assert [view.name for view in capture.views] == names
    assert [view.split for view in capture.views] == ["train"] * 3 + ["test"] * 2
    focal = 0.5 * WIDTH / math.tan(0.5 * ANGLE)
    K = [[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]]
    for index, view in enumerate(capture.views):
        np.testing.assert_allclose(view.camera.viewmat, viewmats[index], atol=1e-12)
        np.testing.assert_allclose(view.camera.K, K)
        np.testing.assert_array_equal(view.image, photo(index, channels=4))
        assert view.mask is None
    (tmp_path / "transforms_test.json").unlink()
    assert len(load_capture(tmp_path).views) == 3


def test_opengl_axes(tmp_path):
    """A camera at (0, 0, 5) with the identity for a pose looks down -z with y up."""
    pose = np.eye(4)
    pose[2, 3] = 5.0
    for rows in (4, 3):  # the last row may be left out
        write_transforms(tmp_path, 1, {"transform_matrix": pose[:rows].tolist()})
        camera = load_capture(tmp_path).views[0].camera
        np.testing.assert_allclose(camera.center, [0, 0, 5])
        np.testing.assert_allclose(camera.viewmat @ [0.25, 0.5, 1.0, 1.0], [0.25, -0.5, 4.0, 1.0])


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("model", sorted(set(MODEL_PARAMS) - {"FULL_OPENCV", "THIN_PRISM_FISHEYE"}))
def test_same_views_as_from_colmap(model, text, tmp_path):
    write_colmap(tmp_path / "colmap", model, text=text)
    params = list(MODEL_PARAMS[model])
    if len(params) in (3, 5) or model in ("SIMPLE_RADIAL", "SIMPLE_RADIAL_FISHEYE"):
        params.insert(1, params[0])
    keys = ["fl_x", "fl_y", "cx", "cy", "k1", "k2"]
    keys += ["k3", "k4"] if model == "OPENCV_FISHEYE" else ["p1", "p2"]
    lens = {"camera_model": "OPENCV_FISHEYE" if "FISHEYE" in model else "OPENCV"}
    write_transforms(tmp_path / "json", **dict(zip(keys, params, strict=False)), **lens)
    from_colmap = load_capture(tmp_path / "colmap").views
    from_json = load_capture(tmp_path / "json").views
    for colmap, view in zip(from_colmap, from_json, strict=True):
        assert view.name == colmap.name
        np.testing.assert_allclose(view.camera.viewmat, colmap.camera.viewmat, atol=1e-12)
        np.testing.assert_array_equal(view.camera.K, colmap.camera.K)
        np.testing.assert_array_equal(view.image, colmap.image)
        np.testing.assert_array_equal(view.mask, colmap.mask)


def test_instant_ngp_style(tmp_path):
    """No camera_model; lens and size for all frames; unknown fields are ignored."""
    fields = {"camera_angle_x": 1.0, "camera_angle_y": 0.7, "w": 48.0, "h": 32.0, "aabb_scale": 16}
    write_transforms(tmp_path, k1=-0.1, k2=0.02, p1=0.001, p2=-0.002, **fields)
    distorted = load_capture(tmp_path).views[0]
    assert distorted.camera.K[0, 0] == 40.0  # fl_x has precedence over the angle
    assert not np.array_equal(distorted.image, photo(0))
    write_transforms(tmp_path, k1=0, k2=0, p1=0, p2=0, **fields)
    np.testing.assert_array_equal(load_capture(tmp_path).views[0].image, photo(0))
    write_transforms(tmp_path, is_fisheye=True, k1=0.01)
    fisheye = load_capture(tmp_path).views[0].image
    write_transforms(tmp_path, camera_model="OPENCV_FISHEYE", k1=0.01)
    np.testing.assert_array_equal(load_capture(tmp_path).views[0].image, fisheye)
    assert not np.array_equal(fisheye, photo(0))


def test_frame_fields_override_those_of_the_file(tmp_path):
    write_transforms(tmp_path, frame={"fl_x": 50.0, "k1": -0.1})
    views = load_capture(tmp_path).views
    assert [view.camera.K[0, 0] for view in views] == [40.0, 50.0, 40.0]
    np.testing.assert_array_equal(views[0].image, photo(0))
    assert not np.array_equal(views[1].image, photo(1))


def test_default_intrinsics(tmp_path):
    """Without w, h, cx, cy and fl_y: the photo's size, its middle, square pixels."""
    missing = dict.fromkeys(("w", "h", "cx", "cy", "fl_y"), ...)
    write_transforms(tmp_path, **missing)
    camera = load_capture(tmp_path).views[0].camera
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    np.testing.assert_array_equal(camera.K, [[40, 0, WIDTH / 2], [0, 40, HEIGHT / 2], [0, 0, 1]])
    write_transforms(tmp_path, **missing, fl_x=..., camera_angle_x=0.9, camera_angle_y=0.5)
    K = load_capture(tmp_path).views[0].camera.K
    assert K[0, 0] == pytest.approx(0.5 * WIDTH / math.tan(0.45))
    assert K[1, 1] == pytest.approx(0.5 * HEIGHT / math.tan(0.25))


@pytest.mark.parametrize("white", [255, 1])
def test_masks(white, tmp_path):
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    mask[5:20, 8:30] = white
    save(tmp_path / "masks/1.png", mask)
    write_transforms(tmp_path, frame={"mask_path": "./masks/1.png"})
    views = load_capture(tmp_path).views
    np.testing.assert_array_equal(views[1].mask, mask > 0)
    assert views[2].mask is None


def test_named_splits(tmp_path):
    names = {"train": ["images/0.png", "./images/3.png"], "test": ["images/2.png"]}
    names["val"] = ["images/1.png"]
    write_transforms(tmp_path, 5, **{f"{split}_filenames": names[split] for split in names})
    splits = {view.name: view.split for view in load_capture(tmp_path).views}
    assert splits == {"images/0.png": "train", "images/2.png": "test", "images/3.png": "train"}
    write_transforms(tmp_path, 3, test_filenames=["images/1.png"])
    assert [view.split for view in load_capture(tmp_path).views] == ["train", "test", "train"]


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_point_cloud(kind, tmp_path):
    write_transforms(tmp_path, ply_file_path="points.ply")
    write_ply(tmp_path / "points.ply", kind)
    points = load_capture(tmp_path).points
    np.testing.assert_allclose(points.xyz, [[1, 2, 3], [-1.5, 0.25, 7]])
    np.testing.assert_array_equal(points.rgb, [[10, 20, 30], [0, 255, 128]])


def write_ply(path, kind="ascii", count=2):
    rows = [(1.0, 2.0, 3.0, 0.5, 10, 20, 30), (-1.5, 0.25, 7.0, 0.5, 0, 255, 128)]
    names = ["float x", "float y", "double z", "float nx", "uchar red", "uchar green", "uchar blue"]
    header = ["ply", f"format {kind} 1.0", "comment made by a test", f"element vertex {count}"]
    header += [f"property {name}" for name in names]
    header += ["element face 1", "property list uchar int vertex_indices", "end_header\n"]
    if kind == "ascii":
        body = "".join(" ".join(map(str, row)) + "\n" for row in rows).encode() + b"3 0 1 0\n"
    else:
        order = "<" if kind == "binary_little_endian" else ">"
        types = f"{order}f4,{order}f4,{order}f8,{order}f4,u1,u1,u1"
        body = np.array(rows, dtype=types).tobytes() + b"\x03" + bytes(12)
    path.write_bytes("\n".join(header).encode() + body)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_damaged_point_cloud(kind, tmp_path):
    write_transforms(tmp_path, 1, ply_file_path="points.ply")
    path = tmp_path / "points.ply"
    for count in (10, 10**12, 10**30):
        write_ply(path, kind, count)
        assert_refused(r"points\.ply is truncated: it announces", load_capture, tmp_path)
    write_ply(path, kind)
    data = path.read_bytes()
    body = data.index(b"end_header") + 10
    for length in range(0, body + (10 if kind == "ascii" else 46), 7):
        path.write_bytes(data[:length])
        assert_refused(r"points\.ply (is truncated|is no \.ply of points)", load_capture, tmp_path)
    path.write_bytes(data)
    damage = random.Random(kind)
    assert assert_damage_is_refused(path, lambda: load_capture(tmp_path), damage, 150, None) > 0
    path.unlink()
    assert_refused(r"points\.ply is missing", load_capture, tmp_path)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"fl_x": 0}, "fl_x is 0, so the intrinsics are singular"),
        ({"fl_x": -40}, "fl_x is -40, so the intrinsics are singular"),
        ({"fl_y": 0}, "fl_y is 0, so the intrinsics are singular"),
        ({"fl_x": math.nan}, "fl_x is not finite"),
        ({"fl_x": "40"}, "fl_x must be a number, not '40'"),
        ({"fl_x": True}, "fl_x must be a number"),
        ({"fl_x": 10**400}, "fl_x is not finite"),
        ({"cx": math.inf}, "cx is not finite"),
        ({"cy": [1]}, r"cy must be a number, not \[1\]"),
        ({"k1": math.nan}, "k1 is not finite"),
        ({"k4": 0.1}, "k4 is 0.1, which has no agreed meaning for a perspective lens"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "p1 is 0.1, .* for a fisheye lens"),
        ({"camera_model": "FISHEYE624"}, "camera_model 'FISHEYE624' is not supported"),
        ({"camera_model": "EQUIRECTANGULAR"}, "48x32 pixels is not twice as wide"),
        ({"camera_model": ["OPENCV"]}, "camera_model .* is not supported"),
        ({"w": 0}, "w is 0; give a whole number"),
        ({"h": 31.5}, "h is 31.5; give a whole number"),
        ({"w": -48}, "w is -48"),
        ({"w": 32, "h": 48}, r"0\.png is 48x32 pixels but its camera .* is 32x48.*EXIF"),
        ({"w": 10**9, "h": 10**9}, r"0\.png is 48x32 .* camera .* 1000000000x1000000000"),
        ({"train_filenames": ["images/9.png"]}, "train_filenames names 'images/9.png', which is"),
        ({"train_filenames": "all"}, "train_filenames must be a list"),
        ({"test_filenames": [1]}, "test_filenames must be a list"),
        (
            {"train_filenames": ["images/0.png"], "test_filenames": ["images/0.png"]},
            "both in train_filenames and in test_filenames",
        ),
        ({"ply_file_path": 3}, "ply_file_path must be a file's path"),
        ({"frames": []}, "frames is empty, so there are no images"),
        ({"frames": {}}, "frames must be a list"),
        ({"frames": [1]}, "frames must be a list of objects"),
        ({"frames": ...}, "frames is missing"),
        ({"fl_x": ...}, "fl_x or camera_angle_x is missing"),
        ({"fl_x": ..., "camera_angle_x": 3.2}, "camera_angle_x is 3.2; .* between 0 and pi"),
    ],
)
def test_bad_field_is_named(fields, words, tmp_path):
    write_transforms(tmp_path, **fields)
    with pytest.raises(IgsrError, match=words) as error:
        load_capture(tmp_path)
    assert "transforms.json" in str(error.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda pose: (np.eye(4) + np.diag([0.1, 0.0, 0.0], 1)) @ pose,
            "is not rigid: R R.T differs from the identity by 0.[01]",
        ),
        (
            lambda pose: pose @ np.diag([0.5, 0.5, 0.5, 1.0]),
            "is not rigid: R R.T differs from the identity by 0.75 .* uniform scale 0.5",
        ),
        (lambda pose: pose @ np.diag([-1.0, 1.0, 1.0, 1.0]), "is a reflection"),
        (lambda pose: pose + np.diag([np.nan, 0.0], 2), "holds a NaN"),
        (lambda pose: pose[:2], "must be 4 rows of 4 numbers"),
        (lambda pose: pose[:, :3], "must be 4 rows of 4 numbers"),
        (lambda pose: 10.0**307 * pose, "is not rigid|ends in the row"),
        (lambda pose: [[10**400] * 4] * 4, "is not a matrix of numbers"),
        *(
            (lambda pose, bad=bad: bad, "must be .*numbers")
            for bad in (None, "eye", [["0"] * 4] * 4, [[[]] * 4] * 4)
        ),
    ],
)
def test_bad_pose_is_named(change, words, tmp_path):
    document = write_transforms(tmp_path)
    pose = change(np.array(document["frames"][1]["transform_matrix"]))
    pose = pose.tolist() if isinstance(pose, np.ndarray) else pose
    write_transforms(tmp_path, frame={"transform_matrix": pose})
    where = r"transforms\.json, frame 1 \(images/1\.png\): transform_matrix"
    assert_refused(f"{where} ({words})", load_capture, tmp_path)


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("file_path", ..., r"transforms\.json, frame 1: file_path is missing"),
        ("transform_matrix", ..., r"frame 1 \(images/1\.png\): transform_matrix is missing"),
        ("mask_path", "masks/9.png", r"frame 1 \(images/1\.png\): the mask .* is missing"),
        ("mask_path", "half.png", r"half\.png is 24x32 .* 48x32; resize the mask"),
        ("file_path", "images/9.png", r"images/9\.png is missing"),
        ("file_path", "../../../../../../../../etc", "is missing"),
        ("file_path", "/dev/null", "is missing"),
        ("file_path", "a" * 5000, "is missing"),
        ("file_path", "images/0.png", "two cameras for the image images/0.png"),
        ("file_path", "./images//0", "two cameras for the image images/0.png"),
        *(("file_path", bad, "file_path must be a file's path") for bad in ("", 7, "a\0b")),
        ("file_path", "a\ud800b", "file_path must be a file's path"),
    ],
)
def test_bad_frame_field_is_named(field, value, words, tmp_path):
    save(tmp_path / "half.png", np.zeros((HEIGHT, WIDTH // 2), dtype=np.uint8))
    write_transforms(tmp_path, frame={field: value})
    assert_refused(words, load_capture, tmp_path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "not valid JSON"),
        ('{"frames": [', "not valid JSON at line 1"),
        ("[1, 2]", "not a JSON object"),
        ("[" * 100_000, "not valid JSON"),
        ('{"fl_x": ' + "1" * 10_000 + "}", "not valid JSON"),
        ("\xff\xfe", "not valid JSON"),
    ],
)
def test_malformed_json(text, words, tmp_path):
    (tmp_path / "transforms.json").write_bytes(text.encode("latin-1"))
    assert_refused(rf"transforms\.json is {words}", load_capture, tmp_path)


def test_damaged_blender_files(tmp_path):
    write_blender(tmp_path)
    train, test = (tmp_path / f"transforms_{split}.json" for split in ("train", "test"))
    document = json.loads(test.read_text())
    write_json(test, {"frames": document["frames"]})
    with pytest.raises(IgsrError, match=r"transforms_test\.json, frame 0 .*fl_x or camera_angle_x"):
        load_capture(tmp_path)
    test.write_bytes(train.read_bytes())
    words = r"two cameras .*r_0.png \(transforms_train.json and transforms_test.json"
    assert_refused(words, load_capture, tmp_path)


def test_random_damage_is_read_or_refused(tmp_path):
    write_transforms(tmp_path, 2, k1=0.01, camera_model="OPENCV")
    path, characters = tmp_path / "transforms.json", b'0123456789-+eE.,:[]{}"ntf \xff'
    rng = random.Random(0)
    assert assert_damage_is_refused(path, lambda: load_capture(tmp_path), rng, 300, characters) > 0
