"""Panoramas and fisheye photos of more than 120 degrees: the pinhole views that they become."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import textured_room as room
from capture_files import opengl_pose, save, write_json
from PIL import Image
from PIL.PngImagePlugin import PngInfo

import igsr
from igsr.capture import Capture, load_capture
from igsr.capture.overview import look_at
from igsr.capture.photo_folder import load_photos
from igsr.capture.rig import moved_to_side, rig_of
from igsr.capture.undistort import Lens
from igsr.capture.wide_photos import (
    WideFisheye,
    edges_join,
    field_of_view,
    panorama_of,
    panorama_of_xmp,
    whole_sphere,
)
from igsr.capture.write_colmap import write_colmap
from igsr.capture.write_transforms import write_transforms
from igsr.errors import IgsrError
from igsr.pose.find_cameras import estimate

WIDTH = 256
SIDES = ["front", "right", "back", "left", "up", "down"]


@pytest.fixture(scope="module")
def stands() -> list[np.ndarray]:
    return room.stands(4)


@pytest.fixture(scope="module")
def panoramas(stands: list[np.ndarray]) -> list[np.ndarray]:
    return [room.photo(one, (WIDTH, WIDTH // 2), room.panorama(WIDTH), 2) for one in stands]


def write(folder: Path, photos: list[np.ndarray], stands: list[np.ndarray], **fields: Any) -> Path:
    frames = []
    for index, (photo, viewmat) in enumerate(zip(photos, stands, strict=True)):
        save(folder / f"images/{index}.png", photo)
        frames.append(
            {"file_path": f"images/{index}.png", "transform_matrix": opengl_pose(viewmat)}
        )
    height, width = photos[0].shape[:2]
    write_json(folder / "transforms.json", {"w": width, "h": height, **fields, "frames": frames})
    return folder


@pytest.fixture
def capture(tmp_path: Path, panoramas: list[np.ndarray], stands: list[np.ndarray]) -> Path:
    return write(tmp_path / "capture", panoramas, stands, camera_model="EQUIRECTANGULAR")


def psnr(view: Any, truth: np.ndarray) -> float:
    error = (view.image.astype(float) - truth) ** 2
    return 10.0 * np.log10(255.0**2 / (error if view.mask is None else error[view.mask]).mean())


def traced(camera: Any) -> np.ndarray:
    size = camera.width, camera.height
    return room.photo(camera.viewmat, size, room.pinhole(camera.K), 2)


def random_rays(count: int, ahead: bool) -> np.ndarray:
    rays = np.random.default_rng(0).normal(size=(count, 3))
    rays[:, 2] = np.abs(rays[:, 2]) + 0.1 if ahead else rays[:, 2]
    return rays


def test_places_are_colmaps() -> None:
    sphere = pycolmap.Camera.create_from_model_name(1, "EQUIRECTANGULAR", 1.0, 200, 100)
    rays = random_rays(200, False)
    u, v, valid = whole_sphere(200, 100).places(rays)
    assert valid.all()
    expected = np.array([sphere.img_from_cam(ray) for ray in rays])
    np.testing.assert_allclose(np.stack([u, v], axis=1), expected, atol=1e-10)


def test_a_fisheye_sees_behind_itself() -> None:
    """COLMAP's own fisheye ends at 90 degrees: beyond, the formula is the test."""
    lens = Lens(True, (0.02, -0.003))
    angle = np.radians([0.0, 30.0, 89.0, 100.0, 109.0])
    rays = np.stack([np.sin(angle), np.zeros(5), np.cos(angle)], axis=1)
    x, y, valid = lens.fisheye_places(7.0 * rays)
    np.testing.assert_allclose(x, angle * (1.0 + 0.02 * angle**2 - 0.003 * angle**4), atol=1e-12)
    assert valid.all()
    assert not y.any()
    # Straight behind is a circle, and beyond the fold the model says nothing.
    assert not lens.fisheye_places(np.array([[0.0, 0.0, -1.0]]))[2].any()
    folding = Lens(True, (-0.2,))
    fold = np.sqrt(1.0 / 0.6)
    for off, seen in ((-0.01, True), (0.01, False)):
        ray = np.array([[np.sin(fold + off), 0.0, np.cos(fold + off)]])
        assert folding.fisheye_places(ray)[2].item() is seen


@pytest.mark.parametrize("max_size", [None, 50])
def test_a_panorama_becomes_what_pinholes_would_see(
    capture: Path, stands: list[np.ndarray], max_size: int | None
) -> None:
    views = load_capture(capture, max_size).views
    assert [view.name for view in views[:6]] == [f"images/0.png/{side}.png" for side in SIDES]
    assert [view.rig for view in views[5:7]] == ["images/0.png", "images/1.png"]
    size = max_size or round(WIDTH / np.pi)
    for index in (0, 8, 16, 4, 5):
        view, camera = views[index], views[index].camera
        assert (camera.width, camera.height, view.mask) == (size, size, None)
        np.testing.assert_allclose(camera.K[:2], [[size / 2, 0, size / 2], [0, size / 2, size / 2]])
        # Sampling an already sampled picture blurs a little, which costs less than half a pixel.
        score = psnr(view, traced(camera))
        assert score > 31.0
        for off in ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5)):
            K = camera.K.copy()
            K[:2, 2] += off
            assert psnr(view, traced(replace(camera, K=K))) < score - 1.0
    for index, view in enumerate(views):
        place = np.linalg.inv(stands[index // 6])[:3, 3]
        np.testing.assert_allclose(view.camera.center, place, atol=1e-12)
    turns = np.stack([view.camera.viewmat[2, :3] for view in views[:6]])
    np.testing.assert_allclose(
        turns @ turns.T, -np.eye(6)[[2, 3, 0, 1, 5, 4]] + np.eye(6), atol=1e-9
    )


def test_whole_panoramas_are_held_out(capture: Path) -> None:
    loaded = load_capture(capture).with_holdout(3)
    assert {view.rig for view in loaded.test_views} == {"images/0.png", "images/3.png"}
    assert (len(loaded.test_views), len(loaded.train_views)) == (12, 12)
    seen = look_at(capture)
    assert (len(seen.sizes), seen.train_photos(3)) == (24, 12)
    assert seen.decoded == [(WIDTH, WIDTH // 2)] * 24
    one = Capture(loaded.path, loaded.views[:6])
    with pytest.raises(IgsrError, match="one photo only"):
        one.with_holdout(2)


def test_masks_and_alpha_go_with_a_panorama(capture: Path, panoramas: list[np.ndarray]) -> None:
    mask = np.full((WIDTH // 2, WIDTH), 255, dtype=np.uint8)
    mask[WIDTH // 2 - 20 :] = 0  # the tripod
    save(capture / "mask.png", mask)
    alpha = np.concatenate([panoramas[1], np.full((WIDTH // 2, WIDTH, 1), 255, np.uint8)], axis=2)
    alpha[:, : WIDTH // 2, 3] = 0
    save(capture / "images/1.png", alpha)
    document = igsr.capture.read_transforms._read_json(capture / "transforms.json")
    document["frames"][0]["mask_path"] = "mask.png"
    write_json(capture / "transforms.json", document)
    views = load_capture(capture).views
    assert views[0].mask is None
    down = views[5].mask
    assert down is not None
    assert not down[down.shape[0] // 2, down.shape[1] // 2]
    assert down[0, 0]
    assert 0.3 < down.mean() < 0.9
    right, left = views[7].image, views[9].image
    assert (right[..., 3] == 255).all()
    assert (left[..., 3] == 0).all()


def test_a_view_that_a_mask_hides_is_left_out(capture: Path) -> None:
    mask = np.full((WIDTH // 2, WIDTH), 255, dtype=np.uint8)
    mask[WIDTH // 2 - WIDTH // 8 - 30 :] = 0
    save(capture / "masks/all.png", mask)
    document = igsr.capture.read_transforms._read_json(capture / "transforms.json")
    for frame in document["frames"]:
        frame["mask_path"] = "masks/all.png"
    write_json(capture / "transforms.json", document)
    views = load_capture(capture).views
    assert [view.name[-9:] for view in views if "down" in view.name] == []
    assert len(views) == 20


# --- COLMAP -----------------------------------------------------------------------------------


def colmap_panorama(folder: Path, panorama: np.ndarray, viewmat: np.ndarray) -> np.ndarray:
    """A model of one panorama by pycolmap that sees 30 points; returns these."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(7, "EQUIRECTANGULAR", 1.0, WIDTH, WIDTH // 2)
    model.add_camera_with_trivial_rig(camera)
    local = random_rays(30, False) * 2.0
    keypoints = np.array([camera.img_from_cam(ray) for ray in local])
    image = pycolmap.Image(name="p.png", keypoints=keypoints, camera_id=7, image_id=1)
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(viewmat[:3, :3]), viewmat[:3, 3])
    model.add_image_with_trivial_frame(image, pose)
    world = (local - viewmat[:3, 3]) @ viewmat[:3, :3]
    for index, point in enumerate(world):
        track = pycolmap.Track()
        track.add_element(1, index)
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    (folder / "sparse/0").mkdir(parents=True)
    model.write_binary(folder / "sparse/0")
    save(folder / "images/p.png", panorama)
    return world


def test_a_colmap_panorama_and_its_tracks(
    tmp_path: Path, panoramas: list[np.ndarray], stands: list[np.ndarray]
) -> None:
    world = colmap_panorama(tmp_path, panoramas[0], stands[0])
    loaded = load_capture(tmp_path)
    assert loaded.views[0].name == "images/p.png/front.png"
    assert psnr(loaded.views[0], traced(loaded.views[0].camera)) > 31.0
    points = loaded.points
    assert points is not None
    tracks = points.tracks
    assert tracks is not None
    # Every point is seen in the one view that shows it, at its projection.
    assert sorted(tracks.point.tolist()) == list(range(30))
    cameras = {view.name: view.camera for view in loaded.views}
    for view, point, xy in zip(tracks.view, tracks.point, tracks.xy, strict=True):
        camera = cameras[tracks.names[view]]
        local = camera.viewmat[:3, :3] @ points.xyz[point] + camera.viewmat[:3, 3]
        np.testing.assert_allclose((camera.K @ local)[:2] / local[2], xy, atol=1e-5)
    np.testing.assert_allclose(points.xyz, world, atol=1e-12)


def test_errors_of_observations_stay_what_they_are() -> None:
    """A place that is off by a pixel to the right is so in the middle of a view of that scale."""
    photo = whole_sphere(628, 314)
    side = rig_of(photo).sides[1]
    direction = np.array([[1.0, 0.02, 0.05]])
    u, v, _ = photo.places(direction)
    places = [
        moved_to_side(np.stack([u + right, v], 1), direction, photo, side.camera)[0][0]
        for right in (0.0, 1.0)
    ]
    np.testing.assert_allclose(places[1] - places[0], [1.0, 0.0], atol=0.03)


@pytest.mark.parametrize("text", [False, True])
def test_rigs_survive_a_colmap_model(capture: Path, tmp_path: Path, text: bool) -> None:
    loaded = load_capture(capture)
    write_colmap(loaded, tmp_path / "model", text=text)
    model = pycolmap.Reconstruction(tmp_path / "model/sparse/0")
    assert (model.num_frames(), model.num_images(), len(model.rigs)) == (4, 24, 1)
    for image, view in zip((model.images[k + 1] for k in range(24)), loaded.views, strict=True):
        expected = view.camera.viewmat[:3]
        # The pose comes from the frame and the rig here, not from the images file.
        np.testing.assert_allclose(image.cam_from_world().matrix(), expected, atol=1e-9)
    again = load_capture(tmp_path / "model")
    groups: dict[str | None, int] = {}
    for view in again.views:
        groups[view.rig] = groups.get(view.rig, 0) + 1
    assert list(groups.values()) == [6] * 4
    assert None not in groups
    # A frame that is cut short is named.
    frames = tmp_path / f"model/sparse/0/frames.{'txt' if text else 'bin'}"
    frames.write_bytes(frames.read_bytes()[:-9])
    with pytest.raises(IgsrError, match=r"frames.* is truncated or damaged"):
        load_capture(tmp_path / "model")


def test_rigs_survive_transforms(capture: Path, tmp_path: Path) -> None:
    loaded = load_capture(capture)
    write_transforms(loaded, tmp_path / "again")
    again = load_capture(tmp_path / "again")
    assert [view.rig for view in again.views] == [view.rig for view in loaded.views]
    np.testing.assert_array_equal(again.views[7].image, loaded.views[7].image)


# --- fisheye ----------------------------------------------------------------------------------


def test_a_fisheye_of_200_degrees(tmp_path: Path, stands: list[np.ndarray]) -> None:
    size = 200
    focal = room.fisheye_focal(size, 200.0)
    photo = room.photo(stands[0], (size, size), room.fisheye(size, 200.0), 2)
    fields = {"fl_x": focal, "fl_y": focal, "cx": size / 2, "cy": size / 2}
    write(tmp_path, [photo], stands[:1], camera_model="OPENCV_FISHEYE", **fields)
    views = load_capture(tmp_path).views
    # Nothing is seen of what is behind: the black corners are no part of the picture.
    assert [Path(view.name).stem for view in views] == ["front", "right", "left", "up", "down"]
    assert views[0].mask is None
    for view in views:
        assert psnr(view, traced(view.camera)) > 33.0
        if view.mask is not None:
            assert 0.5 < view.mask.mean() < 0.65
            assert view.image[view.mask].max(axis=1).min() > 16  # none of the black is left
    # nerfstudio's radius cuts the views off before any pixel is read.
    write(
        tmp_path / "cropped",
        [photo],
        stands[:1],
        camera_model="OPENCV_FISHEYE",
        fisheye_crop_radius=size / 2 - 1,
        **fields,
    )
    cropped = load_capture(tmp_path / "cropped").views
    assert [view.camera.width for view in cropped][1] < 0.65 * cropped[0].camera.width
    assert psnr(cropped[1], traced(cropped[1].camera)) > 33.0


def test_a_fisheye_that_a_pinhole_can_show_stays_one_photo(
    tmp_path: Path, stands: list[np.ndarray]
) -> None:
    for degrees, count in ((118.0, 1), (124.0, 5)):
        size = 120
        focal = room.fisheye_focal(size, degrees)
        wide = WideFisheye(size, size, focal, focal, size / 2, size / 2, Lens(True))
        assert abs(field_of_view(wide) - degrees) < 1.0
        photo = np.full((size, size, 3), 90, dtype=np.uint8)
        fields = {"fl_x": focal, "fl_y": focal, "camera_model": "OPENCV_FISHEYE"}
        write(tmp_path / str(degrees), [photo], stands[:1], **fields)
        assert len(load_capture(tmp_path / str(degrees)).views) == count


# --- recognition --------------------------------------------------------------------------------


def xmp(**fields: object) -> str:
    inside = " ".join(f'GPano:{name}="{value}"' for name, value in fields.items())
    return f"<x:xmpmeta><rdf:RDF><rdf:Description {inside}/></rdf:RDF></x:xmpmeta>"


def test_xmp_tells_a_panorama() -> None:
    sphere = {"ProjectionType": "equirectangular"}
    whole = panorama_of_xmp(xmp(**sphere), 400, 200)
    assert whole == whole_sphere(400, 200)
    part = {
        "FullPanoWidthPixels": 4000,
        "FullPanoHeightPixels": 2000,
        "CroppedAreaImageWidthPixels": 3000,
        "CroppedAreaImageHeightPixels": 1000,
        "CroppedAreaLeftPixels": 500,
        "CroppedAreaTopPixels": 400,
    }
    # The photo has been reduced to a tenth.
    cropped = panorama_of_xmp(xmp(**sphere, **part), 300, 100)
    assert cropped is not None
    assert (cropped.full_width, cropped.full_height) == (400, 200)
    assert (cropped.left, cropped.top) == (50, 40)
    u, v, valid = cropped.places(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.1]]))
    np.testing.assert_allclose([u[0], v[0]], [150.0, 60.0])
    assert valid.tolist() == [True, False, False]
    assert panorama_of_xmp("", 400, 200) is None
    assert panorama_of_xmp(xmp(ProjectionType="cylindrical"), 400, 200) is None
    # Fields that cannot be true, and a photo cut from the panorama since.
    for lie in ({"FullPanoWidthPixels": "1e99"}, {"CroppedAreaTopPixels": 1500}):
        assert panorama_of_xmp(xmp(**sphere, **(part | lie)), 300, 100) is None
        assert panorama_of_xmp(xmp(**sphere, **(part | lie)), 400, 200) == whole
    assert panorama_of_xmp(xmp(**sphere, **part), 150, 100) is None


def test_edges_that_join(panoramas: list[np.ndarray], stands: list[np.ndarray]) -> None:
    for panorama in panoramas:
        assert edges_join(panorama)
        assert not edges_join(np.roll(panorama, 9, axis=1)[:, : WIDTH - WIDTH // 8 * 2][:96])
    # Pinhole photos of twice their height, a plain one, and sky over grass.
    K = np.array([[100.0, 0, 128], [0, 100.0, 64], [0, 0, 1]])
    for viewmat in stands:
        assert not edges_join(room.photo(viewmat, (256, 128), room.pinhole(K), 1))
    plain = np.full((128, 256, 3), 240, dtype=np.uint8)
    plain[40:90, 90:160] = panoramas[0][40:90, 90:160]
    assert not edges_join(plain)
    noise = np.random.default_rng(0).normal(0.0, 3.0, (128, 256, 1))
    sky = np.where(np.arange(128)[:, None, None] < 60, 220.0, 80.0) + noise
    assert not edges_join(np.repeat(sky, 3, axis=2).clip(0, 255).astype(np.uint8))


def test_panoramas_in_a_folder_of_photos(tmp_path: Path, panoramas: list[np.ndarray]) -> None:
    save(tmp_path / "a.png", panoramas[0])
    # Of twice its height, but no panorama: left alone.
    K = np.array([[100.0, 0, 128], [0, 100.0, 64], [0, 0, 1]])
    plain = room.photo(room.stands(1, 3)[0], (WIDTH, WIDTH // 2), room.pinhole(K), 1)
    save(tmp_path / "b.png", plain)
    # One by its XMP alone, of which the edges do not join.
    Image.fromarray(plain).save(
        tmp_path / "c.jpg", xmp=xmp(ProjectionType="equirectangular").encode()
    )
    info = PngInfo()
    info.add_itxt("XML:com.adobe.xmp", xmp(ProjectionType="cubestrip"))
    Image.fromarray(panoramas[1]).save(tmp_path / "d.png", pnginfo=info)
    photos = load_photos(tmp_path)
    counts = {name: sum(one.name.startswith(name) for one in photos) for name in "abcd"}
    assert counts == {"a": 6, "b": 1, "c": 6, "d": 1}
    first = photos[0]
    assert first.place is not None
    assert (first.name, first.place.rig) == ("a.png/front.png", "a.png")
    assert first.focal == first.image.shape[0] / 2
    np.testing.assert_array_equal(next(p for p in photos if p.name == "b.png").image, plain)
    seen = look_at(tmp_path)
    assert (len(seen.sizes), seen.views, seen.train_photos(2)) == (14, [6, 1, 6, 1], 2)
    small = load_photos(tmp_path, max_size=40)[0]
    assert (small.image.shape, small.full_size) == ((40, 40, 3), first.full_size)


def test_a_damaged_photo_of_that_shape_is_named(
    tmp_path: Path, panoramas: list[np.ndarray]
) -> None:
    for name in "ab":
        Image.fromarray(panoramas[0]).save(tmp_path / f"{name}.jpg")
    save(tmp_path / "c.png", panoramas[1])
    data = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "a.jpg").write_bytes(data[: len(data) // 2])
    assert panorama_of(tmp_path / "a.jpg") is None
    with pytest.warns(UserWarning, match=r"a\.jpg is truncated"):
        assert len(load_photos(tmp_path)) == 12


def test_a_lens_beside_photos_makes_them_fisheye(tmp_path: Path, stands: list[np.ndarray]) -> None:
    size = 200
    focal = room.fisheye_focal(size, 200.0)
    photo = room.photo(stands[0], (size, size), room.fisheye(size, 200.0), 1)
    save(tmp_path / "a.png", photo)
    save(tmp_path / "b.png", photo[:100])  # of another camera
    assert len(load_photos(tmp_path)) == 2
    fields = {"camera_model": "OPENCV_FISHEYE", "w": 2 * size, "h": 2 * size, "fl_x": 2 * focal}
    write_json(tmp_path / "lens.json", fields)
    photos = load_photos(tmp_path)
    sides = ["front", "right", "left", "up", "down"]
    assert [one.name for one in photos] == [f"a.png/{side}.png" for side in sides] + ["b.png"]
    place = photos[1].place
    assert place is not None
    camera = place.camera
    seen = photos[1].mask
    assert seen is not None
    assert 0.5 < seen.mean() < 0.65
    truth = traced(replace(camera, viewmat=camera.viewmat @ stands[0])).astype(float)
    assert np.abs(photos[1].image - truth)[seen].mean() < 4.0
    for wrong, message in (
        ({"fl_x": 300.0}, "no fisheye of more than 120 degrees"),
        ({"camera_model": "FISHEYE624"}, "'FISHEYE624' is not supported"),
        ({"w": 0}, "w is 0"),
    ):
        write_json(tmp_path / "lens.json", fields | wrong)
        with pytest.raises(IgsrError, match=f"lens.json.*{message}"):
            load_photos(tmp_path)


# --- cameras --------------------------------------------------------------------------------


def test_networks_refuse_panoramas_by_name(tmp_path: Path, panoramas: list[np.ndarray]) -> None:
    for name in "ab":
        save(tmp_path / f"{name}.png", panoramas[0])
    photos = load_photos(tmp_path)
    with pytest.raises(IgsrError, match=r"a\.png is a panorama.*--estimator colmap"):
        estimate(photos, "dust3r")


@pytest.mark.long
def test_panoramas_are_placed_as_rigs(tmp_path: Path) -> None:
    width, stands = 640, room.stands(5)
    for index, viewmat in enumerate(stands):
        photo = room.photo(viewmat, (width, width // 2), room.panorama(width), 2)
        save(tmp_path / f"photos/{index}.png", photo)
    found = igsr.estimate_poses(tmp_path / "photos", "colmap")
    assert len(found.views) == 30
    centers = np.stack([view.camera.center for view in found.views[::6]])
    true = np.stack([np.linalg.inv(viewmat)[:3, 3] for viewmat in stands])
    a, b = centers - centers.mean(axis=0), true - true.mean(axis=0)
    scale = np.linalg.norm(b) / np.linalg.norm(a)
    u, _, vt = np.linalg.svd(b.T @ a)
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    assert np.linalg.norm(scale * a @ turn.T - b, axis=1).max() < 0.01  # meters
    for view in found.views:
        size = view.camera.width
        np.testing.assert_array_equal(
            view.camera.K[:2], [[size / 2, 0, size / 2], [0, size / 2, size / 2]]
        )
    for first, other in zip(found.views[::6], found.views[3::6], strict=True):
        np.testing.assert_allclose(first.camera.center, other.camera.center, atol=1e-9)
    # They are kept, and come back, as rigs.
    write_colmap(found, tmp_path / "kept")
    again = load_capture(tmp_path / "kept").with_holdout(5)
    assert len(again.test_views) == 6


def test_a_joint_fit_moves_whole_panoramas(capture: Path) -> None:
    loaded = load_capture(capture, 32)
    _, fitted = igsr.fit_with_cameras(
        loaded, steps=60, seed=0, backend="cpu", poses="joint", start="random", max_splats=500
    )
    moved = 0.0
    for k in range(0, 24, 6):
        before, after = (
            [view.camera.viewmat for view in some.views[k : k + 6]] for some in (loaded, fitted)
        )
        moved = max(moved, float(np.abs(before[0] - after[0]).max()))
        for side in range(1, 6):
            within = [pose[side] @ np.linalg.inv(pose[0]) for pose in (before, after)]
            np.testing.assert_allclose(within[0], within[1], atol=1e-9)
    assert moved > 1e-4
    with pytest.raises(IgsrError, match='focal lengths follow from its size; leave focal "fixed"'):
        igsr.fit(loaded, steps=2, focal="shared")


def test_folds_hold_whole_panoramas_out(capture: Path) -> None:
    from igsr.refinement.cross_validation import CrossValidation

    views = load_capture(capture, 32).views

    class Stages:
        def __init__(self) -> None:
            self.fitted: list[list[Any]] = []

        def fit(self, name: str, photos: list[Any], share: float, steps: float) -> Any:
            self.fitted.append(photos)
            return type("Fitted", (), {"splats": None, "shown": None})()

        def validated(self, splats: Any, held_out: list[Any]) -> list[Any]:
            return []

    stages = Stages()
    folds = CrossValidation(stages, views)._fitted()  # type: ignore[arg-type]
    for fold, kept in zip(folds, stages.fitted, strict=True):
        assert len(fold.held_out) == 6
        assert len({view.rig for view in fold.held_out}) == 1
        assert not {view.rig for view in fold.held_out} & {view.rig for view in kept}
