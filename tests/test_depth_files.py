"""Files of depth beside photos: read with the capture, undistorted, reduced, written; bad ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from capture_files import HEIGHT, WIDTH, photo, save, write_colmap, write_json, write_transforms
from PIL import Image

import igsr
from igsr import _core
from igsr.capture import load_capture
from igsr.capture.depth_files import depth_beside
from igsr.capture.downscaling import halved, reduced_view, resampled_plane
from igsr.capture.memory_check import needed_memory
from igsr.capture.write_colmap import write_colmap as write_as_colmap
from igsr.capture.write_transforms import write_transforms as write_as_transforms
from igsr.errors import IgsrError

DEPTH = np.random.default_rng(3).uniform(0.5, 9.0, (HEIGHT, WIDTH)).astype(np.float32)


def with_depth(folder: Path, name: str, **fields: object) -> Path:
    """A capture whose middle photo has the file of depth ``name``."""
    document = write_transforms(folder)
    document["frames"][1] |= {"depth_file_path": name, **fields}
    write_json(folder / "transforms.json", document)
    return folder / name


def loaded(folder: Path, **options: object) -> list[np.ndarray | None]:
    return [view.depth for view in load_capture(folder, **options).views]


def test_arrays_are_world_units(tmp_path: Path) -> None:
    np.save(with_depth(tmp_path, "1.npy"), DEPTH)
    first, second, third = loaded(tmp_path)
    assert first is None
    assert third is None
    assert second is not None
    assert second.dtype == np.float32
    assert np.array_equal(second, DEPTH)


def test_whole_numbers_are_millimetres_unless_the_capture_says_otherwise(tmp_path: Path) -> None:
    stored = np.round(DEPTH * 1000.0).astype(np.uint16)
    for name, unit in (("1.png", None), ("1.npy", None), ("1.tif", 0.25)):
        fields = {} if unit is None else {"depth_unit_scale_factor": unit}
        path = with_depth(tmp_path, name, **fields)
        np.save(path, stored) if path.suffix == ".npy" else Image.fromarray(stored).save(path)
        depth = loaded(tmp_path)[1]
        assert depth is not None
        assert depth == pytest.approx(stored * (unit or 1e-3), rel=1e-6)


def test_channel_z_of_an_exr(tmp_path: Path) -> None:
    color = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    path = with_depth(tmp_path, "1.exr")
    _core.write_exr(str(path), color, np.ones_like(DEPTH), DEPTH)
    depth = loaded(tmp_path)[1]
    assert depth is not None
    assert np.array_equal(depth, DEPTH)


def test_what_is_no_depth_is_not_known(tmp_path: Path) -> None:
    stored = DEPTH.astype(np.float64)
    stored.ravel()[:6] = [np.nan, np.inf, -np.inf, 0.0, -2.0, 1e300]
    np.save(with_depth(tmp_path, "1.npy"), stored)
    depth = loaded(tmp_path)[1]
    assert depth is not None
    assert (depth.ravel()[:6] == 0.0).all()
    assert np.array_equal(depth.ravel()[6:], DEPTH.ravel()[6:])


@pytest.mark.parametrize("size", [(HEIGHT // 2, WIDTH // 2), (2 * HEIGHT, 2 * WIDTH)])
def test_depth_of_another_size_is_brought_to_the_photo(
    tmp_path: Path, size: tuple[int, int]
) -> None:
    rows, columns = np.mgrid[: size[0], : size[1]]
    np.save(with_depth(tmp_path, "1.npy"), 1.0 + rows + 1000.0 * columns)
    depth = loaded(tmp_path)[1]
    assert depth is not None
    at = [int((k + 0.5) * size[0] / HEIGHT) for k in range(HEIGHT)]
    assert (depth[:, 0] % 1000.0).tolist() == [1.0 + row for row in at]


def test_depth_goes_with_the_photo_to_another_size(tmp_path: Path) -> None:
    np.save(with_depth(tmp_path, "1.npy"), DEPTH)
    view = load_capture(tmp_path).views[1]
    small = load_capture(tmp_path, max_size=WIDTH // 3).views[1]
    # Each is a number of the photo: nothing is mixed over an edge.
    for reduced in (small, reduced_view(view, 16, 10), halved(view)):
        assert reduced.depth is not None
        assert reduced.depth.shape == reduced.image.shape[:2]
        assert np.isin(reduced.depth, DEPTH).all()
    assert np.array_equal(small.depth, resampled_plane(DEPTH, WIDTH // 3, small.camera.height))


def test_lens_distortion_of_depth_is_undone(tmp_path: Path) -> None:
    document = write_transforms(tmp_path, k1=0.3)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    frame = document["frames"][1]
    save(tmp_path / frame["file_path"], np.stack([rows, columns, 0 * rows], -1).astype(np.uint8))
    frame["depth_file_path"] = "1.npy"
    write_json(tmp_path / "transforms.json", document)
    np.save(tmp_path / "1.npy", 1.0 + rows + 1000.0 * columns)
    view = load_capture(tmp_path).views[1]
    assert view.depth is not None
    assert view.mask is not None
    shown = view.mask
    assert (view.depth[~shown] == 0.0).all()
    depth = view.depth[shown] - 1.0
    # The photo, whose colors say the same, is interpolated; depth is that of the nearest pixel.
    assert np.abs(depth % 1000 - view.image[shown][:, 0]).max() <= 1.0
    assert np.abs(depth // 1000 - view.image[shown][:, 1]).max() <= 1.0
    assert len(np.unique(depth // 1000)) > WIDTH // 2


def test_depths_beside_a_colmap_model(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    (tmp_path / "depths").mkdir()
    np.save(tmp_path / "depths" / "0.png.npy", DEPTH)
    Image.fromarray(np.full((HEIGHT, WIDTH), 1500, np.uint16)).save(tmp_path / "depths" / "2.png")
    first, second, third = loaded(tmp_path)
    assert np.array_equal(first, DEPTH)
    assert second is None
    assert np.array_equal(third, np.full((HEIGHT, WIDTH), 1.5, np.float32))
    assert depth_beside(tmp_path / "depths", "../transforms") is None


@pytest.mark.parametrize("write", [write_as_colmap, write_as_transforms])
def test_depths_are_written_and_read_back(tmp_path: Path, write) -> None:
    np.save(with_depth(tmp_path, "1.npy"), DEPTH)
    capture = load_capture(tmp_path)
    capture.views[1].depth_confidence = np.tile(np.float32([0.0, 0.5]), (HEIGHT, WIDTH // 2))
    write(capture, tmp_path / "out")
    first, second, third = loaded(tmp_path / "out")
    assert first is None
    assert third is None
    assert np.array_equal(second[:, 1::2], DEPTH[:, 1::2])
    assert (second[:, ::2] == 0.0).all()


def test_depths_count_in_memory() -> None:
    sizes = [(1000, 750)] * 100
    for splats in (None, 1_000_000):
        # Four bytes a pixel as loaded; in a fit these, and z and confidence twice.
        extra = 100 * 1000 * 750 * (4 if splats is None else 20)
        with_depths = needed_memory(sizes, None, splats, depths=True)
        assert with_depths - needed_memory(sizes, None, splats) == extra


def bad_files() -> dict[str, tuple[str, object, str]]:
    eight_bits = photo(0)[..., 0]
    return {
        "a picture of 8 bits": ("1.png", eight_bits, "is an 8-bit picture"),
        "a color picture": ("1.png", photo(0), "is an 8-bit picture"),
        "another shape": ("1.npy", DEPTH[:, : WIDTH // 2], "of another shape"),
        "three dimensions": ("1.npy", np.zeros((2, HEIGHT, WIDTH)), "give depth as \\[H, W\\]"),
        "nothing": ("1.npy", np.zeros((0, WIDTH)), "give depth as \\[H, W\\]"),
        "complex numbers": ("1.npy", DEPTH.astype(complex), "holds no numbers"),
        "texts": ("1.npy", np.full((HEIGHT, WIDTH), "deep"), "holds no numbers"),
        "objects": ("1.npy", np.full((HEIGHT, WIDTH), None), "cannot be read as depth"),
        "no array": ("1.npy", b"\x93NUMPY\x01\x00v\x00{'descr': ", "cannot be read as depth"),
        "more than it holds": (
            "1.npy",
            b"\x93NUMPY\x01\x00v\x00"
            + b"{'descr': '<f4', 'fortran_order': False, 'shape': (900000, 900000), }".ljust(118),
            "cannot be read as depth",
        ),
        "no EXR": ("1.exr", b"v/1\x01 no more", "cannot be read as depth: file: is not an OpenEXR"),
        "nothing at all": ("1.exr", b"", "cannot be read as depth"),
    }


@pytest.mark.parametrize("name", bad_files())
def test_bad_files_are_named(tmp_path: Path, name: str) -> None:
    file, content, sentence = bad_files()[name]
    path = with_depth(tmp_path, file)
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif path.suffix == ".npy":
        np.save(path, content, allow_pickle=True)
    else:
        Image.fromarray(content).save(path)
    with pytest.raises(IgsrError, match=sentence) as raised:
        load_capture(tmp_path)
    assert file in str(raised.value)


def test_a_cut_exr_is_refused(tmp_path: Path) -> None:
    path = with_depth(tmp_path, "1.exr")
    _core.write_exr(str(path), np.zeros((HEIGHT, WIDTH, 3), np.float32), DEPTH, DEPTH)
    whole = path.read_bytes()
    for end in range(0, len(whole), 97):
        path.write_bytes(whole[:end])
        with pytest.raises(IgsrError, match="cannot be read as depth"):
            load_capture(tmp_path)


def test_bad_names_and_units_are_named(tmp_path: Path) -> None:
    with_depth(tmp_path, "gone.npy")
    with pytest.raises(IgsrError, match=r"the depth .*gone\.npy is missing"):
        load_capture(tmp_path)
    for unit in (0.0, -1.0, "deep", None, [1]):
        np.save(with_depth(tmp_path, "1.npy", depth_unit_scale_factor=unit), DEPTH)
        with pytest.raises(IgsrError, match="depth_unit_scale_factor"):
            load_capture(tmp_path)
    document = write_transforms(tmp_path)
    document["frames"][1]["depth_file_path"] = 7
    write_json(tmp_path / "transforms.json", document)
    with pytest.raises(IgsrError, match="depth_file_path"):
        load_capture(tmp_path)


def test_a_panorama_has_no_depth(tmp_path: Path) -> None:
    save(tmp_path / "images/0.png", photo(0, 64, 32))
    np.save(tmp_path / "0.npy", np.ones((32, 64), np.float32))
    frame = {
        "file_path": "images/0.png",
        "transform_matrix": np.eye(4).tolist(),
        "depth_file_path": "0.npy",
    }
    document = {"camera_model": "EQUIRECTANGULAR", "w": 64, "h": 32, "frames": [frame]}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(IgsrError, match="depth of a panorama or wide fisheye photo is not read"):
        load_capture(tmp_path)


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"depth": DEPTH.astype(np.float64)}, "depth"),
        ({"depth": DEPTH[1:]}, "depth"),
        ({"depth": -DEPTH}, "its depth must be finite and not negative"),
        ({"depth": np.full_like(DEPTH, np.nan)}, "its depth must be finite and not negative"),
        ({"depth_confidence": np.ones_like(DEPTH)}, "depth_confidence without depth"),
        ({"depth": DEPTH, "depth_confidence": 2.0 * np.ones_like(DEPTH)}, "must lie in 0..1"),
    ],
)
def test_views_with_senseless_depths_are_refused(tmp_path: Path, fields, sentence: str) -> None:
    write_transforms(tmp_path)
    view = load_capture(tmp_path).views[0]
    with pytest.raises(IgsrError, match=sentence):
        igsr.View(view.name, view.camera, "train", view.image, **fields)
