"""Panoramas and fisheye photos of more than 120 degrees: the pinhole views that they become."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import scenes
import textured_room as room
from capture_files import opengl_pose, save, write_json
from made_up_tracks import projected
from PIL import Image
from PIL.PngImagePlugin import PngInfo

import igsr
from igsr.capture import Capture, load_capture
from igsr.capture.load import look_at
from igsr.capture.photo_folder import read_photos
from igsr.capture.rig import moved_to_side, rig_of
from igsr.capture.undistort import Lens
from igsr.capture.wide_photos import edges_join, panorama_of, panorama_of_xmp, whole_sphere
from igsr.capture.write_colmap import write_colmap
from igsr.capture.write_transforms import write_transforms
from igsr.errors import IgsrError
from igsr.geometry.similarity import similarity_between

WIDTH, HEIGHT = 256, 128
SIDES = ["front", "right", "back", "left", "up", "down"]


@pytest.fixture(scope="module")
def stands():
    return room.stands(4)


@pytest.fixture(scope="module")
def panoramas(stands):
    return [room.photo(stand, (WIDTH, HEIGHT), room.panorama(WIDTH), 2) for stand in stands]


def write(folder, photos, stands, frame=None, **fields):
    """Write a capture; ``frame`` has fields of its first frame."""
    frames = []
    for index, (photo, viewmat) in enumerate(zip(photos, stands, strict=True)):
        name = f"images/{index}.png"
        save(folder / name, photo)
        frames.append({"file_path": name, "transform_matrix": opengl_pose(viewmat)})
    frames[0] |= frame or {}
    height, width = photos[0].shape[:2]
    write_json(folder / "transforms.json", {"w": width, "h": height, **fields, "frames": frames})
    return folder


@pytest.fixture
def capture(tmp_path, panoramas, stands):
    return write(tmp_path / "capture", panoramas, stands, camera_model="EQUIRECTANGULAR")


def traced(camera):
    size = camera.width, camera.height
    return room.photo(camera.viewmat, size, room.pinhole(camera.K), 2)


def psnr(view, camera=None):
    """PSNR of a view as a photo of its camera, or of another one."""
    error = (view.image.astype(float) - traced(camera or view.camera)) ** 2
    return 10.0 * np.log10(255.0**2 / (error if view.mask is None else error[view.mask]).mean())


def test_panoramas_project_as_in_colmap():
    sphere = pycolmap.Camera.create_from_model_name(1, "EQUIRECTANGULAR", 1.0, 200, 100)
    rays = np.random.default_rng(0).normal(size=(200, 3))
    u, v, valid = whole_sphere(200, 100).places(rays)
    assert valid.all()
    expected = np.array([sphere.img_from_cam(ray) for ray in rays])
    np.testing.assert_allclose(np.stack([u, v], axis=1), expected, atol=1e-10)


def test_a_fisheye_sees_behind_itself():
    """COLMAP's fisheye ends at 90 degrees; beyond, the formula is tested."""
    lens = Lens(True, (0.02, -0.003))
    angle = np.radians([0.0, 30.0, 89.0, 100.0, 109.0])
    rays = np.stack([np.sin(angle), np.zeros(5), np.cos(angle)], axis=1)
    x, y, valid = lens.fisheye_places(7.0 * rays)
    np.testing.assert_allclose(x, angle * (1.0 + 0.02 * angle**2 - 0.003 * angle**4), atol=1e-12)
    assert valid.all()
    assert not y.any()
    # Straight behind has no unique image, and the model is not valid beyond the fold.
    assert not lens.fisheye_places(np.array([[0.0, 0.0, -1.0]]))[2].any()
    fold = np.sqrt(1.0 / 0.6)
    for offset, is_valid in ((-0.01, True), (0.01, False)):
        ray = np.array([[np.sin(fold + offset), 0.0, np.cos(fold + offset)]])
        assert Lens(True, (-0.2,)).fisheye_places(ray)[2].item() is is_valid


@pytest.mark.parametrize("max_size", [None, 50])
def test_views_of_a_panorama_equal_photos_of_pinholes(capture, stands, max_size):
    views = load_capture(capture, max_size).views
    assert [view.name for view in views[:6]] == [f"images/0.png/{side}.png" for side in SIDES]
    assert [view.rig for view in views[5:7]] == ["images/0.png", "images/1.png"]
    size = max_size or round(WIDTH / np.pi)
    for index in (0, 8, 16, 4, 5):
        view, camera = views[index], views[index].camera
        assert (camera.width, camera.height, view.mask) == (size, size, None)
        np.testing.assert_allclose(camera.K[:2], [[size / 2, 0, size / 2], [0, size / 2, size / 2]])
        # Sampling an already sampled picture blurs a little, which costs less than half a pixel.
        score = psnr(view)
        assert score > 31.0
        for offset in ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5)):
            K = camera.K.copy()
            K[:2, 2] += offset
            assert psnr(view, replace(camera, K=K)) < score - 1.0
    for index, view in enumerate(views):
        place = np.linalg.inv(stands[index // 6])[:3, 3]
        np.testing.assert_allclose(view.camera.center, place, atol=1e-12)
    axes = np.stack([view.camera.viewmat[2, :3] for view in views[:6]])
    opposite = np.eye(6)[[2, 3, 0, 1, 5, 4]]
    np.testing.assert_allclose(axes @ axes.T, np.eye(6) - opposite, atol=1e-9)


def test_whole_panoramas_are_held_out(capture):
    loaded = load_capture(capture).with_holdout(3)
    assert {view.rig for view in loaded.test_views} == {"images/0.png", "images/3.png"}
    assert (len(loaded.test_views), len(loaded.train_views)) == (12, 12)
    overview = look_at(capture)
    assert (len(overview.sizes), overview.train_photos(3)) == (24, 12)
    assert overview.decoded == [(WIDTH, HEIGHT)] * 24
    with pytest.raises(IgsrError, match="one photo only"):
        Capture(loaded.path, loaded.views[:6]).with_holdout(2)


def test_masks_and_alpha_of_panoramas(tmp_path, panoramas, stands):
    mask = np.full((HEIGHT, WIDTH), 255, dtype=np.uint8)
    mask[HEIGHT - 20 :] = 0  # the tripod
    save(tmp_path / "mask.png", mask)
    alpha = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
    alpha[:, : WIDTH // 2] = 0
    photos = [panoramas[0], np.concatenate([panoramas[1], alpha], axis=2)]
    fields = {"camera_model": "EQUIRECTANGULAR"}
    write(tmp_path, photos, stands[:2], frame={"mask_path": "mask.png"}, **fields)
    views = load_capture(tmp_path).views
    assert views[0].mask is None
    down = views[5].mask
    assert not down[down.shape[0] // 2, down.shape[1] // 2]
    assert down[0, 0]
    assert 0.3 < down.mean() < 0.9
    assert (views[7].image[..., 3] == 255).all()  # right
    assert (views[9].image[..., 3] == 0).all()  # left
    mask[HEIGHT - WIDTH // 8 - 30 :] = 0
    save(tmp_path / "mask.png", mask)
    names = [view.name for view in load_capture(tmp_path).views]
    assert names == [view.name for view in views if view is not views[5]]


# --- COLMAP -----------------------------------------------------------------------------------


def test_a_colmap_panorama_and_its_tracks(tmp_path, panoramas, stands):
    viewmat = stands[0]
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(7, "EQUIRECTANGULAR", 1.0, WIDTH, HEIGHT)
    model.add_camera_with_trivial_rig(camera)
    local = np.random.default_rng(0).normal(size=(30, 3)) * 2.0
    keypoints = np.array([camera.img_from_cam(ray) for ray in local])
    image = pycolmap.Image(name="p.png", keypoints=keypoints, camera_id=7, image_id=1)
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(viewmat[:3, :3]), viewmat[:3, 3])
    model.add_image_with_trivial_frame(image, pose)
    world = (local - viewmat[:3, 3]) @ viewmat[:3, :3]
    for index, point in enumerate(world):
        track = pycolmap.Track()
        track.add_element(1, index)
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    (tmp_path / "sparse/0").mkdir(parents=True)
    model.write_binary(tmp_path / "sparse/0")
    save(tmp_path / "images/p.png", panoramas[0])

    capture = load_capture(tmp_path)

    assert capture.views[0].name == "images/p.png/front.png"
    assert psnr(capture.views[0]) > 31.0
    np.testing.assert_allclose(capture.points.xyz, world, atol=1e-12)
    # Each point is seen in the one view that shows it, at its projection.
    tracks = capture.points.tracks
    assert sorted(tracks.point.tolist()) == list(range(30))
    cameras = {view.name: view.camera for view in capture.views}
    for view, point, xy in zip(tracks.view, tracks.point, tracks.xy, strict=True):
        place = projected(cameras[tracks.names[view]], world[[point]])
        np.testing.assert_allclose(place[0], xy, atol=1e-5)


def test_views_keep_reprojection_errors():
    """An error of a pixel to the right stays one in the middle of a view of that scale."""
    photo = whole_sphere(628, 314)
    side = rig_of(photo).sides[1]
    direction = np.array([[1.0, 0.02, 0.05]] * 2)
    u, v, _ = photo.places(direction)
    places, *_ = moved_to_side(np.stack([u + [0.0, 1.0], v], 1), direction, photo, side.camera)
    np.testing.assert_allclose(places[1] - places[0], [1.0, 0.0], atol=0.03)


@pytest.mark.parametrize("text", [False, True])
def test_rigs_survive_a_colmap_model(capture, tmp_path, text):
    loaded = load_capture(capture)
    write_colmap(loaded, tmp_path / "model", text=text)
    model = pycolmap.Reconstruction(tmp_path / "model/sparse/0")
    assert (model.num_frames(), model.num_images(), len(model.rigs)) == (4, 24, 1)
    for number, view in enumerate(loaded.views, start=1):
        # pycolmap derives the pose from the frame and the rig, not from the images file.
        pose = model.images[number].cam_from_world().matrix()
        np.testing.assert_allclose(pose, view.camera.viewmat[:3], atol=1e-9)
    rigs = Counter(view.rig for view in load_capture(tmp_path / "model").views)
    assert list(rigs.values()) == [6] * 4
    assert None not in rigs
    frames = tmp_path / f"model/sparse/0/frames.{'txt' if text else 'bin'}"
    frames.write_bytes(frames.read_bytes()[:-9])
    with pytest.raises(IgsrError, match=r"frames.* is truncated or damaged"):
        load_capture(tmp_path / "model")


def test_rigs_survive_transforms(capture, tmp_path):
    loaded = load_capture(capture)
    write_transforms(loaded, tmp_path / "again")
    again = load_capture(tmp_path / "again")
    assert [view.rig for view in again.views] == [view.rig for view in loaded.views]
    np.testing.assert_array_equal(again.views[7].image, loaded.views[7].image)


# --- fisheye ----------------------------------------------------------------------------------

SIZE = 200
FOCAL = room.fisheye_focal(SIZE, 200.0)
SHOWN = ["front", "right", "left", "up", "down"]


@pytest.fixture(scope="module")
def fisheye(stands):
    return room.photo(stands[0], (SIZE, SIZE), room.fisheye(SIZE, 200.0), 2)


def test_a_fisheye_of_200_degrees(tmp_path, stands, fisheye):
    fields = {"camera_model": "OPENCV_FISHEYE", "fl_x": FOCAL, "cx": SIZE / 2, "cy": SIZE / 2}
    views = load_capture(write(tmp_path / "a", [fisheye], stands[:1], **fields)).views
    assert [Path(view.name).stem for view in views] == SHOWN
    assert views[0].mask is None
    for view in views:
        assert psnr(view) > 33.0
    for view in views[1:]:
        assert 0.5 < view.mask.mean() < 0.65
        assert view.image[view.mask].max(axis=1).min() > 16  # no black corner
    # nerfstudio's radius crops the views before any pixel is read.
    fields["fisheye_crop_radius"] = SIZE / 2 - 1
    cropped = load_capture(write(tmp_path / "b", [fisheye], stands[:1], **fields)).views
    assert cropped[1].camera.width < 0.65 * cropped[0].camera.width
    assert psnr(cropped[1]) > 33.0


@pytest.mark.parametrize(("degrees", "count"), [(118.0, 1), (124.0, 5)])
def test_a_narrow_fisheye_stays_one_photo(tmp_path, stands, degrees, count):
    photo = np.full((120, 120, 3), 90, dtype=np.uint8)
    fields = {"fl_x": room.fisheye_focal(120, degrees), "camera_model": "OPENCV_FISHEYE"}
    write(tmp_path, [photo], stands[:1], **fields)
    assert len(load_capture(tmp_path).views) == count


def test_a_lens_file_makes_photos_fisheye(tmp_path, stands, fisheye):
    save(tmp_path / "a.png", fisheye)
    save(tmp_path / "b.png", fisheye[:100])  # of another camera
    assert len(read_photos(tmp_path)) == 2
    fields = {"camera_model": "OPENCV_FISHEYE", "w": 2 * SIZE, "h": 2 * SIZE, "fl_x": 2 * FOCAL}
    write_json(tmp_path / "lens.json", fields)
    photos = read_photos(tmp_path)
    assert [photo.name for photo in photos] == [f"a.png/{side}.png" for side in SHOWN] + ["b.png"]
    assert 0.5 < photos[1].mask.mean() < 0.65
    camera = photos[1].place.camera
    truth = traced(replace(camera, viewmat=camera.viewmat @ stands[0])).astype(float)
    assert np.abs(photos[1].image - truth)[photos[1].mask].mean() < 4.0
    for wrong, words in (
        ({"fl_x": 300.0}, "no fisheye of more than 120 degrees"),
        ({"camera_model": "FISHEYE624"}, "'FISHEYE624' is not supported"),
        ({"w": 0}, "w is 0"),
    ):
        write_json(tmp_path / "lens.json", fields | wrong)
        with pytest.raises(IgsrError, match=f"lens.json.*{words}"):
            read_photos(tmp_path)


# --- recognition --------------------------------------------------------------------------------


def xmp(projection="equirectangular", **fields):
    fields = {"ProjectionType": projection, **fields}
    inside = " ".join(f'GPano:{name}="{value}"' for name, value in fields.items())
    return f"<x:xmpmeta><rdf:RDF><rdf:Description {inside}/></rdf:RDF></x:xmpmeta>"


PART = {
    "FullPanoWidthPixels": 4000,
    "FullPanoHeightPixels": 2000,
    "CroppedAreaImageWidthPixels": 3000,
    "CroppedAreaImageHeightPixels": 1000,
    "CroppedAreaLeftPixels": 500,
    "CroppedAreaTopPixels": 400,
}


def test_xmp_of_a_part_of_a_panorama():
    part = panorama_of_xmp(xmp(**PART), 300, 100)  # reduced to a tenth
    assert (part.full_width, part.full_height, part.left, part.top) == (400, 200, 50, 40)
    u, v, valid = part.places(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.1]]))
    np.testing.assert_allclose([u[0], v[0]], [150.0, 60.0])
    assert valid.tolist() == [True, False, False]


@pytest.mark.parametrize(
    ("text", "size", "is_whole"),
    [
        (xmp(), (400, 200), True),
        ("", (400, 200), False),
        (xmp("cylindrical"), (400, 200), False),
        # Impossible numbers count as missing.
        (xmp(**PART | {"FullPanoWidthPixels": "1e99"}), (400, 200), True),
        (xmp(**PART | {"FullPanoWidthPixels": "1e99"}), (300, 100), False),
        (xmp(**PART | {"CroppedAreaTopPixels": 1500}), (400, 200), True),
        (xmp(**PART | {"CroppedAreaTopPixels": 1500}), (300, 100), False),
        # Cropped after the XMP was written.
        (xmp(**PART), (150, 100), False),
        # Too narrow to be treated as a panorama.
        (xmp(**PART | {"CroppedAreaImageWidthPixels": 1000}), (100, 100), False),
    ],
)
def test_xmp_of_whole_panoramas_and_other_photos(text, size, is_whole):
    assert panorama_of_xmp(text, *size) == (whole_sphere(400, 200) if is_whole else None)


PINHOLE = room.pinhole(np.array([[100.0, 0, 128], [0, 100.0, 64], [0, 0, 1]]))


def test_edges_that_join(panoramas, stands):
    for panorama in panoramas:
        assert edges_join(panorama)
        assert not edges_join(np.roll(panorama, 9, axis=1)[:96, : WIDTH - WIDTH // 8 * 2])
    # Pinhole photos twice as wide as high, an object on white, and sky over grass.
    for viewmat in stands:
        assert not edges_join(room.photo(viewmat, (WIDTH, HEIGHT), PINHOLE, 1))
    plain = np.full((HEIGHT, WIDTH, 3), 240, dtype=np.uint8)
    plain[40:90, 90:160] = panoramas[0][40:90, 90:160]
    assert not edges_join(plain)
    noise = np.random.default_rng(0).normal(0.0, 3.0, (HEIGHT, WIDTH, 1))
    sky = np.where(np.arange(HEIGHT)[:, None, None] < 60, 220.0, 80.0) + noise
    assert not edges_join(np.repeat(sky, 3, axis=2).clip(0, 255).astype(np.uint8))


def test_panoramas_in_a_folder_of_photos(tmp_path, panoramas):
    save(tmp_path / "a.png", panoramas[0])
    # Twice as wide as high, but no panorama.
    plain = room.photo(room.stands(1, 3)[0], (WIDTH, HEIGHT), PINHOLE, 1)
    save(tmp_path / "b.png", plain)
    # A panorama only by its XMP, and another projection by its XMP.
    Image.fromarray(plain).save(tmp_path / "c.jpg", xmp=xmp().encode())
    info = PngInfo()
    info.add_itxt("XML:com.adobe.xmp", xmp("cubestrip"))
    Image.fromarray(panoramas[1]).save(tmp_path / "d.png", pnginfo=info)
    photos = read_photos(tmp_path)
    assert Counter(photo.name[0] for photo in photos) == {"a": 6, "b": 1, "c": 6, "d": 1}
    first = photos[0]
    assert (first.name, first.place.rig) == ("a.png/front.png", "a.png")
    assert first.focal == first.image.shape[0] / 2
    np.testing.assert_array_equal(photos[6].image, plain)
    overview = look_at(tmp_path)
    assert (len(overview.sizes), overview.views, overview.train_photos(2)) == (14, [6, 1, 6, 1], 2)
    small = read_photos(tmp_path, max_size=40)[0]
    assert (small.image.shape, small.full_size) == ((40, 40, 3), first.full_size)


def test_a_damaged_panorama_is_named(tmp_path, panoramas):
    for name in "ab":
        Image.fromarray(panoramas[0]).save(tmp_path / f"{name}.jpg")
    save(tmp_path / "c.png", panoramas[1])
    data = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "a.jpg").write_bytes(data[: len(data) // 2])
    assert panorama_of(tmp_path / "a.jpg") is None
    with pytest.warns(UserWarning, match=r"a\.jpg is truncated"):
        assert len(read_photos(tmp_path)) == 12


# --- cameras --------------------------------------------------------------------------------


def test_networks_refuse_panoramas_by_name(tmp_path, panoramas):
    for name in "ab":
        save(tmp_path / f"{name}.png", panoramas[0])
    with pytest.raises(IgsrError, match=r"a\.png is a panorama.*use estimator colmap"):
        igsr.find_cameras(tmp_path, "dust3r")


@pytest.mark.long
def test_panoramas_are_placed_as_rigs(tmp_path):
    width, stands = 640, room.stands(5)
    for index, viewmat in enumerate(stands):
        photo = room.photo(viewmat, (width, width // 2), room.panorama(width), 2)
        save(tmp_path / f"photos/{index}.png", photo)
    placed = igsr.find_cameras(tmp_path / "photos", "colmap")
    assert len(placed.views) == 30
    cameras = [view.camera for view in placed.views[::6]]
    true = [replace(cameras[0], viewmat=viewmat) for viewmat in stands]
    moved = map(similarity_between(cameras, true).camera, cameras)
    off = [one.center - other.center for one, other in zip(moved, true, strict=True)]
    assert np.linalg.norm(off, axis=1).max() < 0.01  # meters
    for index, view in enumerate(placed.views):
        half = view.camera.width / 2
        np.testing.assert_array_equal(view.camera.K[:2], [[half, 0, half], [0, half, half]])
        first = placed.views[index // 6 * 6]
        np.testing.assert_allclose(view.camera.center, first.camera.center, atol=1e-9)
    write_colmap(placed, tmp_path / "kept")
    again = load_capture(tmp_path / "kept").with_holdout(5)
    assert len(again.test_views) == 6


def test_a_joint_fit_moves_whole_panoramas(capture):
    loaded = load_capture(capture, 32)
    options = {"backend": "cpu", "poses": "joint", "start": "random", "max_splats": 500}
    _, fitted = scenes.fit_with_cameras(loaded, steps=60, **options)
    before, after = (
        np.stack([view.camera.viewmat for view in some.views]).reshape(4, 6, 4, 4)
        for some in (loaded, fitted)
    )
    assert np.abs(before[:, 0] - after[:, 0]).max() > 1e-4
    within = [poses @ np.linalg.inv(poses[:, :1]) for poses in (before, after)]
    np.testing.assert_allclose(within[0], within[1], atol=1e-9)
    with pytest.raises(IgsrError, match='whose focal length is known; leave focal "fixed"'):
        scenes.fit(loaded, steps=2, focal="shared")
