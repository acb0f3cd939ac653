"""The plan of a fit in blocks: cells, their photos, and the visible parts of photos."""

import multiprocessing
import os
import struct
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes import round_splats

import igsr
from igsr._internal.peak_memory import peak_bytes
from igsr.blocks import plan as block_plan
from igsr.blocks import visibility
from igsr.blocks.cells import Grid, grid_of, ground_axes, split_into_cells
from igsr.blocks.crops import WHOLE, Box, box_around, cropped
from igsr.blocks.manifest import Manifest, file_mark, read_manifest
from igsr.blocks.plan import blocks_for_memory, memory_of, plan_blocks
from igsr.blocks.tasks import BlockOptions, Context, Region, coarse_task
from igsr.capture import Camera, View
from igsr.capture.photos import PhotoHeader, Shot
from igsr.capture.types import intrinsic_matrix
from igsr.capture.undistort import Lens
from igsr.fitting.photo_statistics import photo_statistics
from igsr_lab.large_scenes import towns


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    capture = towns.town(2, 1, 6, 32, 24, points=100, sharp=1)
    return capture, towns.written(capture, tmp_path_factory.mktemp("town") / "capture")


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 9])
def test_cells_have_equal_numbers_of_cameras_and_cover_the_plane(count):
    random = np.random.default_rng(count)
    places = random.normal(size=(91, 2)) * [5.0, 1.0]
    cells = split_into_cells(places, count)
    assert len(cells) == count
    held = np.stack([cell.contains(places) for cell in cells])
    assert (held.sum(axis=0) == 1).all()
    counts = held.sum(axis=1)
    assert counts.max() - counts.min() <= 2
    far = random.uniform(-1e6, 1e6, (1000, 2))
    assert (np.stack([cell.contains(far) for cell in cells]).sum(axis=0) == 1).all()


def test_the_longer_side_is_split():
    places = np.stack([np.arange(10.0), np.zeros(10)], axis=1)
    left, right = split_into_cells(places, 2)
    assert left.high == (4.5, np.inf)
    assert right.low == (4.5, -np.inf)
    assert left.side == (4.5, 0.0)
    wide = left.expanded()
    assert wide.high[0] == pytest.approx(4.5 + 0.1 * 4.5)
    assert wide.low == (-np.inf, -np.inf)
    assert left.plain() == {"low": [None, None], "high": [4.5, None], "side": [4.5, 0.0]}


def test_photos_at_one_place_stay_together():
    places = np.repeat([[0.0, 0.0], [1.0, 0.0]], [7, 3], axis=0)
    left, right = split_into_cells(places, 2)
    assert left.contains(places).sum() == 7
    assert right.contains(places).sum() == 3
    with pytest.raises(igsr.IgsrError, match=r"3 photos at 1 places .* fewer --blocks"):
        split_into_cells(places, 3)
    with pytest.raises(igsr.IgsrError, match="5 photos at 1 places"):
        split_into_cells(np.zeros((5, 2)), 2)
    with pytest.raises(igsr.IgsrError, match="5 blocks need at least as many photos"):
        split_into_cells(places[:4], 5)


def camera(center, up=(0.0, -1.0, 0.0), forward=(0.0, 0.0, 1.0)):
    z = np.array(forward)
    x = np.cross(-np.array(up), z)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([x, np.cross(z, x), z])
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    return Camera(viewmat, intrinsic_matrix(50.0, 50.0, 16.0, 12.0), 32, 24)


@pytest.mark.parametrize(
    ("spread", "looks_down"),
    [((5, 0.1, 4), True), ((9, 0.01, 0.01), False), ((3, 3, 3), False), ((0, 0, 0), False)],
)
def test_the_ground_is_level(spread, looks_down):
    centers = np.random.default_rng(3).normal(size=(60, 3)) * spread
    # Cameras that look down, as of a drone, do not have the scene's up direction.
    axes_of_camera = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)) if looks_down else ()
    axes = ground_axes([camera(center, *axes_of_camera) for center in centers])
    assert axes @ axes.T == pytest.approx(np.eye(2), abs=1e-9)
    assert np.abs(axes[:, 1]).max() < 0.1


def test_photos_are_assigned_to_the_blocks_that_they_show():
    visible = np.array([[0.9, 0.3], [0.3, 0.6], [0.01, 0.1], [0.08, 0.09], [0.0, 0.0]])
    is_near = np.array([[True, False]] * 4 + [[True, True]])
    assert block_plan.assign_photos(visible, is_near).tolist() == [
        [True, True],
        [True, True],
        [False, True],  # the nearer block is hardly visible
        [True, False],
        [False, False],
    ]
    visible[0, 1] = 0.0
    across = block_plan.photos_across_seams(visible)
    assert across.tolist() == [False, True, False, False, False]


def test_parts_of_photos_are_cropped():
    random = np.random.default_rng(5)
    whole = Camera(np.eye(4), intrinsic_matrix(50.0, 60.0, 50.0, 40.0), 100, 80)
    image = random.integers(0, 256, (80, 100, 3), np.uint8)
    depth = random.uniform(1.0, 2.0, (80, 100)).astype(np.float32)
    view = View("a.png", whole, "train", image, mask=image[..., 0] > 9, depth=depth)
    part = cropped(view, Box(0.255, 0.5, 0.75, 1.0))
    assert part.image.shape == (40, 50, 3)
    assert (part.image == image[40:, 25:75]).all()
    assert (part.mask == view.mask[40:, 25:75]).all()
    assert (part.depth == depth[40:, 25:75]).all()
    assert part.image.base is None  # so that the whole photo is freed
    assert part.camera.K[:2, 2].tolist() == [25.0, 0.0]
    assert cropped(view, WHOLE) is view
    # The minimum size, also at the photo's edge; and all of a smaller photo.
    for box in (Box(0.0, 0.0, 0.01, 0.01), Box(0.99, 0.99, 1.0, 1.0), Box(0.5, 0.4, 0.5, 0.4)):
        assert cropped(view, box).image.shape == (24, 24, 3)
    assert Box(0.9, 0.9, 1.0, 1.0).size(20, 10) == (20, 10)


def test_boxes_ignore_stray_pixels():
    share = np.zeros((24, 32))
    share[6:18, 8:24] = 1.0
    assert box_around(share) == Box(7 / 32, 5 / 24, 25 / 32, 19 / 24)
    share[2, 2] = 0.5
    assert box_around(share) == Box(7 / 32, 5 / 24, 25 / 32, 19 / 24)
    assert box_around(np.zeros((24, 32))) == WHOLE
    corner = np.zeros((24, 32))
    corner[0, 31] = 1.0
    assert box_around(corner) == Box(0.75, 0.0, 1.0, 0.25)


def test_blocks_get_the_parts_of_photos_that_show_their_splats():
    splats = round_splats([[-1.0, 0.0, 4.0], [1.0, 0.5, 4.0]], size=0.15, opacity=6.0)
    inside, wanted = np.eye(2, dtype=np.bool_), np.array([[True, True], [False, True]])
    cameras = [camera([0.0, 0.0, 0.0])] * 2
    given = (splats, cameras, inside, wanted, np.array([-1, 1]), "cpu")
    first, second = visibility.visible_boxes(*given)
    assert (set(first), set(second)) == ({0, 1}, {1})
    assert first[0].right < 0.5 < first[1].left
    assert first[0].top == pytest.approx(1.0 - first[0].bottom, abs=0.05)
    assert first[1].top > 0.25
    # The block that a photo shows most of gets the pixels that show no splats, too.
    assert second[1] == WHOLE


def test_overlap_of_photos_of_different_places():
    # Photos straight down from 4 units show 2.56 x 1.92 units each, 1 unit apart.
    grid = [(float(x), float(z)) for x in range(10) for z in range(10)]
    cameras = [camera([x, -4.0, z], (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)) for x, z in grid]
    image = np.zeros((24, 32, 3), np.uint8)
    views = [View(f"{k}.png", one, "train", image) for k, one in enumerate(cameras)]
    assert photo_statistics(views, np.full(100, 4.0)).overlap == pytest.approx(2.8)
    parts = [cropped(view, Box(0.5, 0.0, 1.0, 1.0)) for view in views]
    assert photo_statistics(parts, np.full(100, 4.0)).overlap == pytest.approx(1.0)


def test_track_depths_are_those_of_the_points_that_photos_see(town):
    capture, _ = town
    depths_of = visibility.track_depths
    assert np.median(depths_of(capture.views, capture.points)) == pytest.approx(3.5, rel=0.3)
    unseen = [replace(capture.views[0], name="other.png")]
    assert depths_of(unseen, capture.points) == [0.0]
    for points in (None, replace(capture.points, tracks=None)):
        assert depths_of(capture.views, points) is None


# The coarse fit of a small scene has all of its splats.
@pytest.mark.parametrize(
    ("blocks", "splats", "size"),
    [(2, 50_000, 333), (2, 9_000_000, 333), (60, 9_000_000, 141)],
)
def test_a_coarse_fit_takes_no_more_memory_than_a_block(blocks, splats, size):
    header = PhotoHeader((1000, 750), 3)
    shots = [Shot("a", None, camera([0, 0, 0]), Lens(), "train", None, None)] * 3000
    manifest = Manifest(Path(), shots, [header] * 3000, [""] * 3000, lambda: None)
    options = BlockOptions(blocks=blocks, settings={"max_splats": splats})
    task = coarse_task(Context(Path("out"), options, manifest), None, blocks)
    assert task.max_size == size
    assert task.settings["transients"] == "off"
    if splats == 50_000:
        assert task.settings["max_splats"] == splats
        return
    photos = list(range(3000))
    coarse = memory_of(manifest, photos, size, task.settings["max_splats"])
    block = memory_of(manifest, photos[: 3600 // blocks], None, round(1.2 * splats / blocks))
    assert 0.99 * block < coarse <= block


def test_splats_that_reach_into_other_cells_belong_to_no_block():
    cells = split_into_cells(np.stack([np.arange(8.0), np.zeros(8)], axis=1), 2)
    border, side = cells[0].high[0], cells[0].side[0]
    x = [1.0, 1.0, -50.0, border - 0.1, 6.0]
    splats = round_splats(np.stack([x, np.zeros(5), [0.0, 0.0, 9.0, 0.0, 0.0]], axis=1), size=0.01)
    # The second and the last splat reach along x, the last one by its rotation.
    splats.scales[[0, 1, 4], [2, 0, 0]] = np.log(0.5 * (border - 1.0) + 0.2 * side)
    splats.scales[2:4] = np.log([[20.0], [0.1]])
    splats.quats[4] = [np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]  # x becomes z
    grid = Grid(np.eye(3)[[0, 2]], cells)
    assert grid.spanning(splats).tolist() == [False, True, False, False, False]
    assert grid.near_borders(splats, 0.1).tolist() == [False, False, False, True, False]
    block = Region(scene=None, scene_hash="", grid=grid, block=0)
    assert block.trainable(splats).tolist() == [True, False, True, True, False]
    assert block.kept(splats).tolist() == [True, False, True, True, False]
    seams = Region(scene=None, scene_hash="", grid=grid, block=None)
    assert seams.trainable(splats).tolist() == [False, False, False, True, False]
    assert seams.kept(splats).all()


def test_scene_depths_are_those_of_the_splats():
    splats = round_splats([[0.0, 0.0, 4.0]], size=3.0, opacity=6.0)
    image = np.zeros((24, 32, 3), np.uint8)
    facing = View("a.png", camera([0.0, 0.0, 0.0]), "train", image)
    away = View("b.png", camera([0.0, 0.0, 0.0], forward=(0.0, 0.0, -1.0)), "train", image)
    found = visibility.scene_depths([facing, away], splats, "cpu")
    assert found == pytest.approx([4.0, 0.0], abs=0.2)


def test_hidden_splats_are_not_visible():
    # Two walls that hide each other from a camera.
    grid = np.stack(np.meshgrid(np.linspace(-2, 2, 20), np.linspace(-2, 2, 20)), axis=-1)
    wall = np.concatenate([grid.reshape(-1, 2), np.full((400, 1), 3.0)], axis=1)
    splats = round_splats(np.concatenate([wall, wall + [0.0, 0.0, 3.0]]), size=0.2, opacity=6.0)
    cameras = [camera([0.0, 0.0, 0.0]), camera([0.0, 0.0, 9.0], forward=(0.0, 0.0, -1.0))]
    is_near = splats.means[:, 2] < 4.5
    groups = np.stack([is_near, ~is_near, np.ones(len(splats), np.bool_)], axis=1)
    shares = visibility.splat_visibility(splats, cameras, groups, "cpu")
    assert shares[0, 0] > 0.95
    assert shares[0, 1] < 0.05
    assert shares[1, 1] > 0.95
    assert shares[:, 2] == pytest.approx(1.0, abs=1e-3)


def test_track_visibility_is_that_of_the_points(town):
    capture, _ = town
    grid = grid_of([view.camera for view in capture.views], 2)
    centers = np.stack([view.camera.center for view in capture.views])
    names = [view.name for view in capture.views]
    groups = grid.inside(grid.positions(capture.points.xyz))
    shares = visibility.track_visibility(capture.points, names, groups)
    own = grid.inside(grid.positions(centers))
    assert shares.sum(axis=1) == pytest.approx(1.0)
    assert shares[own].mean() > 0.6
    assert shares[~own].mean() < 0.4
    assert visibility.track_visibility(None, names, groups).max() == 0.0


def test_a_manifest_decodes_nothing_and_marks_files(town, tmp_path, monkeypatch):
    capture, folder = town
    monkeypatch.setattr(Image.Image, "load", lambda image: pytest.fail("a photo was decoded"))
    manifest = read_manifest(folder, None, 4)
    assert [shot.name for shot in manifest.shots] == [view.name for view in capture.views]
    assert manifest.of_split("test") == [0, 4, 8]
    assert len(manifest.of_split("train")) == 9
    assert len(manifest.points().xyz) == len(capture.points.xyz)
    row = manifest.plain()[0]
    assert (row["width"], row["height"], row["split"]) == (32, 24, "test")
    assert row["mark"] == file_mark(folder / "images/0000.png")
    with pytest.raises(igsr.IgsrError, match="holdout is 1"):
        read_manifest(folder, None, 1)


def test_a_mark_depends_on_the_size_and_both_ends(tmp_path):
    path = tmp_path / "photo"
    content = bytearray(300_000)
    path.write_bytes(content)
    marks = {file_mark(path)}
    for changed in (content + b"x", b"x" + content[1:], content[:-1] + b"x"):
        path.write_bytes(changed)
        marks.add(file_mark(path))
    assert len(marks) == 4
    with pytest.raises(igsr.IgsrError, match="Cannot read"):
        file_mark(tmp_path / "none")


def test_less_memory_needs_more_blocks_and_parts_of_photos_take_less(town):
    manifest = read_manifest(town[1], None, None)
    photos = manifest.of_split("train")
    half = [Box(0.0, 0.0, 0.5, 1.0)] * len(photos)
    assert memory_of(manifest, photos, None, boxes=half) < memory_of(manifest, photos, None)
    assert blocks_for_memory(manifest, None, 1000, available=64 << 30) == 1
    assert blocks_for_memory(manifest, None, 1_000_000, available=2 << 30) > 1
    assert blocks_for_memory(manifest, None, 1_000_000, available=1) == 12


def made_up_capture(folder, count, points):
    """A COLMAP model of 12-megapixel photos along a street; all photos are one JPEG file."""
    random = np.random.default_rng(5)
    (folder / "images").mkdir(parents=True)
    (folder / "sparse/0").mkdir(parents=True)
    Image.new("RGB", (4000, 3000), (90, 120, 60)).save(folder / "one.jpg")
    for number in range(count):
        os.link(folder / "one.jpg", folder / f"images/{number:05d}.jpg")
    with open(folder / "sparse/0/cameras.bin", "wb") as file:
        file.write(struct.pack("<QIiQQ", 1, 1, 1, 4000, 3000))
        file.write(struct.pack("<4d", 3000.0, 3000.0, 2000.0, 1500.0))
    centers = np.stack(
        [np.linspace(0.0, count / 10.0, count), np.full(count, -1.6), random.uniform(-4, 4, count)],
        axis=1,
    )
    xyz = random.uniform([0.0, -6.0, 4.0], [count / 10.0, 0.0, 8.0], (points, 3))
    # Each photo sees the points that lie ahead.
    seen = [
        np.flatnonzero(np.abs(xyz[:, 0] - center[0]) < 0.4 * (xyz[:, 2] - center[2]))[:150]
        for center in centers
    ]
    with open(folder / "sparse/0/images.bin", "wb") as file:
        file.write(struct.pack("<Q", count))
        for number, (center, ids) in enumerate(zip(centers, seen, strict=True)):
            file.write(struct.pack("<I7dI", number + 1, 1.0, 0.0, 0.0, 0.0, *-center, 1))
            file.write(f"{number:05d}.jpg".encode() + b"\0")
            local = xyz[ids] - center
            rows = np.zeros(len(ids), [("xy", "<f8", 2), ("id", "<i8")])
            rows["xy"] = 3000.0 * local[:, :2] / local[:, 2:] + [2000.0, 1500.0]
            rows["id"] = ids + 1
            file.write(struct.pack("<Q", len(ids)) + rows.tobytes())
    with open(folder / "sparse/0/points3D.bin", "wb") as file:
        file.write(struct.pack("<Q", points))
        for number, place in enumerate(xyz):
            file.write(struct.pack("<Q3d3BdQ", number + 1, *place, 90, 90, 90, 0.5, 0))
    return folder


def plan_in_this_process(folder):
    """Plan blocks without decoding photos; the plan's figures, CPU seconds and peak memory."""

    def fail(image):
        raise RuntimeError("a photo was decoded")

    Image.init()
    Image.Image.load = Image.Image.draft = fail
    began = time.process_time()
    manifest = read_manifest(folder, 1000, 8)
    points = manifest.points()
    count = blocks_for_memory(manifest, 1000, None, available=16 << 30)
    grid = grid_of([manifest.shots[index].camera for index in manifest.of_split("train")], count)
    low, high = points.xyz.min(axis=0), points.xyz.max(axis=0)
    means = np.random.default_rng(0).uniform(low, high, (20_000, 3))
    plan = plan_blocks(manifest, grid, round_splats(means, size=0.14), points, "cpu")
    return {
        "seconds": time.process_time() - began,
        "peak": peak_bytes(),
        "blocks": len(grid.cells),
        "photos": plan.photos.sum(axis=0).tolist(),
        "none": int((~plan.photos.any(axis=1)).sum()),
        "test": len(manifest.of_split("test")),
    }


def planned(folder, count):
    """The plan of made-up photos, by a new process."""
    made_up_capture(folder, count, 20 * count)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(plan_in_this_process, folder).result()


def check_plan(plan, count):
    assert plan["peak"] < 1e9
    assert plan["none"] == plan["test"], "a photo to fit is in no block"
    # Blocks have their own photos and few of their neighbors'.
    assert max(plan["photos"]) < 2.0 * count / plan["blocks"]


def test_hundreds_of_photos_are_planned_without_decoding_any(tmp_path):
    check_plan(planned(tmp_path / "capture", 500), 500)


@pytest.mark.long
def test_the_time_of_a_plan_is_proportional_to_the_photos(tmp_path):
    few, many = planned(tmp_path / "few", 500), planned(tmp_path / "many", 5000)
    check_plan(many, 5000)
    assert many["seconds"] < 10.0 * few["seconds"]
