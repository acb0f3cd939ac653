"""Photos without cameras: formats, turned and damaged files, masks, subfolders, videos."""

from __future__ import annotations

import math
import struct
import warnings

import av
import numpy as np
import pillow_heif
import pytest
from capture_files import assert_refused, photo, save
from PIL import Image, ImageOps
from test_capture_photos import write_png

import igsr
from igsr.capture import memory_check
from igsr.capture.photo_folder import read_photos
from igsr.capture.video_frames import MIN_FRAMES, sharpest_frames
from igsr.errors import IgsrError

pillow_heif.register_heif_opener()

ORIENTATION, MAKE, MODEL, SUB_FOLDER = 0x0112, 0x010F, 0x0110, 0x8769
TAGS = {"focal35": 0xA405, "focal": 0x920A, "resolution": 0xA20E, "unit": 0xA210, "w": 0xA002}
TAGS |= {"seconds": 0x829A, "f_number": 0x829D, "iso": 0x8827}


def smooth(width=48, height=32):
    """uint8 [H, W, 3] that lossy formats change little."""
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    return np.rint(255 * np.stack([x, y, 0.5 * (x + y)], axis=-1)).astype(np.uint8)


def exif_of(orientation=1, **sub_folder):
    exif = Image.Exif()
    exif[MAKE], exif[MODEL], exif[ORIENTATION] = "Maker ", "Model\0 1", orientation
    exif.get_ifd(SUB_FOLDER).update({TAGS[name]: value for name, value in sub_folder.items()})
    return exif


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".heic", ".HEIC", ".tif"])
def test_formats(tmp_path, suffix):
    for name in ("a", "b"):
        Image.fromarray(smooth()).save(tmp_path / (name + suffix), quality=95)
    photos = read_photos(tmp_path)
    assert [photo.name for photo in photos] == ["a" + suffix, "b" + suffix]
    assert photos[0].image.dtype == np.uint8
    assert np.abs(photos[0].image.astype(int) - smooth()).mean() < 4.0
    assert (photos[0].mask, photos[0].focal, photos[0].device) == (None, None, None)


def test_sixteen_bits_and_alpha(tmp_path):
    write_png(tmp_path / "a.png", photo(2).astype(np.uint16) * 257, 2)
    save(tmp_path / "b.png", photo(3, channels=4))
    wide, alpha = read_photos(tmp_path)
    np.testing.assert_array_equal(wide.image, photo(2))
    np.testing.assert_array_equal(alpha.image, photo(3, channels=4))


def test_exif_orientation_is_applied(tmp_path):
    stored = Image.fromarray(photo(1))
    for orientation in range(1, 10):  # 9 does not exist
        stored.save(tmp_path / f"{orientation}.png", exif=exif_of(orientation))
    *turned, upright = read_photos(tmp_path)
    for orientation, read in enumerate(turned, start=1):
        with Image.open(tmp_path / f"{orientation}.png") as image:
            np.testing.assert_array_equal(read.image, np.array(ImageOps.exif_transpose(image)))
    np.testing.assert_array_equal(upright.image, photo(1))


def test_turned_heic_is_turned_once(tmp_path):
    for name in ("a.heic", "b.heic"):
        Image.fromarray(smooth()).save(tmp_path / name, exif=exif_of(6).tobytes(), quality=95)
    image = read_photos(tmp_path)[0].image
    assert image.shape == (48, 32, 3)
    assert np.abs(image.astype(int) - np.rot90(smooth(), -1)).mean() < 4.0


def test_focal_length_and_device_from_exif(tmp_path):
    focal = 26 * 500 / math.hypot(36, 24)
    # 8 mm on a plane of 1000 pixels per cm, taken at 800 pixels and reduced to 400.
    plane = {"focal": 8.0, "resolution": 1000.0, "unit": 3, "w": 800}
    expected = [
        (exif_of(focal35=26), focal),
        (exif_of(**plane), 8.0 * 1000 / 10 / 2),
        (exif_of(6, focal35=26), focal),
        # Impossible or missing: 0 and 1 mm on film, 1 mm on a small plane, a kilometer.
        *((exif_of(focal35=wrong), None) for wrong in (0, 1, 9000)),
        (exif_of(focal=1.0, resolution=110.0, unit=3, w=400), None),
        (exif_of(focal=1e6, resolution=1000.0, unit=3, w=400), None),
        (exif_of(), None),
    ]
    for index, (exif, _) in enumerate(expected):
        Image.fromarray(photo(1, 400, 300)).save(tmp_path / f"{index}.jpg", exif=exif)
    photos = read_photos(tmp_path)
    assert [photo.focal for photo in photos] == [pytest.approx(value) for _, value in expected]
    assert photos[2].image.shape == (400, 300, 3)
    assert {photo.device for photo in photos} == {"Maker Model 1"}


def test_impossible_or_damaged_exif_is_ignored(tmp_path):
    bad = ((0.0, 2.0, 100), (0.01, 0.0, 100), (0.01, 2.0, 0))
    exifs = [exif_of(seconds=t, f_number=f, iso=iso) for t, f, iso in bad]
    for index, exif in enumerate([*exifs, b"Exif\0\0II*\0\xff\xff\xff\xff"]):
        Image.fromarray(photo(1)).save(tmp_path / f"{index}.jpg", exif=exif)
    photos = read_photos(tmp_path)
    assert [photo.exposure_value for photo in photos] == [None] * 4
    assert photos[3].device is None


def test_subfolders_are_read_and_other_files_ignored(tmp_path):
    for name in ("b.png", "a/c.png", "a/d/e.JPG", ".hidden/f.png", ".g.png", "masks/b.png"):
        save(tmp_path / name, photo(1, 20 + len(name), 30))
    save(tmp_path / "masks/b.png", np.full((30, 25), 255, dtype=np.uint8))
    (tmp_path / "notes.txt").write_text("no photo")
    photos = read_photos(str(tmp_path))
    assert [photo.name for photo in photos] == ["a/c.png", "a/d/e.JPG", "b.png"]
    assert [photo.image.shape[1] for photo in photos] == [27, 29, 25]


def test_masks_by_either_name(tmp_path):
    for name in ("1.jpg", "a/2.jpg", "3.jpg"):
        save(tmp_path / "images" / name, photo(1))
    mask = np.zeros((32, 48), dtype=np.uint8)
    mask[:, 20:] = 255
    save(tmp_path / "masks/1.jpg.png", mask)
    save(tmp_path / "masks/a/2.png", 255 - mask)
    photos = {photo.name: photo for photo in read_photos(tmp_path)}
    np.testing.assert_array_equal(photos["1.jpg"].mask, mask > 0)
    np.testing.assert_array_equal(photos["a/2.jpg"].mask, mask == 0)
    assert photos["3.jpg"].mask is None
    assert {photo.name for photo in read_photos(tmp_path / "images")} == set(photos)
    save(tmp_path / "masks/3.png", mask.T)
    with pytest.warns(UserWarning, match=r"masks/3\.png is 32x48 pixels but its photo 3\.jpg"):
        assert len(read_photos(tmp_path)) == 2


@pytest.mark.parametrize("suffix", [".heic", ".jpg", ".png", ".webp"])
def test_damaged_photo_is_left_out_by_name(tmp_path, suffix):
    save(tmp_path / "a.png", photo(1))
    save(tmp_path / "c.png", photo(2))
    broken = tmp_path / ("b" + suffix)
    Image.fromarray(photo(3)).save(broken)
    whole = broken.read_bytes()
    for length in (0, 20, len(whole) // 2):
        broken.write_bytes(whole[:length])
        with pytest.warns(UserWarning, match=rf"One of 3 photos is left out: .*b\{suffix}"):
            assert [photo.name for photo in read_photos(tmp_path)] == ["a.png", "c.png"]
    random = np.random.default_rng(0)
    for _ in range(20):
        damaged = np.frombuffer(whole, np.uint8).copy()
        damaged[random.integers(0, len(whole), 12)] = random.integers(0, 256, 12)
        broken.write_bytes(damaged)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert len(read_photos(tmp_path)) in (2, 3)
    broken.write_bytes(b"no photo at all")
    for index in range(5):
        (tmp_path / f"d{index}.png").write_bytes(b"nothing")
    with pytest.warns(UserWarning, match=rf"6 of 8 .*b\{suffix} .*; so are d0\.png, .*"):
        assert len(read_photos(tmp_path)) == 2
    (tmp_path / "a.png").unlink()
    assert_refused(rf"b\{suffix} cannot be read as an image", read_photos, tmp_path)


def test_several_damaged_photos_are_one_sentence(tmp_path):
    for index in range(3):
        save(tmp_path / f"{index}.png", photo(index))
    for index in range(3, 9):
        (tmp_path / f"{index}.png").write_bytes(b"nothing")
    with pytest.warns(UserWarning, match=r"6 of 9 .*3\.png .*; so are 4\.png, .*8\.png$"):
        assert len(read_photos(tmp_path)) == 3


def test_bad_arguments(tmp_path, monkeypatch):
    for path, words in (
        (tmp_path / "nowhere", "does not exist"),
        (tmp_path / "a\0b", "cannot be read|does not exist"),
        (tmp_path, "holds no photos"),
        ([], "empty list"),
        ([tmp_path / "1.png"], "does not exist"),
    ):
        assert_refused(words, read_photos, path)
    first, second = save(tmp_path / "1.png", photo(1)), save(tmp_path / "b/2.png", photo(2))
    text = tmp_path / "a.txt"
    text.write_text("")
    for files, words in (([first, first], "given twice"), ([first, text], r"a\.txt is no photo")):
        assert_refused(words, read_photos, files)
    assert_refused("frames is 0", read_photos, tmp_path, frames=0)
    assert [photo.name for photo in read_photos([second, first])] == ["b/2.png", "1.png"]
    monkeypatch.setattr(memory_check, "available_memory", lambda: 8192)
    assert_refused(r"The 2 photos of 48x32 would need 0.0 GB and 0.0 GB are", read_photos, tmp_path)


# --- videos -------------------------------------------------------------------------------------


def write_video(path, frames):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.bit_rate = 8_000_000
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def film(count, sharp):
    """Frames of stripes, which only the frames in ``sharp`` show with full contrast."""
    stripes = np.zeros((64, 96, 3))
    stripes[:, ::8], stripes[:, 4::8] = 1.0, -1.0
    contrasts = (100.0 if index in sharp else 20.0 for index in range(count))
    return [(128.0 + contrast * stripes).astype(np.uint8) for contrast in contrasts]


def test_sharpest_frames_evenly_spaced(tmp_path):
    sharp = {7, 24, 46, 63}  # 46 and 63 are outside the middle halves of their spans of 16
    write_video(tmp_path / "clip.mp4", film(64, sharp))
    chosen = [index for index, _ in sharpest_frames(tmp_path / "clip.mp4", 4)]
    assert chosen[:2] == [7, 24]
    assert all(16 * span + 4 <= index < 16 * span + 12 for span, index in enumerate(chosen))
    photos = read_photos(tmp_path, frames=4)
    assert [photo.name for photo in photos] == [f"clip.mp4/{index:06d}.png" for index in chosen]
    assert {photo.device for photo in photos} == {"video clip.mp4"}
    assert photos[0].image.shape == (64, 96, 3)
    assert photos[0].image[:, ::8].mean() - photos[0].image[:, 4::8].mean() > 120.0
    assert len(read_photos(tmp_path / "clip.mp4", frames=1000)) == MIN_FRAMES  # a still video


def test_a_video_of_one_frame_is_one_photo(tmp_path):
    write_video(tmp_path / "clip.mp4", film(1, {0}))
    assert [photo.name for photo in read_photos(tmp_path)] == ["clip.mp4/000000.png"]
    with pytest.raises(IgsrError, match=r"at least 2 photos; there is only clip\.mp4/000000\.png"):
        igsr.find_cameras(tmp_path, "colmap")


def test_video_is_turned_by_its_header(tmp_path):
    path = tmp_path / "clip.mp4"
    frame = np.zeros((64, 96, 3), dtype=np.uint8)
    frame[:, 48:] = 255  # the right half
    write_video(path, [frame] * 4)
    data = bytearray(path.read_bytes())
    # The matrix of the track header, in 16.16 and 2.30 fixed point: a quarter turn clockwise.
    at = data.index(b"tkhd") + 4 + 40
    data[at : at + 36] = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, 64 << 16, 0, 1 << 30)
    path.write_bytes(data)
    image = read_photos(path, frames=2)[0].image
    assert image.shape == (96, 64, 3)
    assert image[:40].mean() < 30.0
    assert image[56:].mean() > 220.0


def test_damaged_videos(tmp_path):
    path = tmp_path / "clip.avi"
    write_video(path, film(40, {3}))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert 1 <= len(read_photos(path, frames=4)) <= 4  # the readable part
    for content in (b"", b"no video", whole[:100]):
        path.write_bytes(content)
        assert_refused(r"clip\.avi (cannot be read as a video|has no frame)", read_photos, path)
