"""transforms.json in its three styles, whole and damaged."""

from __future__ import annotations

import json
import math
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_files import (
    HEIGHT,
    MODEL_PARAMS,
    WIDTH,
    opengl_pose,
    photo,
    random_viewmats,
    save,
    transforms_document,
    write_colmap,
    write_json,
    write_transforms,
)

from igsr.capture import load_capture
from igsr.errors import IgsrError

ANGLE = 0.7


def write_blender(folder: Path, train: int = 3, test: int = 2) -> np.ndarray:
    """A NeRF Synthetic scene; returns its viewmats, train first."""
    viewmats = random_viewmats(train + test)
    first = 0
    for split, count in (("train", train), ("test", test)):
        frames = []
        for index in range(count):
            save(folder / f"{split}/r_{index}.png", photo(first + index, channels=4))
            pose = opengl_pose(viewmats[first + index])
            frames.append(
                {"file_path": f"./{split}/r_{index}", "rotation": 0.1, "transform_matrix": pose}
            )
        write_json(folder / f"transforms_{split}.json", {"camera_angle_x": ANGLE, "frames": frames})
        first += count
    return viewmats


def test_blender_scene(tmp_path: Path) -> None:
    viewmats = write_blender(tmp_path)
    write_json(tmp_path / "transforms_val.json", "never read")
    capture = load_capture(tmp_path)
    assert [view.name for view in capture.views] == [
        "train/r_0.png",
        "train/r_1.png",
        "train/r_2.png",
        "test/r_0.png",
        "test/r_1.png",
    ]
    assert [view.split for view in capture.views] == ["train"] * 3 + ["test"] * 2
    focal_length = 0.5 * WIDTH / math.tan(0.5 * ANGLE)
    for index, view in enumerate(capture.views):
        np.testing.assert_allclose(view.camera.viewmat, viewmats[index], atol=1e-12)
        np.testing.assert_allclose(
            view.camera.K,
            [[focal_length, 0, WIDTH / 2], [0, focal_length, HEIGHT / 2], [0, 0, 1]],
        )
        np.testing.assert_array_equal(view.image, photo(index, channels=4))
        assert view.mask is None


def test_blender_scene_without_test_file(tmp_path: Path) -> None:
    write_blender(tmp_path)
    (tmp_path / "transforms_test.json").unlink()
    assert len(load_capture(tmp_path).train_views) == 3


def test_opengl_axes(tmp_path: Path) -> None:
    """A camera at (0, 0, 5) with the identity for a pose looks down -z with y up."""
    pose = np.eye(4)
    pose[2, 3] = 5.0
    document = transforms_document(random_viewmats(1))
    document["frames"][0]["transform_matrix"] = pose.tolist()
    save(tmp_path / "images/0.png", photo())
    write_json(tmp_path / "transforms.json", document)
    camera = load_capture(tmp_path).views[0].camera
    np.testing.assert_allclose(camera.center, [0, 0, 5])
    np.testing.assert_allclose(camera.viewmat @ [0.25, 0.5, 1.0, 1.0], [0.25, -0.5, 4.0, 1.0])


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("model", sorted(set(MODEL_PARAMS) - {"FULL_OPENCV", "THIN_PRISM_FISHEYE"}))
def test_same_cameras_as_from_colmap(model: str, text: bool, tmp_path: Path) -> None:
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
    for one, other in zip(from_colmap, from_json, strict=True):
        assert one.name == other.name
        np.testing.assert_allclose(one.camera.viewmat, other.camera.viewmat, atol=1e-12)
        np.testing.assert_array_equal(one.camera.K, other.camera.K)
        np.testing.assert_array_equal(one.image, other.image)
        assert (one.mask is None) == (other.mask is None)
        if one.mask is not None and other.mask is not None:
            np.testing.assert_array_equal(one.mask, other.mask)


def test_instant_ngp_style(tmp_path: Path) -> None:
    """No camera_model; lens and size for all frames; fields of no interest are passed over."""
    document = write_transforms(
        tmp_path,
        camera_angle_x=1.0,
        camera_angle_y=0.7,
        k1=-0.1,
        k2=0.02,
        p1=0.001,
        p2=-0.002,
        w=float(WIDTH),
        h=float(HEIGHT),
        aabb_scale=16,
    )
    distorted = load_capture(tmp_path).views[0]
    assert distorted.camera.K[0, 0] == 40.0  # fl_x counts before the angle
    assert not np.array_equal(distorted.image, photo(0))
    write_json(tmp_path / "transforms.json", {**document, "k1": 0, "k2": 0, "p1": 0, "p2": 0})
    np.testing.assert_array_equal(load_capture(tmp_path).views[0].image, photo(0))


def test_is_fisheye_of_instant_ngp(tmp_path: Path) -> None:
    write_transforms(tmp_path / "a", is_fisheye=True, k1=0.01)
    write_transforms(tmp_path / "b", camera_model="OPENCV_FISHEYE", k1=0.01)
    one, other = (load_capture(tmp_path / name).views[0].image for name in "ab")
    np.testing.assert_array_equal(one, other)
    assert not np.array_equal(one, photo(0))


def test_frame_fields_count_before_the_file_s(tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    document["frames"][1].update(fl_x=50.0, k1=-0.1)
    write_json(tmp_path / "transforms.json", document)
    views = load_capture(tmp_path).views
    assert [view.camera.K[0, 0] for view in views] == [40.0, 50.0, 40.0]
    np.testing.assert_array_equal(views[0].image, photo(0))
    assert not np.array_equal(views[1].image, photo(1))


def test_defaults(tmp_path: Path) -> None:
    """Without w, h, cx, cy and fl_y: the photo's size, its middle, square pixels."""
    document = write_transforms(tmp_path)
    for key in ("w", "h", "cx", "cy", "fl_y"):
        del document[key]
    write_json(tmp_path / "transforms.json", document)
    camera = load_capture(tmp_path).views[0].camera
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    np.testing.assert_array_equal(camera.K, [[40, 0, WIDTH / 2], [0, 40, HEIGHT / 2], [0, 0, 1]])


def test_both_angles(tmp_path: Path) -> None:
    document = write_transforms(tmp_path, camera_angle_x=0.9, camera_angle_y=0.5)
    del document["fl_x"], document["fl_y"]
    write_json(tmp_path / "transforms.json", document)
    K = load_capture(tmp_path).views[0].camera.K
    assert K[0, 0] == pytest.approx(0.5 * WIDTH / math.tan(0.45))
    assert K[1, 1] == pytest.approx(0.5 * HEIGHT / math.tan(0.25))


def test_three_rows_are_a_pose(tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    whole = load_capture(tmp_path).views[0].camera.viewmat
    for frame in document["frames"]:
        frame["transform_matrix"] = frame["transform_matrix"][:3]
    write_json(tmp_path / "transforms.json", document)
    np.testing.assert_array_equal(load_capture(tmp_path).views[0].camera.viewmat, whole)


def test_masks(tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    mask[5:20, 8:30] = 255
    save(tmp_path / "masks/0.png", mask)
    save(tmp_path / "masks/1.png", mask // 255)
    document["frames"][0]["mask_path"] = "masks/0.png"
    document["frames"][1]["mask_path"] = "./masks/1.png"
    write_json(tmp_path / "transforms.json", document)
    views = load_capture(tmp_path).views
    for view in views[:2]:
        np.testing.assert_array_equal(view.mask, mask > 0)
    assert views[2].mask is None


def test_named_splits(tmp_path: Path) -> None:
    write_transforms(
        tmp_path,
        5,
        train_filenames=["images/0.png", "./images/3.png"],
        test_filenames=["images/2.png"],
        val_filenames=["images/1.png"],
    )
    capture = load_capture(tmp_path)
    assert [view.name for view in capture.train_views] == ["images/0.png", "images/3.png"]
    assert [view.name for view in capture.test_views] == ["images/2.png"]
    assert len(capture.views) == 3


def test_only_test_filenames(tmp_path: Path) -> None:
    write_transforms(tmp_path, 3, test_filenames=["images/1.png"])
    capture = load_capture(tmp_path)
    assert [view.split for view in capture.views] == ["train", "test", "train"]


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_point_cloud(kind: str, tmp_path: Path) -> None:
    write_transforms(tmp_path, ply_file_path="points.ply")
    write_ply(tmp_path / "points.ply", kind)
    points = load_capture(tmp_path).points
    assert points is not None
    np.testing.assert_allclose(points.xyz, [[1, 2, 3], [-1.5, 0.25, 7]])
    np.testing.assert_array_equal(points.rgb, [[10, 20, 30], [0, 255, 128]])


def write_ply(path: Path, kind: str = "ascii", count: int | None = None) -> None:
    rows = [(1.0, 2.0, 3.0, 0.5, 10, 20, 30), (-1.5, 0.25, 7.0, 0.5, 0, 255, 128)]
    names = ["float x", "float y", "double z", "float nx", "uchar red", "uchar green", "uchar blue"]
    header = [
        "ply",
        f"format {kind} 1.0",
        "comment made by a test",
        f"element vertex {len(rows) if count is None else count}",
        *(f"property {name}" for name in names),
        "element face 1",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    if kind == "ascii":
        body = "".join(" ".join(map(str, row)) + "\n" for row in rows).encode() + b"3 0 1 0\n"
    else:
        order = "<" if kind == "binary_little_endian" else ">"
        types = f"{order}f4,{order}f4,{order}f8,{order}f4,u1,u1,u1"
        body = np.array(rows, dtype=types).tobytes() + b"\x03" + bytes(12)
    path.write_bytes("\n".join(header).encode() + body)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_damaged_point_cloud(kind: str, tmp_path: Path) -> None:
    write_transforms(tmp_path, 1, ply_file_path="points.ply")
    path = tmp_path / "points.ply"
    for count in (10, 10**12, 10**30):
        write_ply(path, kind, count)
        with pytest.raises(IgsrError, match=r"points\.ply is truncated: it announces"):
            load_capture(tmp_path)
    write_ply(path, kind)
    data = path.read_bytes()
    rng = random.Random(0)
    for _ in range(200):
        damaged = bytearray(data[: rng.randrange(len(data)) if rng.random() < 0.3 else None])
        if damaged:
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        path.write_bytes(damaged)
        try:
            load_capture(tmp_path)
        except IgsrError as error:
            assert str(error).isprintable()
    path.unlink()
    with pytest.raises(IgsrError, match=r"points\.ply is missing"):
        load_capture(tmp_path)


BAD_FIELDS = [
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
    ({"w": 10**9, "h": 10**9}, r"0\.png is 48x32 pixels but its camera .* 1000000000x1000000000"),
    ({"train_filenames": ["images/9.png"]}, "train_filenames names 'images/9.png', which is no"),
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
]


@pytest.mark.parametrize(("fields", "words"), BAD_FIELDS)
def test_bad_field_is_named(fields: dict[str, Any], words: str, tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    write_json(tmp_path / "transforms.json", {**document, **fields})
    with pytest.raises(IgsrError, match=rf"transforms\.json.*{words}|{words}"):
        load_capture(tmp_path)


def skewed(pose: np.ndarray) -> np.ndarray:
    pose = pose.copy()
    pose[0, :3] += 0.1 * pose[1, :3]
    return pose


def scaled(pose: np.ndarray) -> np.ndarray:
    return pose @ np.diag([0.5, 0.5, 0.5, 1.0])


def mirrored(pose: np.ndarray) -> np.ndarray:
    return pose @ np.diag([-1.0, 1.0, 1.0, 1.0])


def with_nan(pose: np.ndarray) -> np.ndarray:
    pose = pose.copy()
    pose[1, 3] = np.nan
    return pose


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (skewed, "is not rigid: R R.T differs from the identity by 0.[01]"),
        (scaled, "is not rigid: R R.T differs from the identity by 0.75 .* uniform scale 0.5"),
        (mirrored, "is a reflection"),
        (with_nan, "holds a NaN"),
        (lambda pose: pose[:2], "must be 4 rows of 4 numbers"),
        (lambda pose: pose[:, :3], "must be 4 rows of 4 numbers"),
        (lambda pose: 10.0**307 * pose, "is not rigid|last row|ends in the row"),
    ],
)
def test_bad_pose_is_named(change: Any, words: str, tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    pose = np.array(document["frames"][1]["transform_matrix"])
    document["frames"][1]["transform_matrix"] = change(pose).tolist()
    write_json(tmp_path / "transforms.json", document)
    with pytest.raises(
        IgsrError,
        match=rf"transforms\.json, frame 1 \(images/1\.png\): transform_matrix ({words})",
    ):
        load_capture(tmp_path)


@pytest.mark.parametrize(
    "pose", [None, "eye", [[10**400] * 4] * 4, [["0"] * 4] * 4, [[[]] * 4] * 4]
)
def test_pose_of_another_type_is_named(pose: Any, tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    document["frames"][1]["transform_matrix"] = pose
    write_json(tmp_path / "transforms.json", document)
    with pytest.raises(IgsrError, match=r"frame 1 \(images/1\.png\): transform_matrix .*numbers"):
        load_capture(tmp_path)


@pytest.mark.parametrize("key", ["frames", "fl_x"])
def test_missing_field_is_named(key: str, tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    del document[key]
    write_json(tmp_path / "transforms.json", document)
    with pytest.raises(IgsrError, match=rf"transforms\.json.*{key} .*is missing"):
        load_capture(tmp_path)


@pytest.mark.parametrize("key", ["file_path", "transform_matrix"])
def test_missing_frame_field_is_named(key: str, tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    del document["frames"][1][key]
    write_json(tmp_path / "transforms.json", document)
    with pytest.raises(IgsrError, match=rf"transforms\.json, frame 1.*{key} is missing"):
        load_capture(tmp_path)


@pytest.mark.parametrize(
    ("file_path", "words"),
    [
        ("images/9.png", r"images/9\.png is missing"),
        ("../../../../../../../../etc", "is missing"),
        ("/dev/null", "is missing"),
        ("a" * 5000, "is missing"),
        ("images/0.png", "two cameras for the image images/0.png"),
        ("./images//0", "two cameras for the image images/0.png"),
        ("", "file_path must be a file's path"),
        (7, "file_path must be a file's path"),
        ("a\0b", "file_path must be a file's path"),
        ("a\ud800b", "file_path must be a file's path"),
    ],
)
def test_bad_file_path_is_named(file_path: Any, words: str, tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    document["frames"][1]["file_path"] = file_path
    write_json(tmp_path / "transforms.json", document)
    with pytest.raises(IgsrError, match=words):
        load_capture(tmp_path)


def test_bad_masks_are_named(tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    document["frames"][1]["mask_path"] = "masks/1.png"
    write_json(tmp_path / "transforms.json", document)
    with pytest.raises(IgsrError, match=r"frame 1 \(images/1\.png\): the mask .* is missing"):
        load_capture(tmp_path)
    save(tmp_path / "masks/1.png", np.zeros((HEIGHT, WIDTH // 2), dtype=np.uint8))
    with pytest.raises(IgsrError, match=r"masks/1\.png is 24x32 .* 48x32; resize the mask"):
        load_capture(tmp_path)


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
def test_malformed_json(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(IgsrError, match=rf"transforms\.json is {words}"):
        load_capture(tmp_path)


def test_blender_file_without_angle(tmp_path: Path) -> None:
    write_blender(tmp_path)
    path = tmp_path / "transforms_test.json"
    for angle, words in ((None, "fl_x or camera_angle_x is missing"), (3.2, "between 0 and pi")):
        document = json.loads(path.read_text())
        del document["camera_angle_x"]
        write_json(path, document if angle is None else {**document, "camera_angle_x": angle})
        with pytest.raises(IgsrError, match=rf"transforms_test\.json, frame 0 .*{words}"):
            load_capture(tmp_path)
        write_json(path, {**document, "camera_angle_x": ANGLE})


def test_same_photo_for_training_and_test(tmp_path: Path) -> None:
    write_blender(tmp_path)
    (tmp_path / "transforms_test.json").write_bytes(
        (tmp_path / "transforms_train.json").read_bytes()
    )
    with pytest.raises(
        IgsrError, match=r"two cameras .*r_0.png \(transforms_train.json and transforms_test.json"
    ):
        load_capture(tmp_path)


def test_random_damage_never_does_more_than_raise(tmp_path: Path) -> None:
    write_transforms(tmp_path, 2, k1=0.01, camera_model="OPENCV")
    path = tmp_path / "transforms.json"
    data = path.read_bytes()
    rng = random.Random(0)
    for _ in range(300):
        damaged = bytearray(data)
        for _ in range(rng.randint(1, 3)):
            damaged[rng.randrange(len(data))] = rng.choice(b'0123456789-+eE.,:[]{}"ntf \xff')
        path.write_bytes(damaged)
        try:
            load_capture(tmp_path)
        except IgsrError as error:
            assert str(error).isprintable()
