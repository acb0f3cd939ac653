"""Synthetic captures: same seed, same bits; cameras, depths and masks agree."""

import json
import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from ray_stand_in import stand_in_ray

from igsr import IgsrError
from igsr.capture import load_capture
from igsr_lab.synth import CaptureSettings, captures, mitsuba_scene, synthesize
from igsr_lab.synth.cameras import Viewpoint, at_angle, draw_rig, look_at
from igsr_lab.synth.description import Description, Material, Part
from igsr_lab.synth.materials import Materials
from igsr_lab.synth.meshes import place, sheet, superquadric
from igsr_lab.synth.mitsuba_scene import load_scene, one_threaded_mitsuba
from igsr_lab.synth.objects import OBJECTS, random_object
from igsr_lab.synth.parts import bounds
from igsr_lab.synth.skies import SKIES, UNSEEN_SKIES
from igsr_lab.synth.surroundings import draw_description
from igsr_lab.synth.textures import TEXTURES, palette

SMALL = CaptureSettings(size=24, views=3, test_views=1, spp=4)
#: Of seed 0: two scenes of the family "object" and one with surroundings, all quick to make.
LONE, OTHER, AROUND = 7, 6, 4


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a lone object and surroundings."""
    folder = tmp_path_factory.mktemp("synth")
    for first in (LONE, AROUND):
        synthesize(folder, 1, first=first, settings=SMALL)
    return folder


@pytest.fixture
def lone(made, tmp_path):
    """A folder with the lone object."""
    shutil.copytree(scene(made, LONE), scene(tmp_path, LONE))
    return tmp_path


@pytest.fixture
def small_textures(monkeypatch):
    """Drawing textures takes most of the time of drawing a scene."""
    monkeypatch.setattr("igsr_lab.synth.materials.TEXTURE_SIZE", 64)


def files(folder):
    paths = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def scene(folder, index):
    return folder / f"scene_{index:05d}"


def masks_and_depths(folder):
    for view in load_capture(folder).train_views:
        mask = np.asarray(Image.open(folder / "mask" / view.name))
        yield view, mask, np.load(folder / "depth" / Path(view.name).with_suffix(".npy"))


@pytest.mark.parametrize("angle", [5.0, 30.0, 45.0])
def test_cameras_at_an_angle_have_two_neighbors_there(angle, small_textures):
    description = draw_description(np.random.default_rng(3))
    rig = draw_rig(np.random.default_rng(0), description, 32)
    plain, positions = at_angle(rig, 1.0, np.radians(angle), 5)
    views = [plain.viewpoint(np.random.default_rng(1), position) for position in positions]
    rays = np.stack([view.camera_to_world[:3, 3] - plain.center for view in views])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    apart = np.degrees(np.arccos(rays @ rays.T - 1e-12))
    np.testing.assert_allclose([apart[k, k + 2] for k in range(3)], angle, rtol=1e-6)
    np.testing.assert_allclose([apart[k, k + 1] for k in range(4)], angle, rtol=0.05)
    assert rays[:, 2].min() > 0.0


def test_the_angle_must_be_possible():
    with pytest.raises(IgsrError, match="angle must be above 0"):
        CaptureSettings(angle=61.0)


def test_captures_load_with_the_written_cameras(made):
    for index, family, channels in ((LONE, "object", 4), (AROUND, "surroundings", 3)):
        folder = scene(made, index)
        about = json.loads((folder / "scene.json").read_text())
        assert about["family"] == family
        assert (about["recipe"]["seed"], about["recipe"]["index"]) == (0, index)
        assert about["mitsuba"]
        assert about["pyoidn"]
        capture = load_capture(folder)
        assert len(capture.train_views) == 3
        assert len(capture.test_views) == 1
        frames = json.loads((folder / "transforms_train.json").read_text())["frames"]
        for view, frame in zip(capture.train_views, frames, strict=True):
            assert view.mask is None
            assert max(view.camera.width, view.camera.height) == 24
            assert view.camera.K[0, 0] == frame["fl_x"]
            camera_to_world = np.linalg.inv(view.camera.viewmat)
            center = np.array(frame["transform_matrix"])[:3, 3]
            assert np.allclose(camera_to_world[:3, 3], center, atol=1e-12)
            assert view.image.shape == (view.camera.height, view.camera.width, channels)
            # Not black, overexposed or flat.
            assert 10 < view.image[..., :3].mean() < 245
            assert view.image[..., :3].std() > 5


def test_masks_and_depths_agree_with_alpha_and_show_only_the_objects(made):
    for view, mask, depth in masks_and_depths(scene(made, LONE)):
        alpha = view.image[..., 3]
        assert (mask == alpha).all()
        assert depth.dtype == np.float32
        # The center of a pixel may differ from its other samples at thin parts.
        assert np.isfinite(depth[alpha == 255]).mean() > 0.95
        assert np.isnan(depth[alpha == 0]).mean() > 0.95
        assert (alpha == 0).any()
        assert (alpha == 255).any()

    # With surroundings, the photo has no alpha.
    for _, mask, depth in masks_and_depths(scene(made, AROUND)):
        assert set(np.unique(mask)) == {0, 255}
        assert np.isfinite(depth[mask == 255]).all()
        assert np.isfinite(depth[mask == 0]).any()


def test_a_scene_depends_on_its_seed_and_number_only(made, tmp_path, small_textures):
    def vertices(seed):
        return draw_description(np.random.default_rng([seed, LONE, 0])).objects[0].mesh[0]

    assert np.array_equal(vertices(0), vertices(0))
    assert not np.array_equal(vertices(0), vertices(1))


def test_parallel_scenes_have_the_same_bits(made, tmp_path):
    synthesize(tmp_path, 2, first=OTHER, settings=SMALL, jobs=2)
    assert files(scene(tmp_path, LONE)) == files(scene(made, LONE))
    assert files(scene(tmp_path, LONE)) != files(scene(tmp_path, OTHER))


def test_finished_scenes_are_kept_and_unfinished_ones_removed(lone):
    before = files(lone)
    # As left by a killed process.
    unfinished = lone / f".scene_{OTHER:05d}-0000.unfinished"
    (unfinished / "new/train").mkdir(parents=True)
    (unfinished / "new/train/099.png").write_bytes(b"half")
    os.utime(unfinished, (0, 0))
    seen = []
    report = synthesize(
        lone, 2, first=OTHER, settings=SMALL, on_scene=lambda *row: seen.append(row)
    )
    assert [row["name"] for _, _, row in seen] == [f"scene_{OTHER:05d}"]
    assert [row["seconds"] is None for row in report["scenes"]] == [False, True]
    assert not unfinished.exists()
    assert "train/002.png" in files(scene(lone, OTHER))
    assert "train/099.png" not in files(scene(lone, OTHER))
    assert before.items() <= files(lone).items()


def test_scenes_made_on_ray_are_the_same(made, tmp_path, monkeypatch):
    ray = stand_in_ray(monkeypatch)
    options = {"settings": SMALL, "ray": True}
    seen = []
    report = synthesize(tmp_path, 2, first=OTHER, on_scene=lambda *row: seen.append(row), **options)
    # The stand-in does the last one first.
    assert seen == [(1, 2, report["scenes"][1]), (2, 2, report["scenes"][0])]
    assert [row["name"] for row in report["scenes"]] == ["scene_00006", "scene_00007"]
    assert files(scene(tmp_path, LONE)) == files(scene(made, LONE))
    assert not ray.running

    def broken(*given):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(captures, "_photograph", broken)
    with pytest.raises(IgsrError, match=r"Cannot write .*No space left"):
        synthesize(tmp_path, 1, first=AROUND, **options)
    assert not scene(tmp_path, AROUND).exists()


@pytest.mark.parametrize("moment", ["before", "while renaming"])
def test_two_processes_can_make_one_scene(tmp_path, monkeypatch, moment):
    # Another process is the first to finish.
    real, rename = captures._photograph, os.rename
    finished = scene(tmp_path, LONE)

    def overtaken(folder, *rest):
        document = real(folder, *rest)
        shutil.copytree(folder, finished)
        (finished / "scene.json").write_text(json.dumps(document))
        return document

    def overtaken_renaming(old, new):
        if new == finished:
            shutil.copytree(old, new)
        rename(old, new)

    if moment == "before":
        monkeypatch.setattr(captures, "_photograph", overtaken)
    else:
        monkeypatch.setattr(os, "rename", overtaken_renaming)
    synthesize(tmp_path, 1, first=LONE, settings=SMALL)
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"scene_{LONE:05d}"]
    assert len(load_capture(scene(tmp_path, LONE)).train_views) == 3


def ball_on_plane():
    ball = place(superquadric((1.0, 1.0), (0.5, 0.5, 0.5), 96), (0.0, 0.0, 0.5))
    red, gray = (Material("matte", np.array(color)) for color in ([0.8, 0.1, 0.1], [0.5] * 3))
    return Description(
        "surroundings",
        "table",
        ["ball"],
        [Part(ball, red)],
        np.ones((4, 8, 3)),
        [Part(sheet(6.0, 6.0), gray)],
        radius=0.6,
        center=np.array([0.0, 0.0, 0.5]),
    )


def photo(*given):
    return mitsuba_scene.encode(mitsuba_scene.take_photo(*given)).astype(float)


def test_lamps_are_rendered_at_their_projections():
    lamps = np.array([[0.3, 0.0, 0.2], [-0.2, 0.3, 0.0], [0.0, -0.3, -0.2]])
    viewpoints = [
        Viewpoint(look_at(np.array([2.0, 1.0, 0.7]), np.zeros(3), 0.2), 0.7, 64, 48),
        Viewpoint(look_at(np.array([-1.0, -2.0, 0.3]), np.zeros(3), -0.1), 0.9, 48, 64),
    ]
    with one_threaded_mitsuba():
        assert mitsuba_scene.camera_error(viewpoints, lamps, 0.03) < 0.05


def test_few_light_paths_are_denoised():
    description = ball_on_plane()
    rig = draw_rig(np.random.default_rng(3), description, 64)
    view = rig.viewpoint(np.random.default_rng(0), np.array([0.5, 0.5]))
    with one_threaded_mitsuba():
        loaded = load_scene(description)
        many, few, same = (photo(loaded, view, *given) for given in ((400, 1), (9, 2), (9, 2)))
    assert np.array_equal(few, same)
    error = np.square((few - many)[..., :3]).mean()
    # Without denoising, nine paths are at 34 dB.
    assert 10.0 * np.log10(255.0**2 / error) > 37.0


def test_depths_and_masks_are_exact():
    description = ball_on_plane()
    rig = draw_rig(np.random.default_rng(3), description, 48)
    rng = np.random.default_rng(0)
    views = [rig.viewpoint(rng, np.array(at)) for at in ([0.5, 0.5], [0.53, 0.6])]
    with one_threaded_mitsuba():
        loaded = load_scene(description)
        seen = [mitsuba_scene.first_hits(loaded, view) for view in views]
        colors = photo(loaded, views[0], 16, 0)
    for view, (depth, is_object) in zip(views, seen, strict=True):
        rows, columns = np.mgrid[: view.height, : view.width] + 0.5
        x = (columns - 0.5 * view.width) / view.focal
        y = (rows - 0.5 * view.height) / view.focal
        local = np.stack([x * depth, -y * depth, -depth], -1)
        world = local @ view.camera_to_world[:3, :3].T + view.camera_to_world[:3, 3]
        # The ball is of triangles, a little inside of its sphere.
        off_ball = np.linalg.norm(world - [0.0, 0.0, 0.5], axis=-1) - 0.5
        assert is_object.sum() > 50
        assert np.abs(off_ball[is_object]).max() < 2e-3
        around = np.isfinite(depth) & ~is_object
        assert around.any()
        assert np.abs(world[around][:, 2]).max() < 1e-4
    red = colors[..., 0] - colors[..., 1] > 40
    assert (red == seen[0][1]).mean() > 0.95


@pytest.mark.parametrize("name", OBJECTS)
def test_objects_are_valid_meshes(name, small_textures):
    for seed in range(2):
        rng = np.random.default_rng(seed)
        for part in OBJECTS[name](rng, Materials(rng)):
            vertices, faces, uv = part.mesh
            assert np.isfinite(vertices).all()
            assert len(uv) == len(vertices)
            assert 0 <= faces.min() <= faces.max() < len(vertices)


def test_random_objects_have_one_size(small_textures):
    for seed in range(6):
        _, parts = random_object(np.random.default_rng(seed))
        lowest, highest = bounds(parts)
        assert abs(lowest[2]) < 1e-9
        radius = np.hypot(*(highest - lowest)[:2]) / 2
        assert max(radius, 0.6 * highest[2]) >= 1.0 - 1e-9
        assert radius <= 1.0 + 1e-9


def test_textures_and_skies_are_colors():
    for name, texture in TEXTURES.items():
        rng = np.random.default_rng(1)
        picture = texture(rng, palette(rng, 0.5), 64)
        assert picture.shape == (64, 64, 3), name
        assert 0.0 <= picture.min() <= picture.max() <= 1.0, name
    for sky in {*SKIES, *UNSEEN_SKIES}:
        light = sky(np.random.default_rng(1))
        assert light.shape[1] == 2 * light.shape[0]
        assert np.isfinite(light).all()
        assert light.min() >= 0.0
        assert light.max() > 0.1


def test_scenes_are_diverse(small_textures):
    drawn = [draw_description(np.random.default_rng([7, k, 0])) for k in range(10)]
    assert {description.family for description in drawn} == {"object", "surroundings"}
    assert len({description.kind for description in drawn}) >= 4
    assert len({name for description in drawn for name in description.contents}) >= 8


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scenes", "0"], "scenes must be from 1 to 100000, not 0."),
        (["--size", "8"], "size must be from 16 to 4096, not 8."),
        (["--views", "0"], "views must be from 1 to 10000, not 0."),
        (["--test-views", "-1"], "test_views must be from 0 to 10000, not -1."),
        (["--spp", "5"], "spp must be a square such as 9, 16 or 36"),
        (["--seed", "-1"], "seed must be from 0 to"),
        (["--first", "-2"], "first must be from 0 to 1000000, not -2."),
        (["--jobs", "0"], "jobs must be from 1 to 1024, not 0."),
    ],
)
def test_numbers_out_of_range_are_refused(arguments, message, tmp_path, lab_here):
    done = lab_here("synth", "--scenes", "1", "--out", tmp_path / "out", *arguments)
    assert done.returncode == 1
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["mitsuba", "pyoidn"])
def test_a_missing_renderer_is_named(name, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(IgsrError, match=r"pip install 'igsr\[synth\]'"):
        synthesize(tmp_path, 1)


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(IgsrError, match="Cannot write"):
        synthesize(tmp_path / "file", 1, settings=SMALL)


def test_the_command_reports_finished_scenes_and_overwrites_no_others(lone, lab_here):
    given = ["synth", "--scenes", "1", "--first", LONE, "--out", lone]
    given += ["--views", "3", "--test-views", "1", "--spp", "4", "--size"]
    done = lab_here(*given, "24", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["scenes"][0]["family"] == "object"
    settings = {"size": 24, "views": 3, "test_views": 1, "spp": 4, "angle": None}
    assert report["settings"] == settings
    assert "0 made, 1 already finished" in lab_here(*given, "24").stdout
    message = "was made with size 24, not 32; give another --out"
    assert message in lab_here(*given, "32").stderr
    assert "was made with seed 0, not 5" in lab_here(*given, "24", "--seed", 5).stderr
    (scene(lone, LONE) / "scene.json").write_text("{")
    assert "is not a finished scene; delete the folder" in lab_here(*given, "24").stderr
