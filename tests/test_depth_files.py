"""Depth files of photos: read, undistorted, reduced and written with the capture; bad files."""

from __future__ import annotations

import numpy as np
import pytest
from capture_files import HEIGHT, WIDTH, photo, save, write_colmap, write_json, write_transforms
from PIL import Image

import igsr
from igsr import _core
from igsr.capture import load_capture
from igsr.capture.downscaling import halved, reduced_view, resampled_plane
from igsr.capture.image_files import find_depth
from igsr.capture.write_colmap import write_colmap as write_as_colmap
from igsr.capture.write_transforms import write_transforms as write_as_transforms
from igsr.errors import IgsrError

DEPTH = np.random.default_rng(3).uniform(0.5, 9.0, (HEIGHT, WIDTH)).astype(np.float32)


def with_depth(folder, name, content=None, **fields):
    """Write a capture whose second photo has the depth file ``name``."""
    write_transforms(folder, frame={"depth_file_path": name, **fields})
    path = folder / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif path.suffix == ".npy":
        np.save(path, content, allow_pickle=True)
    elif content is not None:
        Image.fromarray(content).save(path)
    return path


def depths(folder):
    return [view.depth for view in load_capture(folder).views]


def test_whole_numbers_are_millimeters_by_default(tmp_path):
    stored = np.round(DEPTH * 1000.0).astype(np.uint16)
    quarters = {"depth_unit_scale_factor": 0.25}
    for name, fields, unit in (("1.png", {}, 1e-3), ("1.npy", {}, 1e-3), ("1.tif", quarters, 0.25)):
        with_depth(tmp_path, name, stored, **fields)
        assert depths(tmp_path)[1] == pytest.approx(stored * unit, rel=1e-6)


def test_channel_z_of_an_exr(tmp_path):
    path = with_depth(tmp_path, "1.exr")
    color = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    _core.write_exr(str(path), color, np.ones_like(DEPTH), DEPTH)
    assert np.array_equal(depths(tmp_path)[1], DEPTH)
    whole = path.read_bytes()
    for end in range(0, len(whole), 97):
        path.write_bytes(whole[:end])
        with pytest.raises(IgsrError, match="cannot be read as depth"):
            load_capture(tmp_path)


def test_arrays_are_in_world_units_and_impossible_depths_unknown(tmp_path):
    stored = DEPTH.astype(np.float64)
    stored.ravel()[:6] = [np.nan, np.inf, -np.inf, 0.0, -2.0, 1e300]
    with_depth(tmp_path, "1.npy", stored)
    first, second, third = depths(tmp_path)
    assert first is third is None
    assert second.dtype == np.float32
    assert (second.ravel()[:6] == 0.0).all()
    assert np.array_equal(second.ravel()[6:], DEPTH.ravel()[6:])


@pytest.mark.parametrize("size", [(HEIGHT // 2, WIDTH // 2), (2 * HEIGHT, 2 * WIDTH)])
def test_depth_of_another_size_is_resampled(tmp_path, size):
    rows, columns = np.mgrid[: size[0], : size[1]]
    with_depth(tmp_path, "1.npy", 1.0 + rows + 1000.0 * columns)
    depth = depths(tmp_path)[1]
    at = [int((k + 0.5) * size[0] / HEIGHT) for k in range(HEIGHT)]
    assert (depth[:, 0] % 1000.0).tolist() == [1.0 + row for row in at]


def test_depth_is_reduced_with_the_photo(tmp_path):
    with_depth(tmp_path, "1.npy", DEPTH)
    view = load_capture(tmp_path).views[1]
    small = load_capture(tmp_path, max_size=WIDTH // 3).views[1]
    # Each number is one of the file's: nothing is mixed over an edge.
    for reduced in (small, reduced_view(view, 16, 10), halved(view)):
        assert reduced.depth.shape == reduced.image.shape[:2]
        assert np.isin(reduced.depth, DEPTH).all()
    assert np.array_equal(small.depth, resampled_plane(DEPTH, WIDTH // 3, small.camera.height))


def test_depth_is_undistorted(tmp_path):
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    write_transforms(tmp_path, frame={"depth_file_path": "1.npy"}, k1=0.3)
    save(tmp_path / "images/1.png", np.stack([rows, columns, 0 * rows], -1).astype(np.uint8))
    np.save(tmp_path / "1.npy", 1.0 + rows + 1000.0 * columns)
    view = load_capture(tmp_path).views[1]
    assert (view.depth[~view.mask] == 0.0).all()
    depth = view.depth[view.mask] - 1.0
    # The colors have the same numbers and are interpolated; depth is taken from the nearest pixel.
    assert np.abs(depth % 1000 - view.image[view.mask][:, 0]).max() <= 1.0
    assert np.abs(depth // 1000 - view.image[view.mask][:, 1]).max() <= 1.0
    assert len(np.unique(depth // 1000)) > WIDTH // 2


def test_depths_of_a_colmap_model(tmp_path):
    write_colmap(tmp_path)
    (tmp_path / "depths").mkdir()
    np.save(tmp_path / "depths" / "0.png.npy", DEPTH)
    Image.fromarray(np.full((HEIGHT, WIDTH), 1500, np.uint16)).save(tmp_path / "depths" / "2.png")
    first, second, third = depths(tmp_path)
    assert np.array_equal(first, DEPTH)
    assert second is None
    assert np.array_equal(third, np.full((HEIGHT, WIDTH), 1.5, np.float32))
    assert find_depth(tmp_path / "depths", "../transforms") is None


@pytest.mark.parametrize("write", [write_as_colmap, write_as_transforms])
def test_depths_are_written_and_read_back(tmp_path, write):
    with_depth(tmp_path, "1.npy", DEPTH)
    capture = load_capture(tmp_path)
    capture.views[1].depth_confidence = np.tile(np.float32([0.0, 0.5]), (HEIGHT, WIDTH // 2))
    write(capture, tmp_path / "out")
    first, second, third = depths(tmp_path / "out")
    assert first is third is None
    assert np.array_equal(second[:, 1::2], DEPTH[:, 1::2])
    assert (second[:, ::2] == 0.0).all()


HUGE_SHAPE = b"{'descr': '<f4', 'fortran_order': False, 'shape': (900000, 900000), }"


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("1.png", photo(0)[..., 0], "is an 8-bit picture"),
        ("1.png", photo(0), "is an 8-bit picture"),
        ("1.npy", DEPTH[:, : WIDTH // 2], "of another shape"),
        ("1.npy", np.zeros((2, HEIGHT, WIDTH)), r"give depth as \[H, W\]"),
        ("1.npy", np.zeros((0, WIDTH)), r"give depth as \[H, W\]"),
        ("1.npy", DEPTH.astype(complex), "holds no numbers"),
        ("1.npy", np.full((HEIGHT, WIDTH), "deep"), "holds no numbers"),
        ("1.npy", np.full((HEIGHT, WIDTH), None), "cannot be read as depth"),
        ("1.npy", b"\x93NUMPY\x01\x00v\x00{'descr': ", "cannot be read as depth"),
        ("1.npy", b"\x93NUMPY\x01\x00v\x00" + HUGE_SHAPE.ljust(118), "cannot be read as depth"),
        ("1.exr", b"v/1\x01 no more", "cannot be read as depth: file: is not an OpenEXR"),
        ("1.exr", b"", "cannot be read as depth"),
    ],
)
def test_bad_files_are_named(tmp_path, name, content, words):
    with_depth(tmp_path, name, content)
    with pytest.raises(IgsrError, match=words) as error:
        load_capture(tmp_path)
    assert name in str(error.value)


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("depth_file_path", "gone.npy", r"the depth .*gone\.npy is missing"),
        ("depth_file_path", 7, "depth_file_path"),
        *(("depth_unit_scale_factor", bad, "depth_unit") for bad in (0.0, -1.0, "deep", None, [1])),
    ],
)
def test_bad_fields_are_named(tmp_path, field, value, words):
    np.save(tmp_path / "1.npy", DEPTH)
    write_transforms(tmp_path, frame={"depth_file_path": "1.npy", field: value})
    with pytest.raises(IgsrError, match=words):
        load_capture(tmp_path)


def test_depth_of_a_panorama_is_refused(tmp_path):
    save(tmp_path / "images/0.png", photo(0, 64, 32))
    np.save(tmp_path / "0.npy", np.ones((32, 64), np.float32))
    pose = np.eye(4).tolist()
    frame = {"file_path": "images/0.png", "transform_matrix": pose, "depth_file_path": "0.npy"}
    document = {"camera_model": "EQUIRECTANGULAR", "w": 64, "h": 32, "frames": [frame]}
    write_json(tmp_path / "transforms.json", document)
    with pytest.raises(IgsrError, match="depth of a panorama or wide fisheye photo is not read"):
        load_capture(tmp_path)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"depth": DEPTH.astype(np.float64)}, "depth"),
        ({"depth": DEPTH[1:]}, "depth"),
        ({"depth": -DEPTH}, "its depth must be finite and not negative"),
        ({"depth": np.full_like(DEPTH, np.nan)}, "its depth must be finite and not negative"),
        ({"depth_confidence": np.ones_like(DEPTH)}, "depth_confidence without depth"),
        ({"depth": DEPTH, "depth_confidence": 2.0 * np.ones_like(DEPTH)}, "must lie in 0..1"),
    ],
)
def test_bad_depths_of_a_view_are_refused(tmp_path, fields, words):
    write_transforms(tmp_path)
    view = load_capture(tmp_path).views[0]
    with pytest.raises(IgsrError, match=words):
        igsr.View(view.name, view.camera, "train", view.image, **fields)
