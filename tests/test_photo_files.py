"""Photos, masks and skipped files of folders."""

import json
import shutil

import numpy as np
import pytest
import scenes
from PIL import Image

import igsr
from igsr.capture.load import look_at
from igsr.capture.mask_files import MASK_FOLDERS
from igsr.capture.photo_files import find_photo_files, has_photos
from igsr.capture.photo_folder import read_photos
from igsr.errors import IgsrError

MASK = np.zeros((24, 32), np.uint8)
MASK[:, :20] = 255


def photo(path, seed=0, size=(24, 32)):
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 255, (*size, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path, format="PNG")


def photos(folder, count=3, suffix=".png"):
    for index in range(count):
        photo(folder / f"{index}{suffix}", index)
    return folder


def found(folder):
    files = find_photo_files(folder)
    return [file.relative_to(files.root).as_posix() for file in files.files], files.skipped_words()


@pytest.mark.parametrize("folder", [*MASK_FOLDERS, "Masks"])
@pytest.mark.parametrize("name", ["{stem}.png", "{name}.png", "{stem}.PNG", "{stem}.jpg"])
@pytest.mark.parametrize("layout", ["inside", "next to images", "colmap", "transforms"])
def test_masks_of_every_name(tmp_path, folder, name, layout):
    made = scenes.capture(views=3, size=24)
    if layout == "inside":
        images = photos(tmp_path)
        place = tmp_path / folder
    else:
        images = photos(tmp_path / "images")
        place = tmp_path / folder
    place.mkdir()
    for file in sorted(images.glob("*.png")):
        target = place / name.format(stem=file.stem, name=file.name)
        Image.fromarray(MASK).save(target, format="PNG")
    if layout in ("inside", "next to images"):
        masks = [one.mask for one in read_photos(tmp_path)]
    else:
        K = made.views[0].camera.K
        if layout == "transforms":
            frames = [
                {"file_path": f"images/{i}.png", "transform_matrix": np.eye(4).tolist()}
                for i in range(3)
            ]
            text = {"fl_x": 30.0, "w": 32, "h": 24, "frames": frames}
            (tmp_path / "transforms.json").write_text(json.dumps(text))
        else:
            model = tmp_path / "sparse" / "0"
            model.mkdir(parents=True)
            (model / "cameras.txt").write_text("1 SIMPLE_PINHOLE 32 24 30 16 12\n")
            lines = [f"{i + 1} 1 0 0 0 {i} 0 0 1 {i}.png\n\n" for i in range(3)]
            (model / "images.txt").write_text("".join(lines))
            (model / "points3D.txt").write_text("")
        assert K.shape == (3, 3)
        masks = [view.mask for view in igsr.load_capture(tmp_path).views]
    assert all(mask is not None and np.array_equal(mask, MASK > 0) for mask in masks)


@pytest.mark.parametrize("name", ["{stem}_mask.png", "{name}.mask.png"])
def test_masks_beside_their_photos(tmp_path, name):
    photos(tmp_path)
    for stem in "01":
        file = tmp_path / name.format(stem=stem, name=f"{stem}.png")
        Image.fromarray(MASK).save(file)
    loaded = read_photos(tmp_path)
    assert [one.name for one in loaded] == ["0.png", "1.png", "2.png"]
    assert [one.mask is not None for one in loaded] == [True, True, False]
    assert "3 photos" in str(look_at(tmp_path).train) + " photos"


def test_masks_of_other_names_are_reported(tmp_path):
    photos(tmp_path)
    (tmp_path / "masks").mkdir()
    Image.fromarray(MASK).save(tmp_path / "masks" / "other.png")
    with pytest.warns(UserWarning, match=r"No mask in .*masks has the name of a photo, so"):
        read_photos(tmp_path)


def test_videos_of_live_photos_are_skipped(tmp_path):
    photos(tmp_path)
    for index in range(3):
        (tmp_path / f"{index}.MOV").write_bytes(b"")
    assert found(tmp_path) == (["0.png", "1.png", "2.png"], "3 videos named like photos")
    seen = look_at(tmp_path)
    assert (seen.train, seen.skipped) == (3, "3 videos named like photos")


@pytest.mark.parametrize(
    ("folders", "names", "skipped"),
    [
        # Polycam
        (
            {"keyframes/images": 3, "keyframes/depth": 3, "keyframes/confidence": 3},
            "keyframes/images/{}.png",
            "3 in confidence/, 3 in depth/",
        ),
        (
            {"keyframes/images": 3, "keyframes/corrected_images": 3},
            "keyframes/corrected_images/{}.png",
            "3 in images/",
        ),
        # Record3D
        ({"rgb": 3, "depth": 3, "conf": 3}, "rgb/{}.png", "3 in conf/, 3 in depth/"),
        # nerfstudio, LLFF
        (
            {"images": 3, "images_2": 3, "images_8": 3, "depths": 3, "masks": 3, ".": 1},
            "{}.png",
            "3 in depths/, 3 in images_2/, 3 in images_8/, 1 outside of images/",
        ),
        ({"images": 3, "Thumbnails": 3}, "{}.png", "3 in Thumbnails/"),
        # Cameras of a rig have photos of the same names.
        ({"a": 2, "b": 1}, None, ""),
    ],
)
def test_folders_beside_photos(tmp_path, folders, names, skipped):
    for index, (folder, count) in enumerate(folders.items()):
        for number in range(count):
            photo(tmp_path / folder / f"{number}.png", 10 * index + number)
    expected = ["a/0.png", "a/1.png", "b/0.png"]
    if names is not None:
        expected = [names.format(number) for number in range(3)]
    assert found(tmp_path) == (expected, skipped)


def test_photos_in_a_folder_of_another_name_count_if_there_are_no_others(tmp_path):
    photos(tmp_path / "depth")
    assert found(tmp_path) == (["depth/0.png", "depth/1.png", "depth/2.png"], "")


def test_what_igsr_wrote_is_no_photo(tmp_path):
    photos(tmp_path)
    before = find_photo_files(tmp_path).files
    out = tmp_path / "out"
    photo(out / "view" / "held-out" / "0.png")
    photo(out / "rounds" / "1" / "view-0.after.png", 8)
    photo(out / "views.png", 7)
    (out / "scene.ply").write_bytes(b"")
    assert find_photo_files(tmp_path).files == before
    assert found(tmp_path)[1] == "3 written by igsr"
    with pytest.raises(IgsrError, match="holds no photos besides 3 written by igsr"):
        find_photo_files(out)
    # The output of a run in the folder of its photos.
    for path in out.iterdir():
        path.rename(tmp_path / path.name)
    assert find_photo_files(tmp_path).files == before


def test_captures_in_the_folder_are_no_photos(tmp_path):
    photos(tmp_path)
    scenes.write_capture(tmp_path / "found", scenes.capture(views=3, size=24))
    photos(tmp_path / "workspace" / "images")
    (tmp_path / "workspace" / "sparse").mkdir()
    expected = ["0.png", "1.png", "2.png"]
    assert found(tmp_path) == (expected, "3 in the capture found/, 3 in the capture workspace/")
    # A splat file next to photos does not make them outputs.
    photos(tmp_path / "a")
    (tmp_path / "a" / "scene.ply").write_bytes(b"")
    assert [name for name in found(tmp_path)[0] if name.startswith("a/")]


@pytest.mark.parametrize("place", [".", "images"])
def test_what_igsr_rendered_is_no_photo(igsr_here, tmp_path, place):
    capture = scenes.capture(views=4, size=24)
    scenes.write_capture(tmp_path / "capture", capture)
    scenes.splats().save(tmp_path / "scene.ply")
    folder = photos(tmp_path / "photos")
    (folder / place).mkdir(exist_ok=True)
    video = folder / "orbit.mp4"
    cameras = ["--cameras", tmp_path / "capture", "--backend", "cpu", "--out"]
    for words in ([*cameras, folder / place], ["--orbit", 4, *cameras, video]):
        done = igsr_here("render", tmp_path / "scene.ply", *words)
        assert done.returncode == 0, done.stderr
    assert sum(path.is_file() for path in folder.rglob("*")) == 3 + 5
    assert found(folder) == (["0.png", "1.png", "2.png"], "5 rendered by igsr")
    # A folder of renders only can be fitted.
    for name in "012":
        (folder / f"{name}.png").unlink()
    assert find_photo_files(folder).files


def test_one_picture_beside_a_video_is_its_title(tmp_path):
    photo(tmp_path / "scan.png")
    (tmp_path / "scan.mp4").write_bytes(b"")
    assert found(tmp_path) == (["scan.mp4", "scan.png"], "")


def test_links_to_folders_are_followed_once(tmp_path):
    photos(tmp_path / "elsewhere")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "loop").symlink_to(tmp_path / "elsewhere")
    assert found(tmp_path / "photos") == ([f"link/{i}.png" for i in range(3)], "")
    assert has_photos(tmp_path / "photos")


@pytest.mark.parametrize(
    ("suffix", "form"),
    [
        (".heic", "JPEG"),
        (".jfif", "JPEG"),
        (".jpe", "JPEG"),
        (".mpo", "MPO"),
        (".avif", "AVIF"),
        (".png", "JPEG"),
    ],
)
def test_photos_are_read_by_content(tmp_path, suffix, form):
    pixels = np.full((24, 32, 3), 90, np.uint8)
    for name in "ab":
        more = (
            {"save_all": True, "append_images": [Image.fromarray(pixels)]} if form == "MPO" else {}
        )
        Image.fromarray(pixels).save(tmp_path / f"{name}{suffix}", format=form, **more)
    assert all(abs(int(one.image.mean()) - 90) < 3 for one in read_photos(tmp_path))


def test_raw_photos_are_named(tmp_path):
    photos(tmp_path)
    (tmp_path / "3.DNG").write_bytes(b"II*\0")
    assert found(tmp_path)[1] == "1 .dng (export them as JPEG)"
    for index in range(3):
        (tmp_path / f"{index}.png").unlink()
    message = r"holds no photos besides 1 \.dng \(export them as JPEG\)"
    for read in (find_photo_files, look_at):
        with pytest.raises(IgsrError, match=message):
            read(tmp_path)


def test_paths_from_windows(tmp_path):
    made = scenes.capture(views=4, size=24)
    scenes.write_capture(tmp_path, made)
    path = tmp_path / "transforms.json"
    document = json.loads(path.read_text())
    before = igsr.load_capture(tmp_path)
    for frame in document["frames"]:
        frame["file_path"] = frame["file_path"].replace("/", "\\")
    path.write_bytes(b"\xef\xbb\xbf" + json.dumps(document).encode())
    assert igsr.load_capture(tmp_path) == before


def test_colmap_models_from_windows(tmp_path):
    for camera in ("a", "b"):
        photos(tmp_path / "images" / camera, 2)
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    # The camera that no photo has is of an unknown model.
    cameras = "1 SIMPLE_PINHOLE 32 24 30 16 12\n2 NEW_MODEL 32 24 1 2 3\n"
    (model / "cameras.txt").write_bytes(b"\xef\xbb\xbf" + cameras.encode())
    names = [f"{camera}\\{i}.png" for camera in "ab" for i in range(2)]
    lines = [f"{i + 1} 1 0 0 0 {i} 0 0 1 {name}\r\n\r\n" for i, name in enumerate(names)]
    (model / "images.txt").write_bytes(b"\xef\xbb\xbf" + "".join(lines).encode())
    (model / "points3D.txt").write_bytes(b"\xef\xbb\xbf")
    capture = igsr.load_capture(tmp_path)
    assert [view.name for view in capture.views] == [
        f"images/{name}".replace("\\", "/") for name in names
    ]
    shutil.rmtree(tmp_path / "images" / "b")
    with pytest.raises(IgsrError, match=r"b/0\.png is missing"):
        igsr.load_capture(tmp_path)


def test_a_kept_mask_counts_in_the_first_sentence(igsr_here, tmp_path):
    made = scenes.capture(views=4, size=24)
    scenes.write_capture(tmp_path / "capture", made)
    masks = tmp_path / "capture" / "masks"
    masks.mkdir()
    for view in made.views:
        name = view.name.split("/")[-1].replace(".png", "")
        Image.fromarray(np.full((24, 24), 255, np.uint8)).save(masks / f"{name}.png")
    done = igsr_here(
        "fit", tmp_path / "capture", "--steps", 2, "--backend", "cpu", "--out", tmp_path / "out"
    )
    assert done.returncode == 0, done.stderr
    assert "Found 4 photos of 24x24, 4 of them with masks" in done.stdout + done.stderr


def write_model(folder, names, count=None):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text("1 SIMPLE_PINHOLE 32 24 30 16 12\n")
    lines = [f"{i + 1} 1 0 0 0 {i} 0 0 1 {name}\n\n" for i, name in enumerate(names[:count])]
    (folder / "images.txt").write_text("".join(lines))
    (folder / "points3D.txt").write_text("")


@pytest.mark.parametrize(
    ("there", "named"),
    [
        ("images/A plan (0).png", "A plan (0).png"),
        ("images/IMG_0.PNG", "img_0.png"),
        ("images/0.png", "0.jpg"),
        ("images/0.png", "images/0.png"),
        ("images/0.png", "C:/Users/me/scan/images/0.png"),
        ("images/a/0.png", "/home/me/images/a/0.png"),
        ("images/DCIM/0.png", "0.png"),
        ("input/0.png", "0.png"),
    ],
)
def test_names_in_colmap_models(tmp_path, there, named):
    photo(tmp_path / there)
    photo(tmp_path / there.replace("0", "1"), 1)
    write_model(tmp_path / "sparse" / "0", [named, named.replace("0", "1")])
    capture = igsr.load_capture(tmp_path)
    random = np.random.default_rng(0)
    assert np.array_equal(capture.views[0].image, random.integers(0, 255, (24, 32, 3), np.uint8))
    assert len(capture.views) == 2


def test_the_model_with_the_most_images_is_read(tmp_path):
    photos(tmp_path / "images", 5)
    names = [f"{i}.png" for i in range(5)]
    write_model(tmp_path / "sparse" / "0", names, 2)
    write_model(tmp_path / "sparse" / "1", names)
    with pytest.warns(UserWarning, match=r"sparse has 2 models; 1, with the most images, is used"):
        assert len(igsr.load_capture(tmp_path).views) == 5


@pytest.mark.parametrize(
    ("photo_name", "mask_name"),
    [
        ("../images/{}.png", "../masks/{}.png"),
        ("{}.png", "masks/{}.png"),
        ("a/{}.png", "masks/a/{}.png"),
        ("a/{}.png", "a/masks/{}.png"),
        ("a/b/{}.png", "a/mask/b/{}.jpg.png"),
    ],
)
def test_masks_of_transforms_by_name(tmp_path, photo_name, mask_name):
    folder = tmp_path / "capture"
    folder.mkdir()
    frames = []
    for number in range(2):
        photo(folder / photo_name.format(number), number)
        mask = folder / mask_name.format(number)
        mask.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(MASK).save(mask)
        name = photo_name.format(number)
        frames.append({"file_path": name, "transform_matrix": np.eye(4).tolist()})
    text = {"fl_x": 30.0, "w": 32, "h": 24, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(text))
    masks = [view.mask for view in igsr.load_capture(folder).views]
    if "jpg" in mask_name:  # of another photo
        assert masks == [None, None]
    else:
        assert all(np.array_equal(mask, MASK > 0) for mask in masks)


@pytest.mark.parametrize("name", ["images/", "/", "."])
def test_images_without_a_name_are_refused(tmp_path, name):
    photos(tmp_path / "images", 2)
    write_model(tmp_path / "sparse" / "0", [name])
    with pytest.raises(IgsrError, match="image 1 has no name"):
        igsr.load_capture(tmp_path)


def test_photos_of_another_folder_are_not_taken(tmp_path):
    photos(tmp_path / "images" / "b", 2)
    write_model(tmp_path / "sparse" / "0", ["a/0.png", "a/1.png"])
    with pytest.raises(IgsrError, match=r"a/0\.png is missing"):
        igsr.load_capture(tmp_path)


def test_absolute_names_of_files_that_exist(tmp_path):
    elsewhere = photos(tmp_path / "elsewhere", 2)
    capture = tmp_path / "capture"
    write_model(capture / "sparse" / "0", [str(elsewhere / f"{i}.png") for i in range(2)])
    assert len(igsr.load_capture(capture).views) == 2
